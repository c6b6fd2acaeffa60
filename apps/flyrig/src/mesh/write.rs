//! Files of a meshed person.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use flyrig_avatar::Light;
use flyrig_body::{GlbContents, write_glb, write_mesh_ply};
use flyrig_mesh::{
    JointFrame, MeshFile, MeshFrame, MeshJoint, MeshSkeleton, MeshedPerson, PersonReport, write_3mf, write_obj,
    write_usd_sequence, write_usdz,
};
use flyrig_report::{png, stop, write_whole};
use flyrig_types::PoseTrack;
use glam::{DMat4, Quat, Vec3};
use serde_json::json;

use super::{
    arguments::{LightKind, MeshArgs},
    metrics::Finished,
    page::{ShownMesh, write_page},
    source::Source,
    texture::PhotoReport,
};

/// Frames from one written surface to the next, as `flyrig eval` writes them.
const SURFACE_EVERY: u64 = 10;

/// Returns the folder beside the target that is written first.
///
/// # Errors
/// The target has no name, as `.` has none.
pub(super) fn partial_of(out: &Path) -> Result<PathBuf> {
    let name = out.file_name().with_context(|| format!("{} names no folder; choose another --out", out.display()))?;
    let mut partial = name.to_owned();
    partial.push(".partial");
    Ok(out.with_file_name(partial))
}

/// Writes a folder beside the target, which appears whole or not at all.
///
/// # Errors
/// The error of `write_to`, or the folder cannot be created or renamed.
pub(super) fn write_folder(out: &Path, write_to: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let partial = partial_of(out)?;
    std::fs::create_dir(&partial).with_context(|| format!("cannot create {}", partial.display()))?;
    if let Err(error) = write_to(&partial) {
        // The first error is the one worth reporting.
        let _ = std::fs::remove_dir_all(&partial);
        return Err(error);
    }
    // An empty folder of this name may be there.
    let _ = std::fs::remove_dir(out);
    std::fs::rename(&partial, out)
        .with_context(|| format!("cannot rename {} to {}; the mesh is in the former", partial.display(), out.display()))
}

/// Creates the folder of the surfaces.
///
/// # Errors
/// Names the folder.
pub(super) fn create_surfaces(folder: &Path) -> Result<()> {
    let surfaces = folder.join("surface");
    std::fs::create_dir(&surfaces).with_context(|| format!("cannot create {}", surfaces.display()))
}

/// Folder that is written.
pub(super) struct MeshFolder<'a> {
    pub out: &'a Path,
    pub source: &'a Source,
    pub person: &'a MeshedPerson,
    pub report: &'a PersonReport,
    pub photos: &'a PhotoReport,
    /// Scores at held-out cameras.
    pub held_out: Option<serde_json::Value>,
    /// Seconds of fusion, surface, skin and texture.
    pub seconds: f64,
    pub args: &'a MeshArgs,
}

impl MeshFolder<'_> {
    /// Writes all files.
    ///
    /// # Errors
    /// As [`write_folder`].
    pub fn write(&self) -> Result<()> {
        ensure!(!stop::requested(), "stopped; nothing was written");
        write_folder(self.out, |folder| self.write_to(folder))?;
        self.print();
        Ok(())
    }

    fn write_to(&self, folder: &Path) -> Result<()> {
        let (track, template) = (self.track()?, &self.person.template);
        let texture = png::encode_rgb(&self.person.texture.rgb, self.person.texture.side, self.person.texture.side)?;
        let contents = GlbContents { track: track.as_ref(), texture: Some(&texture), is_lit: self.is_lit() };
        write_glb(&folder.join("mesh.glb"), template, contents)?;
        let file = MeshFile {
            positions: &template.positions,
            normals: &template.normals,
            uvs: &template.uvs,
            triangles: &template.triangles,
            texture: Some(&texture),
            is_lit: self.is_lit(),
            skeleton: None,
        };
        write_obj(&folder.join("mesh.obj"), &file)?;
        self.write_rigged(&folder.join("mesh.usdz"), &file, track.as_ref())?;
        write_3mf(&folder.join("mesh.3mf"), &file)?;
        self.write_frames(folder, &file)?;
        let metrics = self.metrics();
        write_whole(&folder.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
        let shown = ShownMesh {
            positions: &template.positions,
            normals: &template.normals,
            uvs: &template.uvs,
            triangles: &template.triangles,
            texture: (&self.person.texture.rgb, self.person.texture.side),
        };
        let take = self.args.take.dataset.display();
        write_page(folder, format!("Mesh of {take}"), self.sentences(), &metrics, &shown)
    }

    /// Returns whether other programs light the texture: the light of the take was estimated, by the fit, and removed.
    fn is_lit(&self) -> bool {
        self.args.light == LightKind::Removed && self.source.avatar.light != Light::default()
    }

    /// Returns what a user should know of the mesh.
    fn sentences(&self) -> Vec<String> {
        let mut sentences = Vec::new();
        if !self.source.frames.is_empty() {
            sentences.push(format!(
                "No photograph shows {:.0} % of the texture: its colours there are those of the Gaussians. More cameras, or frames in which the \
                 person turns, show more.",
                100.0 * (1.0 - self.photos.seen)
            ));
        }
        if self.args.light == LightKind::Removed && !self.is_lit() {
            sentences.push("The light of the take is not known, since nothing was fitted to it: it is in the texture, and the materials are unlit.".to_owned());
        }
        let handles = self.report.topology.genus().unwrap_or_default();
        if handles > 0 {
            sentences.push(format!("The surface has {handles} handles, where parts of the body touch, as fingers do."));
        }
        sentences
    }

    /// Writes mesh, bones and motion as USDZ.
    fn write_rigged(&self, path: &Path, file: &MeshFile<'_>, track: Option<&PoseTrack>) -> Result<()> {
        let bones = self.person.template.skeleton.joints();
        let joints: Vec<MeshJoint<'_>> = bones
            .iter()
            .map(|joint| MeshJoint {
                name: &joint.name,
                parent: joint.parent,
                mesh_from_joint: joint.joint_from_canonical.inverse().as_mat4(),
                parent_from_joint: DMat4::from_rotation_translation(joint.rest_rotation, joint.rest_translation)
                    .as_mat4(),
            })
            .collect();
        let (indices, weights): (Vec<_>, Vec<_>) =
            self.person.template.skin.iter().map(|skin| (skin.joints, skin.weights)).unzip();
        let poses: Vec<(f64, Vec<Vec3>, Vec<Quat>)> = track
            .map(PoseTrack::keys)
            .unwrap_or_default()
            .iter()
            .map(|(nanos, pose)| {
                let mut translations: Vec<Vec3> = bones.iter().map(|joint| joint.rest_translation.as_vec3()).collect();
                translations.iter_mut().take(1).for_each(|root| *root = pose.root_translation.as_vec3());
                (*nanos as f64 * 1e-9, translations, pose.joint_rotations.iter().map(|turn| turn.as_quat()).collect())
            })
            .collect();
        let frames: Vec<JointFrame<'_>> = poses
            .iter()
            .map(|(secs, translations, rotations)| JointFrame { secs: *secs, translations, rotations })
            .collect();
        let skeleton = MeshSkeleton { joints: &joints, indices: &indices, weights: &weights, frames: &frames };
        Ok(write_usdz(path, &MeshFile { skeleton: Some(skeleton), ..*file })?)
    }

    /// Returns the tracked motion, or that of an avatar, with y up.
    fn track(&self) -> Result<Option<PoseTrack>> {
        let turn = self.source.y_up();
        let tracked = self.source.frames.iter().zip(self.source.seconds());
        let tracked = tracked.map(|(frame, secs)| ((secs * 1e9) as i64, frame.pose.clone()));
        let given = self.source.motion.iter().flat_map(|track| track.keys().iter().cloned());
        let turned = tracked.chain(given).map(|(nanos, mut pose)| {
            pose.root_translation = turn * pose.root_translation;
            if let Some(root) = pose.joint_rotations.first_mut() {
                *root = (turn * *root).normalize();
            }
            (nanos, pose)
        });
        let keys: Vec<_> = turned.collect();
        Ok(if keys.is_empty() { None } else { Some(PoseTrack::new(keys)?) })
    }

    /// Writes the surfaces of the frames: as PLY in the take's own axes, every tenth or, as a sequence, all, which become one USD stage
    /// with y up as well. Each frame is posed once.
    fn write_frames(&self, folder: &Path, file: &MeshFile<'_>) -> Result<()> {
        let is_written =
            |number: u64| self.args.sequence || self.args.frame.is_some() || number.is_multiple_of(SURFACE_EVERY);
        if self.source.numbers.iter().any(|number| is_written(*number)) {
            create_surfaces(folder)?;
        }
        if self.args.sequence {
            let (secs, turn): (Vec<f64>, _) = (self.source.seconds().collect(), self.source.y_up().as_quat());
            return Ok(write_usd_sequence(&folder.join("sequence.usda"), file, &secs, |i| {
                let mut frame = self.write_surface(folder, i).map_err(std::io::Error::other)?;
                frame.positions.iter_mut().chain(&mut frame.normals).for_each(|vector| *vector = turn * *vector);
                Ok(frame)
            })?);
        }
        let chosen = (0..self.source.frames.len()).filter(|i| is_written(self.source.numbers[*i]));
        chosen.map(|i| self.write_surface(folder, i)).try_for_each(|written| written.map(drop))
    }

    /// Writes and returns the surface of one frame, in the take's own axes.
    fn write_surface(&self, folder: &Path, at: usize) -> Result<MeshFrame> {
        let (number, frame) = (self.source.numbers[at], &self.source.frames[at]);
        let (positions, normals) = self.person.posed(&frame.pose, Some(&frame.translations));
        let path = folder.join(format!("surface/{number:06}.ply"));
        write_mesh_ply(&path, &positions, &normals, &self.person.template.triangles, &[])?;
        Ok(MeshFrame { positions, normals })
    }

    fn metrics(&self) -> serde_json::Value {
        let PersonReport { mesh, skin, .. } = self.report;
        let [simplified_s, tied_s, textured_s] = self.report.seconds;
        let finished = Finished {
            mesh,
            topology: &self.report.topology,
            simplified_by_m: self.report.simplified_by_m,
            charts: self.report.charts,
            coverage: self.report.coverage,
            simplified_s,
            textured_s,
        };
        finished.metrics(json!({
            "take": self.args.take.dataset.display().to_string(),
            "gaussians": mesh.points,
            "dropped": mesh.dropped.total(),
            "texture_from_photographs": self.photos.seen,
            "held_out": self.held_out,
            "depth_images_mm": self.source.depth_mm.map(|[first, last]| json!({ "first": first, "last": last })),
            "shell": self.report.shell.map(|shell| json!({
                "wall_share": shell.wall_share,
                "hidden_share": shell.hidden_share,
                "thick_vertices": shell.thick_vertices,
                "hollow_seconds": shell.seconds[0],
                "thin_seconds": shell.seconds[1],
            })),
            "skin": { "taken": skin.taken, "inpainted": skin.inpainted, "isolated": skin.isolated },
            "seconds": {
                "tracking": self.source.tracked_s,
                "fit": self.source.fitted_s,
                "skin": tied_s,
                "photographs": self.photos.seconds,
                "all_after_tracking_and_fit": self.seconds,
            },
        }))
    }

    fn print(&self) {
        let (mesh, topology) = (&self.report.mesh, &self.report.topology);
        let shell = self.report.shell.map_or_else(String::new, |shell| {
            format!(
                ", {:.1} % is the inner side of the skirt and {:.1} % legs hidden by it",
                100.0 * shell.wall_share,
                100.0 * shell.hidden_share
            )
        });
        println!(
            "{} triangles from {} Gaussians at voxels of {:.1} mm in {:.1} s; {:.1} % of the surface closes holes{shell}, {} self-intersections; {}",
            topology.triangles,
            mesh.points,
            1e3 * mesh.settings.voxel_m,
            self.seconds,
            100.0 * mesh.hole_share,
            topology.self_intersections,
            self.out.join("mesh.glb").display()
        );
    }
}
