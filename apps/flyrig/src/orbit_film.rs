//! Film of a camera that walks around the person while a take plays: for `flyrig eval --orbit` and `flyrig play --orbit`.
//!
//! The camera turns once in [`TURN_SECS`], follows the person softly and stands so far away that the whole person fills the image. Where the
//! take is shorter than one turn, the person stands still at the end until the circle is closed. The person stands on a floor with a contact
//! shadow; no part of the room is known.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use flyrig_renderer::composite_over;
use flyrig_types::{Camera, Intrinsics, Isometry, RenderedView, Rig};
use glam::{DVec3, Vec3};
use image::RgbImage;
use rayon::prelude::*;

use crate::video_file::VideoFile;

/// Width and height, pixels.
const SIZE: (u32, u32) = (720, 900);
/// Time of one turn, seconds.
const TURN_SECS: f64 = 8.0;
/// Vertical field of view and elevation above the horizon, radians.
const FIELD: f64 = 0.5;
const ELEVATION: f64 = 0.14;
/// Room around the person, relative to its size.
const ROOM: f64 = 1.12;
/// Time constant with which the camera follows the person, seconds.
const FOLLOW_SECS: f64 = 0.6;
/// Interval of images while the person stands still, nanoseconds.
const STEP_NANOS: i64 = 33_333_333;
/// Radii of the lit floor and of the contact shadow, metres.
const FLOOR_M: f64 = 1.5;
const SHADOW_M: f64 = 0.38;

/// Place and size of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// Middle of the body, world, metres.
    center: DVec3,
    /// Half of the height, and largest horizontal distance from the middle, metres.
    half_height: f64,
    radius: f64,
}

impl Extent {
    /// Returns the extent of a body's points along `up`, a unit vector; `None` without finite points.
    pub fn of(points: impl Iterator<Item = Vec3> + Clone, up: DVec3) -> Option<Self> {
        let points = points.map(Vec3::as_dvec3).filter(|point| point.is_finite());
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let (mut bottom, mut top) = (f64::INFINITY, f64::NEG_INFINITY);
        for point in points.clone() {
            (low, high) = (low.min(point), high.max(point));
            (bottom, top) = (bottom.min(point.dot(up)), top.max(point.dot(up)));
        }
        if bottom >= top {
            return None;
        }
        let middle = 0.5 * (low + high);
        let center = middle + up * (0.5 * (bottom + top) - middle.dot(up));
        let away = |point: DVec3| (point - center).reject_from_normalized(up).length();
        Some(Self { center, half_height: 0.5 * (top - bottom), radius: points.map(away).fold(0.0, f64::max) })
    }
}

/// Film under way.
pub struct OrbitFilm {
    video: VideoFile,
    path: PathBuf,
    up: DVec3,
    /// Position of the rig's first camera, from which the film starts.
    start: DVec3,
    /// Time of the first image and of the last one, nanoseconds.
    span: Option<(i64, i64)>,
    /// Extent that the camera looks at, which follows the person's.
    shown: Option<Extent>,
    /// Height of the floor along `up`, metres.
    floor: f64,
}

impl OrbitFilm {
    /// Creates the file.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn create(path: &Path, rig: &Rig) -> Result<Self> {
        Ok(Self {
            video: VideoFile::create(path, SIZE)?,
            path: path.to_owned(),
            up: rig.world_up.try_normalize().unwrap_or(DVec3::Z),
            start: rig.cameras.first().map_or(DVec3::X, Camera::position),
            span: None,
            shown: None,
            floor: 0.0,
        })
    }

    /// Returns the unit vector that points up.
    pub fn up(&self) -> DVec3 {
        self.up
    }

    /// Returns the camera at a time (nanoseconds) for a body of this extent. Times do not decrease.
    pub fn camera(&mut self, nanos: i64, body: &Extent) -> Camera {
        let (first, last) = *self.span.get_or_insert((nanos, nanos));
        let bottom = body.center.dot(self.up) - body.half_height;
        let shown = match self.shown {
            None => {
                self.floor = bottom;
                *body
            }
            Some(before) => {
                let elapsed = nanos.saturating_sub(last).max(0) as f64 / 1e9;
                let share = 1.0 - (-elapsed / FOLLOW_SECS).exp();
                // A jump does not move the floor far.
                self.floor += 0.1 * share * (bottom - self.floor);
                Extent {
                    center: before.center + share * (body.center - before.center),
                    half_height: before.half_height.max(body.half_height),
                    radius: before.radius.max(body.radius),
                }
            }
        };
        self.shown = Some(shown);
        self.span = Some((first, last.max(nanos)));
        self.camera_at((nanos.saturating_sub(first)) as f64 / 1e9 / TURN_SECS, &shown)
    }

    /// Returns the camera that sees an extent after a number of turns.
    fn camera_at(&self, turns: f64, shown: &Extent) -> Camera {
        let level = (self.start - shown.center).reject_from_normalized(self.up);
        let ahead = level.try_normalize().unwrap_or_else(|| self.up.any_orthonormal_vector());
        let angle = turns * std::f64::consts::TAU;
        let around = ahead * angle.cos() + self.up.cross(ahead) * angle.sin();
        let (width, height) = SIZE;
        let half = (0.5 * FIELD).tan();
        let (tall, wide) = (shown.half_height / half, shown.radius / half * f64::from(height) / f64::from(width));
        let distance = ROOM * tall.max(wide) + shown.radius.min(shown.half_height);
        let eye = shown.center + distance * (around * ELEVATION.cos() + self.up * ELEVATION.sin());
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "orbit".into(),
            intrinsics: Intrinsics::pinhole(width, height, 0.5 * f64::from(height) / half),
            camera_from_world: Isometry::look_at(eye, shown.center, self.up),
        }
    }

    /// Appends a view of [`Self::camera`] that was taken at a time, nanoseconds.
    ///
    /// # Errors
    /// The disk refuses it.
    pub fn write(&mut self, view: &RenderedView, camera: &Camera, nanos: i64) -> Result<()> {
        let middle = self.shown.map_or(DVec3::ZERO, |shown| shown.center);
        let rgb = composite_over(&view.rgba, &backdrop(camera, self.up, self.floor, middle));
        let image = RgbImage::from_raw(view.width, view.height, rgb).context("a view of another size")?;
        self.video.write(&image, 0, nanos).with_context(|| format!("writing to {}", self.path.display()))
    }

    /// Closes the circle around the person as it stands, and finishes the file. `draw` draws the person.
    ///
    /// # Errors
    /// Those of `draw` and of the disk.
    pub fn finish(mut self, mut draw: impl FnMut(&Camera) -> Result<RenderedView>) -> Result<()> {
        if let (Some((first, last)), Some(shown)) = (self.span, self.shown) {
            let end = first.saturating_add((TURN_SECS * 1e9) as i64);
            let mut nanos = last.saturating_add(STEP_NANOS);
            while nanos <= end {
                let camera = self.camera_at(nanos.saturating_sub(first) as f64 / 1e9 / TURN_SECS, &shown);
                let view = draw(&camera)?;
                self.write(&view, &camera, nanos)?;
                nanos = nanos.saturating_add(STEP_NANOS);
            }
        }
        self.video.finish().with_context(|| format!("closing {}", self.path.display()))
    }
}

/// Draws the empty scene: a dark room whose floor is lit around `middle`, with a contact shadow there. RGB.
fn backdrop(camera: &Camera, up: DVec3, floor: f64, middle: DVec3) -> Vec<u8> {
    let lens = &camera.intrinsics;
    let (eye, world_from_camera) = (camera.position(), camera.camera_from_world.rotation.inverse());
    let above = eye.dot(up) - floor;
    let mut rgb = vec![0; 3 * lens.width as usize * lens.height as usize];
    rgb.par_chunks_exact_mut(3 * lens.width as usize).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let across = (x as f64 - lens.center_px.x) / lens.focal_px.x;
            let ray = world_from_camera * DVec3::new(across, (y as f64 - lens.center_px.y) / lens.focal_px.y, 1.0);
            let down = -ray.dot(up);
            let light = if above > 0.0 && down > 1e-6 {
                let away = (eye + ray * (above / down) - middle).reject_from_normalized(up).length();
                let shadow = 1.0 - 0.6 * (-(away / SHADOW_M).powi(2)).exp();
                1.0 + 1.1 * (-(away / FLOOR_M).powi(2)).exp() * shadow - 0.5 * (1.0 - shadow)
            } else {
                1.0
            };
            for (value, grey) in pixel.iter_mut().zip([34.0, 36.0, 40.0]) {
                *value = (grey * light).round() as u8;
            }
        }
    });
    rgb
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the corners of a box around a body.
    fn body(at: DVec3, half: DVec3) -> Vec<Vec3> {
        let sign = |bit: usize, i: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        (0..8).map(|i| (at + half * DVec3::new(sign(0, i), sign(1, i), sign(2, i))).as_vec3()).collect()
    }

    #[test]
    fn the_whole_person_fills_every_image_of_the_circle() {
        let folder = tempfile::tempdir().unwrap();
        for up in [DVec3::Z, DVec3::Y, -DVec3::Y] {
            let rig = Rig { cameras: Vec::new(), world_up: up };
            let mut film = OrbitFilm::create(&folder.path().join("a.mp4"), &rig).unwrap();
            let half = DVec3::splat(0.3) + 0.6 * up.abs();
            for i in 0..40 {
                let points = body(DVec3::new(0.02 * f64::from(i), 1.0, 0.3), half);
                let extent = Extent::of(points.iter().copied(), up).unwrap();
                let camera = film.camera(i64::from(i) * 200_000_000, &extent);
                camera.validate().unwrap();
                let pixels: Vec<_> = points.iter().map(|p| camera.project(p.as_dvec3()).unwrap()).collect();
                let inside = |p: &glam::DVec2| (0.0..720.0).contains(&p.x) && (0.0..900.0).contains(&p.y);
                assert!(pixels.iter().all(inside), "{i}: {pixels:?}");
                let high = |pick: fn(f64, f64) -> f64, from: f64| pixels.iter().map(|p| p.y).fold(from, pick);
                let height = high(f64::max, 0.0) - high(f64::min, 900.0);
                assert!(height > 600.0, "{i}: {height} of 900 pixels");
            }
            let turned = film.camera_at(0.5, &film.shown.unwrap()).position();
            let from = film.camera_at(0.0, &film.shown.unwrap()).position();
            assert!(turned.distance(from) > 4.0 && (turned - from).dot(up).abs() < 1e-6);
        }
    }

    #[test]
    fn points_that_are_no_numbers_are_left_out() {
        let points = [Vec3::NAN, Vec3::ZERO, Vec3::splat(f32::INFINITY), Vec3::new(0.2, 0.0, 1.8)];
        let extent = Extent::of(points.into_iter(), DVec3::Z).unwrap();
        assert!((extent.half_height - 0.9).abs() < 1e-6 && (extent.radius - 0.1).abs() < 1e-6, "{extent:?}");
        assert_eq!(Extent::of(std::iter::empty(), DVec3::Z), None);
    }

    #[test]
    fn a_short_take_closes_its_circle() {
        use flyrig_capture::{CameraSource as _, VideoOptions, VideoReplay};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mp4");
        let mut film = OrbitFilm::create(&path, &Rig { cameras: Vec::new(), world_up: DVec3::Z }).unwrap();
        let extent = Extent::of(body(DVec3::ZERO, DVec3::new(0.3, 0.2, 0.9)).into_iter(), DVec3::Z).unwrap();
        let view = |_: &Camera| Ok(RenderedView { width: SIZE.0, height: SIZE.1, rgba: vec![0; 4 * 720 * 900] });
        for nanos in [5_000_000_000, 5_040_000_000] {
            let camera = film.camera(nanos, &extent);
            film.write(&view(&camera).unwrap(), &camera, nanos).unwrap();
        }
        film.finish(view).unwrap();
        let mut video = VideoReplay::open(&"a".into(), &path, &VideoOptions::default()).unwrap();
        let times: Vec<i64> =
            std::iter::from_fn(|| video.next_frame(std::time::Duration::ZERO).ok()).map(|f| f.capture_nanos).collect();
        let last = times.last().unwrap() - times[0];
        assert!((7.9e9..8.01e9).contains(&(last as f64)), "{last}");
    }
}
