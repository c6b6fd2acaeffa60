//! Errors of the graphics device.

/// Why there is no GPU to work with, or what it refused.
#[derive(Debug, Clone, thiserror::Error)]
pub enum GpuError {
    /// No adapter at all.
    #[error(
        "no graphics adapter found. Install a Vulkan driver: the GPU maker's, or Mesa's software one with \
         `apt-get install mesa-vulkan-drivers libvulkan1`, then try again"
    )]
    NoAdapter,
    /// None of that name.
    #[error("no graphics adapter has '{wanted}' in its name; there are: {found}")]
    NoSuchAdapter {
        /// The name asked for.
        wanted: String,
        /// Names found, comma separated.
        found: String,
    },
    /// The adapter cannot do what we need.
    #[error(
        "adapter {adapter}: {limit} is {found}, flyrig needs {needed}; choose another adapter or update its driver"
    )]
    Limit {
        /// Which adapter.
        adapter: String,
        /// Which limit.
        limit: &'static str,
        /// What it offers.
        found: u64,
        /// What we need.
        needed: u64,
    },
    /// The driver did not open the device.
    #[error("adapter {adapter} did not open: {source}")]
    Open {
        /// Which adapter.
        adapter: String,
        /// The driver's word.
        source: wgpu::RequestDeviceError,
    },
    /// Too large for one buffer.
    #[error(
        "{what} needs {needed} bytes, more than the {limit} bytes one buffer may have on this adapter; use fewer Gaussians, pixels or views"
    )]
    TooLarge {
        /// What was to be stored.
        what: String,
        /// Bytes.
        needed: u64,
        /// Bytes.
        limit: u64,
    },
    /// Device lost or a wait failed.
    #[error("the graphics device is lost ({0}); check the driver's log when it happens again")]
    Lost(String),
    /// The device's memory is full.
    #[error(
        "the graphics device is out of memory; end other programs that use it, or use fewer Gaussians, views or people"
    )]
    OutOfMemory,
    /// The device rejected a command: a mistake of ours or of the driver.
    #[error("the graphics device rejected a command ({0}); please report it with the adapter's name")]
    Rejected(String),
}

impl GpuError {
    /// Whether the device can no longer be relied on, so that everything on it must be rebuilt.
    #[must_use]
    pub fn is_device_fault(&self) -> bool {
        matches!(self, Self::Lost(_) | Self::OutOfMemory | Self::Rejected(_))
    }
}
