//! File of the built-in body; `assets/make_template.py` describes its layout.

use std::collections::BTreeMap;
use std::io::Read;
use std::sync::OnceLock;

use serde::Deserialize;

use crate::BodyError;

static FILE: &[u8] = include_bytes!("../assets/template.bin.gz");
const MAGIC: &[u8] = b"FLYBODY1";

/// Content of the file, as stored.
#[derive(Debug)]
pub(crate) struct BodyAsset {
    /// Base positions, metres: those of the body, then those that only serve to place joints.
    pub vertices: Vec<[f32; 3]>,
    pub body_vertices: usize,
    /// Body vertex of each corner, a pair of vertex and texture coordinate.
    pub corner_vertex: Vec<u16>,
    pub uvs: Vec<[f32; 2]>,
    /// Corner indices.
    pub triangles: Vec<[u16; 3]>,
    /// Joints of each body vertex.
    pub skin_joints: Vec<[u8; 4]>,
    /// Weights of each body vertex; their sum is 65535.
    pub skin_weights: Vec<[u16; 4]>,
    pub joints: Vec<AssetJoint>,
    /// Tags of each macro axis with the value at which each peaks.
    pub axes: BTreeMap<String, Vec<(f32, String)>>,
    pub targets: Vec<Target>,
}

#[derive(Debug, Deserialize)]
pub(crate) struct AssetJoint {
    pub name: String,
    pub parent: Option<usize>,
    /// Vertices whose mean is the joint's origin.
    pub vertices: Vec<usize>,
}

/// Sparse displacement of vertices.
#[derive(Debug)]
pub(crate) struct Target {
    pub kind: TargetKind,
    pub vertices: Vec<u32>,
    /// Displacement of each vertex at weight 1, in steps of `step_m` as in the file: metres would take twice the memory.
    steps: Vec<[i16; 3]>,
    step_m: f32,
}

impl Target {
    /// Iterates over the moved vertices with their displacements at weight 1, metres.
    pub fn moves(&self) -> impl Iterator<Item = (usize, [f32; 3])> {
        let metres = |steps: &[i16; 3]| steps.map(|step| f32::from(step) * self.step_m);
        self.vertices.iter().zip(&self.steps).map(move |(vertex, steps)| (*vertex as usize, metres(steps)))
    }
}

#[derive(Debug)]
pub(crate) enum TargetKind {
    /// Target whose weight is the product of the axes' hat functions.
    Macro(Vec<String>),
    /// Target whose weight is the part of the parameter with this sign.
    Local { name: String, sign: f32 },
}

#[derive(Deserialize)]
struct Header {
    body_vertices: usize,
    vertices: usize,
    corners: usize,
    triangles: usize,
    joints: Vec<AssetJoint>,
    axes: BTreeMap<String, Vec<(f32, String)>>,
    targets: Vec<TargetHeader>,
}

#[derive(Deserialize)]
struct TargetHeader {
    tags: Option<Vec<String>>,
    local: Option<String>,
    #[serde(default)]
    sign: f32,
    count: usize,
    step_m: f32,
}

/// Returns the file's content, unpacked on first use.
pub(crate) fn body_asset() -> Result<&'static BodyAsset, BodyError> {
    static ASSET: OnceLock<Result<BodyAsset, String>> = OnceLock::new();
    ASSET.get_or_init(|| unpack(FILE)).as_ref().map_err(|message| BodyError::Asset(message.clone()))
}

fn unpack(file: &[u8]) -> Result<BodyAsset, String> {
    let mut bytes = Vec::new();
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).map_err(|error| error.to_string())?;
    let mut rest = Cursor(&bytes);
    if rest.take(MAGIC.len())? != MAGIC {
        return Err("unknown format".to_owned());
    }
    let header_len = rest.array::<4, 1, _>(1, |b| u32::from_le_bytes(*b))?[0][0] as usize;
    let header: Header = serde_json::from_slice(rest.take(header_len)?).map_err(|error| error.to_string())?;
    let u16s = |b: &[u8; 2]| u16::from_le_bytes(*b);
    let i16s = |b: &[u8; 2]| i16::from_le_bytes(*b);
    let f32s = |b: &[u8; 4]| f32::from_le_bytes(*b);
    let vertices = rest.array::<4, 3, _>(header.vertices, f32s)?;
    let corner_vertex = rest.array::<2, 1, _>(header.corners, u16s)?.into_iter().map(|[v]| v).collect::<Vec<_>>();
    let uvs = rest.array::<4, 2, _>(header.corners, f32s)?;
    let triangles = rest.array::<2, 3, _>(header.triangles, u16s)?;
    let skin_joints = rest.array::<1, 4, _>(header.body_vertices, |b| b[0])?;
    let skin_weights = rest.array::<2, 4, _>(header.body_vertices, u16s)?;
    let mut targets = Vec::with_capacity(header.targets.len());
    for target in header.targets {
        let kind = match (target.tags, target.local) {
            (Some(tags), None) => TargetKind::Macro(tags),
            (None, Some(name)) => TargetKind::Local { name, sign: target.sign },
            _ => return Err("a target that is neither macro nor local".to_owned()),
        };
        let gaps = rest.array::<2, 1, _>(target.count, u16s)?;
        let mut vertex = 0;
        let moved = gaps.iter().map(|[gap]| {
            vertex += u32::from(*gap);
            vertex
        });
        let moved: Vec<u32> = moved.collect();
        let [x, y, z] = [(); 3].map(|()| rest.array::<2, 1, _>(target.count, i16s));
        let steps = x?.into_iter().zip(y?).zip(z?).map(|(([x], [y]), [z])| [x, y, z]).collect();
        targets.push(Target { kind, vertices: moved, steps, step_m: target.step_m });
    }
    let asset = BodyAsset {
        vertices,
        body_vertices: header.body_vertices,
        corner_vertex,
        uvs,
        triangles,
        skin_joints,
        skin_weights,
        joints: header.joints,
        axes: header.axes,
        targets,
    };
    check(&asset)?;
    if rest.0.is_empty() { Ok(asset) } else { Err("left-over bytes".to_owned()) }
}

/// Checks that all indices are in range, so that later code may index freely.
fn check(asset: &BodyAsset) -> Result<(), String> {
    let vertices = asset.vertices.len();
    let joints = asset.joints.len();
    let ok = asset.body_vertices <= vertices
        && asset.corner_vertex.iter().all(|&v| usize::from(v) < asset.body_vertices)
        && asset.triangles.iter().flatten().all(|&c| usize::from(c) < asset.corner_vertex.len())
        && asset.skin_joints.iter().flatten().all(|&j| usize::from(j) < joints)
        && asset.joints.iter().all(|joint| !joint.vertices.is_empty())
        && asset.joints.iter().flat_map(|joint| &joint.vertices).all(|&v| v < vertices)
        && asset.targets.iter().flat_map(|target| &target.vertices).all(|&v| (v as usize) < vertices);
    if ok { Ok(()) } else { Err("an index out of range".to_owned()) }
}

struct Cursor<'a>(&'a [u8]);

impl<'a> Cursor<'a> {
    fn take(&mut self, len: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.0.split_at_checked(len).ok_or("cut off")?;
        self.0 = rest;
        Ok(taken)
    }

    /// Reads `count` items of `N` numbers of `SIZE` bytes each.
    fn array<const SIZE: usize, const N: usize, T: Copy>(
        &mut self,
        count: usize,
        number: impl Fn(&[u8; SIZE]) -> T,
    ) -> Result<Vec<[T; N]>, String> {
        let bytes = self.take(count.checked_mul(SIZE * N).ok_or("cut off")?)?;
        let (numbers, _) = bytes.as_chunks::<SIZE>();
        let (items, _) = numbers.as_chunks::<N>();
        Ok(items.iter().map(|item| std::array::from_fn(|i| number(&item[i]))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn repack(bytes: &[u8]) -> Vec<u8> {
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        packed.write_all(bytes).unwrap();
        packed.finish().unwrap()
    }

    #[test]
    fn a_damaged_file_is_refused_not_indexed() {
        let mut bytes = Vec::new();
        flate2::read::GzDecoder::new(FILE).read_to_end(&mut bytes).unwrap();
        assert!(unpack(&FILE[..FILE.len() / 2]).is_err());
        assert!(unpack(b"").is_err());
        for len in [0, 4, 9, 500, bytes.len() / 2, bytes.len() - 1] {
            assert!(unpack(&repack(&bytes[..len])).is_err(), "cut to {len} bytes");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert_eq!(unpack(&repack(&longer)).unwrap_err(), "left-over bytes");
        // The corner list follows header and vertices; an index beyond the body must not pass.
        let header = u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize;
        let asset = unpack(FILE).unwrap();
        let corners = 12 + header + asset.vertices.len() * 12;
        bytes[corners..corners + 2].copy_from_slice(&[255, 255]);
        assert_eq!(unpack(&repack(&bytes)).unwrap_err(), "an index out of range");
    }
}
