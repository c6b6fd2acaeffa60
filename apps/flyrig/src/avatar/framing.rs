//! Camera of `flyrig avatar render`: placed so that the whole clip is in view, or at `--eye`.

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_body::{Skeleton, Template};
use flyrig_types::{Camera, Intrinsics, Isometry, Pose};
use glam::{DQuat, DVec3};

/// Focal length, image heights.
const FOCAL_HEIGHTS: f64 = 1.4;
/// Direction from the person to a camera without `--eye`: in front, slightly above, so that the floor is seen.
const TOWARDS_EYE: DVec3 = DVec3::new(0.0, -1.0, 0.2);
/// Part of the half image that the person may fill, 0..=1.
const FILLED: f64 = 0.93;
/// Least distance of a camera without `--eye` from the person, metres.
const NEAREST_M: f64 = 0.3;

/// Place of the camera. World: metres, z up, the floor at 0, the middle of the person's path at the origin.
#[derive(Debug, Clone, Default, Args)]
pub struct FramingArgs {
    /// Place of the camera X,Y,Z, metres: z up from the floor, the middle of the motion at 0,0, its front at negative y. Without it,
    /// the camera stands in front, where it sees the person in every frame.
    #[arg(long, value_parser = parse_place, allow_hyphen_values = true)]
    pub eye: Option<DVec3>,
    /// Point X,Y,Z in the middle of the image, metres; the middle of the motion otherwise.
    #[arg(long, value_parser = parse_place, allow_hyphen_values = true)]
    pub target: Option<DVec3>,
    /// Degrees by which the camera walks around the target from the first frame to the last, counter-clockwise seen from above.
    #[arg(long, default_value_t = 0.0, value_parser = parse_turn, allow_hyphen_values = true)]
    pub turn: f64,
}

fn parse_place(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[x, y, z]) if [x, y, z].iter().all(|value| value.abs() <= 1000.0) => Ok(DVec3::new(x, y, z)),
        _ => Err(format!("'{text}' is not X,Y,Z in metres, like 2,-3,1.5")),
    }
}

fn parse_turn(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(degrees) if degrees.abs() <= 36_000.0 => Ok(degrees),
        _ => Err(format!("'{text}' is not a number of degrees between -36000 and 36000")),
    }
}

/// Boxes around the parts of a surface that each joint moves.
#[derive(Debug)]
pub(super) struct PartBoxes(Vec<(usize, [DVec3; 8])>);

impl PartBoxes {
    /// Returns the boxes of a surface.
    pub fn new(surface: &Template) -> Self {
        let mut bounds = vec![(DVec3::INFINITY, DVec3::NEG_INFINITY); surface.skeleton.joints().len()];
        for (place, skin) in surface.positions.iter().zip(&surface.skin).filter(|(place, _)| place.is_finite()) {
            if let Some((low, high)) = bounds.get_mut(usize::from(skin.joints[0])) {
                (*low, *high) = (low.min(place.as_dvec3()), high.max(place.as_dvec3()));
            }
        }
        let corner = |low: DVec3, high: DVec3, k: usize| {
            DVec3::from_array([0, 1, 2].map(|axis| if k >> axis & 1 == 0 { low[axis] } else { high[axis] }))
        };
        let boxes = bounds.iter().enumerate().filter(|(_, (low, high))| low.cmple(*high).all());
        Self(
            boxes
                .map(|(joint, (low, high))| (joint, [0, 1, 2, 3, 4, 5, 6, 7].map(|k| corner(*low, *high, k))))
                .collect(),
        )
    }

    /// Returns the corners in a pose, eight per box; world, metres.
    pub fn corners(&self, skeleton: &Skeleton, pose: &Pose) -> Vec<DVec3> {
        let world = skeleton.world_from_canonical(pose);
        self.0
            .iter()
            .flat_map(|(joint, corners)| corners.map(|corner| world[*joint].transform_point3(corner)))
            .collect()
    }
}

/// Camera that may walk around its target.
#[derive(Debug)]
pub(super) struct ClipView {
    size: [u32; 2],
    eye: DVec3,
    pub target: DVec3,
    turn_rad: f64,
    /// Distance of the farthest part of the person from the target, metres.
    pub reach_m: f64,
}

impl ClipView {
    /// Places the camera for a clip: the corners of the person's parts, frame by frame, in the world, metres.
    ///
    /// # Errors
    /// `--eye` and `--target` are the same place.
    pub fn new(args: &FramingArgs, size: [u32; 2], clip: &[Vec<DVec3>]) -> Result<Self> {
        let all = || clip.iter().flatten().copied().filter(|corner| corner.is_finite());
        let (low, high) = all().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), at| (a.min(at), b.max(at)));
        let middle = if low.cmple(high).all() { (low + high) * 0.5 } else { DVec3::Z };
        let target = args.target.unwrap_or(middle);
        let reach_m = all().map(|corner| corner.distance(target)).fold(0.0, f64::max);
        let towards = TOWARDS_EYE.normalize_or(DVec3::NEG_Y);
        let mut view = Self { size, eye: target + towards, target, turn_rad: args.turn.to_radians(), reach_m };
        view.eye = match args.eye {
            Some(eye) => {
                ensure!(eye.distance(target) > 1e-3, "--eye and --target are the same place; move one of them");
                eye
            }
            None => target + towards * view.distance_m(clip),
        };
        Ok(view)
    }

    /// Returns the distance from which the camera sees every frame's person in the frame's direction, metres.
    fn distance_m(&self, clip: &[Vec<DVec3>]) -> f64 {
        let mut distance_m = NEAREST_M;
        for (frame, corners) in clip.iter().enumerate() {
            let camera = self.camera(frame as f64 / clip.len() as f64);
            let half = (camera.intrinsics.center_px + 0.5) * FILLED / camera.intrinsics.focal_px;
            let rotation = camera.camera_from_world.rotation;
            for corner in corners.iter().filter(|corner| corner.is_finite()) {
                let at = rotation * (*corner - self.target);
                distance_m = distance_m.max((at.x.abs() / half.x).max(at.y.abs() / half.y) - at.z);
            }
        }
        distance_m
    }

    /// Returns the camera at a part of the clip, 0..1.
    pub fn camera(&self, part: f64) -> Camera {
        let [width, height] = self.size;
        let eye = self.target + DQuat::from_rotation_z(self.turn_rad * part) * (self.eye - self.target);
        Camera {
            id: "view".into(),
            intrinsics: Intrinsics::pinhole(width, height, FOCAL_HEIGHTS * f64::from(height)),
            camera_from_world: Isometry::look_at(eye, self.target, DVec3::Z),
            time_offset_nanos: 0,
            color: Default::default(),
        }
    }

    /// Returns the number of frames in which the middle of a part of the person is outside the image.
    pub fn cut_off(&self, clip: &[Vec<DVec3>]) -> usize {
        let is_cut = |(frame, corners): &(usize, &Vec<DVec3>)| {
            let camera = self.camera(*frame as f64 / clip.len() as f64);
            corners.chunks_exact(8).any(|corners| {
                let middle = corners.iter().sum::<DVec3>() / 8.0;
                let size = camera.size().map(f64::from);
                !camera.project(middle).is_some_and(|pixel| {
                    (-0.5..size[0] - 0.5).contains(&pixel.x) && (-0.5..size[1] - 0.5).contains(&pixel.y)
                })
            })
        };
        clip.iter().enumerate().filter(is_cut).count()
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use flyrig_body::{ShapeParams, default_template, skin_mesh};

    use super::{super::motion::DrivenMotion, *};

    fn clip(name: &str) -> (Template, DrivenMotion, Vec<Vec<DVec3>>) {
        let body = default_template(&ShapeParams::default()).unwrap();
        let motion = DrivenMotion::load(&body, Path::new(name)).unwrap();
        let boxes = PartBoxes::new(&body);
        let corners =
            (0..motion.frames()).map(|frame| boxes.corners(&body.skeleton, &motion.pose(frame))).collect::<Vec<_>>();
        (body, motion, corners)
    }

    #[test]
    fn every_vertex_of_every_frame_is_in_the_image_and_the_person_fills_it() {
        for name in ["walk", "jump", "lie", "cross-arms"] {
            let (body, motion, corners) = clip(name);
            for (size, turn) in [([512, 768], 0.0), ([640, 360], 0.0), ([512, 512], 360.0), ([512, 768], -75.0)] {
                let args = FramingArgs { turn, ..FramingArgs::default() };
                let view = ClipView::new(&args, size, &corners).unwrap();
                let mut filled = 0.0f64;
                for frame in (0..motion.frames()).step_by(5) {
                    let camera = view.camera(frame as f64 / motion.frames() as f64);
                    let half = camera.intrinsics.center_px + 0.5;
                    for place in skin_mesh(&body, &motion.pose(frame)).0 {
                        let pixel = camera.project(place.as_dvec3()).unwrap();
                        let off = (pixel - camera.intrinsics.center_px).abs() / half;
                        filled = filled.max(off.max_element());
                    }
                }
                // The boxes are larger than what is in them.
                assert!((0.6..=0.97).contains(&filled), "{name} {size:?} {turn}: {filled} of half the image");
                assert_eq!(view.cut_off(&corners), 0);
            }
        }
    }

    #[test]
    fn a_chosen_place_is_kept_and_what_it_cuts_off_is_counted() {
        let (_, _, corners) = clip("walk");
        let eye = DVec3::new(1.5, 2.0, 1.7);
        let args = |eye: DVec3, turn: f64| FramingArgs { eye: Some(eye), target: Some(DVec3::Z), turn };
        let view = ClipView::new(&args(eye, 180.0), [200, 300], &corners).unwrap();
        assert!(view.camera(0.0).position().distance(eye) < 1e-9);
        assert!(view.camera(1.0).position().distance(DVec3::new(-1.5, -2.0, 1.7)) < 1e-9);
        // Counter-clockwise from above.
        assert!(view.camera(0.5).position().x < -1.9);
        let cut = view.cut_off(&corners);
        assert!(cut > corners.len() / 4, "{cut} of {}", corners.len());
        let far = ClipView::new(&args(eye * 20.0, 0.0), [200, 300], &corners).unwrap();
        assert_eq!(far.cut_off(&corners), 0);
        let error = ClipView::new(&args(DVec3::Z, 0.0), [200, 300], &corners).unwrap_err().to_string();
        assert_eq!(error, "--eye and --target are the same place; move one of them");
        // Straight down from above, and a clip of nothing that is finite.
        let above = ClipView::new(&args(DVec3::Z * 9.0, 90.0), [200, 300], &corners).unwrap();
        assert!(above.camera(0.3).camera_from_world.is_finite());
        let nothing = ClipView::new(&FramingArgs::default(), [200, 300], &[vec![DVec3::NAN], vec![]]).unwrap();
        assert!(nothing.camera(0.0).position().is_finite());
    }

    #[test]
    fn places_and_turns_are_parsed() {
        assert_eq!(parse_place("-1, 2.5,0"), Ok(DVec3::new(-1.0, 2.5, 0.0)));
        assert!(
            ["", "1,2", "1,2,3,4", "1,2,nan", "1,2,inf", "1;2;3", "1e9,0,0"]
                .iter()
                .all(|bad| parse_place(bad).is_err())
        );
        assert_eq!(parse_turn("-90"), Ok(-90.0));
        assert!(["", "nan", "1e9", "full"].iter().all(|bad| parse_turn(bad).is_err()));
    }
}
