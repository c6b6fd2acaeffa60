//! Where the networks are trained.

use flyrig_gpu::GpuContext;
use flyrig_learn::burn_tensor::Device;

use crate::{StfaError, shared};

/// A device for the networks.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkDevice(pub(crate) Device);

impl NetworkDevice {
    /// All cores.
    #[must_use]
    pub fn processor() -> Self {
        Self(Device::flex())
    }

    /// The drawing device.
    ///
    /// # Errors
    /// [`StfaError::Device`], always where flyrig was built without the feature `gpu-networks`.
    pub fn adapter(gpu: &GpuContext) -> Result<Self, StfaError> {
        shared::registered(gpu).map(Self)
    }
}
