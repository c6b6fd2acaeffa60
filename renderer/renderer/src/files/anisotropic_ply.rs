//! Anisotropic Gaussians as PLY files in the layout of the 3D Gaussian Splatting reference code.
//!
//! Those files hold harmonics of the sRGB colour, whose sum need not be the conversion of a linear sum. The constant
//! part is converted exactly and the others by the slope of the conversion there, and inversely on reading: writing and
//! reading preserves colours, and files of other tools look the same where the colour varies little with the direction.

use std::path::Path;

use flyrig_model::srgb;

use crate::anisotropic::splats::AnisotropicSplats;
use crate::files::ply::{ExportError, SH_DEGREE_0, log_scale, opacity_logit, write_ply};
use crate::schema::anisotropic_ply_properties;

/// Writes Gaussians as binary PLY. Normals are 0, and a comment names the filter that flyrig draws with (`SplatRenderMode: mip`).
/// Gaussians with a NaN or an infinity are skipped. Returns the number written.
///
/// # Errors
/// [`ExportError::Io`] names the file; the old one, if any, is then untouched.
///
/// # Examples
/// ```
/// use flyrig_renderer::{AnisotropicSplats, HarmonicOrder, SplatFile, write_anisotropic_ply};
///
/// let mut splats = AnisotropicSplats::empty(HarmonicOrder::Zero);
/// splats.center.push([0.0, 1.5, 0.0, 0.0]);
/// splats.scale_opacity.push([0.01, 0.01, 0.002, 0.9]);
/// splats.rotation.push([0.0, 0.0, 0.0, 1.0]);
/// splats.harmonics.push([1.0, 0.5, 0.0, 0.0]);
///
/// let folder = tempfile::tempdir()?;
/// let path = folder.path().join("one.ply");
/// assert_eq!(write_anisotropic_ply(&path, &splats)?, 1);
/// let read = SplatFile::parse(&std::fs::read(&path)?)?.splats;
/// assert_eq!((read.count(), read.order), (1, HarmonicOrder::Zero));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn write_anisotropic_ply(path: &Path, splats: &AnisotropicSplats) -> Result<usize, ExportError> {
    let rows: Vec<Vec<f32>> = (0..splats.count()).map(|i| row(splats, i)).filter(|row| all_finite(row)).collect();
    let count = rows.len();
    let properties = anisotropic_ply_properties(splats.order);
    write_ply(path, properties.iter().map(String::as_str), count, rows.into_iter())?;
    Ok(count)
}

/// Returns the values of Gaussian `i` in the order of the properties.
fn row(splats: &AnisotropicSplats, i: usize) -> Vec<f32> {
    let coefficients = splats.order.coefficients();
    let harmonics = &splats.harmonics[i * coefficients..(i + 1) * coefficients];
    let [x, y, z, _] = splats.center[i];
    let [a, b, c, opacity] = splats.scale_opacity[i];
    let [qx, qy, qz, qw] = splats.rotation[i];
    let constants = [0, 1, 2].map(|c| encode(SH_DEGREE_0 * harmonics[0][c]));
    let mut row = vec![x, y, z, 0.0, 0.0, 0.0];
    row.extend(constants.map(|(value, _)| (value - 0.5) / SH_DEGREE_0));
    for (c, (_, slope)) in constants.into_iter().enumerate() {
        row.extend(harmonics[1..].iter().map(|coefficient| coefficient[c] * slope));
    }
    row.push(if opacity.is_finite() { opacity_logit(opacity) } else { f32::NAN });
    row.extend([a, b, c].map(|scale| if scale.is_finite() { log_scale(scale) } else { f32::NAN }));
    row.extend([qw, qx, qy, qz]);
    row
}

/// Appends a Gaussian of position, constant colour, opacity, scales and rotation, and three channels of each further harmonic.
pub(super) fn push(splats: &mut AnisotropicSplats, fixed: &[f32], varying: &[f32]) {
    let [x, y, z, red, green, blue, logit, a, b, c, qw, qx, qy, qz] = *fixed else { return };
    let linear = [red, green, blue].map(|value| decode(0.5 + SH_DEGREE_0 * value));
    let slopes = linear.map(|value| encode(value).1);
    let element = |values: [f32; 3]| [values[0], values[1], values[2], 0.0];
    let shape = [a.exp(), b.exp(), c.exp(), 1.0 / (1.0 + (-logit).exp())];
    let mut harmonics = vec![element(linear.map(|value| value / SH_DEGREE_0))];
    harmonics.extend(varying.chunks_exact(3).map(|v| element([v[0] / slopes[0], v[1] / slopes[1], v[2] / slopes[2]])));
    let rotation = [qx, qy, qz, qw];
    if all_finite(&[x, y, z]) && all_finite(&shape) && all_finite(&rotation) && all_finite(harmonics.as_flattened()) {
        splats.center.push([x, y, z, 0.0]);
        splats.scale_opacity.push(shape);
        splats.rotation.push(rotation);
        splats.harmonics.extend(harmonics);
    }
}

fn all_finite(values: &[f32]) -> bool {
    values.iter().all(|value| value.is_finite())
}

/// sRGB value of a linear one and the slope there. The curve goes on above 1, and below 0 as above it.
fn encode(linear: f32) -> (f32, f32) {
    let x = linear.abs();
    (srgb::encode(x, f32::powf).copysign(linear), srgb::slope(x, f32::powf))
}

/// Linear value of an sRGB one, the inverse of [`encode`].
fn decode(code: f32) -> f32 {
    srgb::decode(code.abs(), f32::powf).copysign(code)
}

#[cfg(test)]
#[path = "anisotropic_ply_tests.rs"]
mod tests;
