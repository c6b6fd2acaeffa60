//! Drawing order of Gaussians.

use flyrig_types::Camera;
use flyrig_viewing::{BACKFACING_COSINE, faces_away};
use glam::{DVec3, Vec3, Vec4};

/// Least depth of a Gaussian's centre that is drawn, metres; as on the rig.
const NEAR_M: f32 = 0.05;
/// Steps of depth; Gaussians within one keep their order.
const STEPS: usize = 1 << 16;

/// Indices of the Gaussians that a camera sees, farthest first; memory is kept from one image to the next.
#[derive(Debug, Default)]
pub struct DrawOrder {
    seen: Vec<(u32, f32)>,
    starts: Vec<u32>,
    order: Vec<u32>,
}

impl DrawOrder {
    /// Sorts isotropic Gaussians as [`Self::sort_shown`]; those that face away or have a non-finite normal are left out.
    pub fn sort(&mut self, camera: &Camera, center_scale: &[[f32; 4]], normals: &[[f32; 4]]) -> &[u32] {
        let count = center_scale.len().min(normals.len());
        self.sort_shown(camera, &center_scale[..count], |index, sight| {
            let normal = Vec3::from_slice(&normals[index]);
            normal.is_finite() && !faces_away(normal, sight, BACKFACING_COSINE)
        })
    }

    /// Sorts by depth, to 1/65536 of the depth range of the scene, the Gaussians that `is_shown` accepts by their index and the line of sight
    /// to their centre. Gaussians behind the camera or with non-finite numbers are left out.
    pub fn sort_shown(
        &mut self,
        camera: &Camera,
        center_scale: &[[f32; 4]],
        is_shown: impl Fn(usize, Vec3) -> bool,
    ) -> &[u32] {
        let eye = camera.position().as_vec3();
        let ahead = (camera.camera_from_world.rotation.inverse() * DVec3::Z).as_vec3();
        self.seen.clear();
        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
        for (index, center) in center_scale.iter().enumerate() {
            let center = Vec4::from(*center);
            let sight = center.truncate() - eye;
            let depth = sight.dot(ahead);
            if center.is_finite() && center.w > 0.0 && depth >= NEAR_M && is_shown(index, sight) {
                (least, most) = (least.min(depth), most.max(depth));
                self.seen.push((index as u32, depth));
            }
        }
        let by = (STEPS - 1) as f32 / (most - least).max(1e-6);
        let step = |depth: f32| (((most - depth) * by) as usize).min(STEPS - 1);
        self.starts.clear();
        self.starts.resize(STEPS, 0);
        for (_, depth) in &self.seen {
            self.starts[step(*depth)] += 1;
        }
        let mut sum = 0;
        for start in &mut self.starts {
            sum += std::mem::replace(start, sum);
        }
        self.order.clear();
        self.order.resize(self.seen.len(), 0);
        for (index, depth) in &self.seen {
            let at = &mut self.starts[step(*depth)];
            self.order[*at as usize] = *index;
            *at += 1;
        }
        &self.order
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;

    fn camera() -> Camera {
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: "view".into(),
            intrinsics: Intrinsics::pinhole(640, 480, 500.0),
            camera_from_world: Isometry::look_at(DVec3::new(0.0, -3.0, 1.0), DVec3::new(0.0, 0.0, 1.0), DVec3::Z),
        }
    }

    #[test]
    fn the_farthest_come_first_as_in_a_plain_sort() {
        let mut state = 7u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / u32::MAX as f32 - 0.5
        };
        let centers: Vec<[f32; 4]> = (0..5000).map(|_| [random(), random(), 1.0 + random(), 0.005]).collect();
        let normals: Vec<[f32; 4]> = (0..5000).map(|_| [random(), random(), random(), 0.0]).collect();
        let camera = camera();
        let mut order = DrawOrder::default();
        let found = order.sort(&camera, &centers, &normals).to_vec();
        // f64, without shortcuts.
        let eye = camera.position();
        let depth =
            |i: u32| camera.camera_from_world.transform_point(Vec4::from(centers[i as usize]).truncate().as_dvec3()).z;
        let faces = |i: &u32| {
            let normal = Vec4::from(normals[*i as usize]).truncate().as_dvec3();
            let sight = Vec4::from(centers[*i as usize]).truncate().as_dvec3() - eye;
            normal.dot(sight) <= f64::from(BACKFACING_COSINE) * normal.length() * sight.length()
        };
        let expected = (0..5000u32).filter(faces).count();
        assert!(found.len().abs_diff(expected) <= 1, "{} of {expected}", found.len());
        for pair in found.windows(2) {
            assert!(depth(pair[0]) >= depth(pair[1]) - 4e-5, "{} before {}", depth(pair[0]), depth(pair[1]));
        }
    }

    #[test]
    fn poisoned_gaussians_are_left_out() {
        let good = [0.0, 0.0, 1.0, 0.01];
        let toward = [0.0, -1.0, 0.0, 0.0];
        let centers = [
            good,
            [f32::NAN, 0.0, 1.0, 0.01],
            [0.0, f32::INFINITY, 1.0, 0.01],
            [0.0, -9.0, 1.0, 0.01],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 1.0, f32::NAN],
            good,
            good,
        ];
        let mut normals = [toward; 8];
        normals[6] = [0.0, 1.0, 0.0, 0.0];
        normals[7] = [f32::NAN, 0.0, 0.0, 0.0];
        let mut order = DrawOrder::default();
        assert_eq!(order.sort(&camera(), &centers, &normals), [0]);
        assert_eq!(order.sort(&camera(), &[], &[]), [0u32; 0]);
        assert_eq!(order.sort(&camera(), &[good, good], &[toward, toward]), [0, 1], "equal depths");
    }
}
