//! People of whom one at least is an avatar, as Gaussians of three axes.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, BACKFACING_COSINE, HarmonicOrder, SH_DEGREE_0};
use flyrig_types::Camera;
use glam::Vec3;

use crate::scene::ShownPerson;

/// Cosine between the normal and the line of sight above which a Gaussian of an avatar is not drawn, as `flyrig avatar render` has it: its
/// opacity is below 1, so that the far side would show through.
const AWAY: f32 = 0.7;

/// Gaussians on the device, as one camera sees them.
#[derive(Debug)]
pub(crate) struct Ellipsoids {
    buffers: AnisotropicBuffers,
    /// Lists of all people: centre, scales with opacity, normal with the cosine from which it is left out.
    center: Vec<[f32; 4]>,
    scale_opacity: Vec<[f32; 4]>,
    normal: Vec<[f32; 4]>,
    /// Scales with opacity as the last camera sees them.
    facing: Vec<[f32; 4]>,
}

impl Ellipsoids {
    /// Of these people, isotropic ones included; buffers of `before` are used again where their size fits.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, people: &[ShownPerson<'_>], before: Option<Self>) -> Result<Self, GpuError> {
        let (mut center, mut scale_opacity, mut normal) = (Vec::new(), Vec::new(), Vec::new());
        let (mut rotation, mut harmonics) = (Vec::new(), Vec::new());
        for person in people {
            let count = person.count();
            let axes = person.axes.filter(|axes| axes.scale_opacity.len() >= count && axes.rotation.len() >= count);
            let away = if axes.is_some() { AWAY } else { BACKFACING_COSINE as f32 };
            for i in 0..count {
                let ([_, _, _, scale], [r, g, b, opacity]) = (person.posed.center_scale[i], person.colors[i]);
                center.push(person.posed.center_scale[i]);
                scale_opacity.push(axes.map_or([scale, scale, scale, opacity], |axes| axes.scale_opacity[i]));
                rotation.push(axes.map_or([0.0, 0.0, 0.0, 1.0], |axes| axes.rotation[i]));
                let [x, y, z, _] = person.posed.normal[i];
                normal.push([x, y, z, away]);
                harmonics.push([r / SH_DEGREE_0, g / SH_DEGREE_0, b / SH_DEGREE_0, 0.0]);
            }
        }
        // A buffer has at least one element: zero, which is not drawn.
        let buffers = match before.map(|before| before.buffers).filter(|buffers| buffers.count() == center.len()) {
            Some(buffers) => buffers,
            None => AnisotropicBuffers::zeroed(gpu, center.len().max(1), HarmonicOrder::Zero)?,
        };
        if !center.is_empty() {
            buffers.center.write(gpu, &center);
            buffers.rotation.write(gpu, &rotation);
            buffers.harmonics.write(gpu, &harmonics);
        }
        Ok(Self { buffers, center, scale_opacity, normal, facing: Vec::new() })
    }

    /// Leaves out what faces away from a camera, and returns the Gaussians to draw.
    pub fn seen_by(&mut self, gpu: &GpuContext, camera: &Camera) -> &AnisotropicBuffers {
        let eye = camera.position().as_vec3();
        self.facing.clone_from(&self.scale_opacity);
        let rows = self.facing.iter_mut().zip(&self.center).zip(&self.normal);
        rows.for_each(|((shape, center), normal)| {
            let sight = Vec3::from_slice(center) - eye;
            if Vec3::from_slice(normal).dot(sight) > normal[3] * sight.length() {
                shape[3] = 0.0;
            }
        });
        if !self.facing.is_empty() {
            self.buffers.scale_opacity.write(gpu, &self.facing);
        }
        &self.buffers
    }
}
