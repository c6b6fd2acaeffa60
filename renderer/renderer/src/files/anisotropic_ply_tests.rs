//! Files of anisotropic Gaussians: what is written is read again, and damaged files are refused with a reason.

use std::fs;

use super::*;
use crate::anisotropic::order::HarmonicOrder;
use crate::files::ply_error::PlyError;
use crate::files::splat_file::SplatFile;

fn parse(bytes: &[u8]) -> Result<AnisotropicSplats, PlyError> {
    SplatFile::parse(bytes).map(|file| file.splats)
}

fn splats(order: HarmonicOrder, count: usize) -> AnisotropicSplats {
    let mut splats = AnisotropicSplats::empty(order);
    for i in 0..count {
        let t = i as f32;
        splats.center.push([t, -t, 0.5 * t, 0.0]);
        splats.scale_opacity.push([0.01 + 0.001 * t, 0.02, 0.003, 0.1 + 0.8 * (t / count as f32)]);
        splats.rotation.push([0.1 * t, 0.2, -0.3, 1.0]);
        // Black, negative and very bright ones too.
        let element = |k: usize| [0.3 * t - 0.6 * k as f32, 0.002 * t, 1.5 - 0.1 * (t + k as f32), 0.0];
        splats.harmonics.extend((0..order.coefficients()).map(element));
    }
    splats
}

fn written(splats: &AnisotropicSplats) -> (usize, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let count = write_anisotropic_ply(&path, splats).unwrap();
    (count, fs::read(&path).unwrap())
}

#[test]
fn what_is_written_is_read_again_in_every_order() {
    for order in HarmonicOrder::ALL {
        let splats = splats(order, 17);
        let (count, bytes) = written(&splats);
        assert_eq!(count, 17);
        let again = parse(&bytes).unwrap();
        assert_eq!((again.order, again.count()), (order, 17));
        let attributes =
            |s: &AnisotropicSplats| [&s.center, &s.scale_opacity, &s.rotation, &s.harmonics].map(Clone::clone);
        for (a, b) in attributes(&again).iter().zip(&attributes(&splats)) {
            for (a, b) in a.as_flattened().iter().zip(b.as_flattened()) {
                assert!((a - b).abs() <= 2e-5 * b.abs().max(0.1), "{a} {b}");
            }
        }
    }
}

#[test]
fn the_layout_is_that_of_the_reference_code() {
    let mut one = splats(HarmonicOrder::One, 1);
    one.scale_opacity[0][3] = 0.5;
    // White in all directions but along one axis.
    one.harmonics = vec![[1.0 / SH_DEGREE_0; 4], [0.0; 4], [0.1, 0.2, 0.3, 0.0], [0.0; 4]];
    let (_, bytes) = written(&one);
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let values: Vec<f32> = bytes[end..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(names.len(), values.len());
    let value = |name: &str| values[names.iter().position(|n| *n == name).unwrap()];
    let near = |a: f32, b: f32| assert!((a - b).abs() < 1e-5, "{a} {b}");
    near(value("f_dc_0"), 0.5 / SH_DEGREE_0);
    // The slope of the sRGB curve at 1 is 1.055 / 2.4; f_rest is channel by channel.
    for (name, expected) in [("f_rest_1", 0.1), ("f_rest_4", 0.2), ("f_rest_7", 0.3), ("f_rest_0", 0.0)] {
        near(value(name), expected * 1.055 / 2.4);
    }
    // Within its range the curve is that of isotropic splats.
    (0..=20).for_each(|i| near(encode(0.05 * i as f32).0, crate::srgb_from_linear(0.05 * i as f32)));
    near(value("opacity"), 0.0);
    near(value("scale_0"), 0.01f32.ln());
    near(value("rot_0"), 1.0);
    near(value("rot_1"), 0.0);
    near(value("rot_3"), -0.3);
}

#[test]
fn poison_is_left_out() {
    let mut poisoned = splats(HarmonicOrder::Two, 6);
    poisoned.center[0][1] = f32::NAN;
    poisoned.scale_opacity[1][0] = f32::INFINITY;
    poisoned.rotation[2][3] = f32::NAN;
    poisoned.harmonics[3 * 9 + 8][2] = f32::NEG_INFINITY;
    poisoned.scale_opacity[4][3] = f32::NAN;
    let (count, bytes) = written(&poisoned);
    assert_eq!((count, parse(&bytes).unwrap().count()), (1, 1));
    assert_eq!(written(&splats(HarmonicOrder::One, 0)).0, 0);
}

#[test]
fn damaged_files_are_refused_with_a_reason() {
    let (_, bytes) = written(&splats(HarmonicOrder::One, 3));
    let text = |from: &str, to: &str| {
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = String::from_utf8(bytes[..end].to_vec()).unwrap().replacen(from, to, 1);
        [header.as_bytes(), &bytes[end..]].concat()
    };
    let refused = |bytes: &[u8]| parse(bytes).unwrap_err();
    assert_eq!(refused(b""), PlyError::NoEnd);
    assert_eq!(refused(&bytes[..40]), PlyError::NoEnd);
    assert!(matches!(refused(&bytes[..bytes.len() - 1]), PlyError::Short { gaussians: 3, .. }));
    assert!(matches!(refused(&text("vertex 3", "vertex 18446744073709551615")), PlyError::Short { .. }));
    assert!(matches!(refused(&text("vertex 3", "vertex -3")), PlyError::Header(_)));
    assert!(matches!(refused(&text("binary_little_endian", "ascii")), PlyError::Header(_)));
    assert!(matches!(refused(&text("float x", "double x")), PlyError::Short { gaussians: 3, .. }));
    assert!(matches!(refused(&text("float x", "list uchar int x")), PlyError::Header(_)));
    assert!(matches!(refused(&text("f_rest_8", "f_else_8")), PlyError::Header(_)));
    assert_eq!(refused(&text("rot_2", "rot_9")), PlyError::Missing("rot_2".to_owned()));
    assert!(matches!(refused(b"ply\n\xff\xfe\n"), PlyError::NoEnd));
    assert!(matches!(
        refused(b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n"),
        PlyError::Header(_)
    ));
    assert_eq!(refused(&[b'x'; 1 << 17]), PlyError::NoEnd);
    let nothing = b"ply\nformat binary_little_endian 1.0\nelement vertex 4294967296\nend_header\n";
    assert!(matches!(refused(nothing), PlyError::Missing(_)));
    // What other tools add does no harm.
    let commented = text("element vertex", "comment of another tool\nelement vertex");
    assert_eq!(parse(&commented).unwrap().count(), 3);
}

#[test]
fn refusals_name_the_file_and_leave_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let one = splats(HarmonicOrder::Zero, 1);
    let nowhere = folder.path().join("no/such/folder.ply");
    assert!(write_anisotropic_ply(&nowhere, &one).unwrap_err().to_string().contains("no/such/folder.ply"));
    // The target is a folder: the rename fails and the partial file goes.
    let taken = folder.path().join("taken.ply");
    fs::create_dir(&taken).unwrap();
    assert!(matches!(write_anisotropic_ply(&taken, &one), Err(ExportError::Io { .. })));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}
