//! Inputs, settings and errors of direct appearance.

use crate::buffers::GaussianBuffers;
use flyrig_gpu::{GpuError, StorageBuffer};
use flyrig_types::{Camera, CameraId, MAX_IMAGE_SIDE};

/// Input of one camera at this instant.
#[derive(Debug, Clone, Copy)]
pub struct ViewInput<'a> {
    /// Camera that took the image, at the image's size.
    pub camera: &'a Camera,
    /// sRGB bytes, one element per pixel (red in the lowest byte), rows without padding; alpha is the mask coverage,
    /// 255 on the person. The colour is not multiplied by it.
    pub picture: &'a StorageBuffer<u32>,
    /// Canonical positions seen from this camera: [`RenderTarget::canonical`](crate::RenderTarget) of a rendering of
    /// the same Gaussians with this camera.
    pub canonical: &'a StorageBuffer<[f32; 4]>,
    /// Colours of the last update seen from this camera: [`RenderTarget::color`](crate::RenderTarget) of the same
    /// rendering.
    pub rendered: &'a StorageBuffer<[f32; 4]>,
    /// Gaussians posed at this image's time, where that differs from the frame's.
    pub gaussians: Option<&'a GaussianBuffers>,
}

/// Observations of one update, read back: the input of learned appearance.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Observations {
    /// Per view and Gaussian: pixel x and y, weight of Eq. 6 (with the baseline's extra weight where nothing is
    /// inpainted), exp(-k d). All zero where the view does not show the Gaussian.
    pub views: Vec<Vec<[f32; 4]>>,
    /// Per Gaussian: sum of weight times linear RGB; sum of weights.
    pub seen: Vec<[f32; 4]>,
    /// Per Gaussian: sum of the Eq. 6 weights; exp(-k d) of the best view.
    pub quality: Vec<[f32; 2]>,
    /// Per graph node: mean linear RGB seen around it; mean visibility, 0 to 1.
    pub node_seen: Vec<[f32; 4]>,
    /// Per graph node: linear RGB diffused over the surface (stale where nothing is inpainted); w unused.
    pub node_color: Vec<[f32; 4]>,
}

/// Settings of direct appearance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AppearanceSettings {
    /// Whether unseen Gaussians are inpainted from their surroundings on the surface. Off is the paper's baseline:
    /// every camera that has the point inside its image gets a small extra weight, visible or not.
    pub space: bool,
    /// Whether earlier frames are remembered. Off: neither the memory nor the last colours are read.
    pub time: bool,
    /// k of Eq. 8 and 11, per metre: points at canonical distances beyond 1 / k count as occluded.
    pub occlusion_per_m: f32,
    /// w_max of Eq. 10.
    pub memory_weight_max: f32,
    /// Mask coverage (0..1) up to which a pixel is ignored; above it its weight rises linearly to 1.
    pub min_mask: f32,
    /// Weight of the colour diffused over the surface against a Gaussian's own observation, whose weight is w_vis
    /// (0..=1): larger values make poorly seen regions smoother and less detailed.
    pub inpaint_weight: f32,
    /// Weight of the smoothness between neighbouring graph nodes against a node's own observation (0..=1).
    pub smoothness: f32,
    /// Share of the detail lost by rendering that is restored, 0 to 0.95; detail that rendering removes entirely is
    /// amplified `1 / (1 - sharpness)` times.
    pub sharpness: f32,
    /// Whether the colours are corrections (linear RGB of any sign) of colours that are known before, as those of an avatar.
    /// A view then observes the sum of the last correction and the difference between image and rendering: [`Self::sharpness`]
    /// of each Gaussian's own, the rest of the surface around, so that detail which rendering removes does not grow. Where
    /// nothing is observed there is no correction.
    pub corrects: bool,
}

impl Default for AppearanceSettings {
    fn default() -> Self {
        Self {
            space: true,
            time: true,
            occlusion_per_m: 20.0,
            memory_weight_max: 8.0,
            min_mask: 0.5,
            inpaint_weight: 0.01,
            smoothness: 0.005,
            sharpness: 0.8,
            corrects: false,
        }
    }
}

impl AppearanceSettings {
    /// Checks every number.
    ///
    /// # Errors
    /// [`AppearanceError::Setting`] names the first bad one.
    pub fn validate(&self) -> Result<(), AppearanceError> {
        let check = |name, value: f32, ok: bool, expected| {
            if ok { Ok(()) } else { Err(AppearanceError::Setting { name, value, expected }) }
        };
        let positive = |value: f32| value > 0.0 && value.is_finite();
        let k = self.occlusion_per_m;
        check("occlusion_per_m", k, positive(k), "a positive number per metre")?;
        let memory = self.memory_weight_max;
        check("memory_weight_max", memory, positive(memory), "a positive number")?;
        check("min_mask", self.min_mask, (0.0..1.0).contains(&self.min_mask), "0 up to but not including 1")?;
        let inpaint = self.inpaint_weight;
        check("inpaint_weight", inpaint, positive(inpaint), "a positive number")?;
        check("smoothness", self.smoothness, positive(self.smoothness), "a positive number")?;
        check("sharpness", self.sharpness, (0.0..=0.95).contains(&self.sharpness), "0 to 0.95")
    }
}

/// Reason why an update was refused. Nothing was recorded then.
#[derive(Debug, thiserror::Error)]
pub enum AppearanceError {
    /// The GPU reported an error.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A setting out of its range.
    #[error("appearance setting {name} is {value}, expected {expected}")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Value found.
        value: f32,
        /// Description of the valid range.
        expected: &'static str,
    },
    /// Gaussians and graph do not belong together.
    #[error("the deformation graph does not fit the Gaussians: {0}; build both from the same template")]
    Graph(String),
    /// The number of Gaussians differs from that at construction.
    #[error("appearance was made for {expected} Gaussians but is given {found}; make a new one for another body")]
    GaussianCount {
        /// Number at construction.
        expected: usize,
        /// Number found.
        found: usize,
    },
    /// More views than at construction.
    #[error("appearance was made for {max} views but is given {found}; raise max_views")]
    TooManyViews {
        /// Number at construction.
        max: usize,
        /// Number found.
        found: usize,
    },
    /// An image does not fit its camera.
    #[error("camera {camera}: {what} has {found} {unit}, its {width}x{height} image needs {needed}")]
    ViewSize {
        /// Name of the camera.
        camera: CameraId,
        /// Name of the input.
        what: &'static str,
        /// Counted unit.
        unit: &'static str,
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
        /// Count needed.
        needed: usize,
        /// Count found.
        found: usize,
    },
    /// A camera's image is empty or too large.
    #[error("camera {camera}: its image is {width}x{height}, expected 1 to {MAX_IMAGE_SIDE} pixels a side")]
    ImageSize {
        /// Name of the camera.
        camera: CameraId,
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
    },
}
