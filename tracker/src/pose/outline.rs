//! Matches of the posed body's outline with the outline of a mask.
//!
//! Rim vertices (normal across the line of sight, body ends beside them) are thinned to one per cell and matched with the
//! nearest end of the mask along the outline's normal.

use flyrig_body::Template;
use flyrig_types::{Camera, Mask};
use glam::{DVec2, DVec3, Vec3};

use crate::image::view::View;
use crate::masks::gate::{BodyGate, drawn_body};
use crate::pose::body_model::BodyModel;
use crate::pose::line_point::{LineKind, LinePoint, bones, is_usable, undistorted_line};

/// Largest sine of the angle between a rim vertex's normal and the image plane.
const RIM_SINE: f64 = 0.4;
/// Spacing of the chosen rim points, metres at the body.
const SPACING_M: f64 = 0.025;
/// Distances outside a rim point at which the image must not show the body, pixels.
const CLEAR_PX: [f64; 2] = [2.5, 5.0];

/// Posed body in front of a camera.
pub(crate) struct SeenBody<'a> {
    pub camera: &'a Camera,
    pub view: &'a View,
    pub template: &'a Template,
    pub model: &'a BodyModel,
    /// World positions and normals of the template's vertices at the image's time.
    pub vertices: &'a [Vec3],
    pub normals: &'a [Vec3],
    /// Gate in which these vertices are already drawn; without one, they are drawn here.
    pub gate: Option<&'a BodyGate>,
}

impl SeenBody<'_> {
    /// Matches points on the body's outline with the mask's within `reach_m` metres along the outline's normal. Ends of the
    /// mask at the image's border are ignored. `sigma_m` is the standard deviation of the distance, metres.
    pub fn match_mask(&self, mask: &Mask, view: usize, reach_m: f64, sigma_m: f64) -> Vec<LinePoint> {
        let own;
        let (bounds, grid, is_body): (_, _, fn(f32) -> bool) = match self.gate {
            Some(gate) => (gate.bounds, &gate.distance, |distance| distance <= 0.0),
            None => {
                let Some(drawn) = drawn_body(self.camera, self.vertices, &self.template.triangles, 8.0) else {
                    return Vec::new();
                };
                own = drawn;
                (own.0, &own.1, |value| value > 0.5)
            }
        };
        let eye = self.view.center();
        let drawn = |at: DVec2| {
            let (x, y) = (at.x.round() - bounds[0] as f64, at.y.round() - bounds[1] as f64);
            let inside = x >= 0.0 && y >= 0.0 && (x as usize) < grid.width && (y as usize) < grid.height;
            inside && is_body(grid.values[y as usize * grid.width + x as usize])
        };
        // One point per cell, so that dense parts of the mesh (face, hands) do not outweigh the others.
        let mut cells: std::collections::BTreeMap<(i64, i64), (f64, usize, DVec2, DVec2)> = Default::default();
        let (width, height) = (f64::from(mask.width()), f64::from(mask.height()));
        for (vertex, (position, normal)) in self.vertices.iter().zip(self.normals).enumerate() {
            let (position, normal) = (position.as_dvec3(), normal.as_dvec3());
            let sine = normal.dot((position - eye).normalize_or_zero()).abs();
            if sine.is_nan() || sine >= RIM_SINE {
                continue;
            }
            let Some(px_per_m) = self.view.px_per_m(position) else { continue };
            let (Some(at), Some(out)) = (self.camera.project(position), self.camera.project(position + normal * 0.01))
            else {
                continue;
            };
            let direction = (out - at).normalize_or_zero();
            let in_image = at.x >= 1.0 && at.y >= 1.0 && at.x < width - 2.0 && at.y < height - 2.0;
            if direction == DVec2::ZERO || !in_image || CLEAR_PX.iter().any(|step| drawn(at + direction * *step)) {
                continue;
            }
            let cell = (at / (SPACING_M * px_per_m).max(3.0)).floor();
            let best = cells.entry((cell.x as i64, cell.y as i64)).or_insert((f64::INFINITY, vertex, at, direction));
            if sine < best.0 {
                *best = (sine, vertex, at, direction);
            }
        }
        let point = |(_, vertex, at, direction): (f64, usize, DVec2, DVec2)| {
            let px_per_m = self.view.px_per_m(self.vertices[vertex].as_dvec3())?;
            let end = mask_end(mask, at, direction, reach_m * px_per_m)?;
            let (normal, offset) = undistorted_line(self.camera, self.view, end, direction)?;
            let bones = bones(self.model, self.template, vertex);
            is_usable(self.model, &bones).then_some(LinePoint {
                kind: LineKind::Outline,
                vertex,
                worn: DVec3::ZERO,
                view,
                normal,
                offset,
                sigma_px: sigma_m * px_per_m,
                bones,
                shift: DVec3::ZERO,
            })
        };
        cells.into_values().filter_map(point).collect()
    }
}

/// Returns the end of the mask nearest to `at` along a direction, within `reach` pixels.
fn mask_end(mask: &Mask, at: DVec2, direction: DVec2, reach: f64) -> Option<DVec2> {
    let value = |t: f64| coverage(mask, at + direction * t);
    let ends = |t: f64| -> Option<f64> {
        let (inner, outer) = (value(t)?, value(t + 1.0)?);
        (inner >= 0.5 && outer < 0.5).then(|| t + (inner - 0.5) / (inner - outer))
    };
    let mut t = 0.0;
    while t <= reach {
        let (outward, inward) = (ends(t), ends(-t - 1.0));
        if let Some(t) = outward.or(inward) {
            return Some(at + direction * t);
        }
        t += 1.0;
    }
    None
}

/// Samples the coverage bilinearly, 0..=1; `None` outside the mask.
fn coverage(mask: &Mask, at: DVec2) -> Option<f64> {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width as f64 - 1.0 && at.y < height as f64 - 1.0) {
        return None;
    }
    let (x, y) = (at.x as usize, at.y as usize);
    let (fx, fy) = (at.x - x as f64, at.y - y as f64);
    let value = |x: usize, y: usize| f64::from(mask.coverage()[y * width + x]) / 255.0;
    let top = value(x, y) + (value(x + 1, y) - value(x, y)) * fx;
    let bottom = value(x, y + 1) + (value(x + 1, y + 1) - value(x, y + 1)) * fx;
    Some(top + (bottom - top) * fy)
}

#[cfg(test)]
mod tests {
    use flyrig_body::skin_mesh;
    use flyrig_types::Pose;

    use super::*;
    use crate::pose::body_model::JointTurns;
    use crate::testing::{body, mask_of, random_turns, ring};

    fn matched(camera: &Camera, mask: &Mask, template: &Template, pose: &Pose) -> Vec<LinePoint> {
        let (vertices, normals) = skin_mesh(template, pose);
        let (view, model) = (View::new(camera), BodyModel::new(template).unwrap());
        let seen = |gate| {
            let (vertices, normals) = (&vertices, &normals);
            SeenBody { camera, view: &view, template, model: &model, vertices, normals, gate }
        };
        let points = seen(None).match_mask(mask, 0, 0.1, 0.01);
        // A gate that shows the same body changes nothing.
        if let Some(gate) = BodyGate::new(camera, &vertices, &template.triangles) {
            assert_eq!(seen(Some(&gate)).match_mask(mask, 0, 0.1, 0.01).len(), points.len());
        }
        points
    }

    fn place(model: &BodyModel, turns: &JointTurns, point: &LinePoint) -> DVec3 {
        let posed = model.pose(turns);
        let part = |(joint, weight, local): &(usize, f64, DVec3)| {
            (posed.origin[*joint] + posed.rotation[*joint] * *local) * *weight
        };
        point.bones.iter().map(part).sum()
    }

    #[test]
    fn a_body_lies_on_its_own_outline_and_a_shifted_one_beside_it() {
        let (template, camera) = (body(), ring(3).cameras[0].clone());
        let model = BodyModel::new(&template).unwrap();
        let turns = random_turns(&model, 5);
        let mask = mask_of(&camera, &template, &model.to_pose(&turns));
        let points = matched(&camera, &mask, &template, &model.to_pose(&turns));
        assert!(points.len() > 60, "{} points", points.len());
        let view = View::new(&camera);
        let mut moved = turns.clone();
        moved.root += DVec3::new(0.02, -0.01, 0.015);
        let distance = |point: &LinePoint, turns: &JointTurns| {
            let pixel = view.project(place(&model, turns, point)).unwrap();
            (pixel.dot(point.normal) - point.offset).abs() / point.sigma_px * 0.01
        };
        let median = |turns: &JointTurns| {
            let mut all: Vec<f64> = points.iter().map(|point| distance(point, turns)).collect();
            flyrig_solve::median(&mut all).unwrap()
        };
        assert!(median(&turns) < 0.004, "{} m", median(&turns));
        assert!(median(&moved) > 2.0 * median(&turns), "{} {}", median(&moved), median(&turns));
    }

    #[test]
    fn no_mask_a_full_mask_a_body_behind_the_camera_and_poison_match_nothing() {
        let (template, camera) = (body(), ring(3).cameras[0].clone());
        let model = BodyModel::new(&template).unwrap();
        let pose = model.to_pose(&random_turns(&model, 5));
        let filled = |value: u8| Mask::new(800, 800, vec![value; 800 * 800]).unwrap();
        assert!(matched(&camera, &filled(0), &template, &pose).is_empty());
        assert!(matched(&camera, &filled(255), &template, &pose).is_empty(), "the image's border is no outline");
        let mut behind = pose.clone();
        behind.root_translation = camera.position() * 3.0;
        assert!(matched(&camera, &filled(0), &template, &behind).is_empty());
        let mut poisoned = pose;
        poisoned.root_translation.x = f64::NAN;
        assert!(matched(&camera, &filled(255), &template, &poisoned).is_empty());
    }
}
