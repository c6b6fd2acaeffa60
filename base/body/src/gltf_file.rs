//! Buffers and accessors of glTF files, with all lengths checked.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use base64::Engine;
use gltf::accessor::sparse::IndexType;
use gltf::accessor::{DataType, Dimensions};
use gltf::buffer::Source;

use crate::gltf_limits::{MAX_FILE_BYTES, MAX_JSON_ENTRIES};
use crate::{BodyError, gltf_json, gltf_uri};

/// Parsed file with its buffers.
pub(crate) struct GltfFile<'a> {
    pub path: &'a Path,
    pub document: gltf::Document,
    buffers: Vec<Vec<u8>>,
}

impl<'a> GltfFile<'a> {
    /// Reads a `.glb`, or a `.gltf` whose buffers are data URIs or files in its folder.
    pub fn open(path: &'a Path) -> Result<Self, BodyError> {
        let fail = |message: String| BodyError::Gltf { path: path.into(), message };
        let bytes = gltf_uri::read(path, MAX_FILE_BYTES)?;
        // The parser would trust the length in the header.
        if let Some(stated) = bytes.get(8..12).filter(|_| bytes.starts_with(b"glTF")) {
            let stated = u32::from_le_bytes([stated[0], stated[1], stated[2], stated[3]]) as usize;
            if !(20..=bytes.len()).contains(&stated) {
                let found = bytes.len();
                return Err(fail(format!("cut off: {found} of {stated} bytes; copy the file again")));
            }
        }
        let entries = json_entries(json_part(&bytes));
        if entries > MAX_JSON_ENTRIES {
            return Err(fail(too_many("entries of the JSON part", entries, MAX_JSON_ENTRIES)));
        }
        let invalid = |error: gltf::Error| fail(format!("not a valid glTF 2.0 file: {error}"));
        let (text, mut blob) = match bytes.starts_with(b"glTF") {
            true => {
                let glb = gltf::Glb::from_slice(&bytes).map_err(invalid)?;
                (glb.json, glb.bin.map(Cow::into_owned))
            }
            false => (bytes.as_slice().into(), None),
        };
        let json = gltf_json::read(&text, path).map_err(fail)?;
        check_trusted(&json).map_err(fail)?;
        let document = gltf::Document::from_json(json).map_err(invalid)?;
        let beside = external_buffers(path, &document)?;
        let mut buffers = Vec::new();
        for (buffer, beside) in document.buffers().zip(beside) {
            let index = buffer.index();
            let data = match (buffer.source(), beside) {
                (Source::Bin, _) => blob.take().ok_or_else(|| fail(format!("buffer {index} has no data")))?,
                (Source::Uri(_), Some(beside)) => gltf_uri::read(&beside, MAX_FILE_BYTES)?,
                (Source::Uri(uri), None) => base64::engine::general_purpose::STANDARD
                    .decode(embedded(uri).unwrap_or_default())
                    .map_err(|error| fail(format!("buffer {index}: {error}")))?,
            };
            let (found, stated) = (data.len(), buffer.length());
            if found < stated {
                return Err(fail(format!("buffer {index} is cut off: {found} of {stated} bytes")));
            }
            buffers.push(data);
        }
        Ok(Self { path, document, buffers })
    }

    /// Creates an error about this file.
    pub fn fail(&self, message: impl Into<String>) -> BodyError {
        BodyError::Gltf { path: self.path.into(), message: message.into() }
    }

    /// Checks that `found` is at most `limit`.
    pub fn check_count(&self, what: &str, found: usize, limit: usize) -> Result<(), BodyError> {
        if found > limit { Err(self.fail(too_many(what, found, limit))) } else { Ok(()) }
    }

    /// Reads at most `limit` items of `N` numbers; normalised integers become fractions, other numbers keep their value.
    pub fn numbers<const N: usize>(
        &self,
        accessor: &gltf::Accessor<'_>,
        what: &str,
        limit: usize,
    ) -> Result<Vec<[f64; N]>, BodyError> {
        let wanted = match N {
            1 => Dimensions::Scalar,
            2 => Dimensions::Vec2,
            3 => Dimensions::Vec3,
            4 => Dimensions::Vec4,
            _ => Dimensions::Mat4,
        };
        let found = accessor.dimensions();
        if found != wanted {
            return Err(self.fail(format!("{what} is {found:?}, it must be {wanted:?}")));
        }
        let count = accessor.count();
        self.check_count(&format!("items of {what}"), count, limit)?;
        let data_type = accessor.data_type();
        let item = |bytes: &[u8]| {
            let size = data_type.size();
            std::array::from_fn(|n| number(&bytes[n * size..(n + 1) * size], data_type, accessor.normalized()))
        };
        let size = data_type.size() * N;
        let mut items: Vec<[f64; N]> = match accessor.view() {
            Some(view) => self.rows(&view, accessor.offset(), size, count, what)?.map(item).collect(),
            // Zeros by the specification.
            None => vec![[0.0; N]; count],
        };
        if let Some(sparse) = accessor.sparse() {
            let changed = sparse.count();
            self.check_count(&format!("replaced items of {what}"), changed, count)?;
            let (indices, values) = (sparse.indices(), sparse.values());
            let index_type = match indices.index_type() {
                IndexType::U8 => DataType::U8,
                IndexType::U16 => DataType::U16,
                IndexType::U32 => DataType::U32,
            };
            let at = self.rows(&indices.view(), indices.offset(), index_type.size(), changed, what)?;
            for (at, value) in at.zip(self.rows(&values.view(), values.offset(), size, changed, what)?) {
                let at = number(at, index_type, false) as usize;
                let Some(replaced) = items.get_mut(at) else {
                    return Err(self.fail(format!("{what} replaces item {at} of {count}; the file is damaged")));
                };
                *replaced = item(value);
            }
        }
        Ok(items)
    }

    /// Returns `count` rows of `size` bytes of a view, from `offset` on, with all lengths checked.
    fn rows<'s>(
        &'s self,
        view: &gltf::buffer::View<'_>,
        offset: usize,
        size: usize,
        count: usize,
        what: &str,
    ) -> Result<impl Iterator<Item = &'s [u8]> + use<'s, 'a>, BodyError> {
        let cut_off = || self.fail(format!("{what} reaches beyond the end of its buffer; the file is damaged"));
        let stride = view.stride().unwrap_or(size);
        let buffer = self.buffers.get(view.buffer().index()).ok_or_else(cut_off)?;
        let end = view.offset().checked_add(view.length()).ok_or_else(cut_off)?;
        let bytes = buffer.get(view.offset()..end).and_then(|bytes| bytes.get(offset..)).ok_or_else(cut_off)?;
        let needed = match count {
            0 => Some(0),
            _ => stride.checked_mul(count - 1).and_then(|bytes| bytes.checked_add(size)),
        };
        if stride < size || needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(cut_off());
        }
        Ok((0..count).map(move |index| &bytes[index * stride..index * stride + size]))
    }

    /// Reads numbers as [`Self::numbers`] does and checks that all are finite.
    pub fn finite<const N: usize>(
        &self,
        accessor: &gltf::Accessor<'_>,
        what: &str,
        limit: usize,
    ) -> Result<Vec<[f64; N]>, BodyError> {
        let items = self.numbers::<N>(accessor, what, limit)?;
        match items.iter().position(|item| item.iter().any(|x| !x.is_finite())) {
            Some(index) => Err(self.fail(format!("item {index} of {what} is not a finite number"))),
            None => Ok(items),
        }
    }
}

/// Returns the base64 part of a data URI.
fn embedded(uri: &str) -> Option<&str> {
    uri.strip_prefix("data:")?.split_once("base64,").map(|(_, data)| data)
}

/// Returns the path of each buffer in a file of its own. Checks the sum of their sizes before any is read: many buffers may name
/// one file.
fn external_buffers(path: &Path, document: &gltf::Document) -> Result<Vec<Option<PathBuf>>, BodyError> {
    let mut total = 0u64;
    let beside = document.buffers().map(|buffer| {
        let Source::Uri(uri) = buffer.source() else { return Ok(None) };
        if embedded(uri).is_some() {
            return Ok(None);
        }
        let beside = gltf_uri::resolve(path, uri)?;
        let meta = std::fs::metadata(&beside).map_err(|source| BodyError::Io { path: beside.clone(), source })?;
        total = total.saturating_add(meta.len());
        if total > MAX_FILE_BYTES {
            let message =
                too_many(&format!("bytes of all buffers up to buffer {}", buffer.index()), total, MAX_FILE_BYTES);
            return Err(BodyError::Gltf { path: path.into(), message });
        }
        Ok(Some(beside))
    });
    beside.collect()
}

fn too_many(what: &str, found: impl std::fmt::Display, limit: impl std::fmt::Display) -> String {
    format!("{what}: {found}, at most {limit} are allowed; export the body alone, with a shorter animation")
}

/// Returns the JSON of either form of a file; truncated JSON is left to the parser.
fn json_part(bytes: &[u8]) -> &[u8] {
    match (bytes.starts_with(b"glTF"), bytes.get(12..20)) {
        (true, Some(&[a, b, c, d, ..])) => {
            let rest = &bytes[20..];
            &rest[..rest.len().min(u32::from_le_bytes([a, b, c, d]) as usize)]
        }
        _ => bytes,
    }
}

/// Returns an upper bound of the number of objects, arrays and entries in JSON text, without parsing it.
fn json_entries(text: &[u8]) -> usize {
    let (mut entries, mut is_string, mut is_escaped) = (0, false, false);
    for byte in text {
        match (byte, is_string) {
            _ if is_escaped => is_escaped = false,
            (b'\\', true) => is_escaped = true,
            (b'"', _) => is_string = !is_string,
            (b'{' | b'[' | b',', false) => entries += 1,
            _ => {}
        }
    }
    entries
}

/// Checks the parts of a document that gltf 1.4 uses without validation.
fn check_trusted(json: &gltf::json::Root) -> Result<(), String> {
    let primitives = json.meshes.iter().flat_map(|mesh| &mesh.primitives);
    if primitives.flat_map(|primitive| primitive.attributes.values()).any(|index| index.value() >= json.accessors.len())
    {
        return Err("a mesh names an accessor that does not exist; the file is damaged".to_owned());
    }
    for target in json.animations.iter().flat_map(|animation| &animation.channels).map(|channel| &channel.target) {
        if target.node.value() >= json.nodes.len() {
            return Err("an animation moves a node that does not exist; the file is damaged".to_owned());
        }
    }
    Ok(())
}

/// Reads one little-endian number; `bytes` has the type's size.
fn number(bytes: &[u8], data_type: DataType, normalized: bool) -> f64 {
    let mut padded = [0; 4];
    padded[..bytes.len()].copy_from_slice(bytes);
    let unsigned = u32::from_le_bytes(padded);
    let (value, one) = match data_type {
        DataType::F32 => return f64::from(f32::from_bits(unsigned)),
        DataType::U32 => (f64::from(unsigned), f64::from(u32::MAX)),
        DataType::U16 => (f64::from(unsigned), f64::from(u16::MAX)),
        DataType::U8 => (f64::from(unsigned), f64::from(u8::MAX)),
        DataType::I16 => (f64::from(unsigned as u16 as i16), f64::from(i16::MAX)),
        DataType::I8 => (f64::from(unsigned as u8 as i8), f64::from(i8::MAX)),
    };
    if normalized { (value / one).max(-1.0) } else { value }
}
