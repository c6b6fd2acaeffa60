//! Evenly spaced Gaussians on the surface.

use glam::{Vec2, Vec3};

use crate::{BodyError, Part, SkinWeights, Template};

/// About 4 mm apart on an adult (FlyHuman, section 3.1).
pub const DEFAULT_GAUSSIAN_COUNT: usize = 115_000;

/// Gaussians on the canonical surface; all lists have the same length.
#[derive(Debug, Clone)]
pub struct SurfaceGaussians {
    /// Canonical, metres.
    pub positions: Vec<Vec3>,
    /// Canonical unit normals.
    pub normals: Vec<Vec3>,
    /// Texture coordinates.
    pub uvs: Vec<Vec2>,
    /// Body parts.
    pub parts: Vec<Part>,
    /// Skin weights.
    pub skin: Vec<SkinWeights>,
    /// Standard deviation, metres: 0.75 of the distance to the nearest neighbour.
    pub scale_m: Vec<f32>,
    /// Triangle of the template.
    pub triangle: Vec<u32>,
    /// Weights of the triangle's corners.
    pub barycentric: Vec<[f32; 3]>,
}

/// `count` evenly spaced Gaussians.
///
/// # Errors
/// [`BodyError::Mesh`].
pub fn sample_surface(_template: &Template, _count: usize, _seed: u64) -> Result<SurfaceGaussians, BodyError> {
    Err(BodyError::Asset("not yet".to_owned()))
}
