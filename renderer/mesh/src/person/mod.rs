//! Closed mesh of a person: the surface that an avatar's Gaussians draw, tied to its skeleton and deformation graph.

mod hang;

use flyrig_avatar::{Avatar, Bones, DRAWN_BEYOND, Hanging, PosedAvatar};
use flyrig_body::{Template, displacement, skin_mesh};
use flyrig_types::Pose;
use glam::{DVec3, Vec2, Vec3, Vec4};

use crate::{
    MeshError, MeshOptions, MeshReport, OrientedPoint, OrientedPoints, SkinReport, SkinSettings, TriMesh,
    mesh_from_points, person::hang::hang, skin_weights,
};

/// Mesh of a person that poses and a deformation graph move.
#[derive(Debug, Clone)]
pub struct MeshedPerson {
    /// Mesh in the rest pose, with the mean shape of clothes and hair: canonical metres, y up, facing +z; skin and skeleton. It has no
    /// texture coordinates.
    pub template: Template,
    /// Nodes that move the vertices; the mean is that of the template. `None` without a graph.
    pub hanging: Option<Hanging>,
}

/// Counts of [`MeshedPerson::of_avatar`].
#[derive(Debug, Clone)]
pub struct PersonReport {
    /// Fusion and surface.
    pub mesh: MeshReport,
    /// Origin of the skin weights.
    pub skin: SkinReport,
}

impl MeshedPerson {
    /// Meshes the surface that an avatar's Gaussians draw in the rest pose, where a hand cannot grow onto a hip.
    ///
    /// # Errors
    /// As [`mesh_from_points`].
    pub fn of_avatar(avatar: &Avatar, options: &MeshOptions<'_>) -> Result<(Self, PersonReport), MeshError> {
        let mut posed = PosedAvatar::default();
        avatar.pose(&Bones::at_rest(&avatar.template.skeleton), None, &mut posed);
        let (mesh, report) = mesh_from_points(drawn_points(&posed), options)?;
        let (person, skin) = Self::tie(&mesh, avatar, &posed);
        Ok((person, PersonReport { mesh: report, skin }))
    }

    /// Ties a mesh in the rest pose to the avatar's skeleton and graph.
    fn tie(mesh: &TriMesh, avatar: &Avatar, posed: &PosedAvatar) -> (Self, SkinReport) {
        let normals = mesh.normals();
        let at = (mesh.positions.as_slice(), normals.as_slice());
        let body = avatar.surface();
        let (skin, report) = skin_weights(at, &mesh.triangles, &body, SkinSettings::default());
        let part = |skin: &flyrig_body::SkinWeights| {
            let strongest = skin.joints[0];
            let same = avatar.template.skin.iter().position(|known| known.joints[0] == strongest);
            same.and_then(|vertex| avatar.template.parts.get(vertex)).copied().unwrap_or(flyrig_body::Part::Torso)
        };
        let mut by_joint = std::collections::BTreeMap::new();
        let parts = skin.iter().map(|skin| *by_joint.entry(skin.joints[0]).or_insert_with(|| part(skin))).collect();
        let template = Template {
            name: avatar.template.name.clone(),
            positions: mesh.positions.clone(),
            uvs: vec![Vec2::ZERO; mesh.positions.len()],
            triangles: mesh.triangles.clone(),
            normals,
            skin,
            parts,
            skeleton: avatar.template.skeleton.clone(),
        };
        let hanging = avatar.hanging.as_ref().map(|of| hang(&template, of, posed));
        (Self { template, hanging }, report)
    }

    /// Returns the linear RGB of each vertex, without the light of the take's room.
    #[must_use]
    pub fn colors(&self, avatar: &Avatar) -> Vec<[f32; 3]> {
        let points: Vec<(Vec3, Vec3)> =
            self.template.positions.iter().copied().zip(self.template.normals.iter().copied()).collect();
        avatar.colors_at(&points)
    }

    /// Returns world positions, metres, and unit normals of the vertices in a pose. `translations` are those of the graph's nodes,
    /// canonical metres; without them the mesh keeps its mean shape.
    #[must_use]
    pub fn posed(&self, pose: &Pose, translations: Option<&[DVec3]>) -> (Vec<Vec3>, Vec<Vec3>) {
        let (Some(hanging), Some(translations)) = (&self.hanging, translations) else {
            return skin_mesh(&self.template, pose);
        };
        if translations.len() != hanging.nodes.len() {
            return skin_mesh(&self.template, pose);
        }
        let offsets: Vec<DVec3> = translations.iter().zip(&hanging.mean).map(|(own, mean)| *own - *mean).collect();
        let mut moved = self.template.clone();
        let rows = hanging.gaussian_nodes.iter().zip(&hanging.gaussian_weights);
        for (position, (nodes, weights)) in moved.positions.iter_mut().zip(rows) {
            *position += Vec4::from(displacement(&hanging.nodes, &offsets, *nodes, *weights)).truncate();
        }
        moved.normals = moved.normals_at(&moved.positions);
        skin_mesh(&moved, pose)
    }
}

/// Returns the surface that posed Gaussians draw.
fn drawn_points(posed: &PosedAvatar) -> OrientedPoints {
    OrientedPoints::from_rows(posed.surface_points().map(|point| OrientedPoint {
        position: point.drawn(DRAWN_BEYOND),
        normal: point.normal,
        weight: point.opacity,
        uncertainty_m: point.thickness_m,
    }))
}

#[cfg(test)]
mod tests;
