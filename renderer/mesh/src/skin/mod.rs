//! Skin weights of a mesh, taken from a skinned template.
//!
//! A vertex takes the weights of the template's closest point where that lies near and faces the same way. The others (hair, hems,
//! brims) follow from their neighbours: the smoothest weights on the mesh with the known ones given, which minimise the energy of the
//! bi-Laplacian, as in robust weight transfer (Abdrashitov et al. 2023, "Robust Skin Weights Transfer via Weight Inpainting", Eq. 2).

mod closest;
mod inpaint;
mod laplacian;

use flyrig_body::{SkinWeights, Template};
use glam::Vec3;
use rayon::prelude::*;

use crate::skin::{closest::ClosestPoints, inpaint::inpaint};

/// Settings of [`skin_weights`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SkinSettings {
    /// Largest distance from the template at which a vertex takes its weights, metres.
    pub distance_m: f32,
    /// Largest angle between the normals, radians.
    pub angle_rad: f32,
}

impl Default for SkinSettings {
    fn default() -> Self {
        Self { distance_m: 0.04, angle_rad: std::f32::consts::FRAC_PI_3 }
    }
}

/// Counts of [`skin_weights`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SkinReport {
    /// Vertices with weights of the template.
    pub taken: usize,
    /// Vertices whose weights follow from their neighbours.
    pub inpainted: usize,
    /// Vertices on parts of the mesh without a taken one; they have the weights of the closest point at any angle.
    pub isolated: usize,
}

/// Returns skin weights of each vertex, at most four joints with the sum 1. `positions` and `triangles` are in the template's canonical
/// space, metres; `normals` are unit length. Triangles with corners out of range are ignored; a vertex that is not a finite number, and
/// every vertex where the template has no triangle, moves with the root. The same input gives the same weights for any number of
/// threads.
#[must_use]
pub fn skin_weights(
    (positions, normals): (&[Vec3], &[Vec3]),
    triangles: &[[u32; 3]],
    template: &Template,
    settings: SkinSettings,
) -> (Vec<SkinWeights>, SkinReport) {
    let normal = |i: usize| normals.get(i).copied().unwrap_or_default();
    skin_weights_by(positions, triangles, &[template], settings, |i| Origin { template: 0, normal: normal(i) })
}

/// Template that a vertex takes its weights from, and the direction in which the surface faces there.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Origin {
    /// Index of the template.
    pub template: usize,
    /// Unit normal.
    pub normal: Vec3,
}

/// Returns skin weights as [`skin_weights`] does, from the template of each vertex's `origin`.
pub(crate) fn skin_weights_by(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    templates: &[&Template],
    settings: SkinSettings,
    origin: impl Fn(usize) -> Origin + Sync,
) -> (Vec<SkinWeights>, SkinReport) {
    let closest: Vec<(ClosestPoints, &Template)> =
        templates.iter().map(|template| (ClosestPoints::new(template), *template)).collect();
    let cosine = settings.angle_rad.cos();
    let near = |(i, position): (usize, &Vec3)| {
        let Origin { template, normal } = origin(i);
        let (closest, template) = closest.get(template)?;
        let faces = |triangle| closest.normal(triangle).dot(normal) >= cosine;
        closest.within(*position, settings.distance_m, faces).and_then(|found| found.weights(template))
    };
    let known: Vec<Option<SkinWeights>> = positions.par_iter().enumerate().with_min_len(256).map(near).collect();
    let filled = inpaint(positions, triangles, &known);
    let mut report = SkinReport::default();
    let mut weights = Vec::with_capacity(positions.len());
    for (i, ((known, filled), position)) in known.iter().zip(filled).zip(positions).enumerate() {
        weights.push(match (known, filled) {
            (Some(known), _) => {
                report.taken += 1;
                *known
            }
            (None, Some(filled)) => {
                report.inpainted += 1;
                filled
            }
            (None, None) => {
                report.isolated += 1;
                let found = closest.get(origin(i).template).and_then(|(closest, template)| {
                    closest.nearest(*position).and_then(|found| found.weights(template))
                });
                found.unwrap_or_else(root)
            }
        });
    }
    (weights, report)
}

/// Weights of a point that moves with the root.
fn root() -> SkinWeights {
    SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] }
}

#[cfg(test)]
mod tests;
