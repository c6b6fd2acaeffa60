//! Texture of a meshed person in the light of a take.

use flyrig_avatar::{Atlas, Avatar, Light, TrainingFrame};
use flyrig_types::Pose;
use glam::{DVec3, Vec3};

use super::MeshedPerson;
use crate::texture::{
    Photo, PhotoError, PhotoInputs, PhotoSettings, PhotoTexture, TexturedMesh, light_texture, photograph_texture,
};

/// Poses over which light is averaged.
const SHADED_POSES: usize = 8;

impl MeshedPerson {
    /// Returns the light factors of posed vertices by their world normals.
    #[must_use]
    pub fn shades(light: &Light, normals: &[Vec3]) -> Vec<Vec3> {
        normals.iter().map(|normal| Vec3::from(light.shade(*normal))).collect()
    }

    /// Returns the mean light factors of the vertices over the avatar's known poses; those of the mean direction where none is known.
    #[must_use]
    pub fn mean_shades(&self, avatar: &Avatar) -> Vec<Vec3> {
        let known = avatar.known_poses.rotations();
        let chosen: Vec<_> = known.iter().step_by(known.len().div_ceil(SHADED_POSES).max(1)).collect();
        let [constant, ..] = avatar.light.terms;
        let first = if chosen.is_empty() { Vec3::from(constant) } else { Vec3::ZERO };
        let mut sums = vec![first; self.template.positions.len()];
        for rotations in &chosen {
            let pose = Pose { root_translation: DVec3::ZERO, joint_rotations: (*rotations).clone() };
            let (_, normals) = self.posed(&pose, None);
            let shades = Self::shades(&avatar.light, &normals);
            sums.iter_mut().zip(shades).for_each(|(sum, shade)| *sum += shade / chosen.len() as f32);
        }
        sums
    }

    /// Returns the person's texture of unlit colours times the mean light of the vertices.
    ///
    /// # Errors
    /// [`PhotoError`] for a person without a texture.
    pub fn lit_texture(&self, shades: &[Vec3]) -> Result<Atlas, PhotoError> {
        light_texture(&self.textured(), &self.texture, shades)
    }

    /// Makes a texture of the photographs of a take; texels that they do not show are those of the person's own texture. `frames` are
    /// those that the photographs refer to. With `baked`, the mean light of each vertex, the take's light stays in.
    ///
    /// # Errors
    /// [`PhotoError`] for images of wrong sizes.
    pub fn photographed(
        &self,
        light: &Light,
        (frames, photos): (&[TrainingFrame], &[Photo<'_>]),
        baked: Option<&[Vec3]>,
        settings: &PhotoSettings,
    ) -> Result<PhotoTexture, PhotoError> {
        let pose = |frame: usize| {
            let posed = |frame: &TrainingFrame| self.posed(&frame.pose, Some(&frame.translations));
            frames.get(frame).map(posed).unwrap_or_default()
        };
        let inputs = PhotoInputs { mesh: self.textured(), unlit: &self.texture, photos, pose: &pose, light, baked };
        photograph_texture(&inputs, settings)
    }

    fn textured(&self) -> TexturedMesh<'_> {
        let mesh = &self.template;
        TexturedMesh { positions: &mesh.positions, uvs: &mesh.uvs, triangles: &mesh.triangles }
    }
}
