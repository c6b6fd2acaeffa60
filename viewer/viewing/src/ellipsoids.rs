//! Anisotropic Gaussians of people, at least one of whom is an avatar.

use flyrig_stream::PosedAxes;
use glam::{Vec3, Vec4};

/// Cosine between normal and line of sight above which an isotropic Gaussian is not drawn; as on the rig.
pub const BACKFACING_COSINE: f32 = 0.35;
/// Cosine above which a Gaussian of an avatar is not drawn, as in `flyrig avatar render`: its opacity is below 1, so that the far side
/// would show through.
const AVATAR_BACKFACING_COSINE: f32 = 0.7;

/// Returns whether a surface with this normal, of any length, faces away along a line of sight; false for non-finite numbers.
#[must_use]
pub fn faces_away(normal: Vec3, sight: Vec3, cosine: f32) -> bool {
    let along = normal.dot(sight);
    along > 0.0 && along * along > cosine * cosine * normal.length_squared() * sight.length_squared()
}

/// Shapes of the Gaussians of all people, one person after the other; the owner keeps centres and normals in the same order.
#[derive(Debug, Clone, Default)]
pub struct Ellipsoids {
    scale_opacity: Vec<[f32; 4]>,
    rotation: Vec<[f32; 4]>,
    /// Cosine above which each Gaussian faces away.
    backfacing: Vec<f32>,
    seen: Vec<[f32; 4]>,
}

impl Ellipsoids {
    /// Removes all people; memory is kept.
    pub fn clear(&mut self) {
        [&mut self.scale_opacity, &mut self.rotation, &mut self.seen].into_iter().for_each(Vec::clear);
        self.backfacing.clear();
    }

    /// Returns whether there are no people.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rotation.is_empty()
    }

    /// Appends a person with as many Gaussians as `center_scale` and `colors` (linear RGB, opacity) both have: an avatar with its axes,
    /// others, and an avatar with fewer axes, as spheres. A Gaussian whose colour is not finite is not drawn.
    pub fn push(&mut self, center_scale: &[[f32; 4]], colors: &[[f32; 4]], axes: Option<&PosedAxes>) {
        let rows = center_scale.iter().zip(colors);
        let count = rows.len();
        let axes = axes.filter(|axes| axes.scale_opacity.len() >= count && axes.rotation.len() >= count);
        let cosine = if axes.is_some() { AVATAR_BACKFACING_COSINE } else { BACKFACING_COSINE };
        self.backfacing.resize(self.backfacing.len() + count, cosine);
        for (i, (&[.., scale], &color)) in rows.enumerate() {
            let mut shape = axes.map_or([scale, scale, scale, color[3]], |axes| axes.scale_opacity[i]);
            if !Vec4::from(color).is_finite() {
                shape[3] = 0.0;
            }
            self.scale_opacity.push(shape);
            self.rotation.push(axes.map_or([0.0, 0.0, 0.0, 1.0], |axes| axes.rotation[i]));
        }
    }

    /// Returns the unit quaternion x, y, z, w of each Gaussian: world from its axes.
    #[must_use]
    pub fn rotations(&self) -> &[[f32; 4]] {
        &self.rotation
    }

    /// Computes the standard deviations along the axes, metres, and the opacity of each Gaussian for an eye: 0 for one that faces away.
    /// `centers` (metres, world) and `normals` match the Gaussians of [`Self::push`]; their fourth components are ignored.
    pub fn seen_from(&mut self, eye: Vec3, centers: &[[f32; 4]], normals: &[[f32; 4]]) -> &[[f32; 4]] {
        self.seen.clone_from(&self.scale_opacity);
        let rows = self.seen.iter_mut().zip(&self.backfacing).zip(centers.iter().zip(normals));
        rows.for_each(|((shape, cosine), (center, normal))| {
            if faces_away(Vec3::from_slice(normal), Vec3::from_slice(center) - eye, *cosine) {
                shape[3] = 0.0;
            }
        });
        &self.seen
    }

    /// Returns the result of the last [`Self::seen_from`].
    #[must_use]
    pub fn seen(&self) -> &[[f32; 4]] {
        &self.seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn those_that_face_away_have_no_opacity_as_in_plain_arithmetic() {
        let mut state = 7u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / u32::MAX as f32 - 0.5
        };
        let mut rows =
            |count: usize, w: f32| -> Vec<[f32; 4]> { (0..count).map(|_| [random(), random(), random(), w]).collect() };
        let (centers, normals, colors) = (rows(3000, 0.01), rows(3000, 0.0), rows(3000, 0.8));
        let axes = PosedAxes { scale_opacity: rows(1000, 0.6), rotation: rows(1000, 0.5) };
        let mut shapes = Ellipsoids::default();
        shapes.push(&centers[..2000], &colors[..2000], None);
        shapes.push(&centers[2000..], &colors[2000..], Some(&axes));
        assert_eq!(shapes.rotations()[1999..2001], [[0.0, 0.0, 0.0, 1.0], axes.rotation[0]]);
        let eye = Vec3::new(0.3, -2.0, 0.4);
        shapes.seen_from(eye, &centers, &normals);
        let mut hidden = [0, 0];
        for (i, shape) in shapes.seen().iter().enumerate() {
            let [center, normal] = [centers[i], normals[i]].map(|row| Vec4::from(row).truncate().as_dvec3());
            let sight = center - eye.as_dvec3();
            let cosine = normal.dot(sight) / normal.length() / sight.length();
            let is_avatar = i >= 2000;
            let limit = if is_avatar { 0.7 } else { 0.35 };
            let whole = if is_avatar { axes.scale_opacity[i - 2000] } else { [0.01, 0.01, 0.01, 0.8] };
            assert_eq!(shape[..3], whole[..3]);
            if (cosine - limit).abs() > 1e-5 {
                let opacity = if cosine > limit { 0.0 } else { whole[3] };
                assert_eq!(shape[3].to_bits(), opacity.to_bits(), "{i}: {cosine}");
                hidden[usize::from(is_avatar)] += usize::from(cosine > limit);
            }
        }
        assert!(hidden[0] > 500 && hidden[1] > 100, "{hidden:?}");
        shapes.clear();
        assert!(shapes.is_empty() && shapes.seen_from(eye, &centers, &normals).is_empty());
    }

    #[test]
    fn poisoned_and_short_lists_do_no_harm() {
        let row = [0.0, 0.0, 0.0, 0.01];
        let red = [1.0, 0.0, 0.0, 1.0];
        let short = PosedAxes { scale_opacity: vec![[0.5; 4]], rotation: vec![] };
        let mut shapes = Ellipsoids::default();
        shapes.push(&[row; 3], &[red, [f32::NAN, 0.0, 0.0, 1.0]], Some(&short));
        assert_eq!(shapes.rotations(), [[0.0, 0.0, 0.0, 1.0]; 2], "fewer axes than Gaussians count as none");
        let away = [0.0, 1.0, 0.0, 0.0];
        let eye = Vec3::NEG_Y;
        let bits = |seen: &[[f32; 4]]| seen.iter().map(|row| row.map(f32::to_bits)).collect::<Vec<_>>();
        // The second has a colour that is not finite.
        let (whole, hidden) = ([0.01, 0.01, 0.01, 1.0], [0.01, 0.01, 0.01, 0.0]);
        assert_eq!(bits(shapes.seen_from(eye, &[row; 2], &[[0.0; 4], away])), bits(&[whole, hidden]));
        assert_eq!(bits(shapes.seen_from(eye, &[row], &[away])), bits(&[hidden, hidden]));
        assert_eq!(bits(shapes.seen_from(Vec3::NAN, &[row], &[away])), bits(&[whole, hidden]));
        assert_eq!(shapes.seen_from(eye, &[row], &[[f32::INFINITY; 4]]).len(), 2);
    }
}
