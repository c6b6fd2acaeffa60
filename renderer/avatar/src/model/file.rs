//! `.flyavatar` files: safetensors, with a card in JSON.

use std::{collections::HashMap, io::Write as _, path::Path};

use bytemuck::Pod;
use flyrig_body::{Joint, Part, Skeleton, SkinWeights, Template};
use flyrig_types::write_whole;
use glam::{DMat4, DQuat, DVec3, Quat, Vec2, Vec3};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::error::AvatarError;
use crate::model::avatar::{Attachment, Avatar, Card, Hanging};
use crate::model::known_poses::KnownPoses;
use crate::model::light::Light;
use crate::model::parameters::GaussianParameters;

/// Version of the format; files of other versions are rejected.
const VERSION: u32 = 2;
/// Key of the header in the file's metadata.
const HEADER: &str = "flyavatar";
/// Largest size of an avatar's file, bytes.
const MOST_BYTES: u64 = 1 << 30;

#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    card: Card,
    template: String,
    joints: Vec<JointRow>,
}

#[derive(Serialize, Deserialize)]
struct VersionOnly {
    version: u32,
}

#[derive(Serialize, Deserialize)]
struct JointRow {
    name: String,
    parent: Option<usize>,
}

/// Numbers per joint: translation and rotation at rest, and the matrix from canonical space.
const JOINT_NUMBERS: usize = 3 + 4 + 16;

fn numbers(joint: &Joint) -> [f64; JOINT_NUMBERS] {
    let mut all = [0.0; JOINT_NUMBERS];
    let matrix = joint.joint_from_canonical.to_cols_array();
    let parts = joint.rest_translation.to_array().into_iter().chain(joint.rest_rotation.to_array()).chain(matrix);
    all.iter_mut().zip(parts).for_each(|(number, part)| *number = part);
    all
}

fn joint(row: JointRow, [x, y, z, qx, qy, qz, qw, matrix @ ..]: [f64; JOINT_NUMBERS]) -> Joint {
    Joint {
        name: row.name,
        parent: row.parent,
        rest_translation: DVec3::new(x, y, z),
        rest_rotation: DQuat::from_xyzw(qx, qy, qz, qw),
        joint_from_canonical: DMat4::from_cols_array(&matrix),
    }
}

/// Names of the arrays of a body: positions, normals, texture coordinates, triangles, joints and weights of the skin, parts.
type BodyNames = [&'static str; 7];
const BODY: BodyNames =
    ["body.positions", "body.normals", "body.uvs", "body.triangles", "body.joints", "body.weights", "body.parts"];
const UNDRESSED: BodyNames = [
    "undressed.positions",
    "undressed.normals",
    "undressed.uvs",
    "undressed.triangles",
    "undressed.joints",
    "undressed.weights",
    "undressed.parts",
];

fn flat(list: &[Vec3]) -> Vec<[f32; 3]> {
    list.iter().map(Vec3::to_array).collect()
}

/// Collection of arrays to write.
#[derive(Default)]
struct Arrays(Vec<(&'static str, Dtype, Vec<usize>, Vec<u8>)>);

impl Arrays {
    fn push<T: Pod>(&mut self, name: &'static str, dtype: Dtype, columns: usize, values: &[T]) {
        let bytes = bytemuck::cast_slice(values).to_vec();
        let rows = bytes.len() / (columns * dtype.bitsize() / 8).max(1);
        self.0.push((name, dtype, vec![rows, columns], bytes));
    }

    fn skin(&mut self, [joints, weights]: [&'static str; 2], skin: &[SkinWeights]) {
        let numbers: Vec<[u16; 4]> = skin.iter().map(|skin| skin.joints).collect();
        self.push(joints, Dtype::U16, 4, &numbers);
        let shares: Vec<[f32; 4]> = skin.iter().map(|skin| skin.weights).collect();
        self.push(weights, Dtype::F32, 4, &shares);
    }

    /// Adds the mesh of a body, without its skeleton.
    fn body(&mut self, [positions, normals, uvs, triangles, joints, weights, parts]: BodyNames, body: &Template) {
        self.push(positions, Dtype::F32, 3, &flat(&body.positions));
        self.push(normals, Dtype::F32, 3, &flat(&body.normals));
        self.push(uvs, Dtype::F32, 2, &body.uvs.iter().map(Vec2::to_array).collect::<Vec<_>>());
        self.push(triangles, Dtype::U32, 3, &body.triangles);
        self.skin([joints, weights], &body.skin);
        let part = |part: &Part| Part::ALL.iter().position(|known| known == part).unwrap_or_default() as u8;
        self.push(parts, Dtype::U8, 1, &body.parts.iter().map(part).collect::<Vec<_>>());
    }
}

/// Reads rows of `N` numbers of type `T`.
fn rows<T: Pod, const N: usize>(file: &SafeTensors<'_>, name: &str, dtype: Dtype) -> Result<Vec<[T; N]>, String> {
    let found = file.tensor(name).map_err(|_| format!("{name} is missing"))?;
    if found.dtype() != dtype || found.shape().len() != 2 || found.shape()[1] != N {
        return Err(format!("{name} is {:?} of {:?}, expected {N} columns of {dtype:?}", found.shape(), found.dtype()));
    }
    let numbers: Vec<T> = bytemuck::try_cast_slice(found.data())
        .map(<[T]>::to_vec)
        // Not aligned: number by number.
        .unwrap_or_else(|_| found.data().chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect());
    Ok(numbers.chunks_exact(N).filter_map(|row| row.try_into().ok()).collect())
}

fn vectors(file: &SafeTensors<'_>, name: &str) -> Result<Vec<Vec3>, String> {
    Ok(rows::<f32, 3>(file, name, Dtype::F32)?.into_iter().map(Vec3::from).collect())
}

fn skin(file: &SafeTensors<'_>, [joints, weights]: [&str; 2]) -> Result<Vec<SkinWeights>, String> {
    let joints = rows::<u16, 4>(file, joints, Dtype::U16)?;
    let weights = rows::<f32, 4>(file, weights, Dtype::F32)?;
    if joints.len() != weights.len() {
        return Err("it has skin weights for another number of joints".to_owned());
    }
    Ok(joints.into_iter().zip(weights).map(|(joints, weights)| SkinWeights { joints, weights }).collect())
}

/// Reads the mesh of a body with this name and skeleton.
fn body(
    file: &SafeTensors<'_>,
    [positions, normals, uvs, triangles, joints, weights, parts]: BodyNames,
    (name, skeleton): (String, Skeleton),
) -> Result<Template, String> {
    let parts = rows::<u8, 1>(file, parts, Dtype::U8)?.into_iter().map(|[part]| {
        Part::ALL.get(usize::from(part)).copied().ok_or_else(|| format!("body part {part} does not exist"))
    });
    Ok(Template {
        name,
        positions: vectors(file, positions)?,
        normals: vectors(file, normals)?,
        uvs: rows::<f32, 2>(file, uvs, Dtype::F32)?.into_iter().map(Vec2::from).collect(),
        triangles: rows::<u32, 3>(file, triangles, Dtype::U32)?,
        skin: skin(file, [joints, weights])?,
        parts: parts.collect::<Result<_, _>>()?,
        skeleton,
    })
}

impl Avatar {
    /// Returns the bytes of the avatar's file. Equal avatars give equal bytes.
    ///
    /// # Errors
    /// [`AvatarError::Format`] for non-finite numbers.
    pub fn to_bytes(&self) -> Result<Vec<u8>, AvatarError> {
        let fail = |problem: String| AvatarError::Format { path: "avatar".into(), problem };
        self.check().map_err(fail)?;
        let Template { name, skeleton, .. } = &self.template;
        let mut arrays = Arrays::default();
        arrays.body(BODY, &self.template);
        if let Some(body) = &self.undressed {
            arrays.body(UNDRESSED, body);
        }
        let bones: Vec<_> = skeleton.joints().iter().map(numbers).collect();
        arrays.push("body.skeleton", Dtype::F64, JOINT_NUMBERS, &bones);
        arrays.push("gaussians.places", Dtype::F32, 3, &flat(&self.places));
        let triangles: Vec<u32> = self.attachments.iter().map(|attachment| attachment.triangle).collect();
        arrays.push("gaussians.triangles", Dtype::U32, 1, &triangles);
        let corners: Vec<[f32; 3]> = self.attachments.iter().map(|attachment| attachment.barycentric).collect();
        arrays.push("gaussians.barycentric", Dtype::F32, 3, &corners);
        arrays.skin(["gaussians.joints", "gaussians.weights"], &self.skin);
        for (name, list) in LISTS.into_iter().zip(self.parameters.lists()) {
            arrays.push(name, Dtype::F32, 4, list);
        }
        arrays.push("light", Dtype::F32, 3, &self.light.terms);
        if let Some(hanging) = &self.hanging {
            arrays.push("graph.nodes", Dtype::F32, 3, &flat(&hanging.nodes));
            let mean: Vec<[f32; 3]> = hanging.mean.iter().map(|v| v.as_vec3().to_array()).collect();
            arrays.push("graph.mean", Dtype::F32, 3, &mean);
            arrays.push("graph.gaussian_nodes", Dtype::U32, 4, &hanging.gaussian_nodes);
            arrays.push("graph.gaussian_weights", Dtype::F32, 4, &hanging.gaussian_weights);
        }
        let poses: Vec<[f32; 4]> = self.known_poses.0.iter().flatten().map(|turn| turn.as_quat().to_array()).collect();
        arrays.push("poses", Dtype::F32, 4, &poses);
        let joints = skeleton.joints().iter().map(|joint| JointRow { name: joint.name.clone(), parent: joint.parent });
        let header =
            Header { version: VERSION, card: self.card.clone(), template: name.clone(), joints: joints.collect() };
        let header = serde_json::to_string(&header).map_err(|error| fail(error.to_string()))?;
        let views: Vec<_> = arrays
            .0
            .iter()
            .map(|(name, dtype, shape, bytes)| Ok((*name, TensorView::new(*dtype, shape.clone(), bytes)?)))
            .collect::<Result<_, safetensors::SafeTensorError>>()
            .map_err(|error| fail(error.to_string()))?;
        safetensors::serialize(views, Some(HashMap::from([(HEADER.to_owned(), header)])))
            .map_err(|error| fail(error.to_string()))
    }

    /// Writes the avatar atomically.
    ///
    /// # Errors
    /// [`AvatarError::File`], [`AvatarError::Format`].
    pub fn save(&self, path: &Path) -> Result<(), AvatarError> {
        let bytes = self.to_bytes()?;
        write_whole(path, |out| out.write_all(&bytes)).map_err(|source| AvatarError::File { path: path.into(), source })
    }

    /// Reads an avatar.
    ///
    /// # Errors
    /// [`AvatarError::File`], and [`AvatarError::Format`] for a file that is damaged, newer, or no avatar.
    pub fn load(path: &Path) -> Result<Self, AvatarError> {
        let file = |source| AvatarError::File { path: path.into(), source };
        let size = std::fs::metadata(path).map_err(file)?.len();
        let fail = |problem: String| AvatarError::Format { path: path.into(), problem };
        if size > MOST_BYTES {
            return Err(fail(format!("{size} bytes, an avatar has at most {MOST_BYTES}")));
        }
        Self::from_bytes(&std::fs::read(path).map_err(file)?).map_err(fail)
    }

    /// Reads an avatar from the bytes of its file.
    ///
    /// # Errors
    /// A text with the fault and its fix.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        let foreign = || "is no avatar; build one with `flyrig avatar build`".to_owned();
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|_| foreign())?;
        let header = metadata.metadata().as_ref().and_then(|all| all.get(HEADER)).ok_or_else(foreign)?;
        let found =
            serde_json::from_str::<VersionOnly>(header).map_err(|error| format!("is damaged: {error}"))?.version;
        if found > VERSION {
            return Err(format!(
                "has version {found} of the format, this program reads {VERSION}; update flyrig, or build it again"
            ));
        }
        if found < VERSION {
            return Err(format!("has version {found} of the format, this program reads {VERSION}; build it again"));
        }
        Self::read(bytes, header).map_err(|problem| format!("is damaged: {problem}; build it again"))
    }

    fn read(bytes: &[u8], header: &str) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let Header { card, template, joints, .. } = serde_json::from_str(header).map_err(|error| error.to_string())?;
        let numbers = rows::<f64, JOINT_NUMBERS>(&file, "body.skeleton", Dtype::F64)?;
        if numbers.len() != joints.len() {
            return Err(format!("numbers of {} joints for {}", numbers.len(), joints.len()));
        }
        let joints = joints.into_iter().zip(numbers).map(|(row, numbers)| joint(row, numbers));
        let skeleton = Skeleton::new(joints.collect()).map_err(|error| error.to_string())?;
        let template = body(&file, BODY, (template, skeleton))?;
        let undressed = match file.tensor(UNDRESSED[0]) {
            Err(_) => None,
            Ok(_) => Some(body(&file, UNDRESSED, (template.name.clone(), template.skeleton.clone()))?),
        };
        let lists = LISTS.map(|name| rows::<f32, 4>(&file, name, Dtype::F32));
        let [offset, shape, rotation, harmonics] = lists;
        let parameters = GaussianParameters::from_lists([offset?, shape?, rotation?, harmonics?])
            .ok_or("its lists of Gaussians have different lengths")?;
        let light = match file.tensor("light") {
            // Avatars of before have none.
            Err(_) => Light::default(),
            Ok(_) => {
                let terms = rows::<f32, 3>(&file, "light", Dtype::F32)?;
                Light { terms: terms.try_into().map_err(|_| "its light has another number of terms")? }
            }
        };
        let hanging = match file.tensor("graph.nodes") {
            Err(_) => None,
            Ok(_) => Some(Hanging {
                nodes: vectors(&file, "graph.nodes")?,
                mean: vectors(&file, "graph.mean")?.into_iter().map(Vec3::as_dvec3).collect(),
                gaussian_nodes: rows::<u32, 4>(&file, "graph.gaussian_nodes", Dtype::U32)?,
                gaussian_weights: rows::<f32, 4>(&file, "graph.gaussian_weights", Dtype::F32)?,
            }),
        };
        let triangles = rows::<u32, 1>(&file, "gaussians.triangles", Dtype::U32)?;
        let corners = rows::<f32, 3>(&file, "gaussians.barycentric", Dtype::F32)?;
        let attachments =
            triangles.into_iter().zip(corners).map(|([triangle], barycentric)| Attachment { triangle, barycentric });
        let joints = template.skeleton.joints().len().max(1);
        let known_poses = match file.tensor("poses") {
            // Avatars of before have none.
            Err(_) => KnownPoses::default(),
            Ok(_) => {
                let turns: Vec<DQuat> = rows::<f32, 4>(&file, "poses", Dtype::F32)?
                    .into_iter()
                    .map(|turn| Quat::from_array(turn).as_dquat())
                    .collect();
                KnownPoses(turns.chunks(joints).map(<[DQuat]>::to_vec).collect())
            }
        };
        let avatar = Self {
            template,
            undressed,
            places: vectors(&file, "gaussians.places")?,
            attachments: attachments.collect(),
            skin: skin(&file, ["gaussians.joints", "gaussians.weights"])?,
            hanging,
            known_poses,
            parameters,
            light,
            card,
        };
        avatar.check()?;
        Ok(avatar)
    }
}

/// Names of the learned lists.
const LISTS: [&str; 4] = ["gaussians.offset", "gaussians.shape", "gaussians.rotation", "gaussians.harmonics"];

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::model::avatar::tests::{random_pose, small};

    #[test]
    fn avatars_come_back_and_the_same_gives_the_same_bytes() {
        let mut avatar = small(200, 9);
        avatar.known_poses = KnownPoses::new(&[1, 2, 3].map(|seed| random_pose(&avatar, seed).0));
        avatar.light.terms[3] = [0.1, 0.2, 0.3];
        let mut body = avatar.template.clone();
        body.triangles.truncate(20);
        avatar.undressed = Some(body);
        avatar.card = Card { name: "A".to_owned(), cameras: vec!["00".to_owned()], steps: 3, ..Card::default() };
        let bytes = avatar.to_bytes().unwrap();
        // Printed in full they would fill screens.
        assert!(bytes == avatar.clone().to_bytes().unwrap());
        assert!(Avatar::from_bytes(&bytes).unwrap() == avatar);
        avatar.hanging = None;
        let folder = tempfile();
        avatar.save(&folder).unwrap();
        assert!(Avatar::load(&folder).unwrap() == avatar);
        std::fs::remove_file(folder).unwrap();
    }

    fn tempfile() -> std::path::PathBuf {
        std::env::temp_dir().join(format!("flyrig-avatar-{}.flyavatar", std::process::id()))
    }

    #[test]
    fn foreign_newer_and_damaged_files_are_named() {
        let bytes = small(100, 5).to_bytes().unwrap();
        assert!(Avatar::from_bytes(b"").unwrap_err().contains("is no avatar"));
        assert!(Avatar::from_bytes(&[b'{'; 4000]).unwrap_err().contains("flyrig avatar build"));
        assert!(Avatar::load(Path::new("/nowhere.flyavatar")).unwrap_err().to_string().contains("/nowhere.flyavatar"));
        let replaced = |from: &str, to: &str| {
            let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).unwrap();
            let mut changed = bytes.clone();
            changed[at..at + to.len()].copy_from_slice(to.as_bytes());
            Avatar::from_bytes(&changed).unwrap_err()
        };
        assert!(replaced("\\\"version\\\":2", "\\\"version\\\":1").contains("version 1"));
        assert!(replaced("gaussians.shape", "gaussians.shade").contains("is damaged"));
        // Bytes at random: an error or an avatar, never a panic.
        let mut random = StdRng::seed_from_u64(1);
        for _ in 0..300 {
            let mut changed = bytes.clone();
            for _ in 0..4 {
                let at = random.random_range(0..changed.len());
                changed[at] = random.random();
            }
            changed.truncate(random.random_range(0..2 * changed.len()));
            drop(Avatar::from_bytes(&changed));
        }
    }
}
