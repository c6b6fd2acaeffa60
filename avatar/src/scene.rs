//! An avatar drawn into views.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, ViewPainter};
use flyrig_types::{Camera, RenderedView};
use glam::DVec3;

use crate::{Avatar, Bones, PosedAvatar, fit::write};

/// Draws one avatar.
#[derive(Debug)]
pub struct AvatarScene {
    gpu: GpuContext,
    painter: ViewPainter,
    gaussians: AnisotropicBuffers,
    posed: PosedAvatar,
}

impl AvatarScene {
    /// Room for an avatar.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, avatar: &Avatar) -> Result<Self, GpuError> {
        let count = avatar.gaussians();
        Ok(Self {
            gpu: gpu.clone(),
            painter: ViewPainter::new(gpu, count)?,
            gaussians: AnisotropicBuffers::zeroed(gpu, count, avatar.parameters.order())?,
            posed: PosedAvatar::default(),
        })
    }

    /// Poses the avatar for the views to come; see [`Avatar::pose`].
    pub fn pose(&mut self, avatar: &Avatar, bones: &Bones, translations: Option<&[DVec3]>) {
        avatar.pose(bones, translations, &mut self.posed);
        write(&self.gpu, &self.gaussians, &self.posed, avatar);
    }

    /// Draws the avatar as a camera sees it, at its size; straight alpha.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        self.painter.draw(&self.gaussians, camera)
    }
}
