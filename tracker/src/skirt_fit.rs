//! Whether a person wears a skirt or a long coat, from masks.

use flyrig_body::{Skirt, Template, skin_mesh};
use flyrig_types::{Camera, Mask, Pose};
use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::grid::Grid;

/// Masks are compared in squares of this size, metres at the body.
const SQUARE_M: f64 = 0.015;
/// Lengths that are tried, then lengths between them, and flares.
const LENGTHS: [f32; 6] = [0.3, 0.42, 0.54, 0.66, 0.78, 0.9];
const BETWEEN: f32 = 0.06;
const FLARES: [f32; 6] = [0.0, 0.08, 0.16, 0.25, 0.35, 0.5];
const FIRST_FLARE: f32 = 0.16;
/// A skirt is believed when bodies in it overlap masks by so much more (intersection over union) than bodies without: wide trousers
/// gain less.
const GAIN: f64 = 0.015;

/// A person in one image.
#[derive(Debug, Clone, Copy)]
pub struct MaskedView<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Which of [`MaskedPoses::poses`] the person has.
    pub pose: usize,
    /// Coverage by the person.
    pub mask: &'a Mask,
}

/// A person in several images.
#[derive(Debug, Clone, Default)]
pub struct MaskedPoses<'a> {
    /// Poses of the body, world frame.
    pub poses: Vec<Pose>,
    /// Images that show it in one of them.
    pub views: Vec<MaskedView<'a>>,
}

/// A mask in squares, and how many pixels a square has a side.
struct Target<'a> {
    view: &'a MaskedView<'a>,
    squares: Grid,
    side_px: f64,
}

impl<'a> Target<'a> {
    /// `None` where nothing of the person is before the camera.
    fn new(view: &'a MaskedView<'a>, pose: &Pose) -> Option<Self> {
        if [view.mask.width(), view.mask.height()] != view.camera.size() {
            return None;
        }
        let depth = view.camera.camera_from_world.transform_point(pose.root_translation).z;
        if !(depth > 0.1 && depth.is_finite()) {
            return None;
        }
        let side_px = (SQUARE_M * view.camera.intrinsics.focal_px.x / depth).round().max(1.0);
        let side = side_px as usize;
        let (width, height) = (view.mask.width() as usize, view.mask.height() as usize);
        let mut sums = Grid::new(width.div_ceil(side), height.div_ceil(side), 0.0);
        for (y, row) in view.mask.coverage().chunks_exact(width).enumerate() {
            for (x, alpha) in row.iter().enumerate() {
                sums.values[(y / side) * sums.width + x / side] += f32::from(*alpha) / 255.0;
            }
        }
        let half = 0.5 * (side * side) as f32;
        sums.values.iter_mut().for_each(|sum| *sum = f32::from(*sum >= half));
        Some(Self { view, squares: sums, side_px })
    }

    /// Squares that both cover, and squares that either covers.
    fn overlap(&self, vertices: &[Vec3], triangles: &[[u32; 3]]) -> (usize, usize) {
        let place = |v: &Vec3| Some((self.view.camera.project(v.as_dvec3())? + 0.5) / self.side_px - 0.5);
        let pixels: Vec<Option<DVec2>> = vertices.iter().map(place).collect();
        let mut drawn = Grid::new(self.squares.width, self.squares.height, 0.0);
        for triangle in triangles {
            let corner = |k: usize| pixels.get(triangle[k] as usize).copied().flatten();
            if let (Some(a), Some(b), Some(c)) = (corner(0), corner(1), corner(2)) {
                drawn.fill_triangle(a, b, c);
            }
        }
        let pairs = || drawn.values.iter().zip(&self.squares.values).map(|(a, b)| (*a > 0.5, *b > 0.5));
        (pairs().filter(|(a, b)| *a && *b).count(), pairs().filter(|(a, b)| *a || *b).count())
    }
}

/// Returns the skirt in which the body covers the masks best, by intersection over union of all views; `None` where trousers do as well,
/// and for a body that carries none. Views of poses that do not exist, and masks of another size than their camera's images, count nothing.
#[must_use]
pub fn find_skirt(body: &Template, seen: &MaskedPoses<'_>) -> Option<Skirt> {
    let targets: Vec<Target<'_>> =
        seen.views.iter().filter_map(|view| Target::new(view, seen.poses.get(view.pose)?)).collect();
    if targets.is_empty() {
        return None;
    }
    let overlap = |skirt: Option<Skirt>| -> f64 {
        let dressed = match skirt.map(|skirt| skirt.on(body)) {
            None => body.clone(),
            Some(Ok(dressed)) => dressed,
            Some(Err(_)) => return 0.0,
        };
        let skinned: Vec<Vec<Vec3>> = seen.poses.par_iter().map(|pose| skin_mesh(&dressed, pose).0).collect();
        let counts: Vec<(usize, usize)> =
            targets.par_iter().map(|target| target.overlap(&skinned[target.view.pose], &dressed.triangles)).collect();
        let (both, either) = counts.iter().fold((0, 0), |sum, count| (sum.0 + count.0, sum.1 + count.1));
        both as f64 / either.max(1) as f64
    };
    let best_of = |skirts: &mut dyn Iterator<Item = Skirt>| -> Option<(Skirt, f64)> {
        let tried = skirts.map(|skirt| (skirt, overlap(Some(skirt))));
        tried.max_by(|a, b| a.1.total_cmp(&b.1))
    };
    let bare = overlap(None);
    let (best, first) = best_of(&mut LENGTHS.into_iter().map(|length| Skirt { length, flare: FIRST_FLARE }))?;
    let (best, gain) = if first > bare {
        let (best, _) = best_of(&mut FLARES.into_iter().map(|flare| Skirt { flare, ..best }))?;
        best_of(&mut [-BETWEEN, 0.0, BETWEEN].into_iter().map(|by| Skirt { length: best.length + by, ..best }))?
    } else {
        (best, first)
    };
    tracing::debug!(bare, gain = gain - bare, ?best, "compared the body with one in a skirt");
    (gain - bare > GAIN).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body_model::BodyModel;
    use crate::testing::{body, mask_of, random_turns, ring};

    fn found(worn: Option<Skirt>) -> Option<Skirt> {
        let (rig, body) = (ring(3), body());
        let model = BodyModel::new(&body).unwrap();
        let dressed = worn.map_or_else(|| body.clone(), |skirt| skirt.on(&body).unwrap());
        let poses: Vec<Pose> = (0..4).map(|seed| model.to_pose(&random_turns(&model, seed))).collect();
        let masks: Vec<(usize, usize, Mask)> = (0..poses.len())
            .flat_map(|pose| (0..3).map(move |slot| (pose, slot)))
            .map(|(pose, slot)| (pose, slot, mask_of(&rig.cameras[slot], &dressed, &poses[pose])))
            .collect();
        let views =
            masks.iter().map(|(pose, slot, mask)| MaskedView { camera: &rig.cameras[*slot], pose: *pose, mask });
        find_skirt(&body, &MaskedPoses { views: views.collect(), poses })
    }

    #[test]
    fn a_skirt_is_found_with_its_length_and_flare_and_trousers_are_none() {
        assert_eq!(found(None), None);
        for worn in [
            Skirt { length: 0.35, flare: 0.25 },
            Skirt { length: 0.57, flare: 0.1 },
            Skirt { length: 0.85, flare: 0.3 },
        ] {
            let found = found(Some(worn)).unwrap();
            assert!((found.length - worn.length).abs() < 0.09, "{found:?} for {worn:?}");
            assert!((found.flare - worn.flare).abs() < 0.12, "{found:?} for {worn:?}");
        }
    }

    #[test]
    fn nothing_is_worn_where_nothing_is_seen() {
        let (rig, body) = (ring(2), body());
        let model = BodyModel::new(&body).unwrap();
        let pose = model.to_pose(&random_turns(&model, 1));
        assert_eq!(find_skirt(&body, &MaskedPoses { poses: Vec::new(), views: Vec::new() }), None);
        let empty = Mask::new(800, 800, vec![0; 640_000]).unwrap();
        let view = |pose| MaskedView { camera: &rig.cameras[0], pose, mask: &empty };
        assert_eq!(find_skirt(&body, &MaskedPoses { poses: vec![pose.clone()], views: vec![view(0)] }), None);
        assert_eq!(find_skirt(&body, &MaskedPoses { poses: vec![pose], views: vec![view(7)] }), None, "no such pose");
        let lost = Pose { root_translation: glam::DVec3::NAN, joint_rotations: vec![glam::DQuat::IDENTITY] };
        assert_eq!(find_skirt(&body, &MaskedPoses { poses: vec![lost], views: vec![view(0)] }), None);
    }
}
