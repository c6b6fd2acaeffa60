//! Errors of the graphics device.

/// Error of opening or using a graphics device.
#[derive(Debug, Clone, thiserror::Error)]
pub enum GpuError {
    /// There is no adapter.
    #[error(
        "no graphics adapter found. Install a Vulkan driver: the GPU maker's, or Mesa's software one with \
         `apt-get install mesa-vulkan-drivers libvulkan1`, then try again"
    )]
    NoAdapter,
    /// There is no adapter of that name.
    #[error("no graphics adapter has '{wanted}' in its name; there are: {found}")]
    NoSuchAdapter {
        /// Requested name.
        wanted: String,
        /// Names of the adapters, separated by commas.
        found: String,
    },
    /// A limit of the adapter is too low.
    #[error(
        "adapter {adapter}: {limit} is {found}, flyrig needs {needed}; choose another adapter or update its driver"
    )]
    Limit {
        /// Name of the adapter.
        adapter: String,
        /// Name of the limit.
        limit: &'static str,
        /// Value of the adapter.
        found: u64,
        /// Required value.
        needed: u64,
    },
    /// The driver did not open the device.
    #[error("adapter {adapter} did not open: {source}")]
    Open {
        /// Name of the adapter.
        adapter: String,
        /// Error of the driver.
        source: wgpu::RequestDeviceError,
    },
    /// Content is too large for one buffer.
    #[error(
        "{what} needs {needed} bytes, more than the {limit} bytes one buffer may have on this adapter; use fewer Gaussians, pixels or views"
    )]
    TooLarge {
        /// Content.
        what: String,
        /// Required bytes.
        needed: u64,
        /// Bytes that one buffer may have.
        limit: u64,
    },
    /// The device was lost or a wait failed.
    #[error("the graphics device is lost ({0}); check the driver's log when it happens again")]
    Lost(String),
    /// The device's memory is full.
    #[error(
        "the graphics device is out of memory; end other programs that use it, or use fewer Gaussians, views or people"
    )]
    OutOfMemory,
    /// The device rejected a command: a bug in this program or the driver.
    #[error("the graphics device rejected a command ({0}); please report it with the adapter's name")]
    Rejected(String),
}

impl GpuError {
    /// Returns whether the device is unusable, so that everything on it must be rebuilt.
    #[must_use]
    pub fn is_device_fault(&self) -> bool {
        matches!(self, Self::Lost(_) | Self::OutOfMemory | Self::Rejected(_))
    }
}
