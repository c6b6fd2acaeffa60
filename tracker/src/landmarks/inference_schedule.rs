//! Looks of the network at each view, and when the next one is due.
//!
//! A look stays good while the body hardly moves: its landmarks and its mask are carried along with the body. The network is
//! the dearest part of an estimate, so a view gets a new look only once the body has moved in it.

use std::sync::Arc;

use flyrig_types::Camera;
use glam::{DVec2, DVec3, Vec3};

use crate::LANDMARK_COUNT;
use crate::body_model::Turns;
use crate::crop::Crop;
use crate::grid::Grid;
use crate::sighting::Sighting;
use crate::silhouette::net_probability;

/// A look grows old by this much a second, metres, so that a person who is gone is noticed.
const AGING_M_PER_SEC: f64 = 0.1;
/// All views that need a look by more than this factor get it at once, the others in turn.
const URGENT: f64 = 3.0;
/// A landmark that the body has carried this far counts half, metres.
const CARRIED_M: f64 = 0.05;
/// Vertices this much farther from the camera than the nearest one in their cell are hidden, metres.
const HIDDEN_M: f64 = 0.1;

/// The network's view of the person in one camera.
#[derive(Debug, Clone)]
pub(crate) struct Look {
    pub sighting: Arc<Sighting>,
    /// The body as it was estimated then; `None` while it is being estimated.
    pub body: Option<LookBody>,
}

/// The body at the time of a look.
#[derive(Debug, Clone)]
pub(crate) struct LookBody {
    pub nanos: i64,
    pub turns: Arc<Turns>,
    pub marks: [DVec3; LANDMARK_COUNT],
}

impl Look {
    /// A look at the set that is being estimated.
    pub fn fresh(sighting: Sighting) -> Self {
        Self { sighting: Arc::new(sighting), body: None }
    }

    /// How far the body's landmarks have moved since, metres, with the share of age; 0 for a fresh look.
    fn staleness_m(&self, marks: &[DVec3; LANDMARK_COUNT], nanos: i64) -> f64 {
        let Some(body) = &self.body else { return 0.0 };
        let moved = marks.iter().zip(&body.marks).map(|(now, then)| now.distance(*then)).fold(0.0, f64::max);
        moved + AGING_M_PER_SEC * 1e-9 * nanos.saturating_sub(body.nanos).max(0) as f64
    }

    /// Where each landmark was at the look less where it was at the last set, metres, and the factor of its confidence. An old
    /// look says nothing of what has moved since the last set: a predicted motion that counted as seen would feed itself.
    pub fn carried(
        &self,
        last: &[DVec3; LANDMARK_COUNT],
        predicted: &[DVec3; LANDMARK_COUNT],
    ) -> [(DVec3, f64); LANDMARK_COUNT] {
        let Some(body) = &self.body else { return [(DVec3::ZERO, 1.0); LANDMARK_COUNT] };
        std::array::from_fn(|i| {
            let moved = body.marks[i].distance(predicted[i]);
            (body.marks[i] - last[i], 1.0 / (1.0 + (moved / CARRIED_M).powi(2)))
        })
    }
}

/// Chooses the views that the network looks at again: all that have no look, all in which the body has moved far, and of
/// those in which it has moved by more than `limit_m` the one that waits most. Views without an image get none. Of those
/// that have a look no more than `most` are chosen.
pub(crate) fn due(
    looks: &[Option<Look>],
    has_image: impl Fn(usize) -> bool,
    marks: &[DVec3; LANDMARK_COUNT],
    nanos: i64,
    limit_m: f64,
    most: usize,
) -> Vec<bool> {
    let staleness: Vec<f64> = looks
        .iter()
        .enumerate()
        .map(|(slot, look)| match look {
            _ if !has_image(slot) => f64::NEG_INFINITY,
            None => f64::INFINITY,
            Some(look) => look.staleness_m(marks, nanos),
        })
        .collect();
    let stalest = staleness.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut due: Vec<bool> = staleness.iter().map(|&s| s > URGENT * limit_m || (s > limit_m && s >= stalest)).collect();
    let mut order: Vec<usize> = (0..due.len()).filter(|&slot| due[slot] && looks[slot].is_some()).collect();
    order.sort_by(|&a, &b| staleness[b].total_cmp(&staleness[a]));
    order.into_iter().skip(most).for_each(|slot| due[slot] = false);
    due
}

/// Corners of a body in an image: pixel and depth in metres.
pub(crate) type Corners = Vec<Option<(DVec2, f64)>>;

/// Projects the vertices of a body.
pub(crate) fn corners(camera: &Camera, vertices: &[Vec3]) -> Corners {
    let corner = |vertex: &Vec3| {
        let point = vertex.as_dvec3();
        Some((camera.project(point)?, camera.camera_from_world.transform_point(point).z))
    };
    vertices.iter().map(corner).collect()
}

/// The network's mask inside of `bounds` (x0, y0, x1, y1, ends excluded), carried from the body `then` to the body `now`.
pub(crate) fn carried_mask(mask: &[f32], crop: Crop, then: &Corners, now: &Corners, bounds: [usize; 4]) -> Grid {
    let [x0, y0, x1, y1] = bounds;
    let cell = (2.0 * crop.scale()).max(2.0);
    let (columns, rows) = (((x1 - x0) as f64 / cell) as usize + 1, ((y1 - y0) as f64 / cell) as usize + 1);
    let origin = DVec2::new(x0 as f64, y0 as f64);
    let cell_of = |pixel: DVec2| -> Option<usize> {
        let at = (pixel - origin) / cell;
        (at.x >= 0.0 && at.y >= 0.0 && at.x < columns as f64 && at.y < rows as f64)
            .then(|| at.y as usize * columns + at.x as usize)
    };
    let mut nearest = vec![f64::INFINITY; columns * rows];
    for (pixel, depth) in now.iter().flatten() {
        if let Some(at) = cell_of(*pixel) {
            nearest[at] = nearest[at].min(*depth);
        }
    }
    // Mean motion of the vertices that are seen in a cell; cells around the body take their neighbours'.
    let (mut motion, mut count) = (vec![DVec2::ZERO; columns * rows], vec![0.0; columns * rows]);
    for (now, then) in now.iter().zip(then) {
        let (Some((pixel, depth)), Some((before, _))) = (now, then) else { continue };
        let Some(at) = cell_of(*pixel).filter(|&at| *depth < nearest[at] + HIDDEN_M) else { continue };
        motion[at] += *pixel - *before;
        count[at] += 1.0;
    }
    spread(&mut motion, &mut count, columns, rows);
    let mut coarse = Grid::new(x1 - x0, y1 - y0, 0.0);
    for y in y0..y1 {
        for x in x0..x1 {
            let pixel = DVec2::new(x as f64, y as f64);
            let Some(at) = cell_of(pixel) else { continue };
            let before = pixel - motion[at] / f64::max(count[at], 1e-9);
            let value = net_probability(mask, crop.crop_from_image(before));
            coarse.values[(y - y0) * (x1 - x0) + x - x0] = value;
        }
    }
    coarse
}

/// Fills cells without a count from their neighbours, layer by layer.
fn spread(motion: &mut [DVec2], count: &mut [f64], columns: usize, rows: usize) {
    let mut edge: Vec<usize> = (0..count.len()).filter(|&at| count[at] > 0.0).collect();
    while !edge.is_empty() {
        let mut found: Vec<(usize, DVec2, f64)> = Vec::new();
        let mut at_found = std::collections::HashMap::new();
        for &at in &edge {
            let (x, y) = (at % columns, at / columns);
            let neighbours = [
                (x > 0).then(|| at - 1),
                (x + 1 < columns).then_some(at + 1),
                (y > 0).then(|| at - columns),
                (y + 1 < rows).then_some(at + columns),
            ];
            for next in neighbours.into_iter().flatten().filter(|&next| count[next] == 0.0) {
                let index = *at_found.entry(next).or_insert_with(|| {
                    found.push((next, DVec2::ZERO, 0.0));
                    found.len() - 1
                });
                found[index].1 += motion[at] / count[at];
                found[index].2 += 1.0;
            }
        }
        edge.clear();
        for (at, sum, weight) in found {
            (motion[at], count[at]) = (sum, weight);
            edge.push(at);
        }
    }
}

#[cfg(test)]
#[path = "looks_tests.rs"]
mod tests;
