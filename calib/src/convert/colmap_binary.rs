//! COLMAP's binary models: `cameras.bin` and `images.bin`, little endian. Points are skipped, and written as none.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufReader, Read as _},
    path::Path,
};

use flyrig_types::{Intrinsics, Rig};

use super::{
    colmap_models::{MODELS, lens, model, named, pose, shot},
    image_names::Shot,
    imported::ImportedCamera,
    shared::bad,
};
use crate::error::CalibError;

pub(super) const CAMERAS: &str = "cameras.bin";
const IMAGES: &str = "images.bin";
const POINTS: &str = "points3D.bin";
/// Longest name of an image, bytes.
const MAX_NAME: usize = 4096;
/// Bytes of a point of an image.
const POINT_BYTES: u64 = 24;

pub(super) fn read(dir: &Path) -> Result<Vec<ImportedCamera>, CalibError> {
    let file = |name: &str| {
        let path = dir.join(name);
        let source = Source::open(&path).map_err(|source| CalibError::Read { path: path.clone(), source })?;
        Ok::<_, CalibError>((path, source))
    };
    let refused =
        |path: &Path, problem: String| bad(path, format!("{problem}; write the model again (colmap model_converter)"));
    let (path, source) = file(CAMERAS)?;
    let lenses = cameras(source).map_err(|problem| refused(&path, problem))?;
    let (path, source) = file(IMAGES)?;
    let shots = images(source, &lenses).map_err(|problem| refused(&path, problem))?;
    named(&path, shots)
}

fn cameras(mut source: Source) -> Result<BTreeMap<u32, Intrinsics>, String> {
    let mut lenses = BTreeMap::new();
    for _ in 0..source.u64()? {
        let id = source.u32()?;
        let number = source.u32()?;
        let known = usize::try_from(number).ok().and_then(|number| MODELS.get(number));
        let (model, count) = *known.ok_or_else(|| format!("camera {id}: camera model {number} is not known"))?;
        let size = [source.u64()? as f64, source.u64()? as f64];
        let parameters = (0..count).map(|_| source.number()).collect::<Result<Vec<_>, _>>()?;
        let lens = lens(model, &size, &parameters).map_err(|problem| format!("camera {id}: {problem}"))?;
        if lenses.insert(id, lens).is_some() {
            return Err(format!("camera {id} is there twice"));
        }
    }
    source.end().map(|()| lenses)
}

fn images(mut source: Source, lenses: &BTreeMap<u32, Intrinsics>) -> Result<Vec<Shot>, String> {
    let mut shots = Vec::new();
    for _ in 0..source.u64()? {
        let id = source.u32()?;
        let place = format!("image {id}");
        let pose = (0..7).map(|_| source.number()).collect::<Result<Vec<_>, _>>()?;
        let camera = source.u32()?;
        let intrinsics = lenses.get(&camera).ok_or_else(|| format!("{place}: camera {camera} is not in {CAMERAS}"))?;
        let name = source.name()?;
        let points = source.u64()?;
        source.skip(points.saturating_mul(POINT_BYTES))?;
        shots.push(shot(&name, place.clone(), *intrinsics, &pose).map_err(|problem| format!("{place}: {problem}"))?);
    }
    source.end().map(|()| shots)
}

/// File that is read from its beginning to its end; nothing is allocated by a count in it.
struct Source {
    reader: BufReader<File>,
    left: u64,
}

impl Source {
    fn open(path: &Path) -> std::io::Result<Self> {
        let file = File::open(path)?;
        Ok(Self { left: file.metadata()?.len(), reader: BufReader::new(file) })
    }

    fn take(&mut self, bytes: u64) -> Result<(), String> {
        self.left = self.left.checked_sub(bytes).ok_or("is cut off, or holds a wrong count")?;
        Ok(())
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], String> {
        self.take(N as u64)?;
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes).map_err(|error| format!("cannot be read: {error}"))?;
        Ok(bytes)
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, String> {
        self.bytes().map(u64::from_le_bytes)
    }

    fn number(&mut self) -> Result<f64, String> {
        let value = f64::from_le_bytes(self.bytes()?);
        if value.is_finite() { Ok(value) } else { Err(format!("holds {value}, not a finite number")) }
    }

    /// Reads a name, which ends with a zero.
    fn name(&mut self) -> Result<String, String> {
        let mut name = Vec::new();
        loop {
            match self.bytes()? {
                [0] => break,
                _ if name.len() >= MAX_NAME => return Err(format!("has a name of more than {MAX_NAME} bytes")),
                [byte] => name.push(byte),
            }
        }
        String::from_utf8(name).map_err(|_| "has a name that is not UTF-8".to_owned())
    }

    fn skip(&mut self, bytes: u64) -> Result<(), String> {
        self.take(bytes)?;
        let skipped = std::io::copy(&mut self.reader.by_ref().take(bytes), &mut std::io::sink());
        skipped.map(drop).map_err(|error| format!("cannot be read: {error}"))
    }

    fn end(&self) -> Result<(), String> {
        if self.left == 0 { Ok(()) } else { Err(format!("has {} bytes after its last entry", self.left)) }
    }
}

/// Returns the files of a model without points.
pub(super) fn files(rig: &Rig) -> [(&'static str, Vec<u8>); 3] {
    let count = (rig.cameras.len() as u64).to_le_bytes();
    let (mut cameras, mut images) = (count.to_vec(), count.to_vec());
    for (number, camera) in (1u32..).zip(&rig.cameras) {
        let i = &camera.intrinsics;
        let (model, parameters) = model(i);
        let model = (0u32..).zip(MODELS).find(|(_, (name, _))| *name == model).map_or(0, |(id, _)| id);
        cameras.extend(number.to_le_bytes().into_iter().chain(model.to_le_bytes()));
        cameras.extend([i.width, i.height].iter().flat_map(|side| u64::from(*side).to_le_bytes()));
        cameras.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
        images.extend(number.to_le_bytes());
        images.extend(pose(camera).iter().flat_map(|value| value.to_le_bytes()));
        images.extend(number.to_le_bytes());
        images.extend(format!("{}.png\0", camera.id).bytes().chain(0u64.to_le_bytes()));
    }
    [(CAMERAS, cameras), (IMAGES, images), (POINTS, 0u64.to_le_bytes().to_vec())]
}
