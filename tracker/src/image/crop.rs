//! Rotated square crops of an image, the input of landmark networks.

use flyrig_types::Camera;
use glam::{DVec2, DVec3};

use crate::image::pixels::Rgb;
use crate::landmarks::keypoints::{
    Keypoint, LANDMARK_COUNT, LEFT_HIP, LEFT_SHOULDER, RIGHT_HIP, RIGHT_SHOULDER, Sharpness, ViewKeypoints,
};
use crate::network::output::{NET_SIDE, NetOutput};

/// Half side of a crop over the distance of the farthest landmark: the network was trained with a quarter more than the
/// person.
const MARGIN: f64 = 1.25;
/// Sine of the angle between view and vertical below which a camera looks from above or below.
const FROM_ABOVE: f64 = 0.3;

/// Square of an image, rotated so that the person stands upright in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crop {
    /// Centre, pixels of the image.
    pub center: DVec2,
    /// Side, pixels of the image.
    pub side: f64,
    /// Direction of the crop's x axis in the image, a unit vector.
    pub turn: DVec2,
}

impl Crop {
    /// Returns an upright square.
    #[cfg(test)]
    pub fn upright(center: DVec2, side: f64) -> Self {
        Self { center, side, turn: DVec2::X }
    }

    /// Returns the crop for a person's landmarks in image pixels: centred on the hips, shoulders above the hips, reaching a
    /// quarter farther than the farthest landmark. `None` when the points do not span a person.
    pub fn around(points: &[Option<DVec2>; LANDMARK_COUNT]) -> Option<Self> {
        let middle = |a: usize, b: usize| Some((points[a]? + points[b]?) * 0.5);
        let hips = middle(LEFT_HIP, RIGHT_HIP)?;
        let shoulders = middle(LEFT_SHOULDER, RIGHT_SHOULDER)?;
        let up = shoulders - hips;
        let reach = points.iter().flatten().map(|p| (*p - hips).length()).fold(0.0, f64::max);
        if !(reach.is_finite() && (8.0..1e5).contains(&reach)) {
            return None;
        }
        // Seen from above or below the trunk has no direction in the image.
        let turn = if up.length() < 0.08 * reach { DVec2::X } else { up.perp().normalize() };
        Some(Self { center: hips, side: 2.0 * MARGIN * reach, turn })
    }

    /// Returns the size of a pixel of a crop of [`NET_SIDE`], pixels of the image.
    pub fn scale(&self) -> f64 {
        self.side / NET_SIDE as f64
    }

    /// Returns the image pixel of a pixel of a crop of [`NET_SIDE`] (pixel centres at integers in both).
    pub fn to_image(self, crop_px: DVec2) -> DVec2 {
        self.to_image_from(crop_px, NET_SIDE)
    }

    /// Returns the image pixel of a pixel of a crop of `net_side` pixels (pixel centres at integers in both).
    pub fn to_image_from(self, crop_px: DVec2, net_side: usize) -> DVec2 {
        let offset = (crop_px + 0.5 - 0.5 * net_side as f64) * (self.side / net_side as f64);
        self.center + self.turn.rotate(offset)
    }

    /// Returns the pixel of a crop of [`NET_SIDE`] that an image pixel falls on.
    pub fn crop_from_image(self, image_px: DVec2) -> DVec2 {
        let offset = (self.turn * DVec2::new(1.0, -1.0)).rotate(image_px - self.center);
        offset / self.scale() + 0.5 * NET_SIDE as f64 - 0.5
    }

    /// Samples a crop of [`NET_SIDE`]; see [`Self::sample_square`].
    pub fn sample(&self, picture: &Rgb) -> Vec<f32> {
        self.sample_square(picture, NET_SIDE)
    }

    /// Samples a crop of `net_side` x `net_side` pixels: RGB in 0..=1, row by row, black outside the image. Each value
    /// averages enough samples that a large crop does not alias.
    pub fn sample_square(&self, picture: &Rgb, net_side: usize) -> Vec<f32> {
        flyrig_types::vectorized(Sampling { crop: *self, picture, net_side })
    }

    /// Returns the network's landmarks in pixels of the image.
    pub fn keypoints(&self, output: &NetOutput) -> ViewKeypoints {
        std::array::from_fn(|i| {
            let landmark = output.landmarks[i];
            let sharpness = match landmark.sharpness {
                Sharpness::Peak { spread_cells, along, aspect } => {
                    Sharpness::Peak { spread_cells, along: self.turn.rotate(along), aspect }
                }
                other @ (Sharpness::Unknown | Sharpness::NoPeak) => other,
            };
            let pixel = self.to_image(DVec2::new(landmark.x, landmark.y));
            Keypoint { pixel, confidence: landmark.confidence, sharpness }
        })
    }
}

/// Samples of a crop, compiled for the processor's vector instructions.
struct Sampling<'a> {
    crop: Crop,
    picture: &'a Rgb<'a>,
    net_side: usize,
}

impl pulp::NullaryFnOnce for Sampling<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn call(self) -> Vec<f32> {
        let Self { crop, picture, net_side } = self;
        let taps = ((crop.side / net_side as f64).round() as usize).clamp(1, 4);
        let mut rgb = Vec::with_capacity(net_side * net_side * 3);
        let weight = 1.0 / (255.0 * (taps * taps) as f32);
        let place = |crop_px: DVec2| crop.to_image_from(crop_px, net_side);
        let origin = place(DVec2::ZERO);
        let (right, down) = (place(DVec2::X) - origin, place(DVec2::Y) - origin);
        let tap = |t: usize| (t as f64 + 0.5) / taps as f64 - 0.5;
        for y in 0..net_side {
            for x in 0..net_side {
                let mut sum = [0.0f32; 3];
                for ty in 0..taps {
                    let row = origin + down * (y as f64 + tap(ty));
                    for tx in 0..taps {
                        let color = picture.bilinear(row + right * (x as f64 + tap(tx)));
                        for (s, c) in sum.iter_mut().zip(color) {
                            *s += c;
                        }
                    }
                }
                rgb.extend(sum.map(|s| s * weight));
            }
        }
        rgb
    }
}

/// Returns the direction of an upright crop's x axis in a camera's image, to a quarter turn: [`DVec2::X`] unless the camera
/// hangs on its side or upside down. `up` is the world's up direction.
pub(crate) fn quarter_turn(camera: &Camera, up: DVec3) -> DVec2 {
    let up = (camera.camera_from_world.rotation * up).truncate();
    // Seen from above or below nobody stands upright in the image.
    if !up.is_finite() || up.length() < FROM_ABOVE {
        return DVec2::X;
    }
    let turn = up.perp();
    if turn.x.abs() >= turn.y.abs() { DVec2::new(turn.x.signum(), 0.0) } else { DVec2::new(0.0, turn.y.signum()) }
}

/// Returns squares of three sizes that cover an image, the whole image first, in the turn of a person who stands upright; then
/// those of the image's own upright direction where it is another, for rigs whose up direction is wrong.
pub(crate) fn search_crops(width: u32, height: u32, turn: DVec2) -> Vec<Crop> {
    let mut crops = covering_crops(width, height, turn);
    if turn != DVec2::X {
        crops.extend(covering_crops(width, height, DVec2::X));
    }
    crops
}

fn covering_crops(width: u32, height: u32, turn: DVec2) -> Vec<Crop> {
    let (width, height) = (f64::from(width), f64::from(height));
    let long = width.max(height);
    let mut crops = Vec::new();
    for fraction in [1.0, 0.66, 0.45] {
        let side = long * fraction;
        let centers = |length: f64| -> Vec<f64> {
            if length <= side * 1.1 {
                return vec![0.5 * length];
            }
            let count = ((length - side) / (0.5 * side)).ceil() as usize + 1;
            (0..count).map(|i| 0.5 * side + (length - side) * i as f64 / (count - 1).max(1) as f64).collect()
        };
        for y in centers(height) {
            for x in centers(width) {
                crops.push(Crop { center: DVec2::new(x, y), side, turn });
            }
        }
    }
    crops
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};
    use glam::DQuat;

    use super::*;

    #[test]
    fn a_turned_crop_puts_the_shoulders_above_the_hips_and_maps_both_ways() {
        let mut points = [None; LANDMARK_COUNT];
        points[LEFT_HIP] = Some(DVec2::new(100.0, 100.0));
        points[RIGHT_HIP] = Some(DVec2::new(100.0, 120.0));
        points[LEFT_SHOULDER] = Some(DVec2::new(160.0, 100.0));
        points[RIGHT_SHOULDER] = Some(DVec2::new(160.0, 120.0));
        let crop = Crop::around(&points).unwrap();
        let at = |i: usize| crop.crop_from_image(points[i].unwrap());
        assert!(at(LEFT_SHOULDER).y < at(LEFT_HIP).y - 40.0);
        assert!((at(LEFT_SHOULDER).x - at(LEFT_HIP).x).abs() < 1e-9);
        let there = DVec2::new(31.0, 77.0);
        assert!((crop.crop_from_image(crop.to_image(there)) - there).length() < 1e-9);
        assert!((crop.to_image(DVec2::splat(127.5)) - crop.center).length() < 1e-9);
    }

    #[test]
    fn a_camera_on_its_side_is_searched_on_its_side_and_upright() {
        let upright = Isometry::look_at(DVec3::new(3.0, 0.0, 1.0), DVec3::Z, DVec3::Z);
        let camera = |roll_deg: f64| Camera {
            id: "a".into(),
            intrinsics: Intrinsics::pinhole(640, 480, 500.0),
            camera_from_world: Isometry {
                rotation: DQuat::from_rotation_z(roll_deg.to_radians()) * upright.rotation,
                ..upright
            },
            time_offset_nanos: 0,
            color: Default::default(),
        };
        for (roll_deg, turn) in [(5.0, DVec2::X), (90.0, DVec2::Y), (-95.0, DVec2::NEG_Y), (178.0, DVec2::NEG_X)] {
            assert_eq!(quarter_turn(&camera(roll_deg), DVec3::Z), turn, "{roll_deg}");
        }
        assert_eq!(quarter_turn(&camera(0.0), DVec3::X), DVec2::X, "from above");
        assert_eq!(quarter_turn(&camera(0.0), DVec3::NAN), DVec2::X);
        let (turned, upright) = (search_crops(64, 48, DVec2::Y), search_crops(64, 48, DVec2::X));
        assert_eq!(turned[upright.len()..], upright);
        // A person who is upright in the world is upright in the crop: feet, which lie at the image's left, are below.
        let side = turned[0].crop_from_image(DVec2::new(0.0, 24.0));
        let middle = turned[0].crop_from_image(DVec2::new(32.0, 24.0));
        let (up, below) = (camera(90.0).camera_from_world.rotation * DVec3::Z, side.y > middle.y);
        assert_eq!(below, up.x > 0.0, "{side} {up}");
    }

    #[test]
    fn points_that_span_nobody_have_no_crop() {
        assert_eq!(Crop::around(&[None; LANDMARK_COUNT]), None);
        assert_eq!(Crop::around(&[Some(DVec2::ONE); LANDMARK_COUNT]), None);
        assert_eq!(Crop::around(&[Some(DVec2::NAN); LANDMARK_COUNT]), None);
    }

    #[test]
    fn search_covers_every_image_shape() {
        for (width, height) in [(1, 1), (540, 960), (4000, 300)] {
            let crops = search_crops(width, height, DVec2::X);
            assert!((3..200).contains(&crops.len()));
            for corner in [DVec2::ZERO, DVec2::new(f64::from(width), f64::from(height))] {
                for size in [1.0, 0.66, 0.45] {
                    let side = f64::from(width.max(height)) * size;
                    let covered = crops.iter().filter(|c| (c.side - side).abs() < 1e-9);
                    assert!(
                        covered.clone().any(|c| (corner - c.center).abs().max_element() <= 0.56 * side),
                        "{width}x{height} {side} {corner}"
                    );
                }
            }
        }
    }

    #[test]
    fn samples_are_those_of_the_definition_and_poisoned_crops_are_black() {
        let (width, height) = (37usize, 29usize);
        let bytes: Vec<u8> = (0..width * height * 3).map(|i| ((i * 7919) % 251) as u8).collect();
        let picture = Rgb { width, height, bytes: bytes.clone().into() };
        let at = |x: i64, y: i64, k: usize| match (0..width as i64).contains(&x) && (0..height as i64).contains(&y) {
            true => f64::from(bytes[(y as usize * width + x as usize) * 3 + k]),
            false => 0.0,
        };
        let bilinear = |p: DVec2, k: usize| {
            let (x, y, f) = (p.x.floor() as i64, p.y.floor() as i64, p - p.floor());
            let row = |y: i64| at(x, y, k) * (1.0 - f.x) + at(x + 1, y, k) * f.x;
            row(y) * (1.0 - f.y) + row(y + 1) * f.y
        };
        for (side, taps) in [(9.0, 1), (14.0, 1), (31.0, 2), (44.0, 3), (90.0, 4)] {
            let turn = DVec2::from_angle(0.3 * side);
            let crop = Crop { center: DVec2::new(17.3, 15.9), side, turn };
            let samples = crop.sample_square(&picture, 16);
            for (i, found) in samples.iter().enumerate() {
                let (x, y, k) = (i / 3 % 16, i / 48, i % 3);
                let tap = |t: usize| (t as f64 + 0.5) / taps as f64 - 0.5;
                let places = (0..taps * taps).map(|t| {
                    let pixel = DVec2::new(x as f64 + tap(t % taps), y as f64 + tap(t / taps));
                    crop.to_image_from(pixel, 16)
                });
                let expected = places.map(|p| bilinear(p, k)).sum::<f64>() / (255 * taps * taps) as f64;
                assert!((f64::from(*found) - expected).abs() < 1e-5, "{side} {i}: {found} {expected}");
            }
        }
        for poison in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let crop = Crop { center: DVec2::new(poison, 15.0), side: 16.0, turn: DVec2::X };
            assert!(crop.sample_square(&picture, 16).iter().all(|value| *value == 0.0));
        }
        let empty = Rgb { width: 0, height: 0, bytes: Vec::new().into() };
        assert!(Crop::upright(DVec2::ZERO, 8.0).sample_square(&empty, 16).iter().all(|value| *value == 0.0));
    }

    #[test]
    fn a_crop_of_one_colour_is_that_colour_inside_and_black_outside() {
        let picture = Rgb { width: 20, height: 20, bytes: vec![255; 20 * 20 * 3].into() };
        let samples = Crop::upright(DVec2::new(0.0, 9.5), 20.0).sample(&picture);
        let pixel = |x: usize, y: usize| samples[(y * NET_SIDE + x) * 3];
        assert!((pixel(200, 128) - 1.0).abs() < 1e-6);
        assert!(pixel(20, 128).abs() < 1e-6);
    }
}
