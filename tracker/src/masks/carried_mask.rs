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

/// Returns the network's mask inside `bounds` (x0, y0, x1, y1, ends excluded), warped from the body `then` to the body `now`.
/// Each cell moves by the mean motion of its visible vertices, cells without a vertex as their neighbours.
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
