//! From Gaussians back to the template's vertices.

use flyrig_body::{SurfaceGaussians, Template};
use glam::Vec3;

/// Displacements of the template's vertices as means of the Gaussians on the triangles around them.
#[derive(Debug)]
pub struct VertexMeans {
    triangles: Vec<[u32; 3]>,
    /// Triangle's corners and weights of each Gaussian.
    corners: Vec<([u32; 3], [f32; 3])>,
    vertices: usize,
}

impl VertexMeans {
    pub fn new(template: &Template, surface: &SurfaceGaussians) -> Self {
        let corner = |(&triangle, &weights): (&u32, &[f32; 3])| (template.triangles[triangle as usize], weights);
        Self {
            triangles: template.triangles.clone(),
            corners: surface.triangle.iter().zip(&surface.barycentric).map(corner).collect(),
            vertices: template.positions.len(),
        }
    }

    pub fn of(&self, displacement: &[[f32; 4]]) -> Vec<Vec3> {
        let mut sums = vec![Vec3::ZERO.extend(0.0); self.vertices];
        for ((corners, weights), d) in self.corners.iter().zip(displacement) {
            for (&corner, &weight) in corners.iter().zip(weights) {
                sums[corner as usize] += Vec3::new(d[0], d[1], d[2]).extend(1.0) * weight;
            }
        }
        // A vertex that no Gaussian lies next to takes its neighbours' mean, from the rim of the hole inwards.
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
