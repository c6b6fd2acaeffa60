//! Settings of the image loss and the constants that Rust and WGSL share.

use bytemuck::{Pod, Zeroable};

/// Pixels of a column per invocation.
pub(super) const ROWS: u32 = 4;
/// Columns per workgroup.
pub(super) const LANES: u32 = 64;
/// Partial sums per image that are read back; the CPU adds them in `f64`.
pub(super) const SUMS: u32 = 64;

/// Weights of an image's loss
/// `color_weight * |Δ colour|² + mask_weight * (Δ alpha)²`, summed over the pixels of an area: FlyHuman's Eq. 3 over
/// premultiplied linear colour and coverage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LossSettings {
    /// λ_color.
    pub color_weight: f32,
    /// λ_mask.
    pub mask_weight: f32,
    /// Compared area, `[left, top, right, bottom]` in pixels, right and bottom excluded.
    pub area: [u32; 4],
    /// Whether pixels of the image that are [`UNKNOWN_RGBA`] are ignored: a compared pixel with more than half of them
    /// adds neither to the loss nor to its derivatives.
    pub with_unknown: bool,
}

/// Marker of a pixel without information about the person, such as another person's: no coverage, and a colour next to
/// black.
pub const UNKNOWN_RGBA: [u8; 4] = [0, 0, 1, 0];

/// Constants of one comparison, `struct Loss` in image_loss.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(super) struct LossConstants {
    pub size: [u32; 2],
    pub first: [u32; 2],
    pub area: [u32; 2],
    pub sums_at: u32,
    pub color_weight: f32,
    pub mask_weight: f32,
    pub source_width: u32,
    pub shrink: u32,
    pub with_unknown: u32,
}
