//! Light in the texture of the Gaussians.

use flyrig_avatar::{Atlas, grow, srgb_bytes};
use flyrig_model::srgb;
use glam::Vec3;

use super::inputs::{PhotoError, TexturedMesh, check_base, check_vertices};
use super::texels::texels;

/// Returns a texture of unlit colours times the light factors of the vertices.
///
/// # Errors
/// [`PhotoError`] for a list of vertices or a texture of wrong size.
pub(crate) fn light_texture(mesh: &TexturedMesh<'_>, unlit: &Atlas, shades: &[Vec3]) -> Result<Atlas, PhotoError> {
    check_base(unlit)?;
    check_vertices(mesh, Some(shades))?;
    let linear: [f32; 256] = srgb::byte_table(f32::powf);
    let side = unlit.side as usize;
    let mut image = vec![None; side * side];
    let texels = texels(mesh, unlit.side);
    for texel in &texels {
        let known = &unlit.rgb[3 * texel.index as usize..][..3];
        let color = Vec3::from_array(std::array::from_fn(|k| linear[usize::from(known[k])]));
        let shade = texel.blend(mesh.triangles, |vertex| shades[vertex as usize]);
        image[texel.index as usize] = Some(srgb_bytes(color * shade));
    }
    grow(&mut image, side);
    let rest = unlit.rgb.as_chunks().0;
    let rgb = image.into_iter().zip(rest).flat_map(|(color, known)| color.unwrap_or(*known)).collect();
    Ok(Atlas { side: unlit.side, rgb, covered: texels.len() })
}
