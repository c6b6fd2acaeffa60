//! Watch over the cameras of a live rig: bumps are reported, and corrected with `watch = "correct"`.

use std::fmt;

use flyrig_calib::{CameraWatch, WatchState, WatchedImage};
use flyrig_types::{Camera, CameraId, FrameSet, Image, Intrinsics, PixelFormat, Rig};
use glam::{DVec2, DVec3};

/// Time between two checks of a camera, nanoseconds.
const EVERY_NANOS: i64 = 1_000_000_000;
/// Least further turn at which a corrected camera is corrected again, pixels.
const NEWS_PX: f64 = 1.0;
/// Least further turn at which it is corrected again, as a share of its turn.
const NEWS_SHARE: f64 = 0.1;

/// Comparison of one camera per frame set with its reference: the plate, or the first image where there is none.
#[derive(Debug)]
pub struct RigWatch {
    /// Cameras, one element per slot.
    cameras: Vec<WatchedCamera>,
    /// Whether moved cameras are corrected.
    corrects: bool,
}

/// One camera with its reference.
#[derive(Debug)]
struct WatchedCamera {
    /// Camera as it was calibrated.
    camera: Camera,
    /// Plate, kept where moves are corrected.
    plate: Option<Image>,
    /// Rotation vector that the last correction applied, radians.
    corrected: Option<DVec3>,
    watch: Option<CameraWatch>,
    checked_nanos: Option<i64>,
}

/// Event of a camera that was moved, or that stands again where it stood.
#[derive(Debug)]
pub struct WatchEvent {
    /// Id of the camera.
    pub camera: CameraId,
    /// New state.
    pub state: WatchState,
    /// Capture time of the image that decided, nanoseconds.
    pub nanos: i64,
    /// Camera with which the session goes on; `None` where moves are not corrected.
    pub corrected: Option<Correction>,
}

/// Corrected position of a camera.
#[derive(Debug)]
pub struct Correction {
    /// Slot of the camera in the rig.
    pub slot: usize,
    /// Calibrated camera, turned as its background was.
    pub camera: Camera,
    /// Empty scene as the camera sees it now; `None` without a plate.
    pub plate: Option<Image>,
}

impl fmt::Display for WatchEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.state {
            WatchState::Moved(motion) => {
                write!(
                    f,
                    "camera {} was moved: it turned by {:.2} degrees, and its image lies {:.1} pixels off ({} of {} points of the \
                     background agree); ",
                    self.camera,
                    motion.rotation.length().to_degrees(),
                    motion.pixels,
                    motion.agreeing.0,
                    motion.agreeing.1
                )?;
                f.write_str(match self.corrected {
                    Some(_) => "its calibration is turned along until it is put back, or calibrated again (flyrig calibrate person)",
                    None => "put it back, or calibrate again (flyrig calibrate person)",
                })
            }
            WatchState::Steady | WatchState::Unknown => {
                write!(f, "camera {} stands where it stood when its reference was taken", self.camera)
            }
        }
    }
}

impl RigWatch {
    /// Takes the plates of a rig, by slot, as references.
    #[must_use]
    pub fn new(rig: &Rig, plates: &[Option<Image>]) -> Self {
        let watched = |(slot, camera): (usize, &Camera)| WatchedCamera {
            camera: camera.clone(),
            plate: None,
            corrected: None,
            watch: plates.get(slot).and_then(Option::as_ref).and_then(|plate| watch(&camera.intrinsics, plate)),
            checked_nanos: None,
        };
        Self { cameras: rig.cameras.iter().enumerate().map(watched).collect(), corrects: false }
    }

    /// Corrects cameras that were moved: events hold their new positions. `plates`, one per slot, are turned along.
    #[must_use]
    pub fn correcting(mut self, plates: Vec<Option<Image>>) -> Self {
        self.corrects = true;
        self.cameras.iter_mut().zip(plates).for_each(|(camera, plate)| camera.plate = plate);
        self
    }

    /// Checks the camera whose last check is longest ago, if that is a second or more.
    pub fn check(&mut self, set: &FrameSet) -> Option<WatchEvent> {
        let due = self.cameras.iter_mut().zip(&set.frames).enumerate();
        let due = due.filter_map(|(slot, (camera, frame))| Some((slot, camera, frame.as_ref()?)));
        let (slot, watched, frame) = due.min_by_key(|(_, camera, _)| camera.checked_nanos)?;
        let nanos = frame.capture_nanos;
        if watched.checked_nanos.is_some_and(|last| nanos.saturating_sub(last) < EVERY_NANOS) {
            return None;
        }
        watched.checked_nanos = Some(nanos);
        let Some(known) = &mut watched.watch else {
            watched.watch = watch(&watched.camera.intrinsics, &frame.image);
            return None;
        };
        let before = known.state();
        let state = known.compare(&as_watched(&frame.image)?);
        let is_moved = |state: WatchState| matches!(state, WatchState::Moved(_));
        let corrected = self.corrects.then(|| watched.correction(slot, state)).flatten();
        let is_news = corrected.is_some() || is_moved(before) != is_moved(state);
        is_news.then(|| WatchEvent { camera: watched.camera.id.clone(), state, nanos, corrected })
    }

    /// Returns the state of a camera.
    #[must_use]
    pub fn state(&self, slot: usize) -> WatchState {
        let watch = self.cameras.get(slot).and_then(|camera| camera.watch.as_ref());
        watch.map_or(WatchState::Unknown, CameraWatch::state)
    }
}

impl WatchedCamera {
    /// Returns the camera's correction, if it has changed noticeably.
    fn correction(&mut self, slot: usize, state: WatchState) -> Option<Correction> {
        let turned = match state {
            WatchState::Moved(motion) => Some(motion.rotation),
            WatchState::Steady => None,
            WatchState::Unknown => return None,
        };
        let px = self.camera.intrinsics.focal_px.max_element();
        let is_same = match (self.corrected, turned) {
            (None, None) => true,
            (Some(before), Some(now)) => px * before.distance(now) < NEWS_PX.max(NEWS_SHARE * px * now.length()),
            _ => false,
        };
        if is_same {
            return None;
        }
        self.corrected = turned;
        let camera = match state {
            WatchState::Moved(motion) => motion.applied_to(&self.camera),
            _ => self.camera.clone(),
        };
        let plate = self.plate.as_ref().and_then(|plate| turned_plate(plate, &self.camera, &camera));
        Some(Correction { slot, camera, plate })
    }
}

/// Renders the empty scene as a camera sees it after it was turned on the spot. Pixels that it did not see before get the colour of the
/// nearest one that it saw. `None` for formats that [`as_watched`] rejects.
fn turned_plate(plate: &Image, from: &Camera, to: &Camera) -> Option<Image> {
    let WatchedImage { width, height, channels, bytes } = as_watched(plate)?;
    if [width as u32, height as u32] != from.size() {
        return None;
    }
    let pixel = |at: usize| {
        let (x, y) = (at % width, at / width);
        let seen = to.ray(DVec2::new(x as f64, y as f64)).and_then(|ray| from.project(from.position() + ray));
        let at = seen.unwrap_or(DVec2::new(x as f64, y as f64));
        let at = at.clamp(DVec2::ZERO, DVec2::new(width as f64 - 1.0, height as f64 - 1.0));
        let (low, share) = (at.floor(), at.fract());
        let value = move |dx: usize, dy: usize, channel: usize| {
            let (x, y) = ((low.x as usize + dx).min(width - 1), (low.y as usize + dy).min(height - 1));
            f64::from(bytes[channels * (y * width + x) + channel])
        };
        (0..channels).map(move |channel| {
            let row = |dy: usize| value(0, dy, channel) * (1.0 - share.x) + value(1, dy, channel) * share.x;
            (row(0) * (1.0 - share.y) + row(1) * share.y).round() as u8
        })
    };
    let bytes: Vec<u8> = (0..width * height).flat_map(pixel).collect();
    Image::new(plate.width(), plate.height(), plate.format(), bytes).ok()
}

/// Creates the watch of a camera; `None` for a reference that cannot be used.
fn watch(intrinsics: &Intrinsics, reference: &Image) -> Option<CameraWatch> {
    CameraWatch::new(intrinsics, &as_watched(reference)?)
}

/// Views an image as bytes; `None` for formats that a session rejects too.
fn as_watched(image: &Image) -> Option<WatchedImage<'_>> {
    let channels = match image.format() {
        PixelFormat::Rgb8 => 3,
        PixelFormat::Gray8 => 1,
        _ => return None,
    };
    let (width, height) = (image.width() as usize, image.height() as usize);
    Some(WatchedImage { width, height, channels, bytes: image.bytes() })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use flyrig_types::{Frame, Isometry, Lens};

    use super::*;

    const SIZE: (u32, u32) = (320, 240);

    /// Returns blocks of random brightness, shifted to the right.
    fn image(shift: u32, gain: f64) -> Image {
        let block = |x: u32, y: u32| {
            let (bx, by) = ((x + 1000 - shift) / 16, y / 16);
            let mut h = u64::from(bx) << 32 | u64::from(by);
            h = (h ^ (h >> 31)).wrapping_mul(0x7FB5_D329_728E_A185);
            h = (h ^ (h >> 27)).wrapping_mul(0x81DA_DEF4_BC2D_D44D);
            40.0 + ((h >> 33) % 150) as f64
        };
        let bytes: Vec<u8> =
            (0..SIZE.1).flat_map(|y| (0..SIZE.0).flat_map(move |x| [(gain * block(x, y)) as u8; 3])).collect();
        Image::new(SIZE.0, SIZE.1, PixelFormat::Rgb8, bytes).unwrap()
    }

    fn rig() -> Rig {
        let camera = |name: &str| Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: name.into(),
            intrinsics: Intrinsics {
                width: SIZE.0,
                height: SIZE.1,
                focal_px: DVec2::splat(400.0),
                center_px: DVec2::new(159.5, 119.5),
                lens: Lens::PINHOLE,
            },
            camera_from_world: Isometry::IDENTITY,
        };
        Rig { cameras: vec![camera("left"), camera("right")], world_up: DVec3::NEG_Y }
    }

    fn set(rig: &Rig, index: u64, images: [Option<Image>; 2]) -> FrameSet {
        let master_nanos = index as i64 * 250_000_000;
        let frame = |(camera, image): (&Camera, Option<Image>)| {
            Some(Arc::new(Frame {
                camera: camera.id.clone(),
                sequence: index,
                capture_nanos: master_nanos,
                exposure_nanos: None,
                image: image?,
                mask: None,
            }))
        };
        let frames = rig.cameras.iter().zip(images).map(frame).collect();
        FrameSet { index, master_nanos, frames }
    }

    #[test]
    fn the_camera_that_was_moved_is_named_once_and_again_when_it_is_put_back() {
        let rig = rig();
        for plates in [vec![None, None], vec![Some(image(0, 1.0)), Some(image(0, 0.8))]] {
            let mut watch = RigWatch::new(&rig, &plates);
            let mut events = Vec::new();
            for index in 0..120 {
                let shift = if (40..80).contains(&index) { 5 } else { 0 };
                let right = (index % 7 != 3).then(|| image(shift, 0.9));
                events.extend(watch.check(&set(&rig, index, [Some(image(0, 1.0)), right])));
            }
            let texts: Vec<String> = events.iter().map(WatchEvent::to_string).collect();
            assert_eq!(events.len(), 2, "{texts:?}");
            assert!(texts[0].starts_with("camera right was moved: it turned by 0.69 degrees"), "{texts:?}");
            assert!(events[0].nanos < 10_000_000_000 + 5_000_000_000, "within five seconds: {texts:?}");
            assert_eq!(texts[1], "camera right stands where it stood when its reference was taken");
            assert_eq!((watch.state(0), watch.state(1)), (WatchState::Steady, WatchState::Steady));
            assert_eq!(watch.state(9), WatchState::Unknown);
        }
    }

    #[test]
    fn a_camera_that_was_moved_is_turned_along_with_its_plate_and_back_again() {
        let rig = rig();
        let plates = || vec![Some(image(0, 1.0)), Some(image(0, 1.0))];
        let mut watch = RigWatch::new(&rig, &plates()).correcting(plates());
        let mut events = Vec::new();
        for index in 0..200 {
            // Turned, turned further, put back.
            let shift = [0, 5, 12, 0][(index / 40).min(3) as usize];
            events.extend(watch.check(&set(&rig, index, [Some(image(0, 1.0)), Some(image(shift, 0.9))])));
        }
        let texts: Vec<String> = events.iter().map(WatchEvent::to_string).collect();
        assert_eq!(events.len(), 3, "{texts:?}");
        assert!(texts[0].contains("its calibration is turned along"), "{texts:?}");
        // A point far away is seen where the image has moved to.
        let far = DVec3::new(0.0, 0.0, 1000.0);
        for (event, shift) in events.iter().zip([5.0, 12.0, 0.0]) {
            let Correction { slot, camera, plate } = event.corrected.as_ref().unwrap();
            assert_eq!(*slot, 1);
            let moved = camera.project(far).unwrap() - rig.cameras[1].project(far).unwrap();
            assert!(moved.distance(DVec2::new(shift, 0.0)) < 0.3, "{moved}, {shift}");
            let (ours, now) = (plate.as_ref().unwrap(), image(shift as u32, 1.0));
            let middle = |image: &Image| image.bytes()[(120 * SIZE.0 as usize + 60) * 3..][..300].to_vec();
            let off = middle(ours).iter().zip(middle(&now)).filter(|(a, b)| a.abs_diff(*b) > 20).count();
            assert!(off < 30, "{off} of 300 values of the plate differ");
        }
        assert_eq!(events[2].corrected.as_ref().unwrap().camera, rig.cameras[1], "as it was calibrated");
    }

    #[test]
    fn images_of_another_format_or_size_and_empty_sets_are_left_out() {
        let rig = rig();
        let mut watch = RigWatch::new(&rig, &[]);
        let small = || Image::new(8, 8, PixelFormat::Rgb8, vec![9; 192]).unwrap();
        let packed = || Image::new(SIZE.0, SIZE.1, PixelFormat::Yuyv, vec![9; (2 * SIZE.0 * SIZE.1) as usize]).unwrap();
        for index in 0..40 {
            assert!(watch.check(&set(&rig, index, [None, None])).is_none());
            assert!(watch.check(&set(&rig, index, [Some(small()), Some(packed())])).is_none());
        }
        assert_eq!(watch.state(0), WatchState::Unknown);
    }
}
