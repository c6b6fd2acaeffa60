//! Division of a mask of all people among those whose posed bodies are known.

use std::collections::VecDeque;

use flyrig_types::{Camera, Mask};
use glam::{DVec2, Vec3};

/// Posed body, world metres.
pub(super) struct PosedMesh<'a> {
    pub vertices: Vec<Vec3>,
    pub triangles: &'a [[u32; 3]],
}

/// Label of a pixel without a body.
const NOBODY: u32 = u32::MAX;
/// Label of a pixel at the border of two bodies.
const MIXED: u32 = u32::MAX - 1;
/// Least depth of a corner that is drawn, metres.
const NEAR_M: f64 = 0.05;
/// Distance by which clothes and hair stand off the body, metres. In front of a body behind, such a pixel may belong to either.
const CLOTHES_M: f64 = 0.05;
/// Least difference of depth at which a body is behind another one, metres.
const BEHIND_M: f64 = 0.1;

/// Returns, for each body, its own part of the mask and the part that is not informative for it. A pixel belongs to the nearest body drawn
/// there, else (clothes, hair) to the body of the closest pixel that has one. Pixels beside those of another body mix both colours, and
/// those of a body next to one in front may show the other's clothes: they belong to no body.
pub(super) fn split_mask(camera: &Camera, mask: &Mask, bodies: &[PosedMesh<'_>]) -> Vec<(Mask, Mask)> {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let (mut labels, depths) = nearest_bodies(camera, bodies, [width, height]);
    let hidden = behind_clothes(camera, &labels, &depths, bodies.len() as u32, [width, height]);
    spread(&mut labels, width, height);
    let mixed = |at: usize| {
        let (x, y) = (at % width, at / width);
        let near = |v: usize, side: usize| v.saturating_sub(1)..(v + 2).min(side);
        near(y, height).any(|v| near(x, width).any(|u| labels[v * width + u] != labels[at]))
    };
    let labels: Vec<u32> = (0..labels.len())
        .map(|at| {
            if mask.coverage()[at] > 0 && labels[at] != NOBODY && (hidden[at] || mixed(at)) {
                MIXED
            } else {
                labels[at]
            }
        })
        .collect();
    let part = |keep: &dyn Fn(u32) -> bool| {
        let coverage = mask.coverage().iter().zip(&labels).map(|(&c, &label)| if keep(label) { c } else { 0 });
        let coverage: Vec<u8> = coverage.collect();
        // The size is the mask's own, so it is never rejected.
        Mask::new(mask.width(), mask.height(), coverage).unwrap_or_else(|_| mask.clone())
    };
    (0..bodies.len() as u32)
        .map(|own| (part(&|label| label == own), part(&|label| label != own && label != NOBODY)))
        .collect()
}

/// Draws the bodies: label and depth in metres of the nearest one at each pixel.
fn nearest_bodies(camera: &Camera, bodies: &[PosedMesh<'_>], [width, height]: [usize; 2]) -> (Vec<u32>, Vec<f64>) {
    let mut labels = vec![NOBODY; width * height];
    let mut depths = vec![f64::INFINITY; width * height];
    for (label, body) in (0u32..).zip(bodies) {
        let corners: Vec<Option<(DVec2, f64)>> = body
            .vertices
            .iter()
            .map(|vertex| {
                let point = vertex.as_dvec3();
                let depth = camera.camera_from_world.transform_point(point).z;
                let pixel = camera.project(point).filter(|pixel| pixel.is_finite())?;
                (depth > NEAR_M).then_some((pixel, depth))
            })
            .collect();
        for triangle in body.triangles {
            let corner = |k: usize| corners.get(triangle[k] as usize).copied().flatten();
            if let (Some(a), Some(b), Some(c)) = (corner(0), corner(1), corner(2)) {
                let depth = (a.1 + b.1 + c.1) / 3.0;
                draw([a.0, b.0, c.0], [width, height], |at| {
                    if depth < depths[at] {
                        (depths[at], labels[at]) = (depth, label);
                    }
                });
            }
        }
    }
    (labels, depths)
}

/// Returns for each pixel whether it belongs to a body that clothes of a body in front may hide: within [`CLOTHES_M`] of it in the image.
fn behind_clothes(
    camera: &Camera,
    labels: &[u32],
    depths: &[f64],
    bodies: u32,
    [width, height]: [usize; 2],
) -> Vec<bool> {
    let focal_px = camera.intrinsics.focal_px.max_element();
    let mut hidden = vec![false; labels.len()];
    for front in 0..bodies {
        // Steps that the clothes still reach beyond a pixel, and the depth of the body's pixel that they begin at.
        let mut reached: Vec<Option<(u32, f64)>> = vec![None; labels.len()];
        let mut queue = VecDeque::new();
        for at in (0..labels.len()).filter(|&at| labels[at] == front) {
            reached[at] = Some(((CLOTHES_M * focal_px / depths[at]).min(1e4) as u32, depths[at]));
            queue.push_back(at);
        }
        while let Some(at) = queue.pop_front() {
            let Some((reach, depth)) = reached[at].filter(|(reach, _)| *reach > 0) else { continue };
            for next in neighbours(at, [width, height]) {
                let is_behind = depth + BEHIND_M < depths[next];
                if reached[next].is_none() && (labels[next] == NOBODY || is_behind) {
                    hidden[next] |= labels[next] != NOBODY;
                    reached[next] = Some((reach - 1, depth));
                    queue.push_back(next);
                }
            }
        }
    }
    hidden
}

/// Returns the pixels left, right, above and below.
fn neighbours(at: usize, [width, height]: [usize; 2]) -> impl Iterator<Item = usize> {
    let (x, y) = (at % width, at / width);
    let all = [
        (x > 0).then(|| at - 1),
        (x + 1 < width).then(|| at + 1),
        (y > 0).then(|| at - width),
        (y + 1 < height).then(|| at + width),
    ];
    all.into_iter().flatten()
}

/// Calls `visit` for the pixels whose centres lie in a triangle.
fn draw([a, b, c]: [DVec2; 3], [width, height]: [usize; 2], mut visit: impl FnMut(usize)) {
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let first = |value: f64, side: usize| value.ceil().clamp(0.0, side as f64) as usize;
    let end = |value: f64, side: usize| (value.floor() + 1.0).clamp(0.0, side as f64) as usize;
    let edge = |p: DVec2, q: DVec2, at: DVec2| (q - p).perp_dot(at - p);
    for y in first(low.y, height)..end(high.y, height) {
        for x in first(low.x, width)..end(high.x, width) {
            let at = DVec2::new(x as f64, y as f64);
            let sides = [edge(a, b, at), edge(b, c, at), edge(c, a, at)];
            if sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0) {
                visit(y * width + x);
            }
        }
    }
}

/// Gives every pixel the label of the closest labelled one (by steps between neighbours).
fn spread(labels: &mut [u32], width: usize, height: usize) {
    let mut queue: VecDeque<usize> = (0..labels.len()).filter(|&at| labels[at] != NOBODY).collect();
    while let Some(at) = queue.pop_front() {
        let label = labels[at];
        for next in neighbours(at, [width, height]) {
            if labels[next] == NOBODY {
                labels[next] = label;
                queue.push_back(next);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry, Lens};
    use glam::DVec3;

    use super::*;

    fn camera() -> Camera {
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "a".into(),
            intrinsics: Intrinsics {
                width: 40,
                height: 20,
                focal_px: DVec2::splat(20.0),
                center_px: DVec2::new(19.5, 9.5),
                lens: Lens::PINHOLE,
            },
            camera_from_world: Isometry::look_at(DVec3::new(0.0, -2.0, 0.0), DVec3::ZERO, DVec3::Z),
        }
    }

    /// Returns a square that faces the camera, `x` to its right, `y` behind the origin.
    fn square(x: f32, y: f32, half: f32) -> PosedMesh<'static> {
        let corner = |sx: f32, sz: f32| Vec3::new(x + sx * half, y, sz * half);
        let vertices = vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        PosedMesh { vertices, triangles: &[[0, 1, 2], [0, 2, 3]] }
    }

    fn count(mask: &Mask, columns: std::ops::Range<usize>) -> usize {
        let width = mask.width() as usize;
        mask.coverage().iter().enumerate().filter(|(i, c)| **c > 0 && columns.contains(&(i % width))).count()
    }

    #[test]
    fn each_pixel_goes_to_the_nearest_body_and_all_pixels_go_to_somebody() {
        let mask = Mask::new(40, 20, vec![200; 800]).unwrap();
        let parts = split_mask(&camera(), &mask, &[square(-0.5, 0.0, 0.3), square(0.5, 0.0, 0.3)]);
        let [(left, of_right), (right, of_left)] = parts.as_slice() else { panic!("two bodies") };
        assert_eq!((count(left, 0..20), count(left, 20..40)), (380, 0), "a column at the border is nobody's");
        assert_eq!((count(right, 0..20), count(right, 20..40)), (0, 380));
        assert_eq!((count(of_right, 0..40), count(of_left, 0..40)), (420, 420), "and says nothing about either");
        assert!(left.coverage().iter().all(|c| [0, 200].contains(c)), "coverage is kept");
    }

    #[test]
    fn a_body_in_front_hides_the_one_behind() {
        let mask = Mask::new(40, 20, vec![255; 800]).unwrap();
        let parts = split_mask(&camera(), &mask, &[square(0.0, 0.5, 0.9), square(0.0, -0.5, 0.2)]);
        let centre = 10 * 40 + 20;
        assert_eq!((parts[0].0.coverage()[centre], parts[1].0.coverage()[centre]), (0, 255));
        assert_eq!(parts[0].1.coverage()[centre], 255, "the front body's pixels say nothing about the other");
    }

    #[test]
    fn pixels_where_clothes_of_the_body_in_front_may_hide_the_one_behind_are_nobodys() {
        let mask = Mask::new(40, 20, vec![255; 800]).unwrap();
        // 1.5 m away, 13 px a metre: the clothes reach less than a pixel; four times as sharp they reach 2.
        let mut camera = camera();
        camera.intrinsics.focal_px = DVec2::splat(80.0);
        let parts = split_mask(&camera, &mask, &[square(0.0, 0.5, 0.9), square(0.0, -0.5, 0.1)]);
        let owner = |x: usize| [parts[0].0.coverage()[10 * 40 + x], parts[1].0.coverage()[10 * 40 + x]];
        let columns: Vec<[u8; 2]> = (20..32).map(owner).collect();
        // The front body ends at 19.5 + 5.3 pixels; one pixel on either side is mixed, and two behind it.
        assert_eq!(columns[..4], [[0, 255]; 4]);
        assert_eq!(columns[4..7], [[0, 0]; 3]);
        assert_eq!(columns[9..], [[255, 0]; 3], "{columns:?}");
        // Side by side nobody is behind.
        let parts = split_mask(&camera, &mask, &[square(-0.1, 0.0, 0.1), square(0.1, 0.05, 0.1)]);
        let own: usize = parts.iter().map(|(own, _)| count(own, 0..40)).sum();
        assert!(own >= 38 * 20, "{own}");
    }

    #[test]
    fn bodies_that_cannot_be_drawn_own_nothing() {
        let mask = Mask::new(40, 20, vec![255; 800]).unwrap();
        let behind = square(0.0, -5.0, 0.3);
        let broken = PosedMesh { vertices: vec![Vec3::NAN; 4], triangles: &[[0, 1, 2], [7, 8, 9]] };
        let parts = split_mask(&camera(), &mask, &[behind, broken, square(0.0, 0.0, 0.3)]);
        assert_eq!(parts.iter().map(|part| part.0.area_px()).collect::<Vec<_>>(), [0, 0, 800]);
        let nobody = split_mask(&camera(), &mask, &[square(0.0, -5.0, 0.3)]);
        assert_eq!((nobody[0].0.area_px(), nobody[0].1.area_px()), (0, 0));
    }
}
