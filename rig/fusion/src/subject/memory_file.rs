//! Files of [`PersonMemory`]: safetensors, with names and numbers that are no tensors in the metadata.

use std::{collections::HashMap, io::Write as _, path::Path, sync::Arc};

use flyrig_avatar::Avatar;
use flyrig_body::{Joint, Outfit, Shoes, Skirt};
use flyrig_stfa::FeatureMemory;
use glam::{DMat4, DQuat, DVec3, Vec3};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::memory::{NetworkMemory, PersonMemory, fault};
use crate::error::FusionError;

/// Version of the file format; files of other versions are rejected.
const VERSION: &str = "1";
/// Key of the version in the file's metadata.
const VERSION_KEY: &str = "flyrig-person";
/// Key of the joints' names, one per line.
const JOINTS_KEY: &str = "joints";
/// Key of the digest of the networks' weights, hexadecimal, where a memory of networks is saved.
const NETWORKS_KEY: &str = "networks";
/// Tensor with the bytes of the avatar's file, where the person is made of one.
const AVATAR: &str = "avatar";
/// Key of a skirt's length and flare, where the person wears one.
const SKIRT_KEY: &str = "skirt";
/// Key of the soles' thickness in metres, where the person wears shoes.
const SHOES_KEY: &str = "shoes";
/// Largest size of a file, bytes; a larger one is no saved person.
const MOST_BYTES: u64 = 1 << 30;

impl PersonMemory {
    /// Writes a file, completely or not at all.
    ///
    /// # Errors
    /// [`FusionError::SavedPerson`] with the system's reason.
    pub fn save(&self, path: &Path) -> Result<(), FusionError> {
        let fail = |problem: String| fault(&path.display().to_string(), problem);
        let mut tensors = self.tensors();
        if let Some(avatar) = &self.avatar {
            let bytes = avatar.to_bytes().map_err(|error| fail(error.to_string()))?;
            tensors.push((AVATAR, Dtype::U8, vec![bytes.len()], bytes));
        }
        let views: Vec<(&str, TensorView<'_>)> = tensors
            .iter()
            .map(|(name, dtype, shape, data)| Ok((*name, TensorView::new(*dtype, shape.clone(), data)?)))
            .collect::<Result<_, safetensors::SafeTensorError>>()
            .map_err(|error| fail(error.to_string()))?;
        let file = safetensors::serialize(views, Some(self.metadata())).map_err(|error| fail(error.to_string()))?;
        flyrig_types::write_whole(path, |out| out.write_all(&file))
            .map_err(|error| fail(format!("cannot be written ({error}); check that the folder exists and has room")))
    }

    /// Reads a file of [`Self::save`].
    ///
    /// # Errors
    /// [`FusionError::SavedPerson`] when the file cannot be read, is truncated, has another version or holds non-finite numbers.
    pub fn load(path: &Path) -> Result<Self, FusionError> {
        let name = path.display().to_string();
        let read = |error: std::io::Error| fault(&name, format!("cannot be read ({error})"));
        let length = std::fs::metadata(path).map_err(read)?.len();
        if length > MOST_BYTES {
            return Err(fault(
                &name,
                format!("has {length} bytes, too many for a person; name a file that flyrig saved"),
            ));
        }
        Self::decode(&name, &std::fs::read(path).map_err(read)?)
    }

    fn decode(name: &str, file: &[u8]) -> Result<Self, FusionError> {
        let reader = MemoryReader::new(name, file)?;
        Ok(Self {
            outfit: reader.outfit()?,
            positions: reader.vec3("positions")?,
            normals: reader.vec3("normals")?,
            joints: reader.joints()?,
            translations: reader.rows("translations", Dtype::F64, 3)?.chunks_exact(3).map(DVec3::from_slice).collect(),
            memory: reader.vec4("memory")?,
            colors: reader.vec4("colors")?,
            networks: reader.networks()?,
            is_start: false,
            stream: None,
            avatar: reader.avatar()?.map(Arc::new),
        })
    }

    /// Returns name, type, shape and little-endian bytes of each tensor.
    fn tensors(&self) -> Vec<(&'static str, Dtype, Vec<usize>, Vec<u8>)> {
        let vec3 = |points: &[Vec3]| bytes(points.iter().flat_map(Vec3::to_array).map(f32::to_le_bytes));
        let vec4 = |points: &[[f32; 4]]| bytes(points.as_flattened().iter().map(|v| v.to_le_bytes()));
        let joints =
            |numbers: fn(&Joint) -> Vec<f64>| bytes(self.joints.iter().flat_map(numbers).map(f64::to_le_bytes));
        let translations = bytes(self.translations.iter().flat_map(DVec3::to_array).map(f64::to_le_bytes));
        let count = self.joints.len();
        let mut tensors = vec![
            ("positions", Dtype::F32, vec![self.positions.len(), 3], vec3(&self.positions)),
            ("normals", Dtype::F32, vec![self.normals.len(), 3], vec3(&self.normals)),
            ("parents", Dtype::F64, vec![count, 1], joints(|j| vec![j.parent.map_or(-1.0, |p| p as f64)])),
            ("rest_translations", Dtype::F64, vec![count, 3], joints(|j| j.rest_translation.to_array().to_vec())),
            ("rest_rotations", Dtype::F64, vec![count, 4], joints(|j| j.rest_rotation.to_array().to_vec())),
            ("binds", Dtype::F64, vec![count, 16], joints(|j| j.joint_from_canonical.to_cols_array().to_vec())),
            ("translations", Dtype::F64, vec![self.translations.len(), 3], translations),
            ("memory", Dtype::F32, vec![self.memory.len(), 4], vec4(&self.memory)),
            ("colors", Dtype::F32, vec![self.colors.len(), 4], vec4(&self.colors)),
        ];
        if let Some(NetworkMemory { memory, .. }) = &self.networks {
            let (rows, numbers) =
                (memory.weights().len(), |numbers: &[f32]| bytes(numbers.iter().map(|v| v.to_le_bytes())));
            tensors.push(("network_weights", Dtype::F32, vec![rows, 1], numbers(memory.weights())));
            tensors.push(("network_features", Dtype::F32, vec![rows, memory.width()], numbers(memory.features())));
        }
        tensors
    }

    /// Returns version, joints' names, clothes, and the digest of the networks.
    fn metadata(&self) -> HashMap<String, String> {
        let names: Vec<&str> = self.joints.iter().map(|joint| joint.name.as_str()).collect();
        let mut metadata =
            HashMap::from([(VERSION_KEY.to_owned(), VERSION.to_owned()), (JOINTS_KEY.to_owned(), names.join("\n"))]);
        metadata.extend(self.networks.iter().map(|of| (NETWORKS_KEY.to_owned(), format!("{:016x}", of.digest))));
        let Outfit { skirt, shoes } = self.outfit;
        metadata.extend(skirt.map(|Skirt { length, flare }| (SKIRT_KEY.to_owned(), format!("{length} {flare}"))));
        metadata.extend(shoes.map(|Shoes { sole_m }| (SHOES_KEY.to_owned(), sole_m.to_string())));
        metadata
    }
}

/// Decoder of one file.
struct MemoryReader<'a> {
    name: &'a str,
    metadata: HashMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl<'a> MemoryReader<'a> {
    /// Reads the header and checks the version.
    fn new(name: &'a str, file: &'a [u8]) -> Result<Self, FusionError> {
        let (_, header) = SafeTensors::read_metadata(file).map_err(|error| damaged(name, &error.to_string()))?;
        let metadata = header.metadata().clone().unwrap_or_default();
        match metadata.get(VERSION_KEY).map(String::as_str) {
            Some(VERSION) => {}
            Some(other) => return Err(damaged(name, &format!("is of version {other}, this flyrig reads {VERSION}"))),
            None => return Err(fault(name, "is no saved person; name a file that flyrig saved".to_owned())),
        }
        let tensors = SafeTensors::deserialize(file).map_err(|error| damaged(name, &error.to_string()))?;
        Ok(Self { name, metadata, tensors })
    }

    fn damaged(&self, problem: &str) -> FusionError {
        damaged(self.name, problem)
    }

    /// Returns the numbers of a tensor with `columns` columns, row by row; all finite.
    fn rows(&self, tensor: &str, dtype: Dtype, columns: usize) -> Result<Vec<f64>, FusionError> {
        let view = self.tensors.tensor(tensor).map_err(|_| self.damaged(&format!("lacks {tensor}")))?;
        if view.dtype() != dtype || view.shape().len() != 2 || view.shape().get(1) != Some(&columns) {
            return Err(self.damaged(&format!("{tensor} has another shape or type")));
        }
        let four = |b: &[u8]| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        let eight = |b: &[u8]| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]);
        let numbers: Vec<f64> = match dtype {
            Dtype::F32 => view.data().chunks_exact(4).map(four).collect(),
            _ => view.data().chunks_exact(8).map(eight).collect(),
        };
        if numbers.iter().all(|v| v.is_finite()) {
            Ok(numbers)
        } else {
            Err(self.damaged(&format!("{tensor} holds a number that is not finite")))
        }
    }

    fn vec3(&self, tensor: &str) -> Result<Vec<Vec3>, FusionError> {
        let numbers = self.rows(tensor, Dtype::F32, 3)?;
        Ok(numbers.chunks_exact(3).map(|p| DVec3::from_slice(p).as_vec3()).collect())
    }

    fn vec4(&self, tensor: &str) -> Result<Vec<[f32; 4]>, FusionError> {
        let numbers = self.rows(tensor, Dtype::F32, 4)?;
        Ok(numbers.chunks_exact(4).map(|p| [p[0] as f32, p[1] as f32, p[2] as f32, p[3] as f32]).collect())
    }

    fn joints(&self) -> Result<Vec<Joint>, FusionError> {
        let names: Vec<&str> = self.metadata.get(JOINTS_KEY).map_or_else(Vec::new, |names| names.lines().collect());
        let of_joints = |tensor, columns| -> Result<Vec<f64>, FusionError> {
            let numbers = self.rows(tensor, Dtype::F64, columns)?;
            if numbers.len() == names.len() * columns {
                Ok(numbers)
            } else {
                Err(self.damaged(&format!("{tensor} is of another number of joints than their names")))
            }
        };
        let (parents, rests) = (of_joints("parents", 1)?, of_joints("rest_translations", 3)?);
        let (turns, binds) = (of_joints("rest_rotations", 4)?, of_joints("binds", 16)?);
        let joint = |(i, name): (usize, &&str)| Joint {
            name: (*name).to_owned(),
            parent: (parents[i] >= 0.0).then_some(parents[i] as usize),
            rest_translation: DVec3::from_slice(&rests[3 * i..]),
            rest_rotation: DQuat::from_slice(&turns[4 * i..]),
            joint_from_canonical: DMat4::from_cols_slice(&binds[16 * i..]),
        };
        Ok(names.iter().enumerate().map(joint).collect())
    }

    /// Returns the networks' memory; `None` where none was saved.
    fn networks(&self) -> Result<Option<NetworkMemory>, FusionError> {
        let Some(digest) = self.metadata.get(NETWORKS_KEY) else { return Ok(None) };
        let digest = u64::from_str_radix(digest, 16).map_err(|_| self.damaged("the networks' digest is no number"))?;
        let width = self.tensors.tensor("network_features").ok().and_then(|view| view.shape().get(1).copied());
        let width = width.ok_or_else(|| self.damaged("lacks network_features"))?;
        let numbers = |tensor, columns| -> Result<Vec<f32>, FusionError> {
            Ok(self.rows(tensor, Dtype::F32, columns)?.into_iter().map(|v| v as f32).collect())
        };
        let (weights, features) = (numbers("network_weights", 1)?, numbers("network_features", width)?);
        let memory = FeatureMemory::from_parts(width, weights, features)
            .ok_or_else(|| self.damaged("the networks' memory does not fit itself"))?;
        Ok(Some(NetworkMemory { digest, memory }))
    }

    /// Returns the avatar that the person is made of; `None` where none was saved.
    fn avatar(&self) -> Result<Option<Avatar>, FusionError> {
        let Ok(view) = self.tensors.tensor(AVATAR) else { return Ok(None) };
        Avatar::from_bytes(view.data()).map(Some).map_err(|problem| self.damaged(&format!("its avatar: {problem}")))
    }

    fn outfit(&self) -> Result<Outfit, FusionError> {
        let skirt = |text: &String| {
            let (length, flare) = text.split_once(' ')?;
            Some(Skirt { length: length.parse().ok()?, flare: flare.parse().ok()? })
        };
        let skirt = self.metadata.get(SKIRT_KEY).map(skirt);
        let skirt = skirt.map(|skirt| skirt.ok_or_else(|| self.damaged("the skirt's length and flare are no numbers")));
        let shoes = self.metadata.get(SHOES_KEY).map(|text| text.parse().map(|sole_m| Shoes { sole_m }));
        let shoes = shoes.map(|shoes| shoes.map_err(|_| self.damaged("the shoes' soles are no number")));
        Ok(Outfit { skirt: skirt.transpose()?, shoes: shoes.transpose()? })
    }
}

fn damaged(name: &str, problem: &str) -> FusionError {
    fault(name, format!("{problem}; delete it, it is learnt again"))
}

fn bytes<const N: usize>(numbers: impl Iterator<Item = [u8; N]>) -> Vec<u8> {
    numbers.flatten().collect()
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, Template, default_template};

    use super::*;

    fn memory() -> (Template, PersonMemory) {
        let mut template = default_template(&ShapeParams::default()).unwrap();
        template.positions[7] += Vec3::new(0.01, 0.0, -0.02);
        let translations = vec![DVec3::new(0.001, -0.002, 0.003); 5];
        let colors = vec![[0.5; 4]; 9];
        let outfit = Outfit { skirt: Some(Skirt { length: 0.55, flare: 0.15 }), shoes: Some(Shoes { sole_m: 0.02 }) };
        let memory = PersonMemory::new((&template, outfit), translations, vec![[0.1, 0.2, 0.3, 8.0]; 9], colors, None);
        (template, memory)
    }

    #[test]
    fn a_saved_person_comes_back_bit_for_bit() {
        let (template, memory) = memory();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("person.safetensors");
        memory.save(&path).unwrap();
        let loaded = PersonMemory::load(&path).unwrap();
        assert_eq!(loaded, memory);
        let base = default_template(&ShapeParams::default()).unwrap();
        assert_eq!(loaded.template(&base).unwrap(), template);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "written whole");
        let error = memory.save(&folder.path().join("none/person")).unwrap_err().to_string();
        assert!(error.contains("cannot be written"), "{error}");
    }

    #[test]
    fn what_is_no_saved_person_is_refused_in_words() {
        let (_, memory) = memory();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("person.safetensors");
        memory.save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for cut in [0, 4, 8, 100, whole.len() / 2, whole.len() - 1] {
            let error = PersonMemory::decode("p", &whole[..cut]).unwrap_err().to_string();
            assert!(error.starts_with("saved person p: "), "{error}");
        }
        let mut poisoned = memory.clone();
        poisoned.memory[3][1] = f32::NAN;
        poisoned.save(&path).unwrap();
        let error = PersonMemory::load(&path).unwrap_err().to_string();
        assert!(error.contains("memory holds a number that is not finite"), "{error}");
        let other = safetensors::serialize(Vec::<(&str, TensorView<'_>)>::new(), None).unwrap();
        assert!(PersonMemory::decode("p", &other).unwrap_err().to_string().contains("is no saved person"));
        assert!(PersonMemory::load(&folder.path().join("none")).unwrap_err().to_string().contains("cannot be read"));
    }

    #[test]
    fn the_memory_of_networks_comes_back_and_damage_to_it_is_found() {
        let (_, mut memory) = memory();
        let features =
            FeatureMemory::from_parts(2, vec![0.5, 8.0, 0.0], vec![0.1, -3.0, 1e-30, 4.0, 0.0, -0.0]).unwrap();
        memory.networks = Some(NetworkMemory { digest: u64::MAX - 6, memory: features });
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("person.safetensors");
        memory.save(&path).unwrap();
        assert_eq!(PersonMemory::load(&path).unwrap(), memory);

        let whole = std::fs::read(&path).unwrap();
        let replaced = |old: &str, new: &str| {
            assert_eq!(old.len(), new.len());
            let at = whole.windows(old.len()).position(|window| window == old.as_bytes()).unwrap();
            let mut file = whole.clone();
            file[at..at + new.len()].copy_from_slice(new.as_bytes());
            PersonMemory::decode("p", &file).unwrap_err().to_string()
        };
        assert!(replaced("network_features", "network_featuers").contains("lacks network_features"));
        assert!(replaced("network_weights", "network_weihgts").contains("lacks network_weights"));
        assert!(replaced("fffffffffffffff9", "fffffffffffffffx").contains("digest is no number"));
        assert!(replaced("\"shoes\":\"0.02", "\"shoes\":\"0,02").contains("the shoes' soles are no number"));
        assert!(
            replaced("\"skirt\":\"0.55 ", "\"skirt\":\"0.55-").contains("the skirt's length and flare are no numbers")
        );
        let features = FeatureMemory::from_parts(2, vec![1.0; 2], vec![0.0; 4]).unwrap();
        memory.networks = Some(NetworkMemory { digest: 1, memory: features });
        memory.save(&path).unwrap();
        let mut file = std::fs::read(&path).unwrap();
        // The weights of both Gaussians are the only ones in the file.
        let ones = [1.0f32.to_le_bytes(), 1.0f32.to_le_bytes()].concat();
        let at = file.windows(8).rposition(|window| window == ones).unwrap();
        file[at..at + 4].copy_from_slice(&(-1.0f32).to_le_bytes());
        let error = PersonMemory::decode("p", &file).unwrap_err().to_string();
        assert!(error.contains("the networks' memory does not fit itself"), "{error}");
    }
}
