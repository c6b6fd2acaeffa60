//! What goes into direct appearance, and what can be wrong with it.

use crate::buffers::GaussianBuffers;
use flyrig_gpu::{GpuError, StorageBuffer};
use flyrig_types::{Camera, CameraId, MAX_IMAGE_SIDE};

/// What one camera saw at this instant.
#[derive(Debug, Clone, Copy)]
pub struct ViewInput<'a> {
    /// The camera that took the image, at the image's size.
    pub camera: &'a Camera,
    /// sRGB bytes, a pixel an element (red in the lowest byte), rows without padding; a: mask coverage, 255 on the person.
    /// The colour is not multiplied by it.
    pub picture: &'a StorageBuffer<u32>,
    /// The Gaussians' canonical positions as this camera sees them: [`RenderTarget::canonical`](crate::RenderTarget)
    /// of a rendering with this very camera and the same Gaussians.
    pub canonical: &'a StorageBuffer<[f32; 4]>,
    /// The Gaussians with the colours of the last update as this camera sees them: [`RenderTarget::color`](crate::RenderTarget)
    /// of the same rendering.
    pub drawn: &'a StorageBuffer<[f32; 4]>,
    /// The Gaussians as they stood when this image was taken, where that is another instant.
    pub gaussians: Option<&'a GaussianBuffers>,
}

/// What direct appearance found out in one update, read back: the input of learned appearance.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Observations {
    /// By view, by Gaussian: pixel x and y, weight of Eq. 6 (with the baseline's small number where nothing is filled
    /// in), exp(-k d). All zero where the view has nothing to say.
    pub views: Vec<Vec<[f32; 4]>>,
    /// By Gaussian: sum of weight times linear RGB; sum of weights.
    pub seen: Vec<[f32; 4]>,
    /// By Gaussian: sum of the Eq. 6 weights, exp(-k d) of the best view.
    pub quality: Vec<[f32; 2]>,
    /// By graph node: mean linear RGB seen around it; mean visibility, 0 to 1.
    pub node_seen: Vec<[f32; 4]>,
    /// By graph node: linear RGB diffused over the surface (old where nothing is filled in); w unused.
    pub node_color: Vec<[f32; 4]>,
}

/// How colours are gathered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AppearanceSettings {
    /// Fill what no camera sees from its surroundings on the surface. Off: the paper's baseline, every camera that
    /// has the point inside its image gets a small extra weight, visible or not.
    pub space: bool,
    /// Remember earlier frames. Off: neither the memory nor the last colours are read.
    pub time: bool,
    /// k of Eq. 8 and 11, per metre: beyond 1 / k a point counts as hidden.
    pub occlusion_per_m: f32,
    /// w_max of Eq. 10.
    pub memory_weight_max: f32,
    /// Mask coverage (0..1) up to which a pixel is not believed at all; above it belief rises linearly to 1.
    pub min_mask: f32,
    /// Weight of the colour diffused over the surface against a Gaussian's own observation, whose weight is w_vis
    /// (0..=1): the larger, the smoother and the less detailed are badly seen regions.
    pub inpaint_weight: f32,
    /// Weight of the likeness of neighbouring graph nodes against a node's own observation (0..=1).
    pub smoothness: f32,
    /// How much of what drawing blurs is put back into the colours, 0 to 0.95; detail that drawing wipes out wholly is
    /// raised `1 / (1 - sharpness)` times.
    pub sharpness: f32,
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

/// Why colours could not be gathered. Nothing was recorded then.
#[derive(Debug, thiserror::Error)]
pub enum AppearanceError {
    /// The GPU refused.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A setting out of its range.
    #[error("appearance setting {name} is {value}, expected {expected}")]
    Setting {
        /// Which.
        name: &'static str,
        /// What was found.
        value: f32,
        /// What would be right.
        expected: &'static str,
    },
    /// Gaussians and graph do not belong together.
    #[error("the deformation graph does not fit the Gaussians: {0}; build both from the same template")]
    Graph(String),
    /// Other buffers than the ones announced.
    #[error("appearance was made for {expected} Gaussians but is given {found}; make a new one for another body")]
    GaussianCount {
        /// At construction.
        expected: usize,
        /// Now.
        found: usize,
    },
    /// More views than announced.
    #[error("appearance was made for {max} views but is given {found}; raise max_views")]
    TooManyViews {
        /// At construction.
        max: usize,
        /// Now.
        found: usize,
    },
    /// An image that does not fit its camera.
    #[error("camera {camera}: {what} has {found} {unit}, its {width}x{height} image needs {needed}")]
    ViewSize {
        /// Which camera.
        camera: CameraId,
        /// Which input.
        what: &'static str,
        /// What is counted.
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
    /// A camera without pixels, or with an absurd number of them.
    #[error("camera {camera}: its image is {width}x{height}, expected 1 to {MAX_IMAGE_SIDE} pixels a side")]
    ImageSize {
        /// Which camera.
        camera: CameraId,
        /// Pixels.
        width: u32,
        /// Pixels.
        height: u32,
    },
}
