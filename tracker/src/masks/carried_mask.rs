//! The network's mask of an earlier image, warped by the body's motion since.
//!
//! The network does not run on every view of every frame set (see
//! [`inference_schedule`](crate::landmarks::inference_schedule)); the mask of its last run moves with the visible vertices.

use std::collections::HashMap;

use flyrig_types::Camera;
use glam::{DVec2, Vec3};

use crate::image::crop::Crop;
use crate::image::grid::Grid;
use crate::masks::silhouette::net_probability;

/// Depth behind the nearest vertex in a cell beyond which vertices are hidden, metres.
const HIDDEN_M: f64 = 0.1;

/// Vertices of a body in an image: pixel and depth in metres; `None` for those out of view.
pub(crate) type Corners = Vec<Option<(DVec2, f64)>>;

/// Projects the vertices of a body, world metres.
pub(crate) fn corners(camera: &Camera, vertices: &[Vec3]) -> Corners {
    let corner = |vertex: &Vec3| {
        let point = vertex.as_dvec3();
        Some((camera.project(point)?, camera.camera_from_world.transform_point(point).z))
    };
    vertices.iter().map(corner).collect()
}

/// Returns the network's mask inside `bounds` (x0, y0, x1, y1, ends excluded), warped from the body `then` to the body
/// `now`. Each cell moves by the mean motion of its visible vertices, cells without a vertex as their neighbours.
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
    // Mean motion of the visible vertices of a cell; cells around the body adopt that of their neighbours.
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

/// Fills cells without a vertex from their neighbours, layer by layer.
fn spread(motion: &mut [DVec2], count: &mut [f64], columns: usize, rows: usize) {
    let mut edge: Vec<usize> = (0..count.len()).filter(|&at| count[at] > 0.0).collect();
    while !edge.is_empty() {
        let mut found: Vec<(usize, DVec2, f64)> = Vec::new();
        let mut at_found = HashMap::new();
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
mod tests {
    use flyrig_body::skin_mesh;
    use glam::DVec3;

    use super::*;
    use crate::network::output::NET_SIDE;
    use crate::pose::body_model::{BodyModel, JointTurns};
    use crate::testing::{body, mask_of, random_turns, ring};

    /// Mask of a network that sees a person on the coverage of an image.
    fn network_mask(crop: Crop, coverage: impl Fn(DVec2) -> f32) -> Vec<f32> {
        let pixels = (0..NET_SIDE).flat_map(|y| (0..NET_SIDE).map(move |x| DVec2::new(x as f64, y as f64)));
        pixels.map(|pixel| coverage(crop.to_image(pixel))).collect()
    }

    #[test]
    fn a_mask_is_carried_to_where_the_body_went() {
        let (template, camera) = (body(), ring(3).cameras[0].clone());
        let model = BodyModel::new(&template).unwrap();
        let turns = random_turns(&model, 5);
        let mut moved = turns.clone();
        moved.root += DVec3::new(0.12, 0.08, 0.0);
        let place = |turns: &JointTurns| corners(&camera, &skin_mesh(&template, &model.to_pose(turns)).0);
        let mask = |turns: &JointTurns| mask_of(&camera, &template, &model.to_pose(turns));
        let (before, after) = (mask(&turns), mask(&moved));
        let (width, height) = (before.width() as usize, before.height() as usize);
        let crop = Crop::upright(DVec2::new(width as f64, height as f64) * 0.5, width as f64);
        let seen = network_mask(crop, |at| {
            let (x, y) = (at.x.round().max(0.0) as usize, at.y.round().max(0.0) as usize);
            if x < width && y < height { f32::from(before.coverage()[y * width + x]) / 255.0 } else { 0.0 }
        });
        let carried = carried_mask(&seen, crop, &place(&turns), &place(&moved), [0, 0, width, height]);
        let overlap = |mask: &flyrig_types::Mask| {
            let pairs = carried.values.iter().zip(mask.coverage()).map(|(a, b)| (*a > 0.5, *b > 127));
            let (both, either) =
                pairs.fold((0, 0), |(both, either), (a, b)| (both + i32::from(a && b), either + i32::from(a || b)));
            f64::from(both) / f64::from(either)
        };
        assert!(overlap(&after) > 0.93, "{} of the mask of the moved body", overlap(&after));
        assert!(overlap(&before) < 0.8, "{} of the old one", overlap(&before));
    }

    #[test]
    fn nothing_is_carried_of_a_body_out_of_view_and_poison_stays_out() {
        let crop = Crop::upright(DVec2::splat(16.0), 32.0);
        let seen = network_mask(crop, |_| 1.0);
        for corner in [None, Some((DVec2::NAN, f64::NAN)), Some((DVec2::splat(1e9), 1.0))] {
            let body = vec![corner; 5];
            let carried = carried_mask(&seen, crop, &body, &body, [0, 0, 8, 8]);
            assert!(carried.values.iter().all(|value| value.is_finite() && (0.0..=1.0).contains(value)));
        }
        assert!(carried_mask(&seen, crop, &Vec::new(), &Vec::new(), [3, 3, 3, 3]).values.is_empty());
    }
}
