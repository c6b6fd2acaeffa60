//! Surface that posed Gaussians draw, as oriented points.

use glam::{Quat, Vec3};

use crate::model::posing::PosedAvatar;

/// Distance of the drawn surface beyond the centres of an avatar's Gaussians, in their deviations along its normal: an avatar's Gaussians
/// begin so far below the template's surface, and fitted ones are unbiased there (docs/benchmarks/mesh.md).
pub const DRAWN_BEYOND: f32 = 3.4;

/// Gaussian as a piece of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Centre, metres.
    pub center: Vec3,
    /// Unit normal of the surface that the Gaussian is attached to, outwards; zero for a poisoned one.
    pub normal: Vec3,
    /// Standard deviation along the normal, metres.
    pub thickness_m: f32,
    /// Opacity, 0..=1.
    pub opacity: f32,
}

impl SurfacePoint {
    /// Returns the point of the drawn surface above the centre, `beyond` deviations away, metres.
    #[must_use]
    pub fn drawn(&self, beyond: f32) -> Vec3 {
        self.center + self.normal * (beyond * self.thickness_m)
    }
}

impl PosedAvatar {
    /// Returns how far the centres usually lie below the surface that the Gaussians draw, metres: the median; 0 without a finite one.
    #[must_use]
    pub fn below_surface_m(&self) -> f32 {
        let depths = self.surface_points().map(|point| DRAWN_BEYOND * point.thickness_m);
        let mut depths: Vec<f32> = depths.filter(|depth| depth.is_finite()).collect();
        if depths.is_empty() {
            return 0.0;
        }
        let middle = depths.len() / 2;
        *depths.select_nth_unstable_by(middle, f32::total_cmp).1
    }

    /// Returns the Gaussians as pieces of a surface, in their order. The surface that is drawn lies some deviations beyond the centres
    /// ([`SurfacePoint::thickness_m`]): an outline ends where alpha falls to one half.
    pub fn surface_points(&self) -> impl Iterator<Item = SurfacePoint> + '_ {
        let rows = self.center.iter().zip(&self.scale_opacity).zip(&self.rotation).zip(self.normals());
        rows.map(|(((center, [x, y, z, opacity]), rotation), normal)| {
            let turn = Quat::from_array(*rotation).normalize();
            let along = turn.inverse() * normal * Vec3::new(*x, *y, *z);
            SurfacePoint {
                center: Vec3::new(center[0], center[1], center[2]),
                normal,
                thickness_m: along.length(),
                opacity: *opacity,
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template, sample_surface};
    use flyrig_renderer::HarmonicOrder;

    use super::*;
    use crate::{Avatar, Bones};

    #[test]
    fn an_avatar_begins_with_the_surface_of_its_template() {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, 20_000, 5).unwrap();
        let inset = surface.inset();
        let mut avatar = Avatar::new(&template, &inset, None, &[], HarmonicOrder::Zero).unwrap();
        let points = |avatar: &Avatar| {
            let mut posed = PosedAvatar::default();
            avatar.pose(&Bones::at_rest(&template.skeleton), None, &mut posed);
            posed.surface_points().collect::<Vec<SurfacePoint>>()
        };
        let mut off: Vec<f32> = points(&avatar)
            .iter()
            .zip(&surface.positions)
            .map(|(point, place)| point.drawn(DRAWN_BEYOND).distance(*place))
            .collect();
        off.sort_by(f32::total_cmp);
        // Thin parts keep less of their depth.
        assert!(off[off.len() / 2] < 1e-4 && off[off.len() * 9 / 10] < 3e-3, "{}", off[off.len() * 9 / 10]);
        // A Gaussian that is turned by 90 degrees shows its long side along the normal.
        let flat = points(&avatar)[7].thickness_m;
        let turned =
            Quat::from_array(avatar.parameters.rotation[7]) * Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
        avatar.parameters.rotation[7] = turned.to_array();
        let upright = points(&avatar)[7].thickness_m;
        assert!((upright / flat - 2.0).abs() < 1e-3, "{upright} {flat}");
        // The usual depth is that of most of them.
        let mut posed = PosedAvatar::default();
        avatar.pose(&Bones::at_rest(&template.skeleton), None, &mut posed);
        assert!((posed.below_surface_m() / (DRAWN_BEYOND * flat) - 1.0).abs() < 0.3, "{}", posed.below_surface_m());
        assert!(PosedAvatar::default().below_surface_m().abs() <= 0.0);
        // A poisoned one is no finite point.
        avatar.parameters.rotation[7] = [f32::NAN; 4];
        assert!(!points(&avatar)[7].drawn(DRAWN_BEYOND).is_finite());
    }
}
