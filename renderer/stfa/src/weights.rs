//! Weights files: safetensors with a card of their provenance.

use std::{collections::HashMap, path::Path};

use flyrig_learn::Parameter;
use safetensors::SafeTensors;

use crate::{
    NetworkSize, Parameters, StfaError,
    tensor_file::{TensorFile, array, read},
};

/// Version of the networks; files of other versions are rejected.
pub const WEIGHTS_VERSION: u32 = 1;

/// Bundled weights by name; the first are the default.
pub const EMBEDDED: [(&str, &[u8]); 2] = [
    ("small", include_bytes!("../weights/small.safetensors")),
    ("tiny", include_bytes!("../weights/tiny.safetensors")),
];

/// Largest accepted number of channels, heads and layers, against damaged files.
const MAX_SIZE: usize = 4096;

impl Parameters {
    /// Writes the weights; `card` is free-form JSON (data, seeds, command, scores).
    ///
    /// # Errors
    /// [`StfaError::File`].
    pub fn save(&self, path: &Path, card: &serde_json::Value) -> Result<(), StfaError> {
        let mut file = TensorFile::default();
        self.push_to(&mut file, "");
        file.write(path, self.metadata(card))
    }

    /// Returns a hash of the weights: FNV-1a of all values in the order of their names.
    #[must_use]
    pub fn digest(&self) -> u64 {
        let values = self.by_name.values().flat_map(|parameter| &parameter.values);
        let fold = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        values.flat_map(|value| value.to_le_bytes()).fold(0xcbf2_9ce4_8422_2325, fold)
    }

    pub(crate) fn push_to(&self, file: &mut TensorFile, prefix: &str) {
        for (name, parameter) in &self.by_name {
            file.push(format!("{prefix}{name}"), parameter.shape.clone(), &parameter.values);
        }
    }

    pub(crate) fn metadata(&self, card: &serde_json::Value) -> HashMap<String, String> {
        // A struct of numbers always has a JSON form.
        let size = serde_json::to_string(&self.size).unwrap_or_default();
        HashMap::from([
            ("flyrig-stfa".to_owned(), WEIGHTS_VERSION.to_string()),
            ("size".to_owned(), size),
            ("card".to_owned(), card.to_string()),
        ])
    }

    /// Loads bundled weights by a name of [`EMBEDDED`] (`renderer/stfa/weights` has cards with their provenance), or
    /// those of a file.
    ///
    /// # Errors
    /// [`StfaError::File`]; [`StfaError::Weights`] for a file that is truncated, of another version or another network.
    pub fn named(name_or_file: &Path) -> Result<Self, StfaError> {
        match EMBEDDED.iter().find(|(name, _)| name_or_file.as_os_str() == *name) {
            Some((name, bytes)) => Self::from_bytes(name, bytes),
            None => Self::load(name_or_file),
        }
    }

    /// Reads weights from a file.
    ///
    /// # Errors
    /// [`StfaError::File`]; [`StfaError::Weights`] for a file that is truncated, of another version or another network.
    pub fn load(path: &Path) -> Result<Self, StfaError> {
        Self::from_bytes(&path.display().to_string(), &read(path)?)
    }

    /// Reads weights from a file's bytes; `name` is for errors.
    ///
    /// # Errors
    /// [`StfaError::Weights`].
    pub fn from_bytes(name: &str, bytes: &[u8]) -> Result<Self, StfaError> {
        let refuse = |what: String| StfaError::Weights { name: name.to_owned(), what };
        let file = SafeTensors::deserialize(bytes).map_err(|error| refuse(format!("not a whole file ({error})")))?;
        Self::read_from(&file, &header(bytes).map_err(refuse)?, "").map_err(refuse)
    }

    pub(crate) fn read_from(
        file: &SafeTensors<'_>,
        metadata: &HashMap<String, String>,
        prefix: &str,
    ) -> Result<Self, String> {
        let version = metadata.get("flyrig-stfa").ok_or("it holds no flyrig networks")?;
        if *version != WEIGHTS_VERSION.to_string() {
            return Err(format!("version {version}, expected {WEIGHTS_VERSION}"));
        }
        let size = metadata.get("size").ok_or("the networks' size is missing")?;
        let size: NetworkSize = serde_json::from_str(size).map_err(|error| format!("the networks' size: {error}"))?;
        check_size(&size)?;
        let mut by_name = std::collections::BTreeMap::new();
        for (name, shape, _) in size.parameters() {
            let values: Vec<f32> = array(file, &format!("{prefix}{name}"), &shape)?;
            if !values.iter().all(|v| v.is_finite()) {
                return Err(format!("{name} holds numbers that are not finite"));
            }
            by_name.insert(name, Parameter { shape, values });
        }
        Ok(Self { size, by_name })
    }
}

/// Reads the metadata of a safetensors file.
pub(crate) fn header(bytes: &[u8]) -> Result<HashMap<String, String>, String> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
    Ok(metadata.metadata().clone().unwrap_or_default())
}

fn check_size(size: &NetworkSize) -> Result<(), String> {
    let NetworkSize { channels: [a, b, c], node, heads, layers, hidden: [d, e] } = *size;
    let sizes = [a, b, c, node, heads, layers, d, e];
    if sizes.iter().any(|&s| s == 0 || s > MAX_SIZE) || node % heads != 0 {
        return Err(format!("a network of size {size:?} cannot be"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_that_come_along_are_whole_and_others_are_files() {
        let counts = EMBEDDED.map(|(name, _)| Parameters::named(Path::new(name)).unwrap().count());
        assert_eq!(counts, [35_920, 8_860]);
        let error = Parameters::named(Path::new("no-such-weights")).unwrap_err().to_string();
        assert!(error.contains("no-such-weights"), "{error}");
    }
}
