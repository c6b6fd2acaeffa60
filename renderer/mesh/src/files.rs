//! Files of meshes for other programs. Every writer checks its input first and refuses it with one [`MeshFileError`].

mod archive;
mod glb;
mod mesh_file;
mod obj;
#[cfg(test)]
mod tests;
mod threemf;
mod usd_sequence;
mod usd_skeleton;
mod usd_text;
mod usdz;

pub use glb::write_glb;
pub use mesh_file::{JointFrame, MeshFile, MeshFileError, MeshJoint, MeshSkeleton};
pub use obj::write_obj;
pub use threemf::write_3mf;
pub use usd_sequence::{MeshFrame, write_usd_sequence};
pub use usdz::write_usdz;
