//! Anisotropic Gaussians as PLY files in the layout of the 3D Gaussian Splatting reference code.
//!
//! Those files hold harmonics of the sRGB colour, whose sum need not be the conversion of a linear sum. The constant
//! part is converted exactly and the others by the slope of the conversion there, and inversely on reading: writing and
//! reading preserves colours, and files of other tools look the same where the colour varies little with the direction.

use std::path::Path;

use flyrig_model::srgb;

use crate::anisotropic::order::HarmonicOrder;
use crate::anisotropic::splats::AnisotropicSplats;
use crate::files::ply::ExportError;
use crate::files::ply::{SH_DEGREE_0, log_scale, opacity_logit, write_ply};
use crate::schema::PLY_PROPERTIES;
use crate::schema::anisotropic_ply_properties;

/// Reason why bytes are no PLY file of Gaussians.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum PlyError {
    /// The header is not one of a file of Gaussians.
    #[error(
        "the PLY header says {0:?}, which is not how 3D Gaussian Splatting tools write binary files; convert it with one of them"
    )]
    Header(String),
    /// The header does not end.
    #[error("the PLY header has no end_header line; the file is cut off or no PLY file")]
    NoEnd,
    /// A property is missing.
    #[error("the PLY file has no float property {0}; it does not hold Gaussians")]
    Missing(String),
    /// There are fewer bytes than the header announces.
    #[error("the PLY header announces {gaussians} Gaussians, {found} bytes follow; the file is cut off")]
    Short {
        /// Gaussians announced.
        gaussians: u64,
        /// Bytes after the header.
        found: usize,
    },
}

/// Writes Gaussians as binary PLY. Normals are 0; Gaussians with a NaN or an infinity are skipped. Returns the number
/// written.
///
/// # Errors
/// [`ExportError::Io`] names the file; the old one, if any, is then untouched.
pub fn write_anisotropic_ply(path: &Path, splats: &AnisotropicSplats) -> Result<usize, ExportError> {
    let rows: Vec<Vec<f32>> = (0..splats.count()).map(|i| row(splats, i)).filter(|row| all_finite(row)).collect();
    let count = rows.len();
    let properties = anisotropic_ply_properties(splats.order);
    write_ply(path, properties.iter().map(String::as_str), count, rows.into_iter())?;
    Ok(count)
}

/// Parses a binary PLY file. Harmonics above order 2 and further properties are ignored; Gaussians with a NaN or an
/// infinity are skipped.
///
/// # Errors
/// [`PlyError`].
///
/// # Examples
/// ```
/// use flyrig_renderer::{AnisotropicSplats, HarmonicOrder, parse_anisotropic_ply, write_anisotropic_ply};
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
/// let read = parse_anisotropic_ply(&std::fs::read(&path)?)?;
/// assert_eq!((read.count(), read.order), (1, HarmonicOrder::Zero));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn parse_anisotropic_ply(bytes: &[u8]) -> Result<AnisotropicSplats, PlyError> {
    let header = Header::parse(bytes)?;
    let width = header.properties.len() * size_of::<f32>();
    let body = &bytes[header.bytes..];
    let needed = usize::try_from(header.gaussians).ok().and_then(|count| count.checked_mul(width));
    let body = needed
        .and_then(|needed| body.get(..needed))
        .ok_or(PlyError::Short { gaussians: header.gaussians, found: body.len() })?;
    let column = |name: &str| header.properties.iter().position(|property| *property == name);
    let (order, channel) = match (0..).take_while(|k| column(&format!("f_rest_{k}")).is_some()).count() {
        0 => (HarmonicOrder::Zero, 0),
        9 => (HarmonicOrder::One, 3),
        24 => (HarmonicOrder::Two, 8),
        45 => (HarmonicOrder::Two, 15),
        other => return Err(PlyError::Header(format!("{other} properties f_rest_*"))),
    };
    let find = |name: String| column(&name).ok_or(PlyError::Missing(name));
    let wanted = PLY_PROPERTIES.iter().filter(|name| !["nx", "ny", "nz"].contains(name)).map(ToString::to_string);
    let columns = wanted.map(find).collect::<Result<Vec<usize>, PlyError>>()?;
    let varying = order.coefficients() - 1;
    let rest = (0..varying).flat_map(|k| (0..3).map(move |c| format!("f_rest_{}", c * channel + k)));
    let rest = rest.map(find).collect::<Result<Vec<usize>, PlyError>>()?;
    let mut splats = AnisotropicSplats::empty(order);
    for row in body.chunks_exact(width.max(1)) {
        let value = |column: &usize| {
            let at = column * size_of::<f32>();
            row.get(at..at + size_of::<f32>())
                .and_then(|bytes| bytes.try_into().ok())
                .map_or(f32::NAN, f32::from_le_bytes)
        };
        let fixed: Vec<f32> = columns.iter().map(value).collect();
        let varying: Vec<f32> = rest.iter().map(value).collect();
        push(&mut splats, &fixed, &varying);
    }
    Ok(splats)
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
fn push(splats: &mut AnisotropicSplats, fixed: &[f32], varying: &[f32]) {
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

struct Header<'a> {
    gaussians: u64,
    properties: Vec<&'a str>,
    /// Length including the last line, bytes.
    bytes: usize,
}

impl<'a> Header<'a> {
    fn parse(bytes: &'a [u8]) -> Result<Self, PlyError> {
        /// Bound on the length of a header, bytes.
        const LONGEST: usize = 1 << 16;
        let mut header = Self { gaussians: 0, properties: Vec::new(), bytes: 0 };
        let mut section = Section::Magic;
        for line in bytes[..bytes.len().min(LONGEST)].split_inclusive(|byte| *byte == b'\n') {
            header.bytes += line.len();
            let text =
                std::str::from_utf8(line).ok().and_then(|text| text.strip_suffix('\n')).ok_or(PlyError::NoEnd)?;
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            section = match (section, words.as_slice()) {
                (_, ["comment" | "obj_info", ..]) if section != Section::Magic => section,
                (Section::Magic, ["ply"]) => Section::Format,
                (Section::Format, ["format", "binary_little_endian", "1.0"]) => Section::Element,
                (Section::Element, ["element", "vertex", count]) => {
                    header.gaussians = count.parse().map_err(|_| PlyError::Header(text.to_owned()))?;
                    Section::Vertex
                }
                (Section::Vertex, ["property", "float" | "float32", name]) => {
                    header.properties.push(name);
                    Section::Vertex
                }
                (Section::Vertex | Section::Others, ["element", ..]) | (Section::Others, ["property", ..]) => {
                    Section::Others
                }
                (Section::Vertex | Section::Others, ["end_header"]) => return Ok(header),
                _ => return Err(PlyError::Header(text.chars().take(80).collect())),
            };
        }
        Err(PlyError::NoEnd)
    }
}

/// Expected next part of a header.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Section {
    Magic,
    Format,
    Element,
    Vertex,
    /// Section of elements after the Gaussians.
    Others,
}

#[cfg(test)]
#[path = "anisotropic_ply_tests.rs"]
mod tests;
