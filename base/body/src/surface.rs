//! Evenly spaced Gaussians on a template's surface.

use glam::{Vec2, Vec3};
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;

use crate::eliminate::eliminate;
use crate::part::part_of_joints;
use crate::point_grid::PointGrid;
use crate::{BodyError, Part, SkinWeights, Template};

/// Default number of Gaussians: about 4 mm apart on an adult (FlyHuman, section 3.1).
pub const DEFAULT_GAUSSIAN_COUNT: usize = 115_000;

/// Largest number of Gaussians, bounded by memory.
const MAX_GAUSSIANS: usize = 10_000_000;

/// Random candidates per Gaussian; more make the spacing evener and take longer.
const CANDIDATES_PER_GAUSSIAN: usize = 4;

/// Standard deviation of a Gaussian over the distance to its nearest neighbour: 0.69 of the mean spacing, which blue noise puts at 1.3
/// times the nearest distance. Larger ones blur the images, such as 0.75 of the mean spacing (FlyHuman, section 3.1): d1 loses 0.15 dB.
/// Much smaller ones let the back of the body show through: at 0.75 of the nearest distance the front's alpha is 0.98.
const SCALE_OF_NEAREST: f32 = 0.9;

/// Gaussians on the canonical surface; all lists have the same length.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceGaussians {
    /// Canonical positions, metres.
    pub positions: Vec<Vec3>,
    /// Canonical unit normals, interpolated.
    pub normals: Vec<Vec3>,
    /// Texture coordinates, interpolated.
    pub uvs: Vec<Vec2>,
    /// Body part of the joint that moves the Gaussian most.
    pub parts: Vec<Part>,
    /// Skin weights, interpolated, the strongest four.
    pub skin: Vec<SkinWeights>,
    /// Standard deviation, metres: 0.9 of the distance to the nearest neighbour on the same side of the body.
    pub scale_m: Vec<f32>,
    /// Depth of the centre below the rendered surface, along the normal, metres; 0 as sampled ([`Self::inset`]).
    pub depth_m: Vec<f32>,
    /// Triangle of the template, ascending.
    pub triangle: Vec<u32>,
    /// Weights of the triangle's corners, sum 1.
    pub barycentric: Vec<[f32; 3]>,
}

impl SurfaceGaussians {
    /// Returns the number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// Samples `count` Gaussians, evenly spaced over the template's surface (blue noise). Equal templates, counts and seeds give equal
/// Gaussians.
///
/// # Errors
/// [`BodyError::Mesh`] when the template's lists differ in length, a number is not finite, the surface has no area, or
/// `count` is 0 or above ten million.
pub fn sample_surface(template: &Template, count: usize, seed: u64) -> Result<SurfaceGaussians, BodyError> {
    template.check()?;
    let fail = |message: String| BodyError::Mesh { name: template.name.clone(), message };
    if count == 0 || count > MAX_GAUSSIANS {
        return Err(fail(format!("{count} Gaussians asked for; choose 1 to {MAX_GAUSSIANS}")));
    }
    let mut area = 0.0;
    let area_up_to: Vec<f64> = template
        .triangles
        .iter()
        .map(|triangle| {
            let [a, b, c] = corners(template, triangle).map(Vec3::as_dvec3);
            area += 0.5 * (b - a).cross(c - a).length();
            area
        })
        .collect();
    if !(area.is_finite() && area > 1e-9) {
        return Err(fail("the surface has no area; is it in metres?".to_owned()));
    }

    let mut rng = rand::rngs::StdRng::seed_from_u64(seed);
    let thrown = count * CANDIDATES_PER_GAUSSIAN;
    let mut triangle = 0;
    let candidates: Vec<(u32, [f32; 3])> = (0..thrown)
        .map(|i| {
            // One point in each of `thrown` equal shares of the area.
            let at = (i as f64 + rng.random::<f64>()) / thrown as f64 * area;
            while triangle + 1 < area_up_to.len() && area_up_to[triangle] < at {
                triangle += 1;
            }
            let (mut v, mut w): (f32, f32) = (rng.random(), rng.random());
            if v + w > 1.0 {
                (v, w) = (1.0 - v, 1.0 - w);
            }
            (triangle as u32, [1.0 - v - w, v, w])
        })
        .collect();
    let position = |candidate: (u32, [f32; 3])| blend(template, &template.positions, candidate);
    let kept = eliminate(
        candidates.par_iter().map(|&c| position(c)).collect(),
        candidates.par_iter().map(|&c| normal_at(template, c)).collect(),
        count,
        area,
    );
    let candidates: Vec<(u32, [f32; 3])> = kept.iter().map(|&i| candidates[i]).collect();
    drop(kept);

    let positions = candidates.par_iter().map(|&c| position(c)).collect();
    let skin = candidates.par_iter().map(|&c| blend_skin(template, c)).collect();
    Ok(described(template, &candidates, positions, skin))
}

/// Describes Gaussians that are attached to points of a template's surface (triangle and weights of its corners) and lie near
/// them. Scales fit their spacing.
///
/// # Errors
/// [`BodyError::Mesh`] when the template is not valid, there are no Gaussians, the lists differ in length, or an attachment is
/// not the template's.
pub fn attached_surface(
    template: &Template,
    attachments: &[(u32, [f32; 3])],
    positions: Vec<Vec3>,
    skin: Vec<SkinWeights>,
) -> Result<SurfaceGaussians, BodyError> {
    template.check()?;
    let count = attachments.len();
    let triangles = template.triangles.len();
    if count == 0
        || [positions.len(), skin.len()] != [count; 2]
        || attachments.iter().any(|(triangle, _)| *triangle as usize >= triangles)
    {
        let message = format!("{} Gaussians and {count} attachments to {triangles} triangles", positions.len());
        return Err(BodyError::Mesh { name: template.name.clone(), message });
    }
    Ok(described(template, attachments, positions, skin))
}

/// Returns all attributes of attached Gaussians.
fn described(
    template: &Template,
    attachments: &[(u32, [f32; 3])],
    positions: Vec<Vec3>,
    skin: Vec<SkinWeights>,
) -> SurfaceGaussians {
    let normals: Vec<Vec3> = attachments.par_iter().map(|&attachment| normal_at(template, attachment)).collect();
    let spacing = (template.area_m2() / attachments.len() as f64).sqrt() as f32;
    let scale_m = scales(&positions, &normals, spacing);
    let part_of_joint = part_of_joints(&template.skeleton);
    SurfaceGaussians {
        uvs: attachments
            .iter()
            .map(|&(triangle, weights)| {
                let corners = template.triangles[triangle as usize];
                corners.iter().zip(weights).map(|(&corner, w)| template.uvs[corner as usize] * w).sum()
            })
            .collect(),
        parts: skin.iter().map(|s| part_of_joint[usize::from(s.joints[0])]).collect(),
        skin,
        scale_m,
        depth_m: vec![0.0; attachments.len()],
        triangle: attachments.iter().map(|a| a.0).collect(),
        barycentric: attachments.iter().map(|a| a.1).collect(),
        positions,
        normals,
    }
}

/// Interpolates values of the template's vertices.
fn blend(template: &Template, list: &[Vec3], (triangle, weights): (u32, [f32; 3])) -> Vec3 {
    template.triangles[triangle as usize].iter().zip(weights).map(|(&i, w)| list[i as usize] * w).sum()
}

/// Returns the unit normal of the surface at an attachment.
fn normal_at(template: &Template, attachment: (u32, [f32; 3])) -> Vec3 {
    let [a, b, c] = corners(template, &template.triangles[attachment.0 as usize]);
    let normal = blend(template, &template.normals, attachment);
    normal.try_normalize().unwrap_or((b - a).cross(c - a).normalize_or(Vec3::Y))
}

/// Returns the standard deviations of Gaussians that are about `spacing` apart, metres.
pub(crate) fn scales(positions: &[Vec3], normals: &[Vec3], spacing: f32) -> Vec<f32> {
    nearest_distances(positions, normals, spacing).into_iter().map(|distance| distance * SCALE_OF_NEAREST).collect()
}

fn corners(template: &Template, triangle: &[u32; 3]) -> [Vec3; 3] {
    triangle.map(|i| template.positions[i as usize])
}

fn blend_skin(template: &Template, (triangle, weights): (u32, [f32; 3])) -> SkinWeights {
    let mut influences = [(0, 0.0); 12];
    for (slot, influence) in influences.iter_mut().enumerate() {
        let (corner, k) = (slot / 4, slot % 4);
        let skin = &template.skin[template.triangles[triangle as usize][corner] as usize];
        *influence = (skin.joints[k], skin.weights[k] * weights[corner]);
    }
    SkinWeights::strongest(&influences).unwrap_or(SkinWeights { joints: [0; 4], weights: [1.0, 0.0, 0.0, 0.0] })
}

/// Returns the distance of each point to the nearest other one whose normal does not oppose its own; `spacing` where there is none
/// within 8 spacings.
fn nearest_distances(points: &[Vec3], normals: &[Vec3], spacing: f32) -> Vec<f32> {
    let grid = PointGrid::new(points, spacing);
    let nearest = |i: usize| {
        for radius in [1.0, 2.0, 4.0, 8.0].map(|factor| factor * spacing) {
            let mut best = f32::INFINITY;
            grid.within(points[i], radius, |j, squared| {
                if j != i && normals[i].dot(normals[j]) > 0.0 {
                    best = best.min(squared);
                }
            });
            if best.is_finite() {
                return best.sqrt();
            }
        }
        spacing
    };
    (0..points.len()).into_par_iter().map(nearest).collect()
}
