//! An avatar drawn into views.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, ViewPainter};
use flyrig_types::{Camera, RenderedView};
use glam::DVec3;

use crate::{Avatar, Bones, PosedAvatar, parameters::Element};

/// A posed avatar on the adapter, as one camera sees it.
#[derive(Debug)]
pub(crate) struct AvatarBuffers {
    pub gaussians: AnisotropicBuffers,
    scale_opacity: Vec<Element>,
}

impl AvatarBuffers {
    pub fn new(gpu: &GpuContext, avatar: &Avatar) -> Result<Self, GpuError> {
        let gaussians = AnisotropicBuffers::zeroed(gpu, avatar.gaussians(), avatar.parameters.order())?;
        Ok(Self { gaussians, scale_opacity: Vec::new() })
    }

    pub fn pose(&self, gpu: &GpuContext, posed: &PosedAvatar, avatar: &Avatar) {
        self.gaussians.center.write(gpu, &posed.center);
        self.gaussians.scale_opacity.write(gpu, &posed.scale_opacity);
        self.gaussians.rotation.write(gpu, &posed.rotation);
        self.gaussians.harmonics.write(gpu, &avatar.parameters.harmonics);
    }

    /// Leaves out Gaussians that face away from a camera. Returns how many.
    pub fn look(&mut self, gpu: &GpuContext, posed: &PosedAvatar, camera: &Camera) -> usize {
        let eye = camera.camera_from_world.inverse().translation.as_vec3();
        let hidden = posed.facing(eye, &mut self.scale_opacity);
        self.gaussians.scale_opacity.write(gpu, &self.scale_opacity);
        hidden
    }
}

/// Draws one avatar.
#[derive(Debug)]
pub struct AvatarScene {
    gpu: GpuContext,
    painter: ViewPainter,
    buffers: AvatarBuffers,
    posed: PosedAvatar,
    /// Gaussians that the last view left out, as they face away.
    hidden: usize,
}

impl AvatarScene {
    /// Makes room for an avatar.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, avatar: &Avatar) -> Result<Self, GpuError> {
        Ok(Self {
            gpu: gpu.clone(),
            painter: ViewPainter::new(gpu, avatar.gaussians())?,
            buffers: AvatarBuffers::new(gpu, avatar)?,
            posed: PosedAvatar::default(),
            hidden: 0,
        })
    }

    /// Poses the avatar for the views to come; see [`Avatar::pose`].
    pub fn pose(&mut self, avatar: &Avatar, bones: &Bones, translations: Option<&[DVec3]>) {
        avatar.pose(bones, translations, &mut self.posed);
        self.buffers.pose(&self.gpu, &self.posed, avatar);
    }

    /// Draws the avatar as a camera sees it, at its size; straight alpha.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        self.hidden = self.buffers.look(&self.gpu, &self.posed, camera);
        self.painter.draw(&self.buffers.gaussians, camera)
    }

    /// Returns the number of Gaussians that the last view left out, as they face away.
    #[must_use]
    pub fn hidden(&self) -> usize {
        self.hidden
    }
}
