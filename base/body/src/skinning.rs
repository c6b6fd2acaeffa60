//! Linear blend skinning on the CPU.

use flyrig_types::Pose;
use glam::{DMat3, DMat4, DVec3, Mat3, Mat4, Vec3};
use rayon::prelude::*;

use crate::{SkinWeights, Template};

/// Linear blend skinning of one canonical point, the plain reference. Joints beyond the matrices and
/// non-positive weights count nothing; with no weight at all the point stays where it is.
#[must_use]
pub fn skin_point_f64(matrices: &[DMat4], skin: &SkinWeights, point: DVec3) -> DVec3 {
    blend_f64(matrices, skin).transform_point3(point)
}

/// Linear blend skinning of one canonical normal (rotation part of the blend, normalised).
#[must_use]
pub fn skin_normal_f64(matrices: &[DMat4], skin: &SkinWeights, normal: DVec3) -> DVec3 {
    (DMat3::from_mat4(blend_f64(matrices, skin)) * normal).normalize_or_zero()
}

/// Derivative of the skinned point by the canonical point: the linear part of the blended bone matrices, as
/// [`skin_point_f64`] takes them.
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

/// Posed positions (world, metres) and unit normals of a template's vertices.
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
