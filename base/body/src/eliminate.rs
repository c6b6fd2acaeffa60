//! Even spacing by removal of points: weighted sample elimination (C. Yuksel, "Sample Elimination for
//! Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015).

use glam::Vec3;
use rayon::prelude::*;

use crate::monotone_queue::MonotoneQueue;
use crate::point_grid::PointGrid;

/// Parameters of the paper's weight function (1 - d / 2 r_max)^ALPHA, with distances below
/// 2 r_min = 2 r_max (1 - (N / M)^GAMMA) BETA taken as 2 r_min.
const ALPHA: i32 = 8;
const BETA: f32 = 0.65;
const GAMMA: f32 = 1.5;

/// Selects `keep` of the points that lie evenly on a surface of `area` square metres; returns their indices, ascending. Points
/// whose normals oppose each other lie on different sheets and do not repel each other.
///
/// Takes the points for good: with the lists of neighbours this is where a session needs the most memory.
pub(crate) fn eliminate(points: Vec<Vec3>, normals: Vec<Vec3>, keep: usize, area: f64) -> Vec<usize> {
    let count = points.len();
    if keep >= count {
        return (0..count).collect();
    }
    // Radius of the densest packing of `keep` discs.
    let r_max = (area / (2.0 * 3.0f64.sqrt() * keep as f64)).sqrt() as f32;
    let r_min = r_max * (1.0 - (keep as f32 / count as f32).powf(GAMMA)) * BETA;
    let weight = |distance: f32| (1.0 - distance.max(2.0 * r_min) / (2.0 * r_max)).max(0.0).powi(ALPHA);

    // By place in the grid, so that neighbours lie beside each other in memory.
    let grid = PointGrid::new(&points, 2.0 * r_max);
    let order = grid.order();
    let in_order = |given: Vec<Vec3>| -> Vec<Vec3> { order.iter().map(|&index| given[index as usize]).collect() };
    let (placed, normals) = (in_order(points), in_order(normals));
    let starts: Vec<usize> = (0..placed.len()).step_by(POINTS_A_TASK).collect();
    let neighbors: Vec<Neighbors> = starts
        .into_par_iter()
        .map(|start| {
            let mut found = Neighbors::default();
            grid.near_each(start..start + POINTS_A_TASK, 2.0 * r_max, |i, near| {
                let mut sum = 0.0;
                for &(j, squared) in near {
                    if j as usize != i && normals[i].dot(normals[j as usize]) > 0.0 {
                        found.list.push(j);
                        sum += weight(squared.sqrt());
                    }
                }
                found.ends.push(found.list.len());
                found.weights.push(sum);
            });
            found.list.shrink_to_fit();
            found
        })
        .collect();
    drop((grid, normals));
    let of_point = |place: usize| neighbors[place / POINTS_A_TASK].of(place % POINTS_A_TASK);
    let mut weights: Vec<f32> = neighbors.iter().flat_map(|found| &found.weights).copied().collect();
    let mut places = vec![0u32; count];
    order.iter().enumerate().for_each(|(place, &index)| places[index as usize] = place as u32);
    let mut heaviest = MonotoneQueue::new(|entry: &u64| (entry >> BITS_IN_A_BUCKET) as usize);
    places.iter().enumerate().for_each(|(index, &place)| heaviest.push(entry(weights[place as usize], index)));
    // By place.
    let mut alive = vec![true; count];
    let mut left = count;
    while left > keep {
        let Some(first) = heaviest.pop() else { break };
        let index = first as u32 as usize;
        let place = places[index] as usize;
        // Weights only fall: an outdated entry is too heavy and goes to its place.
        let now = entry(weights[place], index);
        if now > first {
            heaviest.push(now);
            continue;
        }
        alive[place] = false;
        left -= 1;
        for neighbor in of_point(place).iter().map(|&neighbor| neighbor as usize) {
            if alive[neighbor] {
                weights[neighbor] -= weight(placed[place].distance_squared(placed[neighbor]).sqrt());
            }
        }
    }
    (0..count).filter(|&i| alive[places[i] as usize]).collect()
}

/// Lowest bits of an entry that may differ within a bucket: steps of less than a hundredth of the weight.
const BITS_IN_A_BUCKET: u32 = 48;

/// Points whose neighbours one parallel task finds, in one list: a list for each point would fragment the memory.
const POINTS_A_TASK: usize = 4096;

/// Neighbours of consecutive points. The weights by which they repel each other are computed again where they are needed: stored, they
/// would take most of the memory.
#[derive(Default)]
struct Neighbors {
    /// End of each point's neighbours in `list`.
    ends: Vec<usize>,
    list: Vec<u32>,
    /// Sum of the weights of each point's neighbours.
    weights: Vec<f32>,
}

impl Neighbors {
    fn of(&self, point: usize) -> &[u32] {
        let start = if point == 0 { 0 } else { self.ends[point - 1] };
        &self.list[start..self.ends[point]]
    }
}

/// Returns a point's entry in the queue: heavier ones are lower, then those of lower index. A single number is compared and
/// moved in a fraction of the time that a pair takes.
fn entry(weight: f32, index: usize) -> u64 {
    let bits = weight.to_bits();
    let ordered = if bits >> 31 == 0 { bits | 1 << 31 } else { !bits };
    u64::from(!ordered) << 32 | index as u64
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};

    use super::*;

    #[test]
    fn the_heaviest_point_comes_first_then_the_lowest_index() {
        let weights = [-2.0f32, -1e-9, -0.0, 0.0, 1e-9, 0.5, 3.0];
        for (a, b) in weights.into_iter().flat_map(|a| weights.map(|b| (a, b))) {
            assert_eq!(entry(a, 7).cmp(&entry(b, 7)), b.total_cmp(&a), "{a} {b}");
            assert!(entry(a, 3) < entry(a, 4) && entry(a, 5) as u32 == 5);
        }
    }

    #[test]
    fn points_of_several_tasks_stay_apart_and_sheets_do_not_repel() {
        let mut rng = rand::rngs::StdRng::seed_from_u64(5);
        let (count, keep) = (POINTS_A_TASK + 1904, 600);
        let points: Vec<Vec3> = (0..count).map(|_| Vec3::new(rng.random(), rng.random(), 0.0)).collect();
        let kept = eliminate(points.clone(), vec![Vec3::Z; count], keep, 1.0);
        assert!(kept.len() == keep && kept.is_sorted_by(|a, b| a < b));
        let packed = 2.0 * (1.0 / (2.0 * 3.0f32.sqrt() * keep as f32)).sqrt();
        let pairs = kept.iter().flat_map(|a| kept.iter().filter(move |b| *b > a).map(move |b| (a, b)));
        let least = pairs.map(|(a, b)| points[*a].distance(points[*b])).fold(f32::INFINITY, f32::min);
        assert!(least > 0.6 * packed, "{least} of {packed}");
        // The same place on two sheets: neither point repels the other.
        let normals = vec![Vec3::Z, -Vec3::Z, Vec3::Z];
        let twice = vec![Vec3::ZERO, Vec3::ZERO, Vec3::X * 1e-3];
        assert!(eliminate(twice, normals, 2, 1.0).contains(&1));
        assert!(eliminate(Vec::new(), Vec::new(), 0, 1.0).is_empty());
    }
}
