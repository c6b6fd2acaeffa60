//! Rendering with no more Gaussians than a camera's pixels resolve.

use flyrig_body::Part;
use flyrig_gpu::{GpuContext, GpuError};
use flyrig_types::{Camera, Pose, RenderedView};
use glam::DVec3;

use crate::model::avatar::Avatar;
use crate::model::posing::Bones;
use crate::model::scene::AvatarScene;

/// Distance below which Gaussians are merged, pixels.
const FINE_PX: f64 = 0.8;
/// Largest number of halvings, and least number of Gaussians that is halved.
const MOST_LEVELS: usize = 5;
const LEAST_GAUSSIANS: usize = 2000;
/// Largest depth of the surface before the joints, metres.
const AROUND_JOINTS_M: f64 = 0.2;

/// Renderer of one avatar that uses fewer Gaussians in small images.
#[derive(Debug)]
pub struct DetailedScene {
    gpu: GpuContext,
    /// Levels from the finest on; coarser ones are created on demand.
    levels: Vec<Level>,
    is_detailed: bool,
    /// Bones and translations of the graph's nodes.
    posed: Option<(Bones, Option<Vec<DVec3>>)>,
    /// World positions of the joints, metres.
    joints: Vec<DVec3>,
    /// Level of the last view.
    drawn: usize,
}

#[derive(Debug)]
struct Level {
    avatar: Avatar,
    scene: AvatarScene,
    spacing_m: f64,
    is_posed: bool,
}

impl Level {
    fn new(gpu: &GpuContext, avatar: Avatar) -> Result<Self, GpuError> {
        let spacing_m = (avatar.template.area_m2() / avatar.gaussians().max(1) as f64).sqrt();
        Ok(Self { scene: AvatarScene::new(gpu, &avatar)?, avatar, spacing_m, is_posed: false })
    }
}

impl DetailedScene {
    /// Takes an avatar. Without `is_detailed` every view is rendered with all Gaussians.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, avatar: Avatar, is_detailed: bool) -> Result<Self, GpuError> {
        let levels = vec![Level::new(gpu, avatar)?];
        Ok(Self { gpu: gpu.clone(), levels, is_detailed, posed: None, joints: Vec::new(), drawn: 0 })
    }

    /// Returns the avatar with all Gaussians.
    #[must_use]
    pub fn avatar(&self) -> &Avatar {
        &self.levels[0].avatar
    }

    /// Poses the avatar for the following views; `translations` as in [`Avatar::pose`].
    pub fn pose(&mut self, pose: &Pose, translations: Option<&[DVec3]>) {
        let skeleton = &self.levels[0].avatar.template.skeleton;
        self.joints = skeleton.world_from_joint(pose).iter().map(|joint| joint.w_axis.truncate()).collect();
        self.posed = Some((Bones::new(skeleton, pose), translations.map(<[DVec3]>::to_vec)));
        self.levels.iter_mut().for_each(|level| level.is_posed = false);
    }

    /// Renders the avatar from a camera at its image size, straight alpha. The image is empty before the first pose.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        self.drawn = self.level_for(camera)?;
        let level = &mut self.levels[self.drawn];
        if let Some((bones, translations)) = self.posed.as_ref().filter(|_| !level.is_posed) {
            level.scene.pose(&level.avatar, bones, translations.as_deref());
            level.is_posed = true;
        }
        level.scene.draw(camera)
    }

    /// Returns the coarsest level whose Gaussians lie closer than the nearest pixels of a camera.
    fn level_for(&mut self, camera: &Camera) -> Result<usize, GpuError> {
        if !self.is_detailed {
            return Ok(0);
        }
        let depths =
            self.joints.iter().map(|joint| camera.camera_from_world.transform_point(*joint).z - AROUND_JOINTS_M);
        let depth_m = depths.fold(f64::INFINITY, f64::min);
        let allowed_m = FINE_PX * depth_m / camera.intrinsics.focal_px.max_element();
        if !allowed_m.is_finite() || allowed_m <= 0.0 {
            return Ok(0);
        }
        let mut level = 0;
        while level < MOST_LEVELS {
            if self.levels.len() == level + 1 {
                let finer = &self.levels[level].avatar;
                // About half as many: not made unless it is likely to be drawn.
                if finer.gaussians() < LEAST_GAUSSIANS || self.levels[level].spacing_m * 1.3 > allowed_m {
                    break;
                }
                let coarser = Level::new(&self.gpu, finer.coarser())?;
                self.levels.push(coarser);
            }
            if self.levels[level + 1].spacing_m > allowed_m {
                break;
            }
            level += 1;
        }
        Ok(level)
    }

    /// Computes [`AvatarScene::part_box`] with the Gaussians of the last view.
    #[must_use]
    pub fn part_box(&self, parts: &[Part], camera: &Camera, margin_px: f64) -> Option<[u32; 4]> {
        let level = &self.levels[self.drawn];
        level.scene.part_box(&level.avatar, parts, camera, margin_px)
    }

    /// Returns the number of Gaussians of the last view, and how many of them were skipped as back-facing.
    #[must_use]
    pub fn drawn(&self) -> (usize, usize) {
        let level = &self.levels[self.drawn];
        (level.avatar.gaussians(), level.scene.hidden())
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;
    use crate::model::avatar::tests::small;

    fn camera(pixels: u32, away_m: f64) -> Camera {
        Camera {
            id: "view".into(),
            intrinsics: Intrinsics::pinhole(pixels, pixels, 1.4 * f64::from(pixels)),
            camera_from_world: Isometry::look_at(DVec3::new(0.0, 0.9, away_m), DVec3::new(0.0, 0.9, 0.0), DVec3::Y),
            time_offset_nanos: 0,
            color: Default::default(),
        }
    }

    /// Returns the means over squares of `side` pixels of sRGB times coverage, 0..=255.
    fn average(view: &RenderedView, side: usize) -> Vec<f64> {
        let columns = view.width as usize / side;
        let mut means = vec![0.0; columns * (view.height as usize / side) * 3];
        for (at, pixel) in view.rgba.chunks_exact(4).enumerate() {
            let (x, y) = (at % view.width as usize / side, at / view.width as usize / side);
            let share = f64::from(pixel[3]) / 255.0 / (side * side) as f64;
            (0..3).for_each(|k| means[(y * columns + x) * 3 + k] += share * f64::from(pixel[k]));
        }
        means
    }

    fn decibels(view: &RenderedView, wanted: &[f64]) -> f64 {
        let found = average(view, 1);
        let squares = found.iter().zip(wanted).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
        10.0 * (255.0 * 255.0 * found.len() as f64 / squares.max(1e-6)).log10()
    }

    #[test]
    fn small_images_get_fewer_gaussians_and_look_the_same() {
        let mut avatar = small(12_000, 7);
        let order = avatar.parameters.order();
        // Stripes of a hand's width.
        for (i, place) in avatar.places.iter().enumerate() {
            let value = if (place.y * 10.0).fract() < 0.5 { 0.6 } else { 0.2 };
            avatar.parameters.harmonics[i * order.coefficients()] = [value, value, 1.0, 0.0];
        }
        let gpu = flyrig_gpu::testing::device().on_processor();
        let pose = avatar.template.skeleton.rest_pose();
        let mut all = DetailedScene::new(&gpu, avatar.clone(), false).unwrap();
        let mut some = DetailedScene::new(&gpu, avatar, true).unwrap();
        all.pose(&pose, None);
        some.pose(&pose, None);
        let reference = all.draw(&camera(768, 3.6)).unwrap();
        let mut before = usize::MAX;
        for (pixels, levels) in [(768, 0..1), (96, 1..4), (48, 2..6)] {
            let camera = camera(pixels, 3.6);
            let wanted = average(&reference, 768 / pixels as usize);
            let [expected, found] = [&mut all, &mut some].map(|scene| decibels(&scene.draw(&camera).unwrap(), &wanted));
            assert_eq!(all.drawn().0, 12_000);
            let (drawn, _) = some.drawn();
            assert!(levels.contains(&some.drawn) && drawn < before, "{pixels} {drawn} level {}", some.drawn);
            before = drawn;
            // Merged ones are the better mean of a pixel.
            assert!(found > expected - 0.1, "{pixels}: {found} {expected}");
        }
        // Back to the large image: the finest level is still posed.
        assert_eq!(all.draw(&camera(768, 3.6)).unwrap().rgba, some.draw(&camera(768, 3.6)).unwrap().rgba);
    }

    #[test]
    fn behind_the_camera_and_before_the_first_pose_nothing_is_there() {
        let gpu = flyrig_gpu::testing::device().on_processor();
        let avatar = small(3000, 7);
        let pose = avatar.template.skeleton.rest_pose();
        let mut scene = DetailedScene::new(&gpu, avatar, true).unwrap();
        let is_empty = |view: &RenderedView| view.rgba.chunks_exact(4).all(|pixel| pixel[3] == 0);
        assert!(is_empty(&scene.draw(&camera(64, 3.0)).unwrap()));
        scene.pose(&pose, None);
        assert!(!is_empty(&scene.draw(&camera(64, 3.0)).unwrap()));
        let mut behind = camera(64, -3.0);
        behind.camera_from_world = Isometry::look_at(DVec3::new(0.0, 0.9, 3.0), DVec3::new(0.0, 0.9, 9.0), DVec3::Y);
        assert!(is_empty(&scene.draw(&behind).unwrap()));
        assert_eq!(scene.drawn().0, 3000);
        // A pose that is not finite.
        let mut lost = pose;
        lost.root_translation = DVec3::NAN;
        scene.pose(&lost, None);
        assert!(is_empty(&scene.draw(&camera(64, 3.0)).unwrap()));
    }
}
