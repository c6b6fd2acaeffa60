//! Errors of meshing splats.

use flyrig_avatar::AvatarError;
use flyrig_gpu::GpuError;

use crate::{AtlasError, DecimateError, MeshError};

/// Extent of people, metres, with raised arms and in small models.
const PEOPLE_M: std::ops::RangeInclusive<f64> = 0.3..=4.0;
/// Units of files, with their length in metres.
const UNITS: [(&str, f64); 3] = [("m", 1.0), ("cm", 0.01), ("mm", 0.001)];
/// Height to scale files of an unknown unit to, metres.
const ADULT_M: f64 = 1.75;

/// Reason why Gaussians are not meshed.
#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    /// They are not as large as a person.
    #[error("{} m tall; {}", shown(*extent_m), fix(*extent_m / f64::from(*unit_m)))]
    Size {
        /// Largest extent along an axis, metres.
        extent_m: f64,
        /// Assumed length of the unit, metres.
        unit_m: f32,
    },
    /// They draw no surface of a body.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The surface cannot be simplified.
    #[error(transparent)]
    Decimate(#[from] DecimateError),
    /// The surface gets no texture coordinates.
    #[error(transparent)]
    Atlas(#[from] AtlasError),
    /// The texture cannot be made.
    #[error(transparent)]
    Texture(#[from] AvatarError),
    /// The virtual cameras cannot be drawn.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl SplatError {
    /// Checks the largest extent of Gaussians, metres, of a file with this unit.
    ///
    /// # Errors
    /// [`Self::Size`].
    pub(super) fn check_size(extent_m: f64, unit_m: f32) -> Result<(), Self> {
        if PEOPLE_M.contains(&extent_m) { Ok(()) } else { Err(Self::Size { extent_m, unit_m }) }
    }
}

fn shown(extent_m: f64) -> String {
    match extent_m {
        10.0..1e6 => format!("{extent_m:.0}"),
        0.001..10.0 => format!("{extent_m:.3}"),
        _ => format!("{extent_m:.3e}"),
    }
}

/// Returns the way to metres for an extent in the file's own unit.
fn fix(extent: f64) -> String {
    match UNITS.iter().find(|(_, length_m)| PEOPLE_M.contains(&(extent * length_m))) {
        Some((unit, _)) => format!("give --unit {unit}"),
        None => format!("scale it to metres: splat-transform IN.ply -s {:.3e} OUT.ply", ADULT_M / extent),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_that_are_not_of_people_name_the_unit_or_the_scale() {
        let text = |extent: f64, unit_m: f32| {
            SplatError::check_size(extent * f64::from(unit_m), unit_m).map_err(|error| error.to_string())
        };
        assert_eq!(text(1748.0, 1.0), Err("1748 m tall; give --unit mm".to_owned()));
        assert_eq!(text(174.8, 1.0), Err("175 m tall; give --unit cm".to_owned()));
        assert_eq!(text(1.748, 0.001), Err("0.002 m tall; give --unit m".to_owned()));
        assert_eq!(text(1748.0, 0.001), Ok(()));
        assert!(text(7.0, 1.0).unwrap_err().ends_with("splat-transform IN.ply -s 2.500e-1 OUT.ply"));
        for absurd in [1e30, 1e-30] {
            assert!(text(absurd, 1.0).unwrap_err().contains("splat-transform IN.ply -s 1.750e"));
        }
    }
}
