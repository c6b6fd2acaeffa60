//! An avatar drawn into views.

use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, Outputs, RasterSettings, Rasterizer, RenderTarget, ViewBytes};
use flyrig_types::{Camera, RenderedView};
use glam::DVec3;

use crate::{Avatar, Bones, PosedAvatar, fit::write};

/// Draws one avatar.
#[derive(Debug)]
pub struct AvatarScene {
    gpu: GpuContext,
    rasterizer: Rasterizer,
    gaussians: AnisotropicBuffers,
    posed: PosedAvatar,
    target: RenderTarget,
    bytes: ViewBytes,
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
            rasterizer: Rasterizer::new(gpu, count)?,
            gaussians: AnisotropicBuffers::zeroed(gpu, count, avatar.parameters.order())?,
            posed: PosedAvatar::default(),
            target: RenderTarget::of_color(gpu, 16, 16)?,
            bytes: ViewBytes::new(gpu)?,
        })
    }

    /// Poses the avatar for the views to come; see [`Avatar::pose`].
    pub fn pose(&mut self, avatar: &Avatar, bones: &Bones, translations: Option<&[DVec3]>) {
        avatar.pose(bones, translations, &mut self.posed);
        write(&self.gpu, &self.gaussians, &self.posed, avatar);
    }

    /// The avatar as it is posed.
    #[must_use]
    pub fn posed(&self) -> &PosedAvatar {
        &self.posed
    }

    /// Draws the avatar as a camera sees it, at its size; straight alpha.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if (self.target.width, self.target.height) != (width, height) {
            self.target = RenderTarget::of_color(&self.gpu, width, height)?;
        }
        let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, &self.gaussians, camera, &settings, &self.target)?;
        self.bytes.encode(&self.gpu, &mut encoder, &self.target)?;
        self.gpu.queue.submit([encoder.finish()]);
        Ok(RenderedView { width, height, rgba: self.bytes.read(&self.gpu, &self.target)? })
    }
}
