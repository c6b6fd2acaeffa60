//! Gaussians checked and brought to unit size (HGM, section 3.1).

use flyrig_renderer::AnisotropicSplats;
use glam::{DVec3, Vec3, Vec4};

use crate::density::first_spacing;
use crate::extract::MIN_POINTS;
use crate::points::near_others;
use crate::splats::error::SplatError;
use crate::{MeshError, Normalization, clamped_scales};

/// Opacity below which a Gaussian is not drawn.
const LEAST_OPACITY: f32 = 1.0 / 255.0;
/// Squared lengths of quaternions that single precision can normalise.
const ROTATIONS: std::ops::Range<f32> = 1e-30..1e30;
/// Smallest standard deviation, in distances of neighbours: thinner Gaussians are as flat.
const THINNEST: f32 = 0.02;
/// Largest standard deviation, in the largest extent: wider Gaussians are no surface of a person.
const WIDEST: f32 = 0.03;
/// Distance of neighbours at least and at most, in the largest extent.
const SPACING: [f32; 2] = [1.0 / 600.0, 1.0 / 60.0];

/// Numbers of Gaussians by their use.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SplatCounts {
    /// Used ones.
    pub used: usize,
    /// Used ones whose scales were clamped.
    pub clamped: usize,
    /// Left out: a NaN, an infinity, a negative scale or no rotation.
    pub not_finite: usize,
    /// Left out: too transparent to be drawn.
    pub transparent: usize,
    /// Left out: far from all others.
    pub distant: usize,
}

/// Gaussians at unit size.
pub(super) struct Prepared {
    pub splats: AnisotropicSplats,
    /// Transform from metres to unit size.
    pub unit: Normalization,
    /// Middle and radius of the sphere around all Gaussians, unit size.
    pub center: DVec3,
    pub radius: f64,
    /// Distance of neighbours, metres.
    pub spacing_m: f32,
    pub counts: SplatCounts,
}

/// Leaves out what is not drawn, clamps scales, and normalises the rest.
///
/// # Errors
/// [`MeshError::TooFewPoints`] below 1000 Gaussians, [`MeshError::Coincident`], and [`SplatError::Size`].
pub(super) fn prepare(splats: &AnisotropicSplats, unit_m: f32) -> Result<Prepared, SplatError> {
    let mut counts = SplatCounts::default();
    let mut rows = Vec::new();
    for i in 0..splats.count() {
        if !is_valid(splats, i, unit_m) {
            counts.not_finite += 1;
        } else if splats.scale_opacity[i][3] < LEAST_OPACITY {
            counts.transparent += 1;
        } else {
            rows.push(i);
        }
    }
    let place = |i: usize| Vec4::from(splats.center[i]).truncate() * unit_m;
    let centers: Vec<Vec3> = rows.iter().map(|i| place(*i)).collect();
    let is_near = near_others(&centers);
    let rows: Vec<usize> = rows.iter().zip(&is_near).filter(|(_, near)| **near).map(|(i, _)| *i).collect();
    let centers: Vec<Vec3> = rows.iter().map(|i| place(*i)).collect();
    counts.distant = is_near.len() - rows.len();
    counts.used = rows.len();
    if rows.len() < MIN_POINTS {
        return Err(MeshError::TooFewPoints { count: rows.len(), needed: MIN_POINTS }.into());
    }
    let low = centers.iter().copied().fold(Vec3::INFINITY, Vec3::min).as_dvec3();
    let high = centers.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max).as_dvec3();
    let extent_m = (high - low).max_element();
    if extent_m <= 0.0 {
        return Err(MeshError::Coincident { count: rows.len() }.into());
    }
    SplatError::check_size(extent_m, unit_m)?;
    let extent = extent_m as f32;
    let spacing_m = first_spacing(&centers).clamp(SPACING[0] * extent, SPACING[1] * extent);

    let unit = Normalization::from_centers(&centers);
    let scale = unit.scale_m();
    let mut unit_splats = AnisotropicSplats::empty(splats.order);
    let coefficients = splats.order.coefficients();
    for (i, center) in rows.iter().zip(&centers) {
        let own = Vec4::from(splats.scale_opacity[*i]);
        let scales_m = own.truncate() * unit_m;
        let clamped = clamped_scales(scales_m, THINNEST * spacing_m, WIDEST * extent);
        counts.clamped += usize::from(clamped != scales_m);
        let scales = unit.normalized_scales(clamped).as_vec3();
        unit_splats.center.push(unit.normalized(*center).as_vec3().extend(0.0).to_array());
        unit_splats.scale_opacity.push(scales.extend(own.w).to_array());
        unit_splats.rotation.push(splats.rotation[*i]);
        unit_splats.harmonics.extend_from_slice(&splats.harmonics[i * coefficients..(i + 1) * coefficients]);
    }
    let center = unit.normalized((0.5 * (low + high)).as_vec3());
    // Two deviations of the widest Gaussian beyond the centres.
    let farthest = centers.iter().map(|place| unit.normalized(*place).distance(center)).fold(0.0, f64::max);
    let radius = farthest + 2.0 * f64::from(WIDEST) * extent_m / scale;
    Ok(Prepared { splats: unit_splats, unit, center, radius, spacing_m, counts })
}

/// Returns whether a Gaussian can be drawn, whatever its opacity.
fn is_valid(splats: &AnisotropicSplats, i: usize, unit_m: f32) -> bool {
    let coefficients = splats.order.coefficients();
    let (center, shape) = (Vec4::from(splats.center[i]).truncate(), Vec4::from(splats.scale_opacity[i]));
    let rotation = Vec4::from(splats.rotation[i]).length_squared();
    let harmonics = &splats.harmonics[i * coefficients..(i + 1) * coefficients];
    (center * unit_m).is_finite()
        && (shape * unit_m).is_finite()
        && shape.truncate().min_element() >= 0.0
        && ROTATIONS.contains(&rotation)
        && harmonics.as_flattened().iter().all(|value| value.is_finite())
}
