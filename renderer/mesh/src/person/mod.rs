//! Closed, textured mesh of a person: the surface that an avatar's Gaussians draw, tied to its skeleton and deformation graph.

mod hang;
mod photograph;
mod skirt;

use std::time::Instant;

use flyrig_avatar::{Atlas, Avatar, AvatarError, BakedMesh, Bones, DRAWN_BEYOND, Hanging, PosedAvatar};
use flyrig_body::{BodyError, Template, displacement, skin_mesh};
use flyrig_types::Pose;
use glam::{DVec3, Vec2, Vec3, Vec4};

use crate::{
    AtlasError, AtlasSettings, DecimateError, Empty, MeshAtlas, MeshError, MeshOptions, MeshReport, OrientedPoint,
    OrientedPoints, SkinReport, SkinSettings, Topology, TriMesh,
    finish::finish,
    mesh_atlas, mesh_from_points,
    person::hang::hang,
    person::skirt::{Hollow, Side, StandIns, covered},
    skin::{Origin, skin_weights, skin_weights_by},
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
    /// The body that wears the avatar's clothes is not valid, or has another skeleton.
    #[error(
        "the body below the clothes does not belong to the avatar; leave it out, or take the one that was tracked: {0}"
    )]
    Undressed(#[from] BodyError),
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
    /// Shell of a skirt; `None` without one.
    pub shell: Option<ShellReport>,
}

/// Measures of a skirt that is a shell around the legs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShellReport {
    /// Share of the inner side of the skirt in the mesh's surface, 0..=1.
    pub wall_share: f64,
    /// Share of legs and hips below the skirt, which are those of the template, 0..=1.
    pub hidden_share: f64,
    /// Vertices of the inner side that keep the thickness of the cut, where a thinner wall would intersect itself.
    pub thick_vertices: usize,
    /// Seconds from the skirt's points to the space below it, and to thin the wall.
    pub seconds: [f64; 2],
}

impl MeshedPerson {
    /// Meshes the surface that an avatar's Gaussians draw in the rest pose, where a hand cannot grow onto a hip, simplifies and
    /// smooths it, and gives it skin, nodes and a texture. A skirt becomes a shell around the legs of [`Avatar::undressed`]; without
    /// that body it is closed at the hem.
    ///
    /// # Errors
    /// As [`mesh_from_points`], and [`PersonError`] where the mesh cannot be simplified or textured.
    pub fn of_avatar(avatar: &Avatar, options: &PersonOptions<'_>) -> Result<(Self, PersonReport), PersonError> {
        let mut posed = PosedAvatar::default();
        avatar.pose(&Bones::at_rest(&avatar.template.skeleton), None, &mut posed);
        let mut points = drawn_points(&posed);
        let started = Instant::now();
        let undressed = avatar.undressed.as_ref();
        if let Some(body) = undressed {
            drop_covered(avatar, body, &mut points)?;
        }
        let hollow = match undressed {
            Some(body) => hollow_of(avatar, body, &points, &options.mesh)?,
            None => None,
        };
        let hollow_s = started.elapsed().as_secs_f64();
        let given = options.mesh.empty;
        let is_empty = |place: Vec3| {
            hollow.as_ref().is_some_and(|hollow| hollow.is_empty(place)) || given.is_some_and(|empty| empty(place))
        };
        let empty: Option<Empty<'_>> = if hollow.is_some() { Some(&is_empty) } else { given };
        let fusion = MeshOptions { empty, ..options.mesh };
        let (fused, mesh) = mesh_from_points(OrientedPoints::from_rows(points), &fusion)?;
        let started = Instant::now();
        let mut simple = finish(&fused, options.triangles, mesh.settings.spacing_m)?;
        let simplified_s = started.elapsed().as_secs_f64();
        let (sides, shell) = hollow.as_ref().map(|hollow| hollow.shell(&mut simple.mesh, hollow_s)).unzip();
        let started = Instant::now();
        let inner = hollow.as_ref().zip(undressed).zip(sides.as_deref());
        let (tied, skin, stand_ins) = Self::tie(&simple.mesh, avatar, &posed, inner);
        let tied_s = started.elapsed().as_secs_f64();
        let started = Instant::now();
        let atlas = mesh_atlas(&simple.mesh, AtlasSettings { side: options.texture_side, ..AtlasSettings::default() })?;
        let mut person = tied.split(&atlas);
        let stand_ins = stand_ins.map(|of| (atlas.split(&of.positions), atlas.split(&of.normals)));
        let Template { positions, normals, uvs, triangles, .. } = &person.template;
        let (positions, normals) = stand_ins.as_ref().map_or((positions, normals), |(p, n)| (p, n));
        person.texture = avatar.bake(BakedMesh { positions, normals, uvs, triangles }, options.texture_side)?;
        let report = PersonReport {
            topology: Topology::measure(&simple.mesh),
            simplified_by_m: simple.mean_distance_m,
            charts: atlas.charts,
            coverage: atlas.coverage,
            seconds: [simplified_s, tied_s, started.elapsed().as_secs_f64()],
            mesh,
            skin,
            shell,
        };
        Ok((person, report))
    }

    /// Ties a mesh in the rest pose to the avatar's skeleton and graph. Returns the places that stand in for those below a skirt.
    fn tie(
        mesh: &TriMesh,
        avatar: &Avatar,
        posed: &PosedAvatar,
        inner: Option<((&Hollow, &Template), &[Side])>,
    ) -> (Self, SkinReport, Option<StandIns>) {
        let normals = mesh.normals();
        let body = avatar.surface();
        let stand_ins = inner.map(|((hollow, _), sides)| hollow.stand_ins(&mesh.positions, &normals, sides));
        let at = stand_ins.as_ref().map_or((&*mesh.positions, &*normals), |of| (&*of.positions, &*of.normals));
        let (skin, report) = match inner {
            None => skin_weights(at, &mesh.triangles, &body, SkinSettings::default()),
            Some(((_, undressed), sides)) => {
                let of = |i: usize| match sides[i] {
                    Side::Hidden => Origin { template: 1, normal: normals[i] },
                    Side::Seen | Side::Wall => Origin { template: 0, normal: at.1[i] },
                };
                let settings = SkinSettings::default();
                skin_weights_by(&mesh.positions, &mesh.triangles, &[&body, undressed], settings, of)
            }
        };
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
            normals: normals.clone(),
            skin,
            parts,
            skeleton: avatar.template.skeleton.clone(),
        };
        let hanging = avatar.hanging.as_ref().map(|of| hang(at, of, posed));
        (Self { template, hanging, texture: Atlas { side: 0, rgb: Vec::new(), covered: 0 } }, report, stand_ins)
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

/// Returns the surface that posed Gaussians draw, one point each.
fn drawn_points(posed: &PosedAvatar) -> Vec<OrientedPoint> {
    let drawn = posed.surface_points().map(|point| OrientedPoint {
        position: point.drawn(DRAWN_BEYOND),
        normal: point.normal,
        weight: point.opacity,
        uncertainty_m: point.thickness_m,
    });
    drawn.collect()
}

/// Takes the weight from the points of the body below a waistband.
fn drop_covered(avatar: &Avatar, body: &Template, points: &mut [OrientedPoint]) -> Result<(), PersonError> {
    body.check()?;
    avatar.template.check_same_joints(body)?;
    let covered = covered(avatar, body, points);
    points.iter_mut().zip(covered).filter(|(_, covered)| *covered).for_each(|(point, _)| point.weight = 0.0);
    Ok(())
}

/// Returns the space below an avatar's skirt, for the voxels that its points are fused in; `None` without a skirt.
fn hollow_of(
    avatar: &Avatar,
    body: &Template,
    points: &[OrientedPoint],
    options: &MeshOptions<'_>,
) -> Result<Option<Hollow>, PersonError> {
    if !Hollow::is_below(&avatar.template, body) {
        return Ok(None);
    }
    let mut oriented = OrientedPoints::from_rows(points.iter().copied());
    oriented.drop_distant();
    let voxel_m = options.settings_of(&oriented)?.voxel_m;
    Ok(Hollow::of(avatar, body, points, voxel_m))
}

#[cfg(test)]
mod tests;
