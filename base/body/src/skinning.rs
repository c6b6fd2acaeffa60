//! Linear blend skinning on the processor.

use flyrig_types::Pose;
use glam::{DMat3, DMat4, DVec3, Mat3, Mat4, Vec3};
use rayon::prelude::*;

use crate::{SkinWeights, Template};

/// Skins one canonical point by linear blend skinning; the reference for faster forms. Joints beyond the matrices and weights that
/// are not positive are ignored; without any weight the point stays in place.
#[must_use]
pub fn skin_point_f64(matrices: &[DMat4], skin: &SkinWeights, point: DVec3) -> DVec3 {
    blend_f64(matrices, skin).transform_point3(point)
}

/// Skins one canonical normal by the linear part of the blend, normalised.
#[must_use]
pub fn skin_normal_f64(matrices: &[DMat4], skin: &SkinWeights, normal: DVec3) -> DVec3 {
    (DMat3::from_mat4(blend_f64(matrices, skin)) * normal).normalize_or_zero()
}

/// Returns the derivative of [`skin_point_f64`] by the canonical point: the linear part of the blended matrices.
#[must_use]
pub fn skin_jacobian_f64(matrices: &[DMat4], skin: &SkinWeights) -> DMat3 {
    DMat3::from_mat4(blend_f64(matrices, skin))
}

fn blend_f64(matrices: &[DMat4], skin: &SkinWeights) -> DMat4 {
    let mut sum = DMat4::ZERO;
    let mut total = 0.0;
    for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
        if let (Some(matrix), true) = (matrices.get(usize::from(joint)), weight > 0.0) {
            sum += *matrix * f64::from(weight);
            total += f64::from(weight);
        }
    }
    if total > 0.0 { sum * (1.0 / total) } else { DMat4::IDENTITY }
}

/// Returns the posed positions (world, metres) and unit normals of a template's vertices.
#[must_use]
pub fn skin_mesh(template: &Template, pose: &Pose) -> (Vec<Vec3>, Vec<Vec3>) {
    let matrices: Vec<Mat4> = template.skeleton.world_from_canonical(pose).iter().map(DMat4::as_mat4).collect();
    template
        .positions
        .par_iter()
        .zip(&template.normals)
        .zip(&template.skin)
        .map(|((&position, &normal), skin)| {
            let blend = blend_f32(&matrices, skin);
            (blend.transform_point3(position), (Mat3::from_mat4(blend) * normal).normalize_or_zero())
        })
        .unzip()
}

fn blend_f32(matrices: &[Mat4], skin: &SkinWeights) -> Mat4 {
    let mut sum = Mat4::ZERO;
    for (&joint, &weight) in skin.joints.iter().zip(&skin.weights) {
        if let (Some(matrix), true) = (matrices.get(usize::from(joint)), weight > 0.0) {
            sum += *matrix * weight;
        }
    }
    // The bottom row adds up to the weights used.
    if sum.w_axis.w > 0.0 { sum * (1.0 / sum.w_axis.w) } else { Mat4::IDENTITY }
}
