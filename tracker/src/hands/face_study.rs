//! Measures the places of the face network's landmarks on a head, for the table of
//! [`face_points`](crate::hands::face_points).
//!
//! A landmark's place is the point nearest to its lines of sight in many images of people whose pose is known (iteratively
//! reweighted least squares).

use flyrig_body::Template;
use flyrig_types::{Camera, Image, Pose};
use glam::{DMat3, DVec3};

use crate::error::TrackError;
use crate::hands::crop_schedule::FaceTarget;
use crate::hands::face_net::{FACE_SIDE, FaceNet, FaceOutput};
use crate::hands::face_points::RIGID;
use crate::image::pixels::Rgb;
use crate::image::view::View;
use crate::landmarks::bias::template_scale;
use crate::pose::body_model::BodyModel;

/// Rounds of reweighting, and the distance at which the weight is halved, metres.
const ROUNDS: usize = 15;
const ROBUST_M: f64 = 0.006;
/// Observations needed for a landmark.
const MIN_COUNT: usize = 20;

/// Line of sight through a landmark, in axes of the head, metres on a body of 1.7 m: the camera and a unit direction.
#[derive(Debug, Clone, Copy)]
struct Ray {
    from: DVec3,
    along: DVec3,
}

/// Measurement of the places of the network's landmarks, on people whose pose is known.
#[derive(Debug)]
pub struct FaceStudy {
    net: FaceNet,
    /// Lines of sight of each landmark of [`RIGID`].
    rays: Vec<Vec<Ray>>,
}

impl FaceStudy {
    /// Starts without measurements.
    #[must_use]
    pub fn new(net: FaceNet) -> Self {
        Self { net, rays: vec![Vec::new(); RIGID.len()] }
    }

    /// Measures one image of a person in a known pose of a known body; returns false when the network finds no face.
    ///
    /// # Errors
    /// Kinds `Template` and `Image` when those cannot be used, `Net` when the network fails.
    pub fn add(
        &mut self,
        camera: &Camera,
        image: &Image,
        template: &Template,
        pose: &Pose,
    ) -> Result<bool, TrackError> {
        let model = BodyModel::with_anatomical_marks(template)?;
        let Some(turns) = model.to_turns(pose) else { return Ok(false) };
        let posed = model.pose(&turns);
        let scale = template_scale(template);
        let Some(target) = FaceTarget::new(camera, &model, &posed, scale) else { return Ok(false) };
        let side = FACE_SIDE;
        let FaceOutput { landmarks, presence } = self.net.run(&target.crop.sample_square(&Rgb::new(image)?, side))?;
        if presence < 0.5 {
            return Ok(false);
        }
        let view = View::new(camera);
        let (rotation, origin) = (posed.rotation[model.roles.head].inverse(), posed.origin[model.roles.head]);
        let from = rotation * (view.center() - origin) / scale;
        for (rays, &landmark) in self.rays.iter_mut().zip(&RIGID) {
            let pixel = target.crop.to_image_from(landmarks[landmark], side);
            let Some(ideal) = view.undistorted(camera, pixel) else { continue };
            let along = rotation * (view.rotation.transpose() * (ideal / view.focal_px).extend(1.0));
            rays.push(Ray { from, along: along.normalize() });
        }
        Ok(true)
    }

    /// Returns index, place in metres and the median distance of its lines in metres of each landmark that was seen often
    /// enough.
    #[must_use]
    pub fn places(&self) -> Vec<(usize, DVec3, f64)> {
        let of = |(landmark, rays): (&usize, &Vec<Ray>)| {
            let (place, off) = meeting(rays)?;
            Some((*landmark, place, off))
        };
        RIGID.iter().zip(&self.rays).filter_map(of).collect()
    }
}

/// Returns the point nearest to most lines, and their median distance from it, metres.
fn meeting(rays: &[Ray]) -> Option<(DVec3, f64)> {
    if rays.len() < MIN_COUNT {
        return None;
    }
    let across = |ray: &Ray| {
        DMat3::IDENTITY - DMat3::from_cols(ray.along * ray.along.x, ray.along * ray.along.y, ray.along * ray.along.z)
    };
    let mut place: Option<DVec3> = None;
    for _ in 0..ROUNDS {
        let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for ray in rays {
            let across = across(ray);
            let off = place.map_or(0.0, |place| (across * (place - ray.from)).length());
            let weight = 1.0 / (1.0 + (off / ROBUST_M).powi(2));
            normal += across * weight;
            right += across * ray.from * weight;
        }
        if normal.determinant().abs() < 1e-6 {
            return None;
        }
        place = Some(normal.inverse() * right);
    }
    let place = place.filter(|place| place.is_finite())?;
    let mut off: Vec<f64> = rays.iter().map(|ray| (across(ray) * (place - ray.from)).length()).collect();
    Some((place, flyrig_solve::median(&mut off)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_meet_where_most_of_them_do() {
        let place = DVec3::new(0.01, 0.09, 0.1);
        let rays: Vec<Ray> = (0..60)
            .map(|k| {
                let t = f64::from(k);
                let from = DVec3::new(2.0 * (0.4 * t).sin(), 0.5 * (0.3 * t).cos(), 2.0);
                let wrong = if k % 6 == 0 { DVec3::new(0.05, 0.0, 0.0) } else { DVec3::ZERO };
                Ray { from, along: (place + wrong - from).normalize() }
            })
            .collect();
        let (found, off) = meeting(&rays).unwrap();
        assert!(found.distance(place) < 1e-3 && off < 1e-3, "{found} {off}");
        assert!(meeting(&rays[..5]).is_none());
        let parallel = vec![Ray { from: DVec3::ZERO, along: DVec3::Z }; 60];
        assert!(meeting(&parallel).is_none(), "one direction alone says nothing of depth");
    }
}
