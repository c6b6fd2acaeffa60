//! Watches the cameras of a live rig for bumps.

use std::fmt;

use flyrig_calib::{CameraWatch, WatchState, WatchedImage};
use flyrig_types::{CameraId, FrameSet, Image, Intrinsics, PixelFormat, Rig};

/// Time between two looks at a camera, nanoseconds.
const EVERY_NANOS: i64 = 1_000_000_000;

/// Compares one camera of a set at a time with its reference: the plate, or the first image where there is none.
#[derive(Debug)]
pub struct RigWatch {
    /// By slot.
    cameras: Vec<Watched>,
}

#[derive(Debug)]
struct Watched {
    id: CameraId,
    intrinsics: Intrinsics,
    watch: Option<CameraWatch>,
    looked_nanos: Option<i64>,
}

/// A camera was moved, or stands again where it stood.
#[derive(Debug, Clone)]
pub struct WatchEvent {
    /// Which camera.
    pub camera: CameraId,
    /// New state.
    pub state: WatchState,
    /// Capture time of the image that decided, nanoseconds.
    pub nanos: i64,
}

impl fmt::Display for WatchEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.state {
            WatchState::Moved(motion) => write!(
                f,
                "camera {} was moved: it turned by {:.2} degrees, and its image lies {:.1} pixels off ({} of {} points of the background \
                 agree); put it back, or calibrate again (flyrig calibrate person)",
                self.camera,
                motion.rotation.length().to_degrees(),
                motion.pixels,
                motion.agreeing.0,
                motion.agreeing.1
            ),
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
        let watched = |(slot, camera): (usize, &flyrig_types::Camera)| Watched {
            id: camera.id.clone(),
            intrinsics: camera.intrinsics,
            watch: plates.get(slot).and_then(Option::as_ref).and_then(|plate| watch(&camera.intrinsics, plate)),
            looked_nanos: None,
        };
        Self { cameras: rig.cameras.iter().enumerate().map(watched).collect() }
    }

    /// Looks at the camera that was not looked at for longest, if that is a second ago.
    pub fn look(&mut self, set: &FrameSet) -> Option<WatchEvent> {
        let due =
            self.cameras.iter_mut().zip(&set.frames).filter_map(|(camera, frame)| Some((camera, frame.as_ref()?)));
        let (camera, frame) = due.min_by_key(|(camera, _)| camera.looked_nanos)?;
        let nanos = frame.capture_nanos;
        if camera.looked_nanos.is_some_and(|last| nanos.saturating_sub(last) < EVERY_NANOS) {
            return None;
        }
        camera.looked_nanos = Some(nanos);
        let Some(known) = &mut camera.watch else {
            camera.watch = watch(&camera.intrinsics, &frame.image);
            return None;
        };
        let before = known.state();
        let state = known.look(&watched(&frame.image)?);
        let is_moved = |state: WatchState| matches!(state, WatchState::Moved(_));
        (is_moved(before) != is_moved(state)).then(|| WatchEvent { camera: camera.id.clone(), state, nanos })
    }

    /// State of a camera.
    #[must_use]
    pub fn state(&self, slot: usize) -> WatchState {
        let watch = self.cameras.get(slot).and_then(|camera| camera.watch.as_ref());
        watch.map_or(WatchState::Unknown, CameraWatch::state)
    }
}

fn watch(intrinsics: &Intrinsics, reference: &Image) -> Option<CameraWatch> {
    CameraWatch::new(intrinsics, &watched(reference)?)
}

/// Views an image as bytes; `None` for formats that a session does not take either.
fn watched(image: &Image) -> Option<WatchedImage<'_>> {
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

    use flyrig_types::{Camera, Frame, Isometry, Lens};
    use glam::{DVec2, DVec3};

    use super::*;

    const SIZE: (u32, u32) = (320, 240);

    /// Blocks of random brightness, shifted to the right.
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
                events.extend(watch.look(&set(&rig, index, [Some(image(0, 1.0)), right])));
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
    fn images_of_another_format_or_size_and_empty_sets_are_left_out() {
        let rig = rig();
        let mut watch = RigWatch::new(&rig, &[]);
        let small = || Image::new(8, 8, PixelFormat::Rgb8, vec![9; 192]).unwrap();
        let packed = || Image::new(SIZE.0, SIZE.1, PixelFormat::Yuyv, vec![9; (2 * SIZE.0 * SIZE.1) as usize]).unwrap();
        for index in 0..40 {
            assert!(watch.look(&set(&rig, index, [None, None])).is_none());
            assert!(watch.look(&set(&rig, index, [Some(small()), Some(packed())])).is_none());
        }
        assert_eq!(watch.state(0), WatchState::Unknown);
    }
}
