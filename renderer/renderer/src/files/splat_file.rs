//! Splat files of other tools: PLY files of 3D and 2D Gaussian Splatting.

use crate::anisotropic::order::HarmonicOrder;
use crate::anisotropic::splats::AnisotropicSplats;
use crate::files::anisotropic_ply::push;
use crate::files::ply::SH_DEGREE_0;
use crate::files::ply_error::PlyError;
use crate::files::ply_header::{Column, Header, PlyType};
use crate::raster::settings::RasterSettings;

/// Thickness of the flat Gaussians of 2D Gaussian Splatting, in the smaller of their two scales.
const FLAT: f32 = 0.01;
/// Least variance along an axis before Mip-Splatting's filter, squared units of the file.
const LEAST_VARIANCE: f64 = 1e-30;
/// Comment that names the low-pass filter, as Brush writes it.
const MODE: &str = "SplatRenderMode:";

/// Low-pass filter on the screen with which Gaussians were trained.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum SplatFilter {
    /// Variance of 0.3 px² at the full opacity: the 3D Gaussian Splatting reference code, and files without a comment.
    #[default]
    Classic,
    /// Mip-Splatting's filter, which preserves the integral: `comment SplatRenderMode: mip`, what flyrig writes, and files with the
    /// property `filter_3D`.
    Mip,
}

impl SplatFilter {
    /// Returns the settings with this filter.
    #[must_use]
    pub fn applied(self, settings: RasterSettings) -> RasterSettings {
        match self {
            Self::Classic => settings.with_classic_filter(),
            Self::Mip => settings,
        }
    }
}

/// Content of a splat file.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatFile {
    /// Gaussians whose numbers are all finite, in the unit and axes of the file.
    pub splats: AnisotropicSplats,
    /// Rows with a NaN or an infinity, which are left out.
    pub left_out: usize,
    /// Degree of the file's harmonics, 0..=4. Those of degree 3 and 4 are not among [`Self::splats`].
    pub degree: u8,
    /// Whether the file has two scales per Gaussian, as 2D Gaussian Splatting writes; the third one is a hundredth of the smaller.
    pub is_flat: bool,
    /// Filter to draw the Gaussians with.
    pub filter: SplatFilter,
}

impl SplatFile {
    /// Parses a binary PLY file in the layout of the 3D Gaussian Splatting reference code, or of 2D Gaussian Splatting, which has no
    /// `scale_2`. Properties have any order, type and order of bytes; further properties and elements are ignored. Files with `red`,
    /// `green` and `blue` in place of `f_dc_*` (Nerfstudio) have harmonics of degree 0; the smoothing filter of Mip-Splatting,
    /// `filter_3D`, is applied to scales and opacity.
    ///
    /// # Errors
    /// [`PlyError`].
    pub fn parse(bytes: &[u8]) -> Result<Self, PlyError> {
        let header = Header::parse(bytes)?;
        if header.column("packed_position").is_some() {
            return Err(PlyError::Packed);
        }
        let layout = Layout::new(&header)?;
        let body = header.body(bytes)?;
        let mut splats = AnisotropicSplats::empty(layout.order);
        let (mut fixed, mut varying) = (Vec::new(), Vec::new());
        for row in body.chunks_exact(header.row_bytes.max(1)) {
            let number = |column: &Column| column.kind.read(&row[column.offset..], header.endian);
            let value = |column: &Column| number(column) as f32;
            fixed.clear();
            fixed.extend(layout.fixed.iter().map(value));
            if let Some(kind) = layout.rgb {
                fixed[3..6].iter_mut().for_each(|color| *color = harmonic_of_color(*color, kind));
            }
            if layout.is_flat {
                // The scales, logarithms, lie before the four numbers of the rotation.
                let third = fixed[7].min(fixed[8]) + FLAT.ln();
                fixed.insert(9, third);
            }
            if let Some(column) = &layout.smoothing {
                smooth(&mut fixed, number(column));
            }
            varying.clear();
            varying.extend(layout.varying.iter().map(value));
            push(&mut splats, &fixed, &varying);
        }
        let mode = header.comments.iter().find_map(|comment| comment.strip_prefix(MODE));
        let is_mip = mode.map_or(layout.smoothing.is_some(), |mode| mode.trim() == "mip");
        let filter = if is_mip { SplatFilter::Mip } else { SplatFilter::Classic };
        let left_out = body.len() / header.row_bytes.max(1) - splats.count();
        Ok(Self { splats, left_out, degree: layout.degree, is_flat: layout.is_flat, filter })
    }
}

/// Properties that are read.
struct Layout {
    /// Position, constant colour, opacity, scales, rotation.
    fixed: Vec<Column>,
    /// Harmonics that vary with the direction, the three channels of each one after another.
    varying: Vec<Column>,
    order: HarmonicOrder,
    degree: u8,
    is_flat: bool,
    /// Type of the constant colours where they are sRGB values and no harmonics.
    rgb: Option<PlyType>,
    /// Deviation of Mip-Splatting's smoothing filter.
    smoothing: Option<Column>,
}

/// Returns the constant harmonic of an sRGB value: whole numbers up to 255, or 0..=1.
fn harmonic_of_color(value: f32, kind: PlyType) -> f32 {
    let color = if matches!(kind, PlyType::F32 | PlyType::F64) { value } else { value / 255.0 };
    (color - 0.5) / SH_DEGREE_0
}

/// Widens the logarithmic scales of a Gaussian by a filter of this deviation and lowers its opacity so that its integral stays
/// (Mip-Splatting, section 4.1).
fn smooth(fixed: &mut [f32], deviation: f64) {
    let [.., logit, a, b, c, _, _, _, _] = fixed else { return };
    let variance = deviation * deviation;
    let mut share = 1.0;
    for scale in [a, b, c] {
        let own = (2.0 * f64::from(*scale)).exp().max(LEAST_VARIANCE);
        share *= own / (own + variance);
        *scale = (0.5 * (own + variance).ln()) as f32;
    }
    let opacity = share.sqrt() / (1.0 + (-f64::from(*logit)).exp());
    *logit = (opacity / (1.0 - opacity)).ln() as f32;
}

impl Layout {
    fn new(header: &Header<'_>) -> Result<Self, PlyError> {
        let find = |name: &str| header.column(name).ok_or_else(|| PlyError::Missing(name.to_owned()));
        let is_flat = header.column("scale_2").is_none();
        let rgb = header.column("red").filter(|_| header.column("f_dc_0").is_none()).map(|column| column.kind);
        let [red, green, blue] = if rgb.is_some() { ["red", "green", "blue"] } else { ["f_dc_0", "f_dc_1", "f_dc_2"] };
        let names = ["x", "y", "z", red, green, blue, "opacity", "scale_0", "scale_1", "scale_2"];
        let names = names.iter().filter(|name| !(is_flat && **name == "scale_2"));
        let fixed = names.chain(&["rot_0", "rot_1", "rot_2", "rot_3"]).map(|name| find(name));
        let fixed = fixed.collect::<Result<Vec<Column>, PlyError>>()?;
        let rest = (0..).take_while(|k| header.column(&format!("f_rest_{k}")).is_some()).count();
        let (order, degree) = match rest {
            0 => (HarmonicOrder::Zero, 0),
            9 => (HarmonicOrder::One, 1),
            24 => (HarmonicOrder::Two, 2),
            45 => (HarmonicOrder::Two, 3),
            72 => (HarmonicOrder::Two, 4),
            other => return Err(PlyError::Header(format!("{other} properties f_rest_*"))),
        };
        let read = order.coefficients() - 1;
        let varying = (0..read).flat_map(|k| (0..3).map(move |channel| format!("f_rest_{}", channel * rest / 3 + k)));
        let varying = varying.map(|name| find(&name)).collect::<Result<Vec<Column>, PlyError>>()?;
        Ok(Self { fixed, varying, order, degree, is_flat, rgb, smoothing: header.column("filter_3D") })
    }
}

#[cfg(test)]
#[path = "splat_file_tests.rs"]
mod tests;
