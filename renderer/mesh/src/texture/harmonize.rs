//! Smooth corrections on the surface: what varies slowly between two sets of colours.

use std::collections::BTreeMap;

use glam::Vec3;

/// Surface whose vertices at one place count as one.
pub(super) struct Welded {
    /// Number of the place of each vertex.
    place: Vec<u32>,
    /// Neighbouring places of each place, ascending.
    around: Vec<Vec<u32>>,
}

impl Welded {
    /// Joins vertices of equal positions; triangles with vertices out of range are ignored.
    pub fn new(positions: &[Vec3], triangles: &[[u32; 3]]) -> Self {
        let mut numbers = BTreeMap::new();
        let place: Vec<u32> = positions
            .iter()
            .map(|position| {
                let next = numbers.len() as u32;
                *numbers.entry(position.to_array().map(f32::to_bits)).or_insert(next)
            })
            .collect();
        let mut around = vec![Vec::new(); numbers.len()];
        for [a, b, c] in triangles {
            for (i, j) in [(a, b), (b, c), (c, a)] {
                let (Some(i), Some(j)) = (place.get(*i as usize), place.get(*j as usize)) else { continue };
                if i != j {
                    around[*i as usize].push(*j);
                    around[*j as usize].push(*i);
                }
            }
        }
        for row in &mut around {
            row.sort_unstable();
            row.dedup();
        }
        Self { place, around }
    }

    /// Returns the number of places.
    pub fn places(&self) -> usize {
        self.around.len()
    }

    /// Returns the place of a vertex.
    pub fn place(&self, vertex: u32) -> usize {
        self.place[vertex as usize] as usize
    }

    /// Averages weighted values over neighbours, `steps` times: a place keeps half of its own, and each step leaves `kept` of a
    /// neighbour's weight. Values without weight count nothing, so that they are filled in from around; far from any the weight
    /// fades. Returns mean and weight of each place.
    pub fn spread(&self, mut sums: Vec<(Vec3, f32)>, steps: usize, kept: f32) -> Vec<(Vec3, f32)> {
        for _ in 0..steps {
            let before = sums.clone();
            for ((sum, weight), (around, own)) in sums.iter_mut().zip(self.around.iter().zip(&before)) {
                let share = 0.5 * kept / around.len().max(1) as f32;
                *sum = own.0 * 0.5;
                *weight = own.1 * 0.5;
                for other in around.iter().map(|other| before[*other as usize]) {
                    *sum += other.0 * share;
                    *weight += other.1 * share;
                }
            }
        }
        sums.into_iter().map(|(sum, weight)| (if weight > 1e-9 { sum / weight } else { Vec3::ZERO }, weight)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    /// Compares with dense f64 matrices.
    #[test]
    fn values_spread_as_by_a_matrix() {
        let mesh = shapes::bumpy_sphere(3);
        let surface = Welded::new(&mesh.positions, &mesh.triangles);
        let count = surface.places();
        assert_eq!(count, mesh.positions.len());
        let sums: Vec<(Vec3, f32)> = (0..count)
            .map(|i| if i % 5 == 0 { (Vec3::new(i as f32, 1.0, -2.0), 1.0 + i as f32) } else { (Vec3::ZERO, 0.0) })
            .collect();
        let mut matrix = vec![vec![0.0f64; count]; count];
        for (i, row) in matrix.iter_mut().enumerate() {
            let neighbors: std::collections::BTreeSet<usize> = mesh
                .triangles
                .iter()
                .filter(|t| t.contains(&(i as u32)))
                .flatten()
                .map(|j| *j as usize)
                .filter(|j| *j != i)
                .collect();
            row[i] = 0.5;
            neighbors.iter().for_each(|j| row[*j] = 0.45 / neighbors.len() as f64);
        }
        let mut expected: Vec<[f64; 2]> = sums.iter().map(|(v, w)| [f64::from(v.x), f64::from(*w)]).collect();
        for _ in 0..4 {
            let of = |row: &Vec<f64>, k: usize| row.iter().zip(&expected).map(|(m, v)| m * v[k]).sum::<f64>();
            expected = matrix.iter().map(|row| [of(row, 0), of(row, 1)]).collect();
        }
        for ((mean, weight), [x, w]) in surface.spread(sums, 4, 0.9).into_iter().zip(expected) {
            assert!((f64::from(weight) - w).abs() < 1e-4 * (1.0 + w) && (f64::from(mean.x) - x / w).abs() < 1e-3);
        }
    }

    #[test]
    fn vertices_at_one_place_are_one_and_poison_has_no_neighbors() {
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::X, Vec3::NAN, Vec3::ZERO];
        let surface = Welded::new(&positions, &[[0, 1, 2], [5, 3, 2], [0, 1, 99], [4, 4, 4]]);
        assert_eq!(surface.places(), 4);
        assert_eq!((surface.place(1), surface.place(0)), (surface.place(3), surface.place(5)));
        let found =
            surface.spread(vec![(Vec3::ONE, 1.0), (Vec3::ZERO, 0.0), (Vec3::ZERO, 0.0), (Vec3::ZERO, 0.0)], 1, 1.0);
        assert!(found[1].0.distance(Vec3::ONE) < 1e-6 && found[3] == (Vec3::ZERO, 0.0));
        assert!(Welded::new(&[], &[]).spread(Vec::new(), 3, 1.0).is_empty());
    }
}
