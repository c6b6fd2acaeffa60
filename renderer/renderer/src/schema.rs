//! Attributes of a Gaussian: the single definition for buffers, kernels, read-back and files.
//!
//! On the wire (`transport/stream/src/splats.rs`) a splat has `center_scale` and `color` in its own quantisation; `normal` and
//! `canonical` stay on the device.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};

use crate::anisotropic::order::HarmonicOrder;

/// Element of every attribute's buffer.
pub type GaussianElement = [f32; 4];
/// WGSL type of a [`GaussianElement`].
const WGSL_ELEMENT: &str = "vec4<f32>";

/// Attribute of every Gaussian, one [`GaussianElement`] each in a separate buffer.
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

/// All attributes of an isotropic Gaussian, in the order of their bindings.
pub const GAUSSIAN_ATTRIBUTES: [GaussianAttribute; 4] = [CENTER_SCALE, NORMAL, COLOR, CANONICAL];

/// World position of an anisotropic Gaussian.
pub const CENTER: GaussianAttribute =
    GaussianAttribute { name: "center", label: "Gaussian centres", components: ["x", "y", "z", ""], unit: "metres" };
/// Standard deviations along the Gaussian's own axes, and opacity in 0..=1.
pub const SCALE_OPACITY: GaussianAttribute = GaussianAttribute {
    name: "scale_opacity",
    label: "Gaussian scales",
    components: ["scale x", "scale y", "scale z", "opacity"],
    unit: "metres; none",
};
/// Quaternion of any length: world from the Gaussian's axes.
pub const ROTATION: GaussianAttribute =
    GaussianAttribute { name: "rotation", label: "Gaussian rotations", components: ["x", "y", "z", "w"], unit: "none" };
/// Coefficients of the colour by direction, [`HarmonicOrder::coefficients`](crate::HarmonicOrder::coefficients)
/// consecutive elements per Gaussian.
pub const HARMONICS: GaussianAttribute = GaussianAttribute {
    name: "harmonics",
    label: "Gaussian harmonics",
    components: ["red", "green", "blue", ""],
    unit: "linear RGB",
};

/// All attributes of an anisotropic Gaussian, in the order of their bindings.
pub const ANISOTROPIC_ATTRIBUTES: [GaussianAttribute; 4] = [CENTER, SCALE_OPACITY, ROTATION, HARMONICS];

/// Properties of a splat in a PLY file, in the layout of the 3D Gaussian Splatting reference code: position, normal,
/// degree-0 spherical harmonic of the sRGB colour, logit of the opacity, natural logarithms of the standard deviations along
/// the axes, and the rotation as a quaternion w, x, y, z.
pub const PLY_PROPERTIES: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

/// Returns the properties of an anisotropic Gaussian in a PLY file: [`PLY_PROPERTIES`] with the higher harmonics after
/// the constant ones, all coefficients of red, then of green, then of blue.
pub(crate) fn anisotropic_ply_properties(order: HarmonicOrder) -> Vec<String> {
    const CONSTANT: usize = 9;
    let rest = (0..3 * (order.coefficients() - 1)).map(|k| format!("f_rest_{k}"));
    let [before, after] = [&PLY_PROPERTIES[..CONSTANT], &PLY_PROPERTIES[CONSTANT..]];
    before.iter().map(ToString::to_string).chain(rest).chain(after.iter().map(ToString::to_string)).collect()
}

impl GaussianAttribute {
    /// Creates the attribute's buffer for `count` Gaussians, all zero.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn zeroed(&self, gpu: &GpuContext, count: usize) -> Result<StorageBuffer<GaussianElement>, GpuError> {
        StorageBuffer::zeroed(gpu, self.label, count)
    }
}

/// Returns WGSL declarations of attributes as read-only bindings of group 0, from binding `first` on.
pub(crate) fn bindings_wgsl(first: u32, attributes: &[GaussianAttribute]) -> String {
    let declare = |(binding, attribute): (u32, &GaussianAttribute)| {
        format!("@group(0) @binding({binding}) var<storage, read> {}: array<{WGSL_ELEMENT}>;\n", attribute.name)
    };
    (first..).zip(attributes).map(declare).collect()
}

/// Returns WGSL declarations of the attributes' derivatives, each named as its attribute with `_out`, as bindings of
/// group 0 from binding `first` on.
pub(crate) fn derivatives_wgsl(first: u32, attributes: &[GaussianAttribute]) -> String {
    let declare = |(binding, attribute): (u32, &GaussianAttribute)| {
        format!(
            "@group(0) @binding({binding}) var<storage, read_write> {}_out: array<{WGSL_ELEMENT}>;\n",
            attribute.name
        )
    };
    (first..).zip(attributes).map(declare).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_elements_have_the_size_of_their_wgsl() {
        for attributes in [GAUSSIAN_ATTRIBUTES, ANISOTROPIC_ATTRIBUTES] {
            let declared = [bindings_wgsl(1, &attributes), derivatives_wgsl(5, &attributes)].concat();
            let module = naga::front::wgsl::parse_str(&declared).unwrap();
            let names = attributes.iter().map(|a| a.name.to_owned());
            let expected: Vec<_> = names.clone().chain(names.map(|name| name + "_out")).collect();
            let found: Vec<_> = module.global_variables.iter().filter_map(|(_, v)| v.name.clone()).collect();
            assert_eq!(found, expected);
            for (_, variable) in module.global_variables.iter() {
                let naga::TypeInner::Array { stride, .. } = module.types[variable.ty].inner else { panic!("an array") };
                assert_eq!(stride as usize, size_of::<GaussianElement>());
            }
        }
        let mut properties = PLY_PROPERTIES.to_vec();
        properties.sort_unstable();
        properties.dedup();
        assert_eq!(properties.len(), PLY_PROPERTIES.len());
    }
}
