//! Stands in for [`SharedAppearance`] where flyrig was built without the feature `wgpu`: there is none then.

use flyrig_gpu::GpuContext;
use flyrig_learn::burn_tensor::Device;
use flyrig_renderer::{AppearanceSettings, DirectAppearance, GaussianBuffers};

use crate::{BodyGraph, Parameters, StfaError, ViewImage};

/// Networks on the drawing device; this flyrig was built without them.
#[derive(Debug)]
pub enum SharedAppearance {}

impl SharedAppearance {
    /// # Errors
    /// Always [`StfaError::Device`].
    pub fn new(_: &GpuContext, _: &Parameters, _: &BodyGraph) -> Result<Self, StfaError> {
        Err(missing())
    }

    /// Forgets all earlier frames.
    pub fn reset(&mut self) {
        match *self {}
    }

    /// # Errors
    /// None: there is nothing to call this on.
    pub fn paint(
        &mut self,
        _: &GpuContext,
        _: &DirectAppearance,
        _: &GaussianBuffers,
        _: &[ViewImage<'_>],
        _: &AppearanceSettings,
    ) -> Result<(), StfaError> {
        match *self {}
    }
}

pub(crate) fn registered(_: &GpuContext) -> Result<Device, StfaError> {
    Err(missing())
}

fn missing() -> StfaError {
    StfaError::Device("this flyrig was built without that (cargo build --release --features gpu-networks)".to_owned())
}
