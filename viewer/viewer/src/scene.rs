//! Drawing of the people of the stream.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{GaussianBuffers, ViewPainter};
use flyrig_types::{Camera, RenderedView};

use crate::{ellipsoids::EllipsoidBuffers, shown_person::ShownPerson};

/// Rasteriser with the Gaussians of the people to draw.
#[derive(Debug)]
pub struct PeopleScene {
    gpu: GpuContext,
    painter: ViewPainter,
    gaussians: GaussianBuffers,
    /// Anisotropic Gaussians, used instead where a person is an avatar.
    ellipsoids: Option<EllipsoidBuffers>,
}

impl PeopleScene {
    /// Creates an empty scene.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] on a device without room for its buffers.
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let (painter, gaussians) = (ViewPainter::new(gpu, 1)?, GaussianBuffers::zeroed(gpu, 1)?);
        Ok(Self { gpu: gpu.clone(), painter, gaussians, ellipsoids: None })
    }

    /// Replaces the people of the scene. With an avatar among them, all are drawn as anisotropic Gaussians.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] for more Gaussians than a buffer holds.
    pub fn set_people<'a, P: Into<ShownPerson<'a>>>(
        &mut self,
        people: impl IntoIterator<Item = P>,
    ) -> Result<(), GpuError> {
        let people: Vec<ShownPerson<'_>> = people.into_iter().map(Into::into).collect();
        let has_avatar = people.iter().any(|person| person.axes.is_some());
        let before = self.ellipsoids.take();
        self.ellipsoids = has_avatar.then(|| EllipsoidBuffers::new(&self.gpu, &people, before)).transpose()?;
        if has_avatar {
            return Ok(());
        }
        let mut people = people.iter().map(|person| {
            let (posed, count) = (person.posed, person.count());
            (&posed.center_scale[..count], &posed.normal[..count], &person.colors[..count])
        });
        let first = people.next().unwrap_or_default();
        let Some(second) = people.next() else { return self.write(first.0, first.1, first.2) };
        let (mut centers, mut normals, mut colors) = (first.0.to_vec(), first.1.to_vec(), first.2.to_vec());
        for (of_centers, of_normals, of_colors) in std::iter::once(second).chain(people) {
            centers.extend_from_slice(of_centers);
            normals.extend_from_slice(of_normals);
            colors.extend_from_slice(of_colors);
        }
        self.write(&centers, &normals, &colors)
    }

    fn write(&mut self, centers: &[[f32; 4]], normals: &[[f32; 4]], colors: &[[f32; 4]]) -> Result<(), GpuError> {
        // A buffer has at least one element; zeros are not drawn.
        if self.gaussians.count() != centers.len().max(1) || centers.is_empty() {
            self.gaussians = GaussianBuffers::zeroed(&self.gpu, centers.len().max(1))?;
        }
        if !centers.is_empty() {
            self.gaussians.center_scale.write(&self.gpu, centers);
            self.gaussians.normal.write(&self.gpu, normals);
            self.gaussians.color.write(&self.gpu, colors);
        }
        Ok(())
    }

    /// Draws the people for a camera, at its size; straight alpha.
    ///
    /// # Errors
    /// [`GpuError`] of the device.
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        match &mut self.ellipsoids {
            Some(ellipsoids) => self.painter.draw(ellipsoids.seen_by(&self.gpu, camera), camera),
            None => self.painter.draw(&self.gaussians, camera),
        }
    }
}
