//! `flyrig play --orbit`: a film of a recorded person stream.

use std::{path::Path, sync::Arc};

use anyhow::{Context as _, Result, ensure};
use flyrig_capture::recorded_messages;
use flyrig_gpu::GpuContext;
use flyrig_stream::{Posed, PosedAxes, StreamTemplate, stamp_of};
use flyrig_takes::recorded::recorded_cameras;
use flyrig_types::{Camera, RenderedView};
use flyrig_viewer::{PeopleScene, ShownPerson};
use flyrig_viewing::People;
use glam::Vec3;

use crate::{
    orbit_film::{Extent, OrbitFilm},
    stream_recording::{MOTION, TEMPLATE, TOPIC},
};

/// People of the stream as they are drawn.
struct Stage {
    people: People,
    scene: PeopleScene,
    film: OrbitFilm,
    images: u64,
}

impl Stage {
    /// Draws the people at a capture time, nanoseconds; nothing before the first one is known.
    fn draw(&mut self, nanos: i64) -> Result<()> {
        let now = nanos as f64 / 1e9;
        let numbers: Vec<u32> = self.people.iter().map(|(number, _)| number).collect();
        let mut posed_people = Vec::new();
        for number in numbers {
            let Some(person) = self.people.get_mut(number) else { continue };
            let Some(motion) = person.motion_at(now, false) else { continue };
            let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
            let colors = person.pose(&motion, &mut posed);
            let is_avatar = person.pose_axes(&motion, &posed, &mut axes);
            posed_people.push((posed, colors, is_avatar.then_some(axes)));
        }
        let Some((first, ..)) = posed_people.first() else { return Ok(()) };
        let points = first.center_scale.iter().map(|&[x, y, z, _]| Vec3::new(x, y, z));
        let Some(extent) = Extent::of(points, self.film.up()) else { return Ok(()) };
        let shown = posed_people.iter().map(|(posed, colors, axes)| ShownPerson { posed, colors, axes: axes.as_ref() });
        self.scene.set_people(shown)?;
        let camera = self.film.camera(nanos, &extent);
        let view = self.scene.draw(&camera)?;
        self.images += 1;
        self.film.write(&view, &camera, nanos)
    }
}

/// Writes the film of a recording of `flyrig watch --record`.
pub fn film(recording: &Path, path: &Path, gpu: &GpuContext) -> Result<()> {
    let rig = recorded_cameras(recording)?
        .rig
        .with_context(|| format!("{} has no calibration; record it with flyrig watch --record", recording.display()))?;
    let scene = PeopleScene::new(&gpu.fastest())?;
    let mut stage = Stage { people: People::default(), scene, film: OrbitFilm::create(path, &rig)?, images: 0 };
    let (mut damaged, mut pending) = (0u64, None);
    for (_, message) in recorded_messages(recording, TOPIC)? {
        let Some(([kind, person @ ..], bytes)) = message.split_first_chunk::<5>() else {
            damaged += 1;
            continue;
        };
        let person = u32::from_le_bytes(*person);
        if *kind == TEMPLATE {
            match StreamTemplate::decode(bytes) {
                Ok(template) => stage.people.set_template(person, Arc::new(template)),
                Err(_) => damaged += 1,
            }
            continue;
        }
        let Ok(stamp) = stamp_of(bytes) else {
            damaged += 1;
            continue;
        };
        // The first motion of another instant: all people and colours of the instant before have arrived.
        let is_motion = *kind == MOTION;
        if is_motion && let Some(nanos) = pending.replace(stamp.capture_nanos).filter(|n| *n != stamp.capture_nanos) {
            stage.draw(nanos)?;
        }
        damaged += u64::from(stage.people.ingest(person, is_motion, bytes, stamp.capture_nanos as f64 / 1e9).is_err());
    }
    if let Some(nanos) = pending {
        stage.draw(nanos)?;
    }
    let Stage { mut scene, film, images, .. } = stage;
    ensure!(images > 0, "{} shows no person; record one with flyrig watch --record", recording.display());
    film.finish(|camera: &Camera| -> Result<RenderedView> { Ok(scene.draw(camera)?) })?;
    eprintln!("play: {images} frames, {damaged} messages damaged; the film is {}", path.display());
    Ok(())
}
