//! The four compute kernels and the constants that Rust and WGSL share.

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{CAMERA_WGSL, ComputeKernel, GpuContext};

use crate::appearance::hierarchy::DiffusionHierarchy;
use crate::appearance::settings::AppearanceSettings;
use crate::color::linear_from_srgb;

/// Threads per workgroup; 256 is the most that every adapter supports.
pub(super) const WORKGROUP: u32 = 256;

/// Distance from the camera's plane below which nothing is projected, metres, as in [`flyrig_types::Camera::project`].
pub(super) const NEAR_M: f32 = 1e-3;

/// Coverage by Gaussians below which a pixel shows no surface to compare with.
pub(super) const MIN_RENDERED_ALPHA: f32 = 0.5;

/// Mask coverage below which a sample is ignored: its colour would be dominated by rounding errors.
pub(super) const MIN_COVERAGE: f32 = 0.01;

/// Extra weight of every view in the baseline: far below the weight of a visible view, far above rounding.
const BASELINE_VIEW_WEIGHT: f32 = 1e-3;

/// Layout of `struct Settings` in the WGSL (std430, 44 bytes).
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(super) struct SettingsConstants {
    pub occlusion_per_m: f32,
    pub memory_weight_max: f32,
    pub min_mask: f32,
    pub inpaint_weight: f32,
    pub smoothness: f32,
    pub view_weight: f32,
    pub space: u32,
    pub time: u32,
    pub sharpness: f32,
    pub corrects: u32,
    pub unseen: f32,
}

impl SettingsConstants {
    /// Converts the settings; `painted` is whether colours of an earlier frame exist.
    pub(super) fn new(settings: &AppearanceSettings, painted: bool) -> Self {
        Self {
            occlusion_per_m: settings.occlusion_per_m,
            memory_weight_max: settings.memory_weight_max,
            min_mask: settings.min_mask,
            inpaint_weight: settings.inpaint_weight,
            smoothness: settings.smoothness,
            view_weight: if settings.space || settings.corrects { 0.0 } else { BASELINE_VIEW_WEIGHT },
            space: settings.space.into(),
            time: settings.time.into(),
            sharpness: if settings.corrects || painted && settings.time { settings.sharpness } else { 0.0 },
            corrects: settings.corrects.into(),
            unseen: if settings.corrects { 0.0 } else { linear_from_srgb(0.5) },
        }
    }
}

#[derive(Debug)]
pub(super) struct AppearanceKernels {
    pub(super) observe: ComputeKernel,
    pub(super) gather: ComputeKernel,
    pub(super) diffuse: ComputeKernel,
    pub(super) paint: ComputeKernel,
}

impl AppearanceKernels {
    pub(super) fn new(gpu: &GpuContext) -> Self {
        let [observe, gather, diffuse, paint] =
            sources().map(|(name, source)| ComputeKernel::new(gpu, name, &[&source], "main"));
        Self { observe, gather, diffuse, paint }
    }
}

/// Returns name and complete WGSL of each kernel.
fn sources() -> [(&'static str, String); 4] {
    let constants = format!(
        "const WORKGROUP: u32 = {WORKGROUP}u;\nconst NEAR_M: f32 = {NEAR_M:?};\n\
         const MIN_RENDERED_ALPHA: f32 = {MIN_RENDERED_ALPHA:?};\nconst MIN_COVERAGE: f32 = {MIN_COVERAGE:?};\n\
         const RELAX_STEPS: u32 = {}u;\nconst DAMPING: f32 = {:?};\n",
        DiffusionHierarchy::RELAX_STEPS,
        DiffusionHierarchy::DAMPING,
    );
    let common = include_str!("common.wgsl");
    [
        ("appearance: observe", [&constants, common, CAMERA_WGSL, include_str!("observe.wgsl")].concat()),
        ("appearance: gather", [&constants, include_str!("gather.wgsl")].concat()),
        ("appearance: diffuse", [&constants, common, include_str!("diffuse.wgsl")].concat()),
        ("appearance: paint", [&constants, common, include_str!("paint.wgsl")].concat()),
    ]
}

#[cfg(test)]
mod tests {
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    use super::*;

    #[test]
    fn kernels_are_valid_wgsl() {
        for (name, source) in sources() {
            assert!(!source.contains("var<uniform>"), "{name}: see constants.rs");
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
            Validator::new(ValidationFlags::all(), Capabilities::empty())
                .validate(&module)
                .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
            let settings = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some("Settings"));
            if let Some((_, ty)) = settings {
                assert_eq!(ty.inner.size(module.to_ctx()) as usize, size_of::<SettingsConstants>(), "{name}");
            }
        }
    }
}
