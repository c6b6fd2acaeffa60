//! Photographs, mesh and light that make a texture, and what is wrong with them.

use flyrig_avatar::{Atlas, Light};
use flyrig_types::{Camera, CameraId};
use glam::{Vec2, Vec3};

/// Photograph of a frame of the take.
#[derive(Debug, Clone, Copy)]
pub struct Photo<'a> {
    /// Frame whose pose it shows.
    pub frame: usize,
    /// Camera of the image.
    pub camera: &'a Camera,
    /// sRGB with the person's mask as alpha, row by row.
    pub rgba: &'a [u8],
}

/// Mesh with texture coordinates. Lists of vertices have the same length.
#[derive(Debug, Clone, Copy)]
pub struct TexturedMesh<'a> {
    /// Positions in the rest pose, metres; vertices at one place are one.
    pub positions: &'a [Vec3],
    /// Texture coordinates in 0..=1, v down.
    pub uvs: &'a [Vec2],
    /// Vertices of each triangle, counter-clockwise from outside.
    pub triangles: &'a [[u32; 3]],
}

/// Positions, world metres, and unit normals of the vertices in the pose of a frame.
pub type Poser<'a> = &'a (dyn Fn(usize) -> (Vec<Vec3>, Vec<Vec3>) + Sync);

/// Reason why photographs make no texture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PhotoError {
    /// An image has another size than its camera.
    #[error("photograph of camera {camera}, frame {frame}: {bytes} bytes, not the {expected} of its camera")]
    Size {
        /// Camera.
        camera: CameraId,
        /// Frame.
        frame: usize,
        /// Bytes of the image.
        bytes: usize,
        /// Bytes of an image of the camera.
        expected: usize,
    },
    /// A list of vertices has another length than that of the positions.
    #[error("{what}: {count} vertices, not the {expected} of the mesh")]
    Vertices {
        /// Faulty list.
        what: &'static str,
        /// Its length.
        count: usize,
        /// Vertices of the mesh.
        expected: usize,
    },
    /// The texture to start from has the wrong number of bytes.
    #[error("a texture of {side} texels a side holds {bytes} bytes; bake it from the Gaussians first")]
    Base {
        /// Texels per side.
        side: u32,
        /// Bytes.
        bytes: usize,
    },
}

/// Inputs of [`crate::photograph_texture`].
#[derive(Clone, Copy)]
pub struct PhotoInputs<'a> {
    /// Mesh.
    pub mesh: TexturedMesh<'a>,
    /// Texture of the Gaussians' unlit colours.
    pub unlit: &'a Atlas,
    /// Photographs, those of a frame in a row.
    pub photos: &'a [Photo<'a>],
    /// Posed vertices.
    pub pose: Poser<'a>,
    /// Light of the take.
    pub light: &'a Light,
    /// Mean light factors of each vertex, which the texture keeps; without them photographs are divided by their light.
    pub baked: Option<&'a [Vec3]>,
}

impl PhotoInputs<'_> {
    pub(super) fn check(&self) -> Result<(), PhotoError> {
        check_vertices(&self.mesh, self.baked)?;
        check_base(self.unlit)?;
        for photo in self.photos {
            let [width, height] = photo.camera.size().map(|side| side as usize);
            let (bytes, expected) = (photo.rgba.len(), 4 * width * height);
            if bytes != expected || expected == 0 {
                return Err(PhotoError::Size { camera: photo.camera.id.clone(), frame: photo.frame, bytes, expected });
            }
        }
        Ok(())
    }
}

pub(super) fn check_vertices(mesh: &TexturedMesh<'_>, shades: Option<&[Vec3]>) -> Result<(), PhotoError> {
    let expected = mesh.positions.len();
    let lists = [("texture coordinates", Some(mesh.uvs.len())), ("mean light", shades.map(<[Vec3]>::len))];
    for (what, count) in lists {
        if let Some(count) = count.filter(|count| *count != expected) {
            return Err(PhotoError::Vertices { what, count, expected });
        }
    }
    Ok(())
}

pub(super) fn check_base(unlit: &Atlas) -> Result<(), PhotoError> {
    let side = unlit.side as usize;
    if side == 0 || unlit.rgb.len() != 3 * side * side {
        return Err(PhotoError::Base { side: unlit.side, bytes: unlit.rgb.len() });
    }
    Ok(())
}

/// Texture from photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotoTexture {
    /// Texture, sRGB.
    pub atlas: Atlas,
    /// Share of the covered texels that photographs show, 0..=1; texels of a transition count in part.
    pub seen: f32,
}
