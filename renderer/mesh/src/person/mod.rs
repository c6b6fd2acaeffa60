//! Closed, textured mesh of a person: the surface that an avatar's Gaussians draw, tied to its skeleton and deformation graph.

mod hang;
mod photograph;

use std::time::Instant;

use flyrig_avatar::{Atlas, Avatar, AvatarError, BakedMesh, Bones, DRAWN_BEYOND, Hanging, PosedAvatar};
use flyrig_body::{Template, displacement, skin_mesh};
use flyrig_types::Pose;
use glam::{DVec3, Vec2, Vec3, Vec4};

use crate::{
    AtlasError, AtlasSettings, DecimateError, MeshAtlas, MeshError, MeshOptions, MeshReport, OrientedPoint,
    OrientedPoints, SkinReport, SkinSettings, Topology, TriMesh, finish::finish, mesh_atlas, mesh_from_points,
    person::hang::hang, skin_weights,
};

/// Mesh of a person that poses and a deformation graph move.
#[derive(Debug, Clone)]
pub struct MeshedPerson {
    /// Mesh in the rest pose, with the mean shape of clothes and hair: canonical metres, y up, facing +z; skin and skeleton. Vertices
    /// are split where charts of the texture meet.
    pub template: Template,
    /// Nodes that move the vertices; the mean is that of the template. `None` without a graph.
    pub hanging: Option<Hanging>,
    /// Texture of the unlit colours.
    pub texture: Atlas,
}

/// Reason why an avatar is not meshed.
#[derive(Debug, thiserror::Error)]
pub enum PersonError {
    /// The Gaussians draw no surface of a body.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The surface cannot be simplified.
    #[error(transparent)]
    Decimate(#[from] DecimateError),
    /// The surface gets no texture coordinates.
    #[error(transparent)]
    Atlas(#[from] AtlasError),
    /// The texture cannot be made.
    #[error(transparent)]
    Texture(#[from] AvatarError),
}

/// Options of [`MeshedPerson::of_avatar`].
#[derive(Clone, Copy)]
pub struct PersonOptions<'a> {
    /// Fusion and surface.
    pub mesh: MeshOptions<'a>,
    /// Triangles to simplify to; a mesh with fewer keeps its own.
    pub triangles: usize,
    /// Texels along a side of the texture.
    pub texture_side: u32,
}

impl Default for PersonOptions<'_> {
    fn default() -> Self {
        Self { mesh: MeshOptions::default(), triangles: 60_000, texture_side: 2048 }
    }
}

/// Counts of [`MeshedPerson::of_avatar`].
#[derive(Debug, Clone)]
pub struct PersonReport {
    /// Topology of the simplified and smoothed mesh.
    pub topology: Topology,
    /// Mean distance of the simplified mesh from the fused one before it is smoothed, metres.
    pub simplified_by_m: f32,
    /// Charts of the texture.
    pub charts: u32,
    /// Share of its texels that they cover, 0..=1.
    pub coverage: f32,
    /// Seconds of simplification and smoothing, of skin and graph, and of the texture.
    pub seconds: [f64; 3],
    /// Fusion and surface.
    pub mesh: MeshReport,
    /// Origin of the skin weights.
    pub skin: SkinReport,
}

impl MeshedPerson {
    /// Meshes the surface that an avatar's Gaussians draw in the rest pose, where a hand cannot grow onto a hip, simplifies and
    /// smooths it, and gives it skin, nodes and a texture.
    ///
    /// # Errors
    /// As [`mesh_from_points`], and [`PersonError`] where the mesh cannot be simplified or textured.
    pub fn of_avatar(avatar: &Avatar, options: &PersonOptions<'_>) -> Result<(Self, PersonReport), PersonError> {
        let mut posed = PosedAvatar::default();
        avatar.pose(&Bones::at_rest(&avatar.template.skeleton), None, &mut posed);
        let (fused, mesh) = mesh_from_points(drawn_points(&posed), &options.mesh)?;
        let started = Instant::now();
        let simple = finish(&fused, options.triangles, mesh.settings.spacing_m)?;
        let simplified_s = started.elapsed().as_secs_f64();
        let started = Instant::now();
        let (tied, skin) = Self::tie(&simple.mesh, avatar, &posed);
        let tied_s = started.elapsed().as_secs_f64();
        let started = Instant::now();
        let atlas = mesh_atlas(&simple.mesh, AtlasSettings { side: options.texture_side, ..AtlasSettings::default() })?;
        let mut person = tied.split(&atlas);
        let Template { positions, normals, uvs, triangles, .. } = &person.template;
        person.texture = avatar.bake(BakedMesh { positions, normals, uvs, triangles }, options.texture_side)?;
        let report = PersonReport {
            topology: Topology::measure(&simple.mesh),
            simplified_by_m: simple.mean_distance_m,
            charts: atlas.charts,
            coverage: atlas.coverage,
            seconds: [simplified_s, tied_s, started.elapsed().as_secs_f64()],
            mesh,
            skin,
        };
        Ok((person, report))
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
        (Self { template, hanging, texture: Atlas { side: 0, rgb: Vec::new(), covered: 0 } }, report)
    }

    /// Splits the vertices where charts of the texture meet.
    fn split(self, atlas: &MeshAtlas) -> Self {
        let Self { template, hanging, texture } = self;
        let hanging = hanging.map(|of| Hanging {
            gaussian_nodes: atlas.split(&of.gaussian_nodes),
            gaussian_weights: atlas.split(&of.gaussian_weights),
            ..of
        });
        let template = Template {
            positions: atlas.split(&template.positions),
            normals: atlas.split(&template.normals),
            uvs: atlas.uvs.clone(),
            triangles: atlas.triangles.clone(),
            skin: atlas.split(&template.skin),
            parts: atlas.split(&template.parts),
            ..template
        };
        Self { template, hanging, texture }
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
