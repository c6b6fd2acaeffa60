//! stub
use flyrig_body::{DeformationGraph, SurfaceGaussians};
use flyrig_gpu::{GpuContext, GpuTimer};

use super::{AppearanceError, AppearanceSettings, ViewInput};
use crate::GaussianBuffers;

/// Paints every Gaussian from the pictures of this instant and a memory of earlier ones.
#[derive(Debug)]
pub struct DirectAppearance {
    forget: bool,
}

impl DirectAppearance {
    /// For the Gaussians and graph of one body and at most `max_views` pictures a frame.
    ///
    /// # Errors
    /// [`AppearanceError::Graph`] and [`AppearanceError::Gpu`].
    pub fn new(
        _gpu: &GpuContext,
        _gaussians: &SurfaceGaussians,
        _graph: &DeformationGraph,
        _max_views: usize,
    ) -> Result<Self, AppearanceError> {
        Ok(Self { forget: true })
    }

    /// Records the painting of [`GaussianBuffers::color`].
    ///
    /// # Errors
    /// [`AppearanceError`] names the view or setting that does not fit.
    pub fn update(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut wgpu::CommandEncoder,
        gaussians: &GaussianBuffers,
        views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
    ) -> Result<(), AppearanceError> {
        self.update_timed(gpu, encoder, gaussians, views, settings, None)
    }

    /// [`Self::update`] with the time of every stage.
    ///
    /// # Errors
    /// As [`Self::update`].
    pub fn update_timed(
        &mut self,
        _gpu: &GpuContext,
        _encoder: &mut wgpu::CommandEncoder,
        _gaussians: &GaussianBuffers,
        _views: &[ViewInput<'_>],
        settings: &AppearanceSettings,
        _timer: Option<&mut GpuTimer>,
    ) -> Result<(), AppearanceError> {
        self.forget = false;
        settings.validate()
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        self.forget = true;
    }
}
