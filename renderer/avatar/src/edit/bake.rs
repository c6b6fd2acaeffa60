//! Texture of any mesh, from colours of its surface: those of an avatar's Gaussians for a mesh near its surface.

use glam::{Vec2, Vec3};

use crate::edit::atlas::{Atlas, SIDES, UNUSED, each_texel, encode, grow};
use crate::error::AvatarError;
use crate::model::avatar::Avatar;

/// Mesh; in the rest pose with the take's mean shape for [`Avatar::bake`]. Lists of vertices have the same length.
#[derive(Debug, Clone, Copy)]
pub struct BakedMesh<'a> {
    /// Positions, metres; canonical for [`Avatar::bake`].
    pub positions: &'a [Vec3],
    /// Unit normals.
    pub normals: &'a [Vec3],
    /// Texture coordinates in 0..=1, v down.
    pub uvs: &'a [Vec2],
    /// Vertices of each triangle.
    pub triangles: &'a [[u32; 3]],
}

impl Avatar {
    /// Renders the unlit colours of the Gaussians into a texture of a mesh, as [`BakedMesh::paint`] does.
    ///
    /// # Errors
    /// As [`BakedMesh::paint`].
    pub fn bake(&self, mesh: BakedMesh<'_>, side: u32) -> Result<Atlas, AvatarError> {
        mesh.paint(side, |points| self.colors_at(points))
    }
}

impl BakedMesh<'_> {
    /// Renders a texture of the mesh. `colors` returns the linear RGB of points of its surface, given by position and unit normal.
    /// Triangles with vertices out of range are ignored; where two triangles share a texel, the first one wins.
    ///
    /// # Errors
    /// [`AvatarError::Texture`] for a side outside of 16..=4096.
    pub fn paint(
        &self,
        side: u32,
        colors: impl FnOnce(&[(Vec3, Vec3)]) -> Vec<[f32; 3]>,
    ) -> Result<Atlas, AvatarError> {
        if !SIDES.contains(&side) {
            let (least, most) = (SIDES.start(), SIDES.end());
            return Err(AvatarError::Texture(format!("a texture of {side} texels a side; choose {least} to {most}")));
        }
        let mut taken = vec![false; (side * side) as usize];
        let (mut texels, mut points) = (Vec::new(), Vec::new());
        for triangle in self.triangles {
            let corners = triangle.map(|i| {
                let i = i as usize;
                Some((*self.positions.get(i)?, *self.normals.get(i)?, *self.uvs.get(i)?))
            });
            let [Some(a), Some(b), Some(c)] = corners else { continue };
            let corners = [a, b, c];
            each_texel(corners.map(|(.., uv)| uv * side as f32), side, |index, weights| {
                if std::mem::replace(&mut taken[index], true) {
                    return;
                }
                let blend = |value: fn(&(Vec3, Vec3, Vec2)) -> Vec3| -> Vec3 {
                    corners.iter().zip(weights).map(|(corner, weight)| value(corner) * weight).sum()
                };
                texels.push(index);
                points.push((blend(|corner| corner.0), blend(|corner| corner.1).normalize_or(Vec3::Y)));
            });
        }
        let mut image = vec![None; (side * side) as usize];
        for (index, color) in texels.iter().zip(colors(&points)) {
            image[*index] = Some(encode(Vec3::from(color)));
        }
        grow(&mut image, side as usize);
        let rgb = image.into_iter().flat_map(|color| color.unwrap_or(UNUSED)).collect();
        Ok(Atlas { side, rgb, covered: texels.len() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::avatar::tests::small;

    #[test]
    fn texels_have_the_colors_of_the_points_that_they_show() {
        let avatar = small(4000, 7);
        let (positions, normals) = (&avatar.template.positions, &avatar.template.normals);
        let mesh = BakedMesh { positions, normals, uvs: &avatar.template.uvs, triangles: &avatar.template.triangles };
        let baked = avatar.bake(mesh, 64).unwrap();
        assert!(baked.covered > 64 * 64 / 4, "{}", baked.covered);
        let mut compared = 0;
        for texel in avatar.texels(64).unwrap().iter().step_by(11) {
            let [color] = avatar.colors_at(&[(texel.place, texel.normal)])[..] else { panic!("one point") };
            let expected = encode(Vec3::from(color));
            let off = texel.bytes(&baked.rgb).iter().zip(expected).map(|(a, b)| a.abs_diff(b)).max().unwrap();
            compared += usize::from(off <= 2);
        }
        // Vertices without coordinates (shoes) are drawn into the corner here.
        assert!(compared > 100, "{compared}");
        let broken = BakedMesh { positions: &[], triangles: &[[0, 1, u32::MAX]], ..mesh };
        assert_eq!(avatar.bake(broken, 16).unwrap().covered, 0);
        assert!(avatar.bake(mesh, 5).unwrap_err().to_string().contains("choose 16 to 4096"));
    }
}
