//! Content of mesh files and its check.

use std::io;
use std::path::{Path, PathBuf};

use glam::{Mat4, Quat, Vec2, Vec3};

/// First bytes of every PNG file.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";
/// Largest deviation of a vertex's skin weights from a sum of one.
const WEIGHT_TOLERANCE: f32 = 1e-3;

/// Reason why a mesh file is not written.
#[derive(Debug, thiserror::Error)]
pub enum MeshFileError {
    /// The content does not fit the format.
    #[error("{}: not written, {message}", path.display())]
    Refused {
        /// File.
        path: PathBuf,
        /// Problem and fix.
        message: String,
    },
    /// The system failed; a file that existed before is unchanged.
    #[error("{}: not written, {source}", path.display())]
    System {
        /// File.
        path: PathBuf,
        /// Failure.
        source: io::Error,
    },
}

/// Mesh with texture and skeleton, in metres, y up. Vertices are split where texture coordinates or normals differ.
#[derive(Debug, Clone, Copy, Default)]
pub struct MeshFile<'a> {
    /// Vertex positions, metres, y up.
    pub positions: &'a [Vec3],
    /// Unit normal of each vertex.
    pub normals: &'a [Vec3],
    /// Texture coordinates of each vertex, v down as in glTF; may be empty without a texture.
    pub uvs: &'a [Vec2],
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: &'a [[u32; 3]],
    /// Texture as a PNG file, sRGB.
    pub texture: Option<&'a [u8]>,
    /// Whether other programs light the texture; otherwise it contains the lighting.
    pub is_lit: bool,
    /// Skeleton, for the formats that have one (USDZ).
    pub skeleton: Option<MeshSkeleton<'a>>,
}

/// Joints, skin weights and motion of a mesh.
#[derive(Debug, Clone, Copy, Default)]
pub struct MeshSkeleton<'a> {
    /// Joints, parents first.
    pub joints: &'a [MeshJoint<'a>],
    /// Joints of each vertex.
    pub indices: &'a [[u16; 4]],
    /// Weight of each of these joints; they sum to one.
    pub weights: &'a [[f32; 4]],
    /// Poses by time, may be empty.
    pub frames: &'a [JointFrame<'a>],
}

/// Joint of a mesh's skeleton.
#[derive(Debug, Clone, Copy)]
pub struct MeshJoint<'a> {
    /// Name; characters that a format does not allow are replaced.
    pub name: &'a str,
    /// Index of the parent, smaller than the joint's own; `None` for a root.
    pub parent: Option<usize>,
    /// Transform from the joint's frame to the mesh as it is stored (the bind pose).
    pub mesh_from_joint: Mat4,
    /// Transform to the parent's frame at rest (root: to the mesh).
    pub parent_from_joint: Mat4,
}

/// Pose of a skeleton at a time.
#[derive(Debug, Clone, Copy)]
pub struct JointFrame<'a> {
    /// Time, seconds.
    pub secs: f64,
    /// Position of each joint in its parent's frame (root: in the mesh's), metres.
    pub translations: &'a [Vec3],
    /// Rotation `parent_from_joint` of each joint.
    pub rotations: &'a [Quat],
}

impl MeshFile<'_> {
    /// Checks the content, and that the file's name ends in `extension`.
    ///
    /// # Errors
    /// [`MeshFileError::Refused`] for an extension of another format, an empty mesh, lists that differ in length, indices
    /// out of range, numbers that are not finite, a texture without coordinates or not in PNG, and a skeleton that does
    /// not fit.
    pub(super) fn check(&self, path: &Path, extension: &str) -> Result<(), MeshFileError> {
        let found = path.extension().and_then(|found| found.to_str()).unwrap_or_default();
        let problem = if found.eq_ignore_ascii_case(extension) {
            self.surface_problem().or_else(|| self.skeleton.and_then(|s| s.problem(self.positions.len())))
        } else {
            Some(format!("the name must end in .{extension}"))
        };
        problem.map_or(Ok(()), |message| Err(refused(path, message)))
    }

    fn surface_problem(&self) -> Option<String> {
        let count = self.positions.len();
        if count == 0 || self.triangles.is_empty() {
            return Some("the mesh is empty".to_owned());
        }
        if self.normals.len() != count {
            return Some(format!("there are {count} positions but {} normals", self.normals.len()));
        }
        if self.uvs.len() != count && !self.uvs.is_empty() {
            return Some(format!("there are {count} positions but {} texture coordinates", self.uvs.len()));
        }
        // USD's indices are signed 32-bit integers.
        let is_outside = |i: &&u32| **i as usize >= count || i32::try_from(**i).is_err();
        if let Some(index) = self.triangles.as_flattened().iter().find(is_outside) {
            return Some(format!("a triangle refers to vertex {index} of {count}"));
        }
        let is_finite = |i: usize| {
            self.positions[i].is_finite()
                && self.normals[i].is_finite()
                && self.uvs.get(i).is_none_or(|uv| uv.is_finite())
        };
        if let Some(vertex) = (0..count).find(|i| !is_finite(*i)) {
            return Some(format!("vertex {vertex} is not a finite number"));
        }
        match self.texture {
            Some(_) if self.uvs.is_empty() => Some("there is a texture but no texture coordinates".to_owned()),
            Some(png) if !png.starts_with(PNG) => Some("the texture is not a PNG file".to_owned()),
            _ => None,
        }
    }
}

impl MeshSkeleton<'_> {
    fn problem(&self, vertices: usize) -> Option<String> {
        let joints = self.joints.len();
        if joints == 0 {
            return Some("the skeleton has no joints".to_owned());
        }
        let (indices, weights) = (self.indices.len(), self.weights.len());
        if (indices, weights) != (vertices, vertices) {
            return Some(format!("there are {vertices} positions but joints of {indices} and weights of {weights}"));
        }
        for (i, joint) in self.joints.iter().enumerate() {
            let name = flyrig_types::shortened(joint.name);
            if joint.parent.is_some_and(|parent| parent >= i) {
                return Some(format!("joint '{name}' stands before its parent"));
            }
            if !joint.mesh_from_joint.is_finite() || !joint.parent_from_joint.is_finite() {
                return Some(format!("joint '{name}' has a transform that is not finite"));
            }
        }
        if let Some(index) = self.indices.as_flattened().iter().find(|i| usize::from(**i) >= joints) {
            return Some(format!("a vertex refers to joint {index} of {joints}"));
        }
        let is_share =
            |w: &[f32; 4]| w.iter().all(|w| *w >= 0.0) && (w.iter().sum::<f32>() - 1.0).abs() <= WEIGHT_TOLERANCE;
        if let Some(vertex) = self.weights.iter().position(|w| !is_share(w)) {
            return Some(format!("the skin weights of vertex {vertex} do not sum to one"));
        }
        for frame in self.frames {
            let (moved, turned) = (frame.translations.len(), frame.rotations.len());
            if (moved, turned) != (joints, joints) {
                return Some(format!(
                    "a pose of {moved} translations and {turned} rotations does not fit {joints} joints"
                ));
            }
            if !frame.translations.iter().all(|t| t.is_finite()) || !frame.rotations.iter().all(|r| r.is_normalized()) {
                return Some(format!("the pose at {} s is not finite or has rotations that are not unit", frame.secs));
            }
        }
        times_problem(self.frames.iter().map(|frame| frame.secs))
    }
}

/// Returns the problem of times that are not finite or not ascending.
pub(super) fn times_problem(secs: impl Iterator<Item = f64>) -> Option<String> {
    let mut last = f64::NEG_INFINITY;
    for secs in secs {
        if !secs.is_finite() || secs <= last {
            return Some(format!("the frame at {secs} s does not follow the one at {last} s"));
        }
        last = secs;
    }
    None
}

/// Returns the error for content that does not fit.
pub(super) fn refused(path: &Path, message: String) -> MeshFileError {
    MeshFileError::Refused { path: path.to_owned(), message }
}

/// Returns a map from the system's errors.
pub(super) fn system(path: &Path) -> impl FnOnce(io::Error) -> MeshFileError {
    |source| MeshFileError::System { path: path.to_owned(), source }
}

/// Returns the file beside `path` with another extension, and its name as a reference from there.
///
/// # Errors
/// [`MeshFileError::Refused`] for names that a reference cannot hold.
pub(super) fn beside(path: &Path, extension: &str) -> Result<(PathBuf, String), MeshFileError> {
    let other = path.with_extension(extension);
    let name = other.file_name().and_then(|name| name.to_str()).map(str::to_owned);
    match name.filter(|name| !name.contains(|c: char| c.is_control() || c == '@')) {
        Some(name) => Ok((other, name)),
        None => Err(refused(path, "the name must be without control characters and '@'".to_owned())),
    }
}
