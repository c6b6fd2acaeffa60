//! The background of one camera: a plate that follows the room, or a screen of one colour.
//!
//! A plate ([`Plate`](crate::masks::plate::Plate)) is an image of the empty scene, recorded beforehand or learnt where no
//! person stands. A [`KeyColor`] is known from the start. Either gives evidence for a foreground in the exposure of one
//! image ([`BackgroundLight`]). The owner ingests every fourth frame set, and every one while the background is being
//! learnt.

use std::sync::Arc;

use flyrig_types::{Camera, Image, Mask};

use crate::error::{TrackError, TrackErrorKind};
use crate::image::pixels::Rgb;
use crate::masks::background_event::BackgroundEvent;
use crate::masks::background_light::{BackgroundLight, Exposure};
use crate::masks::gate::BodyGate;
use crate::masks::gated_mask::gated_mask;
use crate::masks::key_color::KeyColor;
use crate::masks::person_area::PersonArea;
use crate::masks::plate::Plate;
use crate::masks::seen_background::SeenBackground;

/// Background of one camera, as far as it is known.
///
/// A plate alone, without the pose network, masks a person whose body is known roughly:
///
/// ```
/// use flyrig_body::{ShapeParams, default_template, skin_mesh};
/// use flyrig_tracker::{Background, BodyGate};
/// use flyrig_types::{Camera, Image, Intrinsics, Isometry, Lens, PixelFormat};
/// use glam::{DVec2, DVec3};
///
/// let camera = Camera {
///     time_offset_nanos: 0,
///     color: Default::default(),
///     id: "front".into(),
///     intrinsics: Intrinsics {
///         width: 160,
///         height: 160,
///         focal_px: DVec2::splat(180.0),
///         center_px: DVec2::splat(79.5),
///         lens: Lens::PINHOLE,
///     },
///     camera_from_world: Isometry::look_at(DVec3::new(0.0, 1.0, 3.0), DVec3::new(0.0, 0.9, 0.0), DVec3::Y),
/// };
/// let body = default_template(&ShapeParams::default())?;
/// let (vertices, _) = skin_mesh(&body, &body.skeleton.rest_pose());
/// let gate = BodyGate::new(&camera, &vertices, &body.triangles).ok_or("the body is out of view")?;
///
/// let wall = |x: usize, y: usize| [120 + (x / 4) as u8, 130 + (y / 5) as u8, 110];
/// let shirt = |x: usize, y: usize| if (70..90).contains(&x) && (50..110).contains(&y) { [30, 40, 160] } else { wall(x, y) };
/// let image = |paint: &dyn Fn(usize, usize) -> [u8; 3]| {
///     let bytes: Vec<u8> = (0..160 * 160).flat_map(|at| paint(at % 160, at / 160)).collect();
///     Image::new(160, 160, PixelFormat::Rgb8, bytes)
/// };
/// let background = Background::from_plate(&camera, &image(&wall)?)?;
/// let mask = background.mask(&image(&shirt)?, &gate)?.ok_or("nothing stands out")?;
/// assert!(mask.coverage()[80 * 160 + 80] > 200, "the shirt is covered");
/// assert_eq!(mask.coverage()[20 * 160 + 10], 0, "the wall is not");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct Background {
    width: usize,
    height: usize,
    kind: Kind,
}

/// Source of a background.
#[derive(Debug, Clone)]
enum Kind {
    Plate(Plate),
    Key(KeyColor),
}

impl Background {
    /// Starts from an image of the empty scene.
    ///
    /// # Errors
    /// Kind `Image` names the camera when the size is not that of its calibration or the format cannot be read.
    pub fn from_plate(camera: &Camera, plate: &Image) -> Result<Self, TrackError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if (plate.width(), plate.height()) != (width, height) {
            return Err(TrackError::new(
                TrackErrorKind::Image,
                format!(
                    "camera {}: the plate is {}x{} pixels but the camera's calibration is for {width}x{height}; record the \
                     plate again with the camera's own settings (`flyrig plate`), or remove it",
                    camera.id,
                    plate.width(),
                    plate.height()
                ),
            ));
        }
        let picture = Rgb::new(plate)?;
        let kind = Kind::Plate(Plate::recorded(&picture));
        Ok(Self { width: picture.width, height: picture.height, kind })
    }

    /// Starts without any knowledge of the scene: [`Self::update`] learns it where no person stands.
    #[must_use]
    pub fn unknown(camera: &Camera) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        Self { width, height, kind: Kind::Plate(Plate::unknown(width, height)) }
    }

    /// Starts from a screen of one colour behind the people.
    #[must_use]
    pub fn from_key(camera: &Camera, key: KeyColor) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        Self { width, height, kind: Kind::Key(key) }
    }

    /// Whether much remains to be learnt, so that the next image is worth an update.
    #[must_use]
    pub fn is_learning(&self) -> bool {
        matches!(&self.kind, Kind::Plate(plate) if plate.is_learning())
    }

    /// Returns the background after the camera was moved: from `plate`, the empty scene as the camera sees it now, else an
    /// unknown one. A screen of one colour stays one.
    ///
    /// # Errors
    /// Those of [`Self::from_plate`].
    pub fn after_move(&self, camera: &Camera, plate: Option<&Image>) -> Result<Self, TrackError> {
        match (&self.kind, plate) {
            (Kind::Key(_), _) => Ok(self.clone()),
            (Kind::Plate(_), Some(plate)) => Self::from_plate(camera, plate),
            (Kind::Plate(_), None) => Ok(Self::unknown(camera)),
        }
    }

    /// Returns the person's mask from this background and the posed body alone; `None` when nothing stands out near the
    /// body or the image has another size.
    ///
    /// # Errors
    /// Kind `Image` when the format cannot be read.
    pub fn mask(&self, image: &Image, gate: &BodyGate) -> Result<Option<Mask>, TrackError> {
        let picture = Rgb::new(image)?;
        let seen = self.seen(&picture, gate);
        Ok(seen.as_ref().and_then(SeenBackground::evidence).and_then(|evidence| gated_mask(evidence, gate)))
    }

    /// Ingests an image that shows no person but `people`: the background follows slow changes of the light and is relearnt
    /// after sudden ones. Returns the changes that the user has to know of, each once.
    ///
    /// # Errors
    /// Kind `Image` when the format cannot be read. Images of another size change nothing.
    pub fn update(&mut self, image: &Image, people: &[PersonArea<'_>]) -> Result<Vec<BackgroundEvent>, TrackError> {
        let picture = Rgb::new(image)?;
        match &mut self.kind {
            Kind::Plate(plate) if self.width == picture.width && self.height == picture.height => {
                Ok(plate.update(&picture, people))
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Returns the background in the exposure of an image, which is measured at pixels where `is_background`; `None` for an
    /// image of another size or without the screen.
    pub(crate) fn light<'a>(
        &'a self,
        picture: &Rgb,
        is_background: &dyn Fn(usize) -> bool,
    ) -> Option<BackgroundLight<'a>> {
        if (picture.width, picture.height) != (self.width, self.height) {
            return None;
        }
        match &self.kind {
            Kind::Key(key) => key.screen(picture).map(|screen| BackgroundLight::Screen(key, Arc::new(screen))),
            Kind::Plate(plate) => Some(BackgroundLight::Plate(plate, plate.drift(picture, is_background))),
        }
    }

    /// Measures the background around a posed body; `None` for an image of another size or without the screen.
    pub(crate) fn seen(&self, picture: &Rgb, gate: &BodyGate) -> Option<SeenBackground> {
        let light = self.light(picture, &|at| !gate.reaches_pixel(at))?;
        Some(SeenBackground::new(&light, picture, gate))
    }

    /// Returns the share of `bounds` where the background is known, 0..=1.
    pub(crate) fn known_share(&self, width: usize, [x0, y0, x1, y1]: [usize; 4]) -> f64 {
        let Kind::Plate(plate) = &self.kind else { return 1.0 };
        let known = (y0..y1).map(|y| (x0..x1).filter(|x| plate.knows(y * width + x)).count()).sum::<usize>();
        known as f64 / ((x1 - x0) * (y1 - y0)).max(1) as f64
    }

    /// Returns the background in an exposure that was measured before; `None` for an image of another size, or an exposure of
    /// another kind of background or size of image.
    pub(crate) fn light_again(&self, picture: &Rgb, seen: &SeenBackground) -> Option<BackgroundLight<'_>> {
        if (picture.width, picture.height) != (self.width, self.height) {
            return None;
        }
        match (&self.kind, seen.exposure_for(picture)?) {
            (Kind::Plate(plate), Exposure::Plate(drift)) => Some(BackgroundLight::Plate(plate, *drift)),
            (Kind::Key(key), Exposure::Screen(screen)) => Some(BackgroundLight::Screen(key, Arc::clone(screen))),
            (Kind::Plate(_), Exposure::Screen(_)) | (Kind::Key(_), Exposure::Plate(_)) => None,
        }
    }
}

#[cfg(test)]
#[path = "background_tests.rs"]
mod tests;
