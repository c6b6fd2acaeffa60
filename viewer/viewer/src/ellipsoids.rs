//! People, at least one of whom is an avatar, as anisotropic Gaussians on the device.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, HarmonicOrder, SH_DEGREE_0};
use flyrig_types::Camera;
use flyrig_viewing::Ellipsoids;

use crate::shown_person::ShownPerson;

/// Anisotropic Gaussians on the device for one camera.
#[derive(Debug)]
pub(crate) struct EllipsoidBuffers {
    buffers: AnisotropicBuffers,
    /// Centres of all people.
    center: Vec<[f32; 4]>,
    /// Normals of all people.
    normal: Vec<[f32; 4]>,
    shapes: Ellipsoids,
}

impl EllipsoidBuffers {
    /// Uploads people, isotropic ones included; reuses the buffers of `before` where their size fits.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] for more Gaussians than a buffer holds.
    pub fn new(gpu: &GpuContext, people: &[ShownPerson<'_>], before: Option<Self>) -> Result<Self, GpuError> {
        let (mut center, mut normal, mut harmonics) = (Vec::new(), Vec::new(), Vec::new());
        let mut shapes = Ellipsoids::default();
        for person in people {
            let count = person.count();
            let (centers, colors) = (&person.posed.center_scale[..count], &person.colors[..count]);
            center.extend_from_slice(centers);
            normal.extend_from_slice(&person.posed.normal[..count]);
            harmonics
                .extend(colors.iter().map(|[r, g, b, _]| [r / SH_DEGREE_0, g / SH_DEGREE_0, b / SH_DEGREE_0, 0.0]));
            shapes.push(centers, colors, person.axes);
        }
        // A buffer has at least one element; zeros are not drawn.
        let buffers = match before.map(|before| before.buffers).filter(|buffers| buffers.count() == center.len()) {
            Some(buffers) => buffers,
            None => AnisotropicBuffers::zeroed(gpu, center.len().max(1), HarmonicOrder::Zero)?,
        };
        if !center.is_empty() {
            buffers.center.write(gpu, &center);
            buffers.rotation.write(gpu, shapes.rotations());
            buffers.harmonics.write(gpu, &harmonics);
        }
        Ok(Self { buffers, center, normal, shapes })
    }

    /// Hides Gaussians that face away from a camera, and returns the buffers to draw.
    pub fn seen_by(&mut self, gpu: &GpuContext, camera: &Camera) -> &AnisotropicBuffers {
        let seen = self.shapes.seen_from(camera.position().as_vec3(), &self.center, &self.normal);
        if !seen.is_empty() {
            self.buffers.scale_opacity.write(gpu, seen);
        }
        &self.buffers
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn viewers_leave_out_the_same_isotropic_gaussians_as_the_rig() {
        let ours = f64::from(flyrig_viewing::BACKFACING_COSINE);
        assert!((ours - flyrig_renderer::BACKFACING_COSINE).abs() < 1e-7, "{ours}");
    }
}
