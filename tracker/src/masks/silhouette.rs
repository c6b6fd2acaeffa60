//! Masks from the network's coarse mask, sharpened on the image and gated by the fitted body.
//!
//! The probability is joined with a colour model of person and surroundings, evidence from the background where it is
//! known, and the distance to the body, then smoothed along the image's edges by a guided filter (He et al. 2010).

use flyrig_types::Mask;
use glam::DVec2;
use rayon::prelude::*;

use crate::image::crop::Crop;
use crate::image::grid::{Grid, clean};
use crate::image::pixels::Rgb;
use crate::masks::gate::BodyGate;
use crate::masks::plate_evidence::NO_EVIDENCE;
use crate::network::output::NET_SIDE;

/// Twice the log-odds of a pixel that surely differs from the plate, and of one that surely matches it.
const DIFFERENT_LOGIT: f32 = 10.0;
const PLATE_LOGIT: f32 = 6.0;
/// Bins per channel of the colour model.
const BINS: usize = 16;

/// Distance from the body at which a mask from the body alone ends, and width of its fade, in the gate's unit.
const CLOTHES: f32 = 0.2;
const FADE: f32 = 0.1;

/// Returns the network's probability of a person in a crop inside the gate's bounds.
pub(crate) fn coarse_mask(mask: &[f32], crop: Crop, gate: &BodyGate) -> Grid {
    let [x0, y0, x1, y1] = gate.bounds;
    let mut coarse = Grid::new(x1 - x0, y1 - y0, 0.0);
    coarse.rows_mut().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let pixel = DVec2::new((x + x0) as f64, (y + y0) as f64);
            *value = net_probability(mask, crop.crop_from_image(pixel));
        }
    });
    coarse
}

/// Returns a probability from the distance to the body alone, for a network that has no mask.
pub(crate) fn body_mask(gate: &BodyGate) -> Grid {
    let mut coarse = gate.distance.clone();
    coarse.values.iter_mut().for_each(|distance| *distance = 1.0 / (1.0 + ((*distance - CLOTHES) / FADE).exp()));
    coarse
}

/// Returns the person's mask at the image's size; `None` when it is empty.
///
/// `coarse` is the network's probability inside the gate's bounds and `crop_scale` the size of one of its pixels in pixels
/// of the image. The colour model consists of histograms of this image's own sure regions. Evidence from the background,
/// inside the gate's bounds, finds thin parts that the coarse mask misses, and the coarse mask finds parts of the
/// background's colour.
pub(crate) fn refine(
    picture: &Rgb,
    coarse: &Grid,
    crop_scale: f64,
    gate: &BodyGate,
    plate_evidence: Option<&Grid>,
) -> Option<Mask> {
    let [x0, y0, x1, y1] = gate.bounds;
    let (width, height) = (x1 - x0, y1 - y0);
    let bin = |x: usize, y: usize| -> usize {
        let [r, g, b] = picture.pixel(x + x0, y + y0).map(|c| usize::from(c) * BINS / 256);
        (r * BINS + g) * BINS + b
    };
    let mut inside = vec![0.05f32; BINS * BINS * BINS];
    let mut outside = inside.clone();
    let (mut inside_total, mut outside_total) = (0.0f32, 0.0f32);
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            let (p, d) = (coarse.values[at], gate.distance.values[at]);
            if p > 0.8 && d < 0.4 {
                inside[bin(x, y)] += 1.0;
                inside_total += 1.0;
            } else if p < 0.2 && d > 0.15 {
                outside[bin(x, y)] += 1.0;
                outside_total += 1.0;
            }
        }
    }
    // Once per bin: pixels outnumber bins.
    let speaks = inside_total > 50.0 && outside_total > 50.0;
    let color_logit = |bin: usize| {
        let (i, o) = (smooth(&inside, bin) / inside_total, smooth(&outside, bin) / outside_total);
        ((i + 1e-5) / (o + 1e-5)).ln().clamp(-2.5, 2.5)
    };
    let color_logits: Vec<f32> = (0..inside.len())
        .into_par_iter()
        .with_min_len(512)
        .map(|bin| if speaks { color_logit(bin) } else { 0.0 })
        .collect();
    let radius = (1.5 * crop_scale).round().clamp(2.0, 12.0) as usize;
    let [left, top, right, bottom] = reached(gate, 2 * radius)?;
    let mut probability = Grid::new(right - left, bottom - top, 0.0);
    probability.rows_mut().for_each(|(y, row)| {
        for (x, probability) in row.iter_mut().enumerate() {
            let (x, y) = (x + left, y + top);
            let at = y * width + x;
            let (p, d) = (coarse.values[at].clamp(0.02, 0.98), gate.distance.values[at]);
            if d >= gate.reach {
                continue;
            }
            let color = color_logits[bin(x, y)];
            let near = 1.0 - 4.0 * d.min(1.0);
            let evidence = plate_evidence.map_or(NO_EVIDENCE, |e| e.values[at]) - NO_EVIDENCE;
            let plate = evidence * if evidence > 0.0 { DIFFERENT_LOGIT } else { PLATE_LOGIT };
            // The plate knows better how the surroundings look at this pixel: shoes of the floor's colour are no floor.
            let color = if evidence == 0.0 { color } else { color.max(0.0) };
            let odds = (0.6 * color + near + plate).exp() * p / (1.0 - p);
            *probability = odds / (1.0 + odds);
        }
    });
    let mut guide = Grid::new(right - left, bottom - top, 0.0);
    guide.rows_mut().for_each(|(y, row)| {
        for (x, guide) in row.iter_mut().enumerate() {
            let [r, g, b] = picture.pixel(x + left + x0, y + top + y0).map(f32::from);
            *guide = (0.3 * r + 0.55 * g + 0.15 * b) / 255.0;
        }
    });
    let mut smoothed = probability.guided(&guide, radius, 1e-3);
    smoothed.rows_mut().for_each(|(y, row)| {
        let distances = &gate.distance.values[(y + top) * width + left..];
        for (value, d) in row.iter_mut().zip(distances) {
            // A soft step around one half keeps about a pixel of slope.
            *value = if *d >= gate.reach { 0.0 } else { ((*value - 0.5) * 3.0 + 0.5).clamp(0.0, 1.0) };
        }
    });
    clean(&mut smoothed, (0.02 * gate.px_per_m).round() as usize);
    smoothed.paste(picture.width, picture.height, x0 + left, y0 + top)
}

/// Returns the part of a gate's bounds that the person may cover, with a margin: left, top, right, bottom (ends excluded);
/// `None` where that is nothing.
fn reached(gate: &BodyGate, margin: usize) -> Option<[usize; 4]> {
    let Grid { width, height, values } = &gate.distance;
    let is_near = |d: &f32| *d < gate.reach;
    let rows = values.chunks_exact((*width).max(1));
    let spans = rows.map(|row| Some((row.iter().position(is_near)?, row.iter().rposition(is_near)?)));
    let spans: Vec<(usize, (usize, usize))> =
        spans.enumerate().filter_map(|(y, span)| span.map(|span| (y, span))).collect();
    let (top, bottom) = (spans.first()?.0, spans.last()?.0);
    let left = spans.iter().map(|(_, (first, _))| *first).min()?;
    let right = spans.iter().map(|(_, (_, last))| *last).max()?;
    let end = |last: usize, side: usize| (last + 1 + margin).min(side);
    Some([left.saturating_sub(margin), top.saturating_sub(margin), end(right, *width), end(bottom, *height)])
}

/// Returns a bin's count and a share of its neighbours' counts.
fn smooth(histogram: &[f32], bin: usize) -> f32 {
    let mut sum = histogram[bin];
    for (step, limit) in [(1, BINS), (BINS, BINS * BINS), (BINS * BINS, BINS * BINS * BINS)] {
        let place = bin % limit / step;
        if place > 0 {
            sum += 0.3 * histogram[bin - step];
        }
        if place + 1 < BINS {
            sum += 0.3 * histogram[bin + step];
        }
    }
    sum
}

/// Samples the network's mask bilinearly at a pixel of the crop; 0 outside.
pub(crate) fn net_probability(mask: &[f32], at: DVec2) -> f32 {
    let limit = NET_SIDE as f64 - 1.0;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x <= limit && at.y <= limit) {
        return 0.0;
    }
    let (x, y) = (at.x as usize, at.y as usize);
    let (x1, y1) = ((x + 1).min(NET_SIDE - 1), (y + 1).min(NET_SIDE - 1));
    let (fx, fy) = ((at.x - x as f64) as f32, (at.y - y as f64) as f32);
    let value = |x: usize, y: usize| mask[y * NET_SIDE + x];
    let top = value(x, y) + (value(x1, y) - value(x, y)) * fx;
    let bottom = value(x, y1) + (value(x1, y1) - value(x, y1)) * fx;
    top + (bottom - top) * fy
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reached_part_is_where_a_plain_search_finds_near_pixels() {
        let mut body = Grid::new(90, 60, 0.0);
        for y in 20..31 {
            body.values[y * 90 + 40..y * 90 + 44].fill(1.0);
        }
        let gate = BodyGate::of_grid(&body, 30.0);
        let near: Vec<[usize; 2]> =
            (0..90 * 60).filter(|&at| gate.distance.values[at] < gate.reach).map(|at| [at % 90, at / 90]).collect();
        let [low, high] = [0, 1]
            .map(|k| (near.iter().map(|at| at[k]).min(), near.iter().map(|at| at[k]).max()))
            .map(|(low, high)| [low.unwrap(), high.unwrap() + 1]);
        assert!(near.len() < 90 * 60 && low[0] > 3 && high[0] > 3, "the margin fits on every side");
        assert_eq!(reached(&gate, 0), Some([low[0], high[0], low[1], high[1]]));
        assert_eq!(reached(&gate, 3), Some([low[0] - 3, high[0] - 3, low[1] + 3, high[1] + 3]));
        assert_eq!(reached(&gate, 1000), Some([0, 0, 90, 60]), "no farther than the gate");
        let nothing = BodyGate::of_grid(&Grid::new(90, 60, 0.0), 30.0);
        assert_eq!(reached(&nothing, 3), None);
    }
}
