//! Gaussians as binary glTF with the extension KHR_gaussian_splatting.

use std::path::Path;

use flyrig_body::GlbWriter;
use flyrig_model::srgb;
use flyrig_renderer::{AnisotropicSplats, SH_DEGREE_0};
use glam::{Quat, Vec3};
use serde_json::{Map, Value, json};

use crate::error::AvatarError;

const EXTENSION: &str = "KHR_gaussian_splatting";
/// Constant that the extension adds to the sum of the harmonics.
const BIAS: f32 = 0.5;

/// Writes Gaussians as glTF, in colours of sRGB, the space that viewers draw whatever the file says and that Gaussians of other programs
/// are trained in. As in PLY files, the constant part of the harmonics is converted exactly and the others by the slope there. `COLOR_0`,
/// for viewers without the extension, is linear, as glTF requires. `file_from_world` rotates them to y up, metres. Gaussians
/// with a NaN or an infinity are skipped. Returns the number written.
///
/// # Errors
/// [`AvatarError::Body`] names the file; the old one, if any, is then untouched.
pub fn write_splat_glb(path: &Path, splats: &AnisotropicSplats, file_from_world: Quat) -> Result<usize, AvatarError> {
    let coefficients = splats.order.coefficients();
    let is_finite = |i: &usize| {
        let rows = [&splats.center[*i], &splats.scale_opacity[*i], &splats.rotation[*i]];
        let harmonics = &splats.harmonics[i * coefficients..(i + 1) * coefficients];
        rows.into_iter().chain(harmonics).flatten().all(|value| value.is_finite())
    };
    let kept: Vec<usize> = (0..splats.count()).filter(is_finite).collect();
    let numbers = |of: &dyn Fn(usize) -> Vec<f32>| kept.iter().flat_map(|i| of(*i)).collect::<Vec<f32>>();
    let mut glb = GlbWriter::default();
    let positions: Vec<Vec3> = kept.iter().map(|i| Vec3::from_slice(&splats.center[*i])).collect();
    let turn = |i: usize| Quat::from_array(splats.rotation[i]).normalize().to_array().to_vec();
    let opacities = numbers(&|i| vec![splats.scale_opacity[i][3].clamp(0.0, 1.0)]);
    let color = |i: usize| splats.harmonics[i * coefficients].map(|value| (value * SH_DEGREE_0).clamp(0.0, 1.0));
    let fallback = numbers(&|i| color(i)[..3].iter().copied().chain([splats.scale_opacity[i][3]]).collect());
    let mut attributes = Map::new();
    let mut add = |name: String, accessor: usize| attributes.insert(name, json!(accessor));
    add("POSITION".to_owned(), glb.positions(&positions));
    add("COLOR_0".to_owned(), glb.floats(&fallback, "VEC4", 4));
    add(format!("{EXTENSION}:ROTATION"), glb.floats(&numbers(&turn), "VEC4", 4));
    add(format!("{EXTENSION}:SCALE"), glb.floats(&numbers(&|i| splats.scale_opacity[i][..3].to_vec()), "VEC3", 3));
    add(format!("{EXTENSION}:OPACITY"), glb.floats(&opacities, "SCALAR", 1));
    for k in 0..coefficients {
        let (degree, index) = place(k);
        let values = numbers(&|i| {
            let constant = splats.harmonics[i * coefficients];
            let own = splats.harmonics[i * coefficients + k];
            let value = |c: usize| match k {
                0 => (encode(SH_DEGREE_0 * constant[c]).0 - BIAS) / SH_DEGREE_0,
                _ => own[c] * encode(SH_DEGREE_0 * constant[c]).1,
            };
            [0, 1, 2].map(value).to_vec()
        });
        add(format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"), glb.floats(&values, "VEC3", 3));
    }
    let extension = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    });
    glb.write(
        path,
        json!({
            "extensionsUsed": [EXTENSION],
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "name": "avatar", "mesh": 0, "rotation": file_from_world.to_array() }],
            "meshes": [{ "primitives": [{ "mode": 0, "attributes": Value::Object(attributes), "extensions": { EXTENSION: extension } }] }],
        }),
    )?;
    Ok(kept.len())
}

/// sRGB value of a linear one and the slope there. The curve goes on above 1, and below 0 as above it.
fn encode(linear: f32) -> (f32, f32) {
    let x = linear.abs();
    (srgb::encode(x, f32::powf).copysign(linear), srgb::slope(x, f32::powf))
}

/// Returns degree and index within the degree of a coefficient, in the renderer's order.
fn place(coefficient: usize) -> (usize, usize) {
    match coefficient {
        0 => (0, 0),
        1..=3 => (1, coefficient - 1),
        _ => (2, coefficient - 4),
    }
}

#[cfg(test)]
mod tests {
    use flyrig_renderer::HarmonicOrder;

    use super::*;

    #[test]
    fn a_file_holds_the_finite_gaussians() {
        let splats = AnisotropicSplats {
            center: vec![[1.0, 2.0, 3.0, 0.0], [f32::NAN; 4]],
            scale_opacity: vec![[0.01, 0.02, 0.03, 0.5]; 2],
            rotation: vec![[0.0, 0.0, 0.0, 2.0]; 2],
            harmonics: (0..8).map(|k| [k as f32, 0.5, 0.25, 0.0]).collect(),
            order: HarmonicOrder::One,
        };
        let path = std::env::temp_dir().join(format!("flyrig-splats-{}.glb", std::process::id()));
        assert_eq!(write_splat_glb(&path, &splats, Quat::IDENTITY).unwrap(), 1);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&bytes[..4], word(8)), (b"glTF".as_slice(), bytes.len()));
        let document: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
        let binary = 20 + word(12) + 8;
        let numbers = |name: &str| -> Vec<f32> {
            let accessor = &document["meshes"][0]["primitives"][0]["attributes"][name];
            let accessor = &document["accessors"][accessor.as_u64().unwrap() as usize];
            let view = &document["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
            let (from, length) =
                (view["byteOffset"].as_u64().unwrap() as usize, view["byteLength"].as_u64().unwrap() as usize);
            bytes[binary + from..binary + from + length]
                .chunks(4)
                .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
                .collect()
        };
        let near = |name: &str, expected: &[f32]| {
            let found = numbers(name);
            assert!(
                found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5),
                "{name}: {found:?}"
            );
        };
        near("POSITION", &[1.0, 2.0, 3.0]);
        near("KHR_gaussian_splatting:ROTATION", &[0.0, 0.0, 0.0, 1.0]);
        near("KHR_gaussian_splatting:OPACITY", &[0.5]);
        // The sum that the extension prescribes is the sRGB value; small changes of it are those of the linear value.
        let curve = |linear: f32| match linear * SH_DEGREE_0 {
            x if x <= 0.003_130_8 => 12.92 * x,
            x => 1.055 * x.powf(1.0 / 2.4) - 0.055,
        };
        let slope = |linear: f32| (curve(linear + 1e-3) - curve(linear)) / (1e-3 * SH_DEGREE_0);
        let sums = numbers("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0");
        for (sum, linear) in sums.iter().zip([0.0, 0.5, 0.25]) {
            assert!((0.5 + SH_DEGREE_0 * sum - curve(linear)).abs() < 1e-5, "{sums:?}");
        }
        let varying = numbers("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2");
        for ((found, linear), base) in varying.iter().zip([3.0, 0.5, 0.25]).zip([0.0, 0.5, 0.25]) {
            assert!((found / (linear * slope(base)) - 1.0).abs() < 0.01, "{varying:?}");
        }
        assert_eq!(
            document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["colorSpace"],
            json!("srgb_rec709_display")
        );
        assert!((numbers("COLOR_0")[1] - 0.5 * SH_DEGREE_0).abs() < 1e-6);
    }
}
