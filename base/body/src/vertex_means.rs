//! Means of Gaussians at the template's vertices.

use glam::Vec3;

use crate::Template;

/// Displacements of a template's vertices as means of the Gaussians on the triangles around them.
#[derive(Debug)]
pub struct VertexMeans {
    triangles: Vec<[u32; 3]>,
    /// Corners of the triangle and weights of each Gaussian.
    corners: Vec<([u32; 3], [f32; 3])>,
    vertices: usize,
}

impl VertexMeans {
    /// Prepares the means for Gaussians on a template, one element each: triangle, and weights of its corners (sum 1). Gaussians on
    /// triangles out of range are ignored.
    #[must_use]
    pub fn new(template: &Template, hung: impl IntoIterator<Item = (u32, [f32; 3])>) -> Self {
        let corner = |(triangle, weights): (u32, [f32; 3])| {
            template.triangles.get(triangle as usize).map_or(([0; 3], [0.0; 3]), |corners| (*corners, weights))
        };
        Self {
            triangles: template.triangles.clone(),
            corners: hung.into_iter().map(corner).collect(),
            vertices: template.positions.len(),
        }
    }

    /// Returns the displacement of each vertex, in the unit of `displacement`, whose fourth component is ignored. Vertices without a
    /// Gaussian next to them follow their neighbours; 0 where there are none.
    #[must_use]
    pub fn of(&self, displacement: &[[f32; 4]]) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO.extend(0.0); self.vertices];
        for ((corners, weights), d) in self.corners.iter().zip(displacement) {
            for (&corner, &weight) in corners.iter().zip(weights) {
                sums[corner as usize] += Vec3::new(d[0], d[1], d[2]).extend(1.0) * weight;
            }
        }
        // A vertex without a Gaussian next to it takes its neighbours' mean, from the rim of the hole inwards.
        while sums.iter().any(|s| s.w <= 0.0) {
            let mut more = vec![Vec3::ZERO.extend(0.0); self.vertices];
            for triangle in &self.triangles {
                for (&a, &b) in triangle.iter().zip(triangle.iter().cycle().skip(1)) {
                    for (to, from) in [(a, b), (b, a)] {
                        let from = sums[from as usize];
                        if from.w > 0.0 {
                            more[to as usize] += from / from.w;
                        }
                    }
                }
            }
            let mut filled = false;
            for (sum, more) in sums.iter_mut().zip(more) {
                if sum.w <= 0.0 && more.w > 0.0 {
                    *sum = more;
                    filled = true;
                }
            }
            if !filled {
                break;
            }
        }
        sums.iter().map(|s| if s.w > 0.0 { s.truncate() / s.w } else { Vec3::ZERO }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ShapeParams, default_template, sample_surface};

    #[test]
    fn a_linear_displacement_comes_back_and_holes_follow_their_rim() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 30_000, 1).unwrap();
        let by = |p: Vec3| Vec3::new(0.02 * p.y, 0.01 - 0.03 * p.x, 0.01 * p.z);
        let hung = || surface.triangle.iter().copied().zip(surface.barycentric.iter().copied());
        let given: Vec<[f32; 4]> = surface.positions.iter().map(|p| by(*p).extend(9.0).to_array()).collect();
        let found = VertexMeans::new(&template, hung()).of(&given);
        // Means over a triangle are exact up to the slope times its size.
        let worst = template.positions.iter().zip(&found).map(|(p, found)| (by(*p) - *found).length());
        assert!(worst.fold(0.0, f32::max) < 1.5e-3);

        // Gaussians of the upper half only: the lower half takes the displacement of the rim, which is constant here.
        let upper: Vec<(u32, [f32; 3])> =
            hung().zip(&surface.positions).filter(|(_, p)| p.y > 1.0).map(|(hung, _)| hung).collect();
        let means = VertexMeans::new(&template, upper.iter().copied());
        let found = means.of(&vec![[0.01, 0.0, 0.0, 0.0]; upper.len()]);
        // Pieces without a Gaussian that no triangle connects to one (teeth, eyes, skin cut off at seams) stay in place.
        let mut reached = vec![false; found.len()];
        for (triangle, weights) in &upper {
            let corners = template.triangles[*triangle as usize].iter().zip(weights);
            corners.for_each(|(corner, weight)| reached[*corner as usize] |= *weight > 0.0);
        }
        loop {
            let before = reached.iter().filter(|reached| **reached).count();
            for triangle in &template.triangles {
                if triangle.iter().any(|corner| reached[*corner as usize]) {
                    triangle.iter().for_each(|corner| reached[*corner as usize] = true);
                }
            }
            if before == reached.iter().filter(|reached| **reached).count() {
                break;
            }
        }
        for (vertex, (by, reached)) in found.iter().zip(&reached).enumerate() {
            let expected = if *reached { Vec3::X * 0.01 } else { Vec3::ZERO };
            assert!(by.distance(expected) < 1e-6, "{vertex}: {by}, expected {expected}");
        }
        let held = upper.iter().flat_map(|(triangle, _)| template.triangles[*triangle as usize]);
        let held = held.collect::<std::collections::BTreeSet<_>>().len();
        let moved = reached.iter().filter(|reached| **reached).count();
        assert!(moved > held + 1000 && moved < found.len(), "{held} with Gaussians, {moved} of {} moved", found.len());

        assert_eq!(VertexMeans::new(&template, [(u32::MAX, [1.0; 3])]).of(&[[1.0; 4]])[0], Vec3::ZERO);
        assert!(VertexMeans::new(&template, []).of(&[]).iter().all(|by| *by == Vec3::ZERO));
    }
}
