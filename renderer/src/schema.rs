//! The attributes of a Gaussian: the one place that names them for buffers, kernels, read-back and files.
//!
//! On the wire (`transport/src/splats.rs`) a splat has `center_scale` and `color` in its own quantisation; `normal` and
//! `canonical` stay on the device.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};

/// Element of every attribute's buffer.
pub type GaussianElement = [f32; 4];
/// The same in WGSL.
const WGSL_ELEMENT: &str = "vec4<f32>";

/// One attribute of every Gaussian, a [`GaussianElement`] each in a buffer of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GaussianAttribute {
    /// Name of the buffer in Rust and WGSL.
    pub name: &'static str,
    /// Label of the buffer.
    pub label: &'static str,
    /// Meaning of the four components; empty where one is unused.
    pub components: [&'static str; 4],
    /// Unit of the components.
    pub unit: &'static str,
}

/// World position and standard deviation of the isotropic Gaussian.
pub const CENTER_SCALE: GaussianAttribute = GaussianAttribute {
    name: "center_scale",
    label: "Gaussian centres",
    components: ["x", "y", "z", "scale"],
    unit: "metres",
};
/// World unit normal of the surface, and depth of the centre below the surface that is drawn.
pub const NORMAL: GaussianAttribute = GaussianAttribute {
    name: "normal",
    label: "Gaussian normals",
    components: ["nx", "ny", "nz", "depth"],
    unit: "none; metres",
};
/// Linear colour, and opacity in 0..=1.
pub const COLOR: GaussianAttribute = GaussianAttribute {
    name: "color",
    label: "Gaussian colours",
    components: ["red", "green", "blue", "opacity"],
    unit: "linear RGB",
};
/// Canonical position. Constant over time.
pub const CANONICAL: GaussianAttribute = GaussianAttribute {
    name: "canonical",
    label: "Gaussian canonical positions",
    components: ["x", "y", "z", ""],
    unit: "metres",
};

/// All attributes, in the order of their bindings.
pub const GAUSSIAN_ATTRIBUTES: [GaussianAttribute; 4] = [CENTER_SCALE, NORMAL, COLOR, CANONICAL];

/// Properties of a splat in a PLY file, in the layout of the 3D Gaussian Splatting reference code: position, normal,
/// degree-0 spherical harmonic of the sRGB colour, logit of the opacity, natural logarithms of the standard deviations along
/// the axes, and the rotation as a quaternion w, x, y, z.
pub const PLY_PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

impl GaussianAttribute {
    /// Creates the attribute's buffer for `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(&self, gpu: &GpuContext, count: usize) -> Result<StorageBuffer<GaussianElement>, GpuError> {
        StorageBuffer::zeroed(gpu, self.label, count)
    }
}

/// WGSL declarations of all attributes as read-only bindings of group 0, from binding `first` on.
pub(crate) fn bindings_wgsl(first: u32) -> String {
    let declare = |(binding, attribute): (u32, &GaussianAttribute)| {
        format!("@group(0) @binding({binding}) var<storage, read> {}: array<{WGSL_ELEMENT}>;\n", attribute.name)
    };
    (first..).zip(&GAUSSIAN_ATTRIBUTES).map(declare).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_elements_have_the_size_of_their_wgsl() {
        let module = naga::front::wgsl::parse_str(&bindings_wgsl(1)).unwrap();
        assert_eq!(module.global_variables.len(), GAUSSIAN_ATTRIBUTES.len());
        for ((_, variable), attribute) in module.global_variables.iter().zip(GAUSSIAN_ATTRIBUTES) {
            assert_eq!(variable.name.as_deref(), Some(attribute.name));
            let naga::TypeInner::Array { stride, .. } = module.types[variable.ty].inner else { panic!("an array") };
            assert_eq!(stride as usize, size_of::<GaussianElement>());
        }
        let mut properties = PLY_PROPERTIES.to_vec();
        properties.sort_unstable();
        properties.dedup();
        assert_eq!(properties.len(), PLY_PROPERTIES.len());
    }
}
