//! Colours by direction and their derivatives: `anisotropic/harmonics.wgsl`, `anisotropic/paint.wgsl` and
//! `anisotropic/paint_backward.wgsl` on the processor.

use glam::{Vec3, Vec4};

const C0: f32 = 0.282_094_8;
const C1: f32 = 0.488_602_5;
const C2_XY: f32 = 1.092_548_4;
const C2_ZZ: f32 = 0.315_391_57;
const C2_XX: f32 = 0.546_274_2;

/// Coefficients of all Gaussians and the position they are seen from.
#[derive(Clone, Copy)]
pub(crate) struct Harmonics<'a> {
    pub center: &'a [[f32; 4]],
    /// Coefficients; those of one Gaussian are consecutive.
    pub harmonics: &'a [[f32; 4]],
    /// Coefficients per Gaussian: 1, 4 or 9.
    pub coefficients: usize,
    /// World position of the camera.
    pub eye: Vec3,
}

impl Harmonics<'_> {
    /// Returns the colour of Gaussian `i`; `None` where it is not finite.
    #[inline(always)]
    pub fn color(&self, i: usize) -> Option<[f32; 4]> {
        let direction = (Vec4::from(self.center[i]).truncate() - self.eye).normalize_or(Vec3::Z);
        let color = unclamped_color(self.of(i), direction);
        color.is_finite().then(|| color.max(Vec3::ZERO).extend(0.0).to_array())
    }

    /// Adds the derivatives of Gaussian `i`, given dL/d its colour, to those with respect to its centre and its
    /// coefficients. A channel that is clamped at 0 contributes nothing.
    #[inline(always)]
    pub fn add_backward(&self, i: usize, d_color: Vec3, center_out: &mut [f32; 4], harmonics_out: &mut [[f32; 4]]) {
        let coefficients = self.of(i);
        let sight = Vec4::from(self.center[i]).truncate() - self.eye;
        let inverse_distance = 1.0 / sight.length();
        let direction = sight * inverse_distance;
        let is_open = unclamped_color(coefficients, direction).cmpge(Vec3::ZERO);
        let d_color = Vec3::select(is_open, d_color, Vec3::ZERO);
        if !d_color.is_finite() {
            return;
        }
        for (out, value) in harmonics_out.iter_mut().zip(basis(direction)) {
            *out = (Vec4::from(*out) + (value * d_color).extend(0.0)).to_array();
        }
        let slope = direction_slope(coefficients, direction, d_color);
        let in_world = (slope - direction * direction.dot(slope)) * inverse_distance;
        if self.coefficients > 1 && in_world.is_finite() {
            *center_out = (Vec4::from(*center_out) + in_world.extend(0.0)).to_array();
        }
    }

    #[inline(always)]
    fn of(&self, i: usize) -> &[[f32; 4]] {
        &self.harmonics[i * self.coefficients..(i + 1) * self.coefficients]
    }
}

/// Evaluates the harmonics in the unit direction `d`.
#[inline(always)]
fn basis(d: Vec3) -> [f32; 9] {
    let Vec3 { x, y, z } = d;
    [
        C0,
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2_XY * x * y,
        -C2_XY * y * z,
        C2_ZZ * (2.0 * z * z - x * x - y * y),
        -C2_XY * x * z,
        C2_XX * (x * x - y * y),
    ]
}

#[inline(always)]
fn unclamped_color(coefficients: &[[f32; 4]], d: Vec3) -> Vec3 {
    coefficients.iter().zip(basis(d)).map(|(c, value)| Vec4::from(*c).truncate() * value).sum()
}

/// Returns dL/d direction, including its part along the direction, given dL/d colour.
#[inline(always)]
fn direction_slope(coefficients: &[[f32; 4]], d: Vec3, d_color: Vec3) -> Vec3 {
    let by = |k: usize| coefficients.get(k).map_or(0.0, |c| d_color.dot(Vec4::from(*c).truncate()));
    let (xy, yz, zz) = (C2_XY * by(4), -C2_XY * by(5), 2.0 * C2_ZZ * by(6));
    let (xz, xx) = (-C2_XY * by(7), 2.0 * C2_XX * by(8));
    C1 * Vec3::new(-by(3), -by(1), by(2))
        + Vec3::new(
            xy * d.y + xz * d.z + (xx - zz) * d.x,
            xy * d.x + yz * d.z - (xx + zz) * d.y,
            yz * d.y + xz * d.x + 2.0 * zz * d.z,
        )
}
