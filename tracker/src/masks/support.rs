//! Clears mask fragments that no other camera supports.
//!
//! A passer-by behind the person, or a screen that lights up there, differs from the plate as a sleeve does, but lies
//! beside the body in one image only. A part of the person appears in every camera that views its place: a visual hull test
//! along the ray.

use flyrig_types::{Camera, Mask};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::image::grid::{Grid, components};
use crate::masks::gate::BodyGate;

/// Side of the squares that are tested as one, metres at the body, and its least value in pixels.
const SQUARE_M: f64 = 0.02;
const MIN_SQUARE_PX: f64 = 2.0;
/// Distance from the body beyond which masks need support, in the gate's unit: nearer, an outline is the camera's own.
const NEEDS_SUPPORT: f32 = 0.3;
/// Spacing of the depths that are tried along a ray, metres.
const DEPTH_STEP_M: f64 = 0.03;
/// Least number of squares of a fragment; fewer are edges on which cameras disagree by their calibration.
const MIN_SQUARES: usize = 6;

/// Number of other cameras above which one of them may miss a part that the rest has.
const MAY_DISSENT: usize = 3;

/// Mask in squares: those that hold some of it, widened by one square for errors of calibration and time.
struct Coarse {
    squares: Grid,
    side_px: usize,
}

impl Coarse {
    /// Reduces a mask to squares of `side_px`.
    fn new(mask: &Mask, side_px: usize) -> Self {
        let (width, height) = (mask.width() as usize, mask.height() as usize);
        let mut squares = Grid::new(width.div_ceil(side_px), height.div_ceil(side_px), 0.0);
        for (y, row) in mask.coverage().chunks_exact(width).enumerate() {
            for (x, _) in row.iter().enumerate().filter(|(_, alpha)| **alpha >= 128) {
                squares.values[(y / side_px) * squares.width + x / side_px] = 1.0;
            }
        }
        let mut squares = squares.distance_to_set();
        squares.values.iter_mut().for_each(|away| *away = f32::from(*away < 1.5));
        Self { squares, side_px }
    }

    /// Whether the mask may cover a pixel; `None` outside the image.
    fn may_cover(&self, pixel: DVec2) -> Option<bool> {
        let at = (pixel + 0.5) / self.side_px as f64;
        if !(at.x >= 0.0 && at.y >= 0.0) {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let inside = x < self.squares.width && y < self.squares.height;
        inside.then(|| self.squares.values[y * self.squares.width + x] > 0.5)
    }
}

/// Clears components of `masks` beside the body that lie, at every depth that clothes may have, outside the masks of the
/// other cameras that view the place (all of up to three, all but one of more). Slices are in rig order; cameras without a
/// mask or a gate are ignored. The person must be alone: another one would hide parts that a mask should have.
pub(crate) fn drop_unsupported(cameras: &[Camera], gates: &[Option<BodyGate>], masks: &mut [Option<Mask>]) {
    let side_px = |gate: &BodyGate| (SQUARE_M * gate.px_per_m).round().max(MIN_SQUARE_PX) as usize;
    let coarse: Vec<Option<Coarse>> = masks
        .iter()
        .zip(gates)
        .map(|(mask, gate)| {
            let (mask, gate) = (mask.as_ref()?, gate.as_ref()?);
            let fits = [mask.width() as usize, mask.height() as usize] == gate.image;
            fits.then(|| Coarse::new(mask, side_px(gate)))
        })
        .collect();
    if coarse.iter().flatten().count() < 2 {
        return;
    }
    let cleared: Vec<Option<Mask>> = (0..masks.len().min(cameras.len()))
        .into_par_iter()
        .map(|slot| {
            let (gate, mask) = (gates[slot].as_ref()?, masks[slot].as_ref()?);
            let away = coarse[slot].as_ref()?.side_px;
            let camera = &cameras[slot];
            let forwards = camera.camera_from_world.rotation.inverse() * DVec3::Z;
            let [near, far] = gate.depth_range_m();
            let steps = ((far - near) / DEPTH_STEP_M).ceil().clamp(1.0, 500.0) as usize;
            let covered = |other: usize, point| coarse[other].as_ref()?.may_cover(cameras[other].project(point)?);
            let is_possible = |point: DVec3| {
                let seen = (0..masks.len()).filter(|other| *other != slot).filter_map(|other| covered(other, point));
                let (agree, all) = seen.fold((0, 0), |(agree, all), covers| (agree + usize::from(covers), all + 1));
                all - agree <= usize::from(all > MAY_DISSENT)
            };
            let is_supported = |pixel: DVec2| {
                camera.ray(pixel).is_none_or(|ray| {
                    let along = ray.dot(forwards).max(1e-3);
                    let depth = |step: usize| near + (far - near) * step as f64 / steps as f64;
                    (0..=steps).any(|step| is_possible(camera.position() + ray * (depth(step) / along)))
                })
            };
            without_fragments(mask, gate, away, is_supported)
        })
        .collect();
    for (mask, cleared) in masks.iter_mut().zip(cleared) {
        if cleared.is_some() {
            *mask = cleared;
        }
    }
}

/// Returns the mask without unsupported components of several squares; `None` when there are none.
fn without_fragments(
    mask: &Mask,
    gate: &BodyGate,
    side_px: usize,
    is_supported: impl Fn(DVec2) -> bool,
) -> Option<Mask> {
    let [x0, y0, x1, y1] = gate.bounds;
    let width = mask.width() as usize;
    let mut doubtful = Grid::new((x1 - x0).div_ceil(side_px), (y1 - y0).div_ceil(side_px), 0.0);
    let needs_support = |x: usize, y: usize| {
        gate.distance.values[(y - y0) * gate.distance.width + x - x0] > NEEDS_SUPPORT
            && mask.coverage()[y * width + x] > 0
    };
    let square = |column: usize, row: usize| {
        let (left, top) = (x0 + column * side_px, y0 + row * side_px);
        (top..(top + side_px).min(y1)).flat_map(move |y| (left..(left + side_px).min(x1)).map(move |x| (x, y)))
    };
    for row in 0..doubtful.height {
        for column in 0..doubtful.width {
            if !square(column, row).any(|(x, y)| needs_support(x, y)) {
                continue;
            }
            let centre =
                DVec2::new((x0 + column * side_px) as f64, (y0 + row * side_px) as f64) + 0.5 * (side_px as f64 - 1.0);
            doubtful.values[row * doubtful.width + column] = f32::from(!is_supported(centre));
        }
    }
    let mut fragments = Vec::new();
    components(
        &doubtful,
        |value| value > 0.5,
        |squares| {
            if squares.len() >= MIN_SQUARES {
                fragments.extend_from_slice(squares);
            }
        },
    );
    if fragments.is_empty() {
        return None;
    }
    let mut coverage = mask.coverage().to_vec();
    for at in fragments {
        for (x, y) in square(at % doubtful.width, at / doubtful.width).filter(|(x, y)| needs_support(*x, *y)) {
            coverage[y * width + x] = 0;
        }
    }
    Mask::new(mask.width(), mask.height(), coverage).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::body_model::BodyModel;
    use crate::testing::{body, mask_of, random_turns, ring};
    use flyrig_body::{Template, skin_mesh};
    use flyrig_types::{Pose, Rig};

    struct Scene {
        rig: Rig,
        gates: Vec<Option<BodyGate>>,
        masks: Vec<Option<Mask>>,
    }

    fn scene(count: usize) -> Scene {
        let (rig, template) = (ring(count), body());
        let model = BodyModel::new(&template).unwrap();
        of(rig, &template, &model.to_pose(&random_turns(&model, 3)))
    }

    fn of(rig: Rig, template: &Template, pose: &Pose) -> Scene {
        let (vertices, _) = skin_mesh(template, pose);
        let gates = rig.cameras.iter().map(|camera| BodyGate::new(camera, &vertices, &template.triangles)).collect();
        let masks = rig.cameras.iter().map(|camera| Some(mask_of(camera, template, pose))).collect();
        Scene { rig, gates, masks }
    }

    /// Sets pixels, and returns how many were not covered before.
    fn paint(mask: &mut Option<Mask>, inside: impl Fn(usize, usize) -> bool) -> usize {
        let before = mask.clone().unwrap();
        let width = before.width() as usize;
        let mut coverage = before.coverage().to_vec();
        let mut painted = 0;
        for (_, alpha) in coverage.iter_mut().enumerate().filter(|(at, _)| inside(at % width, at / width)) {
            painted += usize::from(*alpha < 128);
            *alpha = 255;
        }
        *mask = Mask::new(before.width(), before.height(), coverage).ok();
        painted
    }

    /// A point beside the body's middle as the first camera sees it, and its distance from the body in that image, metres.
    fn beside(scene: &Scene) -> DVec3 {
        let (camera, gate) = (&scene.rig.cameras[0], scene.gates[0].as_ref().unwrap());
        let to_camera = (camera.position() - DVec3::Z).normalize();
        let aside = to_camera.cross(DVec3::Z).normalize();
        let [x0, y0, ..] = gate.bounds;
        (0..200)
            .map(|step| DVec3::Z + aside * 0.01 * f64::from(step))
            .find(|point| {
                let pixel = camera.project(*point).unwrap();
                let (x, y) = (pixel.x as usize - x0, pixel.y as usize - y0);
                gate.distance.values[y * gate.distance.width + x] > 1.4
            })
            .unwrap()
    }

    /// Pixels at `point` of the world, in each camera, within `radius_px`.
    fn disc(rig: &Rig, slot: usize, point: DVec3, radius_px: f64) -> impl Fn(usize, usize) -> bool {
        let centre = rig.cameras[slot].project(point).unwrap();
        move |x, y| centre.distance(DVec2::new(x as f64, y as f64)) <= radius_px
    }

    #[test]
    fn whole_masks_stay_as_they_are() {
        for count in [1, 2, 3, 5] {
            let mut scene = scene(count);
            let before = scene.masks.clone();
            drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
            assert!(scene.masks == before, "{count} cameras");
        }
    }

    #[test]
    fn what_one_camera_alone_sees_beside_the_body_is_cleared() {
        for count in [3, 4, 6] {
            let mut scene = scene(count);
            let whole = scene.masks.clone();
            let at = disc(&scene.rig, 0, beside(&scene), 12.0);
            let painted = paint(&mut scene.masks[0], at);
            assert!(painted > 400, "{painted}");
            drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
            assert!(scene.masks == whole, "{count} cameras");
        }
    }

    #[test]
    fn what_the_other_cameras_see_as_well_stays() {
        let mut scene = scene(5);
        let point = beside(&scene);
        let radius = |slot: usize| 0.05 * scene.gates[slot].as_ref().map_or(0.0, |gate| gate.px_per_m);
        let discs: Vec<_> = (0..5).map(|slot| disc(&scene.rig, slot, point, radius(slot))).collect();
        // One camera of five may miss it.
        for (slot, disc) in discs.into_iter().enumerate().filter(|(slot, _)| *slot != 3) {
            paint(&mut scene.masks[slot], disc);
        }
        let before = scene.masks.clone();
        drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
        assert!(scene.masks == before);
    }

    #[test]
    fn cameras_without_a_mask_or_a_view_of_the_place_do_not_contradict() {
        let mut scene = scene(3);
        let at = disc(&scene.rig, 0, beside(&scene), 12.0);
        paint(&mut scene.masks[0], at);
        (scene.masks[1], scene.masks[2]) = (None, None);
        let before = scene.masks.clone();
        drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
        assert!(scene.masks == before, "nobody else has a mask");
        scene.gates[0] = None;
        drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
        assert!(scene.masks == before, "no body");
        drop_unsupported(&[], &[], &mut []);
    }

    #[test]
    fn masks_of_other_sizes_and_broken_cameras_do_no_harm() {
        let mut scene = scene(3);
        scene.masks[1] = Mask::new(2, 2, vec![255; 4]).ok();
        let before = scene.masks[1].clone();
        scene.rig.cameras[2].camera_from_world.translation.x = f64::NAN;
        drop_unsupported(&scene.rig.cameras, &scene.gates, &mut scene.masks);
        assert!(scene.masks[1] == before);
        assert!(scene.masks[0].as_ref().unwrap().area_px() > 1000);
    }
}
