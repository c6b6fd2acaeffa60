//! Classification of an image's pixels by how likely they show a person: the background is learnt elsewhere only.

use flyrig_types::Mask;

use crate::image::grid::Grid;
use crate::image::pixels::Rgb;
use crate::masks::gate::BodyGate;

/// Distance from body and mask, in the gate's unit, beyond which a pixel in a person's reach is likely to show background.
const CLEAR: f32 = 0.4;

/// Region of an image that one person may cover.
#[derive(Debug, Clone)]
pub struct PersonArea<'a> {
    /// Reach of the posed body.
    pub gate: BodyGate,
    /// Mask of the person; without one no pixel in the body's reach is learnt.
    pub mask: Option<&'a Mask>,
}

/// Possible content of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shows {
    /// Out of every person's reach.
    Background,
    /// In a person's reach, but away from body and mask.
    LikelyBackground,
    /// On a person, or close by.
    Person,
}

/// Classifies every pixel of an image, row by row. With `separates_near`, pixels in a person's reach but away from body and
/// mask count as [`Shows::LikelyBackground`]; without, as [`Shows::Person`].
pub(crate) fn classify(picture: &Rgb, people: &[PersonArea<'_>], separates_near: bool) -> Vec<Shows> {
    let mut shows = vec![Shows::Background; picture.width * picture.height];
    for PersonArea { gate, mask } in people {
        let [x0, y0, x1, y1] = gate.bounds;
        let own_size =
            |mask: &&Mask| (mask.width() as usize, mask.height() as usize) == (picture.width, picture.height);
        let mask = mask.filter(own_size).filter(|_| separates_near);
        let clear_px = CLEAR * gate.unit_px() as f32;
        let from_mask = mask.map(|mask| {
            let mut covered = Grid::new(x1 - x0, y1 - y0, 0.0);
            for (row, y) in covered.values.chunks_exact_mut((x1 - x0).max(1)).zip(y0..y1) {
                let coverage = &mask.coverage()[y * picture.width + x0..y * picture.width + x1];
                row.iter_mut().zip(coverage).for_each(|(covered, coverage)| *covered = f32::from(*coverage > 25));
            }
            covered.distance_to_set()
        });
        for y in y0..y1.min(picture.height) {
            for x in x0..x1.min(picture.width) {
                if !gate.reaches(x, y) {
                    continue;
                }
                let at = (y - y0) * gate.distance.width + x - x0;
                let is_clear = gate.distance.values[at] > CLEAR
                    && from_mask.as_ref().is_some_and(|distance| distance.values[at] > clear_px);
                let shown = &mut shows[y * picture.width + x];
                *shown = match (is_clear, *shown) {
                    (true, Shows::Background) => Shows::LikelyBackground,
                    (true, before) => before,
                    (false, _) => Shows::Person,
                };
            }
        }
    }
    shows
}
