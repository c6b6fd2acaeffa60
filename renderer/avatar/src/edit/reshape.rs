//! Change of an avatar's shape (LoGAvatar, section 5.4).

use flyrig_body::{PointGrid, ShapeParams, Template};
use glam::{Mat3, Quat, Vec3};

use crate::error::AvatarError;
use crate::model::avatar::{Attachment, Avatar};

/// First search radius for the vertex of a graph node, which lies on the surface, metres; doubled until one is found.
const NEAR_M: f32 = 0.02;

impl Avatar {
    /// Changes the body's shape: see [`Template::reshape`] for the targets and their accuracy. Gaussians move, turn and
    /// grow with the triangles that they are attached to; colours are unchanged.
    ///
    /// # Errors
    /// [`AvatarError::Body`] for unknown targets, weights out of range, and bodies whose shape cannot be edited.
    pub fn reshape(&mut self, change: &ShapeParams) -> Result<(), AvatarError> {
        let new = self.template.reshape(change)?;
        // Joints that are placed by the mesh have one place for both.
        let reshape = |body: &Template| {
            body.reshape(change).map(|under| Template { skeleton: new.template.skeleton.clone(), ..under.template })
        };
        let undressed = self.undressed.as_ref().map(reshape).transpose()?;
        for i in 0..self.places.len() {
            let attachment = self.attachments[i];
            let at = |template: &Template| attachment.blend(template, &template.positions);
            let (old_point, new_point) = (at(&self.template), at(&new.template));
            let (turn, growth) = change_of(&self.template, &new.template, attachment);
            self.places[i] = new_point + turn * (self.places[i] - old_point);
            let Self { parameters, .. } = self;
            let [x, y, z, w] = parameters.offset[i];
            parameters.offset[i] = (turn * Vec3::new(x, y, z)).extend(w).to_array();
            parameters.shape[i][..3].iter_mut().for_each(|logarithm| *logarithm += growth.ln());
            parameters.rotation[i] = (turn * Quat::from_array(parameters.rotation[i])).to_array();
        }
        if let Some(hanging) = &mut self.hanging {
            let grid = PointGrid::new(&self.template.positions, NEAR_M);
            for node in &mut hanging.nodes {
                *node += displacement_near(&grid, *node, &new.displacement);
            }
        }
        self.template = new.template;
        self.undressed = undressed;
        Ok(())
    }
}

/// Returns the displacement of the vertex nearest to a point; zero without one within a metre.
fn displacement_near(grid: &PointGrid, point: Vec3, displacement: &[Vec3]) -> Vec3 {
    let mut radius = NEAR_M;
    while radius < 1.0 {
        let mut best = (f32::INFINITY, Vec3::ZERO);
        grid.within(point, radius, |i, squared| {
            if squared < best.0 {
                best = (squared, displacement[i]);
            }
        });
        if best.0.is_finite() {
            return best.1;
        }
        radius *= 2.0;
    }
    Vec3::ZERO
}

/// Returns the rotation of a triangle, and the growth of the side of a square on it.
fn change_of(old: &Template, new: &Template, attachment: Attachment) -> (Quat, f32) {
    let frame = |template: &Template| {
        let [a, b, c] = template.triangles[attachment.triangle as usize].map(|i| template.positions[i as usize]);
        let normal = (b - a).cross(c - a);
        let along = (b - a).try_normalize()?;
        let up = normal.try_normalize()?;
        Some((Mat3::from_cols(along, up.cross(along), up), normal.length()))
    };
    match (frame(old), frame(new)) {
        (Some((from, small)), Some((to, large))) => {
            (Quat::from_mat3(&(to * from.transpose())).normalize(), (large / small).sqrt().clamp(0.2, 5.0))
        }
        // A triangle without an area.
        _ => (Quat::IDENTITY, 1.0),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use flyrig_body::{Skirt, default_template, sample_surface};
    use flyrig_renderer::HarmonicOrder;

    use super::*;
    use crate::model::avatar::tests::small;

    #[test]
    fn gaussians_lie_where_those_of_the_other_shape_would() {
        let change = ShapeParams::default().with("age", 0.1).with("upperarm-scale-vert", 0.7);
        let mut avatar = small(3000, 50);
        let before = avatar.clone();
        avatar.reshape(&change).unwrap();
        let expected = default_template(&change).unwrap();
        let mut most = 0.0f32;
        for (i, attachment) in avatar.attachments.iter().enumerate() {
            most = most.max(avatar.places[i].distance(attachment.blend(&expected, &expected.positions)));
        }
        assert!(most < 1e-5, "{most}");
        // Where the surface shrinks, Gaussians do: as those sampled anew.
        let anew = sample_surface(&expected, 3000, 5).unwrap();
        let mean = |avatar: &Avatar| avatar.parameters.shape.iter().map(|row| row[0]).sum::<f32>() / 3000.0;
        let expected_growth = anew.scale_m.iter().map(|scale| scale.ln()).sum::<f32>() / 3000.0 - mean(&before);
        assert!(expected_growth < -0.03, "{expected_growth}");
        assert!(((mean(&avatar) - mean(&before)) / expected_growth - 1.0).abs() < 0.3, "{expected_growth}");
        assert!(
            avatar
                .hanging
                .as_ref()
                .unwrap()
                .nodes
                .iter()
                .zip(&before.hanging.as_ref().unwrap().nodes)
                .any(|(a, b)| a.distance(*b) > 0.01)
        );
        avatar.check().unwrap();
    }

    #[test]
    fn the_body_below_a_skirt_changes_with_it() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let dressed = Skirt { length: 0.6, flare: 0.2 }.on(&body).unwrap();
        let surface = sample_surface(&dressed, 500, 5).unwrap();
        let mut avatar = Avatar::new(&dressed, &surface, None, &[], HarmonicOrder::Zero).unwrap();
        avatar.undressed = Some(body);
        // Vertices of the skirt are those that the body does not have.
        let shared = |avatar: &Avatar| {
            let bits = |place: &Vec3| place.to_array().map(f32::to_bits);
            let own: HashSet<_> = avatar.undressed.as_ref().unwrap().positions.iter().map(bits).collect();
            avatar.template.positions.iter().map(|place| own.contains(&bits(place))).collect::<Vec<_>>()
        };
        let before = shared(&avatar);
        assert!(before.contains(&true) && before.contains(&false));
        avatar.reshape(&ShapeParams::default().with("age", 0.1)).unwrap();
        assert_eq!(shared(&avatar), before);
        assert!(Avatar::from_bytes(&avatar.to_bytes().unwrap()).unwrap() == avatar);
    }

    #[test]
    fn no_change_changes_little_and_unknown_targets_nothing() {
        let mut avatar = small(500, 20);
        let before = avatar.clone();
        assert!(avatar.reshape(&ShapeParams::default().with("stomach", 1.0)).is_err());
        assert!(avatar == before);
        avatar.reshape(&ShapeParams::default()).unwrap();
        for i in 0..500 {
            assert!(avatar.places[i].distance(before.places[i]) < 1e-6);
            assert!((avatar.parameters.shape[i][0] - before.parameters.shape[i][0]).abs() < 1e-5);
        }
    }
}
