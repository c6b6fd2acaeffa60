//! Texture of a mesh from photographs.
//!
//! Every photograph in which a texel is visible, facing the camera and clear of outlines adds its colour. Where the colour differs
//! much from that of the Gaussians, something else is in front, and it counts little. Two means are kept: a plain one, which is even
//! but blurred by errors of poses, and a sharp one, in which the best views of each texel prevail. The texture is the sharp one,
//! moved to the plain one's values where the two differ slowly along the surface. Texels that no photograph shows keep the colours
//! of the Gaussians, with a soft transition.

mod blend;
mod draw;
mod edges;
mod harmonize;
mod inputs;
mod lit;
mod raster;
mod texels;
mod view;

pub use blend::PhotoSettings;
pub use draw::{DrawnMesh, draw_textured};
pub use inputs::{Photo, PhotoError, PhotoInputs, PhotoTexture, Poser, TexturedMesh};
pub(crate) use lit::light_texture;

/// Makes the texture of a mesh from photographs. Equal input gives equal bytes. A few frames are held at a time.
///
/// # Errors
/// [`PhotoError`] names the list or image whose size is wrong.
pub fn photograph_texture(inputs: &PhotoInputs<'_>, settings: &PhotoSettings) -> Result<PhotoTexture, PhotoError> {
    inputs.check()?;
    Ok(blend::blend(inputs, settings))
}

#[cfg(test)]
mod tests;
