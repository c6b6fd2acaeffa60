//! Binary glTF files.

use std::{io::Write as _, path::Path};

use flyrig_types::write_whole;
use glam::Vec3;
use serde_json::{Value, json};

use crate::BodyError;

/// Writer of binary glTF 2.0: collects typed data in one buffer, with a view and an accessor each.
#[derive(Debug, Default)]
pub struct GlbWriter {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl GlbWriter {
    /// Adds bytes without an accessor, such as an image. Returns the view's index.
    pub fn bytes(&mut self, data: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": data.len() }));
        self.bytes.extend_from_slice(data);
        self.views.len() - 1
    }

    /// Adds material 0 with a texture, a PNG file, to the document. It is unlit where the texture contains the lighting.
    pub fn material(&mut self, document: &mut Value, png: &[u8], is_lit: bool) {
        let view = self.bytes(png);
        document["images"] = json!([{ "bufferView": view, "mimeType": "image/png" }]);
        document["textures"] = json!([{ "source": 0 }]);
        let mut material = json!({
            "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "metallicFactor": 0.0, "roughnessFactor": 1.0 },
        });
        if !is_lit {
            document["extensionsUsed"] = json!(["KHR_materials_unlit"]);
            material["extensions"] = json!({ "KHR_materials_unlit": {} });
        }
        document["materials"] = json!([material]);
    }

    fn add(&mut self, data: &[u8], component: u32, kind: &str, count: usize, bounds: Option<[Value; 2]>) -> usize {
        let view = self.bytes(data);
        let mut accessor = json!({ "bufferView": view, "componentType": component, "count": count, "type": kind });
        if let Some([min, max]) = bounds {
            accessor["min"] = min;
            accessor["max"] = max;
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    /// Adds positions with their bounds. Returns the accessor's index.
    pub fn positions(&mut self, positions: &[Vec3]) -> usize {
        let low = positions.iter().fold(Vec3::INFINITY, |a, b| a.min(*b));
        let high = positions.iter().fold(Vec3::NEG_INFINITY, |a, b| a.max(*b));
        let bounds = [low, high].map(|bound| json!(bound.to_array()));
        self.add(bytemuck::cast_slice(positions), 5126, "VEC3", positions.len(), Some(bounds))
    }

    /// Adds rows of `width` numbers; `kind` is glTF's name of such a row, `VEC4` for example. Returns the accessor's index.
    pub fn floats(&mut self, data: &[f32], kind: &str, width: usize) -> usize {
        let bounds = (kind == "SCALAR").then(|| {
            let low = data.iter().copied().fold(f32::INFINITY, f32::min);
            let high = data.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            [json!([low]), json!([high])]
        });
        self.add(bytemuck::cast_slice(data), 5126, kind, data.len() / width, bounds)
    }

    /// Adds rows of `width` numbers of 16 bits. Returns the accessor's index.
    pub fn shorts(&mut self, data: &[u16], kind: &str, width: usize) -> usize {
        self.add(bytemuck::cast_slice(data), 5123, kind, data.len() / width, None)
    }

    /// Adds vertex indices. Returns the accessor's index.
    pub fn indices(&mut self, data: &[u32]) -> usize {
        self.add(bytemuck::cast_slice(data), 5125, "SCALAR", data.len(), None)
    }

    /// Writes the file atomically: `document` completed by asset, buffer, views and accessors.
    ///
    /// # Errors
    /// [`BodyError::Unwritten`] when the file would be larger than the format allows, or the system fails.
    pub fn write(mut self, path: &Path, mut document: Value) -> Result<(), BodyError> {
        let unwritten = |message| BodyError::Unwritten { path: path.to_owned(), message };
        document["asset"] = json!({ "version": "2.0", "generator": "flyrig" });
        document["buffers"] = json!([{ "byteLength": self.bytes.len() }]);
        document["bufferViews"] = json!(self.views);
        document["accessors"] = json!(self.accessors);
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let length =
            |bytes: usize| u32::try_from(bytes).map_err(|_| unwritten("4 GiB are the most it can hold".to_owned()));
        let total = length(12 + 8 + text.len() + 8 + self.bytes.len())?;
        let [text_length, bytes_length] = [length(text.len())?, length(self.bytes.len())?];
        write_whole(path, |out| {
            out.write_all(b"glTF")?;
            for word in [2, total, text_length] {
                out.write_all(&word.to_le_bytes())?;
            }
            out.write_all(b"JSON")?;
            out.write_all(&text)?;
            out.write_all(&bytes_length.to_le_bytes())?;
            out.write_all(b"BIN\0")?;
            out.write_all(&self.bytes)
        })
        .map_err(|source| unwritten(source.to_string()))
    }
}
