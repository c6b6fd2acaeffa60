//! Detection of shoes, and of a skirt or a long coat, from masks.
//!
//! Clothes are tried on the posed body, and accepted where they raise the overlap with the masks of several frame sets
//! enough. Poses stay those of the body; the dressed body is drawn.

use flyrig_body::{Outfit, Part, Shoes, Skirt, Template, skin_mesh};
use flyrig_types::{Camera, Mask, Pose};
use glam::{DVec2, Vec3};
use rayon::prelude::*;

use crate::image::grid::Grid;

/// Side of the squares in which masks are compared, metres at the body: for skirts, and around the feet for shoes.
const SQUARE_M: f64 = 0.015;
const FOOT_SQUARE_M: f64 = 0.004;
/// Skirt lengths that are tried, the refinement between them, and flares.
const LENGTHS: [f32; 6] = [0.3, 0.42, 0.54, 0.66, 0.78, 0.9];
const BETWEEN: f32 = 0.06;
const FLARES: [f32; 6] = [0.0, 0.08, 0.16, 0.25, 0.35, 0.5];
const FIRST_FLARE: f32 = 0.16;
/// Least gain in overlap (intersection over union) by which a skirt is accepted: wide trousers gain less.
const GAIN: f64 = 0.015;
/// Thicknesses of soles that are tried, metres.
const SOLES_M: [f32; 5] = [0.008, 0.015, 0.022, 0.03, 0.042];
/// Least gain in overlap around the feet by which shoes are accepted: thin ones gain up to 0.060 on the bare feet of real
/// footage, and simulated shoes 0.088 and more where no coat hides them (docs/benchmarks/deform.md).
const SHOES_GAIN: f64 = 0.065;
/// Distance around the feet within which masks are compared, metres.
const AROUND_FEET_M: f64 = 0.05;

/// Person in one image.
#[derive(Debug, Clone, Copy)]
pub struct MaskedView<'a> {
    /// Camera.
    pub camera: &'a Camera,
    /// Index of the person's pose in [`MaskedPoses::poses`].
    pub pose: usize,
    /// Mask of the person, at the image's size.
    pub mask: &'a Mask,
}

/// Person in several images.
#[derive(Debug, Clone, Default)]
pub struct MaskedPoses<'a> {
    /// Poses of the body, world frame.
    pub poses: Vec<Pose>,
    /// Images that show the person in one of the poses.
    pub views: Vec<MaskedView<'a>>,
}

/// Mask reduced to squares.
struct Target<'a> {
    view: &'a MaskedView<'a>,
    squares: Grid,
    side_px: f64,
    /// Columns and rows of the compared squares: left, right, top, bottom (right and bottom excluded).
    counted: [usize; 4],
}

impl<'a> Target<'a> {
    /// Reduces a mask to squares of `square_m` metres at the body; `None` when the person is not before the camera or the
    /// size differs.
    fn new(view: &'a MaskedView<'a>, pose: &Pose, square_m: f64) -> Option<Self> {
        if [view.mask.width(), view.mask.height()] != view.camera.size() {
            return None;
        }
        let depth = view.camera.camera_from_world.transform_point(pose.root_translation).z;
        if !(depth > 0.1 && depth.is_finite()) {
            return None;
        }
        let side_px = (square_m * view.camera.intrinsics.focal_px.x / depth).round().max(1.0);
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
        let counted = [0, sums.width, 0, sums.height];
        Some(Self { view, squares: sums, side_px, counted })
    }

    /// Restricts the comparison to the surroundings of world points (metres); `None` where the camera sees none of them.
    fn around(self, points: impl Iterator<Item = Vec3>, reach_m: f64) -> Option<Self> {
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for point in points.map(Vec3::as_dvec3) {
            let depth = self.view.camera.camera_from_world.transform_point(point).z;
            if let Some(pixel) = self.view.camera.project(point) {
                let reach_px = reach_m * self.view.camera.intrinsics.focal_px.x / depth;
                (low, high) = (low.min(pixel - reach_px), high.max(pixel + reach_px));
            }
        }
        let square = |at: f64, most: usize| (at / self.side_px).clamp(0.0, most as f64) as usize;
        let (columns, rows) = (self.squares.width, self.squares.height);
        let counted = [square(low.x, columns), square(high.x, columns), square(low.y, rows), square(high.y, rows)];
        (counted[0] < counted[1] && counted[2] < counted[3]).then_some(Self { counted, ..self })
    }

    /// Returns the number of compared squares that body and mask both cover, and of those that either covers.
    fn overlap(&self, vertices: &[Vec3], triangles: &[[u32; 3]]) -> (usize, usize) {
        let place = |v: &Vec3| Some((self.view.camera.project(v.as_dvec3())? + 0.5) / self.side_px - 0.5);
        let pixels: Vec<Option<DVec2>> = vertices.iter().map(place).collect();
        let mut drawn = Grid::new(self.squares.width, self.squares.height, 0.0);
        drawn.fill_mesh(&pixels, triangles);
        let [left, right, top, bottom] = self.counted;
        let (mut both, mut either) = (0, 0);
        for row in top..bottom {
            let row = row * drawn.width;
            for (a, b) in
                drawn.values[row + left..row + right].iter().zip(&self.squares.values[row + left..row + right])
            {
                both += usize::from(*a > 0.5 && *b > 0.5);
                either += usize::from(*a > 0.5 || *b > 0.5);
            }
        }
        (both, either)
    }
}

/// Reduces all masks to squares.
fn targets<'a>(seen: &'a MaskedPoses<'_>, square_m: f64) -> impl Iterator<Item = Target<'a>> {
    seen.views.iter().filter_map(move |view| Target::new(view, seen.poses.get(view.pose)?, square_m))
}

/// Returns the intersection over union of masks with a dressed body in its poses; 0 for clothes that it cannot wear.
fn overlap(targets: &[Target<'_>], poses: &[Pose], dressed: Result<Template, flyrig_body::BodyError>) -> f64 {
    let Ok(dressed) = dressed else { return 0.0 };
    let skinned: Vec<Vec<Vec3>> = poses.par_iter().map(|pose| skin_mesh(&dressed, pose).0).collect();
    let of = |target: &Target<'_>| target.overlap(&skinned[target.view.pose], &dressed.triangles);
    let counts: Vec<(usize, usize)> = targets.par_iter().map(of).collect();
    let (both, either) = counts.iter().fold((0, 0), |sum, count| (sum.0 + count.0, sum.1 + count.1));
    both as f64 / either.max(1) as f64
}

/// Returns the outfit in which the body covers the masks best, by intersection over union of all views: shoes where they do
/// better than bare feet, a skirt where it does better than trousers; nothing for a body that cannot wear any. Views of
/// missing poses and masks of another size than their camera's images are ignored.
#[must_use]
pub fn find_outfit(body: &Template, seen: &MaskedPoses<'_>) -> Outfit {
    let shoes = find_shoes(body, seen);
    let bare = Outfit { shoes, ..Outfit::default() };
    Outfit { skirt: find_skirt(body, bare, seen), ..bare }
}

/// Finds the shoes that raise the overlap around the feet.
fn find_shoes(body: &Template, seen: &MaskedPoses<'_>) -> Option<Shoes> {
    let on_foot = |vertex: usize| matches!(body.parts.get(vertex), Some(Part::LeftFoot | Part::RightFoot));
    let feet: Vec<Vec<Vec3>> = seen
        .poses
        .par_iter()
        .map(|pose| {
            let (vertices, _) = skin_mesh(body, pose);
            vertices.into_iter().enumerate().filter(|(vertex, _)| on_foot(*vertex)).map(|(_, at)| at).collect()
        })
        .collect();
    let targets: Vec<Target<'_>> = targets(seen, FOOT_SQUARE_M)
        .filter_map(|target| {
            let feet = feet[target.view.pose].iter().copied();
            target.around(feet, AROUND_FEET_M)
        })
        .collect();
    if targets.is_empty() {
        return None;
    }
    let bare = overlap(&targets, &seen.poses, Ok(body.clone()));
    let tried = SOLES_M.into_iter().map(|sole_m| {
        let shoes = Shoes { sole_m };
        (shoes, overlap(&targets, &seen.poses, shoes.on(body)))
    });
    let (best, gain) = tried.max_by(|a, b| a.1.total_cmp(&b.1))?;
    tracing::debug!(bare, gain = gain - bare, ?best, "compared bare feet with shoes");
    (gain - bare > SHOES_GAIN).then_some(best)
}

/// Finds the skirt that raises the overlap of a body in `worn`.
fn find_skirt(body: &Template, worn: Outfit, seen: &MaskedPoses<'_>) -> Option<Skirt> {
    let targets: Vec<Target<'_>> = targets(seen, SQUARE_M).collect();
    if targets.is_empty() {
        return None;
    }
    let worn = worn.on(body).ok()?;
    let best_of = |skirts: &mut dyn Iterator<Item = Skirt>| -> Option<(Skirt, f64)> {
        let tried = skirts.map(|skirt| (skirt, overlap(&targets, &seen.poses, skirt.on(&worn))));
        tried.max_by(|a, b| a.1.total_cmp(&b.1))
    };
    let without = overlap(&targets, &seen.poses, Ok(worn.clone()));
    let (best, first) = best_of(&mut LENGTHS.into_iter().map(|length| Skirt { length, flare: FIRST_FLARE }))?;
    let (best, gain) = if first > without {
        let (best, _) = best_of(&mut FLARES.into_iter().map(|flare| Skirt { flare, ..best }))?;
        best_of(&mut [-BETWEEN, 0.0, BETWEEN].into_iter().map(|by| Skirt { length: best.length + by, ..best }))?
    } else {
        (best, first)
    };
    tracing::debug!(without, gain = gain - without, ?best, "compared the body with one in a skirt");
    (gain - without > GAIN).then_some(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::body_model::BodyModel;
    use crate::testing::{body, mask_of, random_turns, ring};

    fn found(worn: Outfit) -> Outfit {
        let (rig, body) = (ring(3), body());
        let model = BodyModel::new(&body).unwrap();
        let dressed = worn.on(&body).unwrap();
        let poses: Vec<Pose> = (0..4).map(|seed| model.to_pose(&random_turns(&model, seed))).collect();
        let masks: Vec<(usize, usize, Mask)> = (0..poses.len())
            .flat_map(|pose| (0..3).map(move |slot| (pose, slot)))
            .map(|(pose, slot)| (pose, slot, mask_of(&rig.cameras[slot], &dressed, &poses[pose])))
            .collect();
        let views =
            masks.iter().map(|(pose, slot, mask)| MaskedView { camera: &rig.cameras[*slot], pose: *pose, mask });
        find_outfit(&body, &MaskedPoses { views: views.collect(), poses })
    }

    #[test]
    fn a_skirt_is_found_with_its_length_and_flare_and_trousers_are_none() {
        assert_eq!(found(Outfit::default()), Outfit::default());
        for worn in [
            Skirt { length: 0.35, flare: 0.25 },
            Skirt { length: 0.57, flare: 0.1 },
            Skirt { length: 0.85, flare: 0.3 },
        ] {
            let found = found(Outfit { skirt: Some(worn), ..Outfit::default() }).skirt.unwrap();
            assert!((found.length - worn.length).abs() < 0.09, "{found:?} for {worn:?}");
            assert!((found.flare - worn.flare).abs() < 0.12, "{found:?} for {worn:?}");
        }
    }

    #[test]
    fn shoes_are_found_with_their_soles_below_a_skirt_as_well() {
        let skirt = Some(Skirt { length: 0.6, flare: 0.16 });
        for (sole_m, skirt) in [(0.01, None), (0.022, None), (0.04, None), (0.022, skirt)] {
            let found = found(Outfit { shoes: Some(Shoes { sole_m }), skirt });
            assert_eq!(found.skirt.is_some(), skirt.is_some());
            let found = found.shoes.unwrap().sole_m;
            assert!((found - sole_m).abs() < 0.006, "soles of {found} m for {sole_m} m");
        }
    }

    #[test]
    fn nothing_is_worn_where_nothing_is_seen() {
        let (rig, body) = (ring(2), body());
        let model = BodyModel::new(&body).unwrap();
        let pose = model.to_pose(&random_turns(&model, 1));
        assert_eq!(find_outfit(&body, &MaskedPoses { poses: Vec::new(), views: Vec::new() }), Outfit::default());
        let empty = Mask::new(800, 800, vec![0; 640_000]).unwrap();
        let view = |pose| MaskedView { camera: &rig.cameras[0], pose, mask: &empty };
        assert_eq!(
            find_outfit(&body, &MaskedPoses { poses: vec![pose.clone()], views: vec![view(0)] }),
            Outfit::default()
        );
        assert_eq!(
            find_outfit(&body, &MaskedPoses { poses: vec![pose], views: vec![view(7)] }),
            Outfit::default(),
            "no such pose"
        );
        let lost = Pose { root_translation: glam::DVec3::NAN, joint_rotations: vec![glam::DQuat::IDENTITY] };
        assert_eq!(find_outfit(&body, &MaskedPoses { poses: vec![lost], views: vec![view(0)] }), Outfit::default());
    }
}
