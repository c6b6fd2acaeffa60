//! Export of a simulated capture to a folder: EasyMocap layout, with the truth beside it.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use flyrig_body::{GlbContents, write_glb, write_mesh_ply};
use flyrig_calib::save_export;
use flyrig_types::{CameraId, write_whole};
use image::{ExtendedColorType, ImageEncoder as _};
use serde_json::json;

use crate::camera::faults::{Delivery, FramePlan};
use crate::camera::source::{corrupted, shot};
use crate::error::SimError;
use crate::files::truth_file::write_truth;
use crate::simulator::Simulator;

/// Options of an export.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExportOptions {
    /// Number of frames per camera.
    pub frames: u64,
    /// Whether to write the folder `truth` as well.
    pub truth: bool,
}

/// Summary of an export.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Exported {
    /// Images of all cameras.
    pub pictures: u64,
    /// Frames lost by the fault script.
    pub lost: u64,
}

/// Simulates frame after frame into a new folder:
///
/// - `intri.yml`, `extri.yml`, `images/CAM/000000.png`, `mask/CAM/000000.png`, `background/CAM.png` (EasyMocap layout),
/// - `subject.glb`: the body without clothes and its motion, z up,
/// - `simulation.toml`: the configuration that reproduces the capture,
/// - `truth/intri.yml`, `truth/extri.yml`: the true cameras, without the calibration error,
/// - `truth/frames.csv`: true time, timestamp and delivery of each frame,
/// - `truth/poses.jsonl`: one line per frame with pose and joints,
/// - `truth/surface/000000.ply`: the clothed surface with canonical positions and displacement of the cloth (`cloth_*`,
///   metres),
/// - `truth/CAM/000000.exr`: depth, normal, canonical position and part at each pixel of the image.
///
/// A frame that the fault script loses has no image. `go_on` receives the number of completed frames, and ends the
/// export by returning false. Everything is written next to the folder first: it appears whole or not at all.
///
/// # Errors
/// [`SimError::Export`] names the file and the fix, [`SimError::Stopped`] after `go_on` returned false; others when an
/// image cannot be rendered.
pub fn export(
    simulator: &mut Simulator,
    folder: &Path,
    options: ExportOptions,
    go_on: &mut dyn FnMut(u64) -> bool,
) -> Result<Exported, SimError> {
    let name = folder.file_name().ok_or_else(|| refused(folder, "is no name for a folder"))?;
    let taken = fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) || folder.is_file();
    if taken {
        return Err(refused(folder, "is there already; remove it or choose another name"));
    }
    let mut partial_name = name.to_owned();
    partial_name.push(".partial");
    let partial = folder.with_file_name(partial_name);
    if partial.exists() {
        return Err(refused(
            &partial,
            "is left over from an export that still runs or was killed; remove it if none runs",
        ));
    }
    let mut written = Folder { root: partial, pictures: 0, lost: 0 }.write(simulator, options, go_on);
    let partial = folder.with_file_name(format!("{}.partial", name.to_string_lossy()));
    if written.is_ok() {
        // An empty folder of this name may be there.
        let _ = fs::remove_dir(folder);
        written = written.and_then(|exported| io(&partial, fs::rename(&partial, folder)).map(|()| exported));
    }
    if written.is_err() {
        // The first error is the one worth telling.
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn refused(path: &Path, message: &str) -> SimError {
    SimError::Export { path: path.to_owned(), message: message.to_owned() }
}

fn io<T>(path: &Path, result: std::io::Result<T>) -> Result<T, SimError> {
    result.map_err(|error| refused(path, &format!("cannot be written: {error}")))
}

struct Folder {
    root: PathBuf,
    pictures: u64,
    lost: u64,
}

impl Folder {
    fn write(
        mut self,
        simulator: &mut Simulator,
        options: ExportOptions,
        go_on: &mut dyn FnMut(u64) -> bool,
    ) -> Result<Exported, SimError> {
        let cameras: Vec<CameraId> = simulator.rig().cameras.iter().map(|camera| camera.id.clone()).collect();
        self.folder("background")?;
        for camera in &cameras {
            for kind in ["images", "mask"].into_iter().chain(options.truth.then_some("truth")) {
                self.folder(&format!("{kind}/{camera}"))?;
            }
        }
        save_export(&self.root, &simulator.reported_rig())?;
        for (slot, camera) in cameras.iter().enumerate() {
            let plate = simulator.plate(slot)?;
            let size = [plate.width(), plate.height()];
            self.png(&format!("background/{camera}.png"), plate.bytes(), size, ExtendedColorType::Rgb8)?;
        }
        let last = simulator.frame_nanos(options.frames.saturating_sub(1));
        let track = simulator.track().repeated_until(last);
        write_glb(
            &self.root.join("subject.glb"),
            simulator.template(),
            GlbContents { track: Some(&track), ..GlbContents::default() },
        )?;
        let config = toml::to_string(simulator.config())
            .map_err(|error| refused(&self.root.join("simulation.toml"), &error.to_string()))?;
        self.text("simulation.toml", &config)?;
        if options.truth {
            self.folder("truth/surface")?;
            save_export(&self.root.join("truth"), simulator.rig())?;
        }
        let mut times = "frame,camera,delivery,true_nanos,stamp_nanos,exposure\n".to_owned();
        let mut poses = String::new();
        for frame in 0..options.frames {
            if !go_on(frame) {
                return Err(SimError::Stopped);
            }
            for (slot, camera) in cameras.iter().enumerate() {
                let plan = simulator.plan(slot, frame)?;
                let delivery = format!("{:?}", plan.delivery).to_lowercase();
                let FramePlan { true_nanos, stamp_nanos, exposure, .. } = plan;
                times.push_str(&format!("{frame},{camera},{delivery},{true_nanos},{stamp_nanos},{exposure}\n"));
                if plan.delivery != Delivery::Frame {
                    self.lost += 1;
                    continue;
                }
                self.frame(simulator, frame, slot, camera, &plan, options.truth)?;
                self.pictures += 1;
            }
            if options.truth {
                let nanos = simulator.frame_nanos(frame);
                poses.push_str(&pose_line(simulator, frame, nanos));
                let surface = simulator.clothed_surface(nanos);
                let canonical = |axis: usize| surface.canonical.iter().map(|p| p[axis]).collect();
                let more =
                    [("canonical_x", canonical(0)), ("canonical_y", canonical(1)), ("canonical_z", canonical(2))];
                let path = self.root.join(format!("truth/surface/{frame:06}.ply"));
                write_mesh_ply(&path, &surface.positions, &surface.normals, &surface.triangles, &more)?;
            }
        }
        if options.truth {
            self.text("truth/frames.csv", &times)?;
            self.text("truth/poses.jsonl", &poses)?;
        }
        go_on(options.frames);
        Ok(Exported { pictures: self.pictures, lost: self.lost })
    }

    fn frame(
        &self,
        simulator: &mut Simulator,
        frame: u64,
        slot: usize,
        camera: &CameraId,
        plan: &FramePlan,
        truth: bool,
    ) -> Result<(), SimError> {
        let shot = shot(plan, slot);
        let (picture, mask) = if truth {
            let seen = simulator.render_with(&shot)?;
            write_truth(&self.root.join(format!("truth/{camera}/{frame:06}.exr")), &seen)?;
            (seen.color, seen.mask)
        } else {
            simulator.capture_with(&shot)?
        };
        let picture = corrupted(simulator, plan, frame, picture)?;
        let size = [picture.width(), picture.height()];
        self.png(&format!("images/{camera}/{frame:06}.png"), picture.bytes(), size, ExtendedColorType::Rgb8)?;
        self.png(&format!("mask/{camera}/{frame:06}.png"), mask.coverage(), size, ExtendedColorType::L8)?;
        Ok(())
    }

    fn folder(&self, name: &str) -> Result<(), SimError> {
        let path = self.root.join(name);
        io(&path, fs::create_dir_all(&path))
    }

    fn text(&self, name: &str, text: &str) -> Result<(), SimError> {
        let path = self.root.join(name);
        io(&path, write_whole(&path, |out| out.write_all(text.as_bytes())))
    }

    fn png(&self, name: &str, bytes: &[u8], size: [u32; 2], color: ExtendedColorType) -> Result<(), SimError> {
        let mut png = Vec::new();
        image::codecs::png::PngEncoder::new(&mut png).write_image(bytes, size[0], size[1], color)?;
        let path = self.root.join(name);
        io(&path, fs::write(&path, png))
    }
}

/// Returns pose and joints of an instant as a line of JSON.
fn pose_line(simulator: &Simulator, frame: u64, nanos: i64) -> String {
    let pose = simulator.pose(nanos);
    let skeleton = &simulator.template().skeleton;
    let world = skeleton.world_from_joint(&pose);
    let joints: Vec<_> = skeleton
        .joints()
        .iter()
        .zip(&world)
        .zip(&pose.joint_rotations)
        .map(|((joint, world), rotation)| {
            json!({
                "name": joint.name,
                "rotation_xyzw": rotation.to_array(),
                "position_m": world.w_axis.truncate().to_array(),
            })
        })
        .collect();
    let root = pose.root_translation.to_array();
    format!("{}\n", json!({ "frame": frame, "nanos": nanos, "root_translation_m": root, "joints": joints }))
}
