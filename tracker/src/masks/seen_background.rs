//! Background as the mask estimation measured it in one image; the matte of the same image uses it again.

use crate::image::grid::Grid;
use crate::image::pixels::Rgb;
use crate::masks::background_light::{BackgroundLight, Exposure};
use crate::masks::gate::BodyGate;

/// Background of one camera as one image shows it around a person.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenBackground {
    exposure: Exposure,
    /// Width and height of the image.
    image: [usize; 2],
    /// Part of the image that `evidence` covers: x0, y0, x1, y1 (ends excluded).
    bounds: [usize; 4],
    evidence: Option<Grid>,
}

impl SeenBackground {
    /// Measures the evidence around a posed body.
    pub(crate) fn new(light: &BackgroundLight<'_>, picture: &Rgb, gate: &BodyGate) -> Self {
        let evidence = light.evidence(picture, gate.bounds);
        let image = [picture.width, picture.height];
        Self { exposure: light.exposure(), image, bounds: gate.bounds, evidence }
    }

    /// Returns the exposure that an image of the size of `picture` showed.
    pub(crate) fn exposure_for(&self, picture: &Rgb) -> Option<&Exposure> {
        (self.image == [picture.width, picture.height]).then_some(&self.exposure)
    }

    /// Returns evidence for a foreground inside the bounds of the gate, 0..=1 with the border at one half; `None` while no
    /// pixel of the background is known there.
    pub(crate) fn evidence(&self) -> Option<&Grid> {
        self.evidence.as_ref()
    }

    /// Returns the evidence inside `bounds` (x0, y0, x1, y1, ends excluded): a part of what was measured, or all of it measured
    /// anew where `bounds` exceed the gate's.
    pub(crate) fn evidence_in(&self, light: &BackgroundLight<'_>, picture: &Rgb, bounds: [usize; 4]) -> Option<Grid> {
        let ([x0, y0, x1, y1], [left, top, right, bottom]) = (bounds, self.bounds);
        if x0 < left || y0 < top || x1 > right || y1 > bottom {
            return light.evidence(picture, bounds);
        }
        let evidence = self.evidence.as_ref()?;
        let row = |y: usize| &evidence.values[(y - top) * evidence.width..][x0 - left..x1 - left];
        Some(Grid { width: x1 - x0, height: y1 - y0, values: (y0..y1).flat_map(row).copied().collect() })
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Image, PixelFormat};

    use super::*;
    use crate::masks::background::Background;
    use crate::testing::small_camera;

    const SIDE: usize = 64;

    fn image(side: usize, paint: impl Fn(usize, usize) -> u8) -> Image {
        let bytes: Vec<u8> = (0..side * side).flat_map(|at| [paint(at % side, at / side); 3]).collect();
        Image::new(side as u32, side as u32, PixelFormat::Rgb8, bytes).unwrap()
    }

    fn gate() -> BodyGate {
        let mut body = Grid::new(SIDE, SIDE, 0.0);
        (20..44).for_each(|y| body.values[y * SIDE + 28..y * SIDE + 36].fill(1.0));
        BodyGate { bounds: [8, 10, 56, 60], ..BodyGate::of_grid(&body, 40.0) }
    }

    #[test]
    fn a_part_of_the_measured_evidence_is_what_is_measured_there() {
        let wall = |x: usize, y: usize| (60 + 2 * x + y) as u8;
        let person = |x: usize, y: usize| if (28..36).contains(&x) && (20..44).contains(&y) { 20 } else { wall(x, y) };
        let (plate, now) = (image(SIDE, wall), image(SIDE, person));
        let background = Background::from_plate(&small_camera("left", SIDE), &plate).unwrap();
        let picture = Rgb::new(&now).unwrap();
        let seen = background.seen(&picture, &gate()).unwrap();
        let light = background.light_again(&picture, &seen).unwrap();
        let whole = seen.evidence().unwrap();
        assert_eq!((whole.width, whole.height), (48, 50));
        for bounds in [[8, 10, 56, 60], [20, 30, 41, 33]] {
            let part = seen.evidence_in(&light, &picture, bounds).unwrap();
            let [x0, y0, x1, y1] = bounds;
            let plain: Vec<f32> = (y0..y1)
                .flat_map(|y| (x0..x1).map(move |x| (x, y)))
                .map(|(x, y)| whole.values[(y - 10) * 48 + x - 8])
                .collect();
            assert_eq!((part.width, part.height, part.values), (x1 - x0, y1 - y0, plain));
        }
        // One column left of what was measured.
        let bounds = [7, 10, 56, 60];
        assert_eq!(seen.evidence_in(&light, &picture, bounds), light.evidence(&picture, bounds));
    }

    #[test]
    fn what_was_measured_in_an_image_of_another_size_is_not_used() {
        let now = image(SIDE, |x, y| (x + y) as u8);
        let background = Background::from_plate(&small_camera("left", SIDE), &now).unwrap();
        let seen = background.seen(&Rgb::new(&now).unwrap(), &gate()).unwrap();
        let other = image(SIDE / 2, |x, y| (x + y) as u8);
        let small = Background::from_plate(&small_camera("left", SIDE / 2), &other).unwrap();
        assert!(small.light_again(&Rgb::new(&other).unwrap(), &seen).is_none());
        assert!(background.light_again(&Rgb::new(&now).unwrap(), &seen).is_some());
    }
}
