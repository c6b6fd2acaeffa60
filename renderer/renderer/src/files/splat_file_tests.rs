//! Splat files of other tools: layouts, types, filters, faults.

use super::*;

/// Value of a property of Gaussian `i`, by a formula for each name.
fn value(name: &str, i: usize) -> f64 {
    let t = i as f64;
    match name {
        "x" => t,
        "y" => -0.5 * t,
        "z" => 0.25,
        "f_dc_1" => 0.2,
        "opacity" => 1.5,
        "scale_0" => -4.0,
        "scale_1" => -5.0 + 0.1 * t,
        "scale_2" => -3.0,
        "rot_0" => 1.0,
        "rot_2" => -0.5,
        _ => name.strip_prefix("f_rest_").map_or(0.0, |k| k.parse::<f64>().unwrap() / 64.0 - 0.4),
    }
}

fn names(rest: usize, flat: bool) -> Vec<String> {
    let fixed = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(str::to_owned);
    let scales = ["opacity", "scale_0", "scale_1", "scale_2"].iter().filter(|name| !(flat && **name == "scale_2"));
    let others = scales.chain(&["rot_0", "rot_1", "rot_2", "rot_3"]).map(|name| (*name).to_owned());
    fixed.into_iter().chain((0..rest).map(|k| format!("f_rest_{k}"))).chain(others).collect()
}

/// Writes a file of 5 Gaussians: doubles or floats, of either order of bytes.
fn file(names: &[String], head: &str, double: bool, big: bool) -> Vec<u8> {
    let (order, kind) = (if big { "big" } else { "little" }, if double { "double" } else { "float" });
    let mut text = format!("ply\nformat binary_{order}_endian 1.0\n{head}element vertex 5\n");
    names.iter().for_each(|name| text += &format!("property {kind} {name}\n"));
    let mut bytes = format!("{text}element face 0\nproperty list uchar int vertex_indices\nend_header\n").into_bytes();
    for i in 0..5 {
        for name in names {
            let number = value(name, i);
            let mut number =
                if double { number.to_le_bytes().to_vec() } else { (number as f32).to_le_bytes().to_vec() };
            if big {
                number.reverse();
            }
            bytes.extend(number);
        }
    }
    bytes
}

#[test]
fn types_and_orders_of_bytes_give_the_same_gaussians() {
    let names = names(9, false);
    let plain = SplatFile::parse(&file(&names, "", false, false)).unwrap();
    assert_eq!((plain.splats.count(), plain.left_out, plain.degree, plain.is_flat), (5, 0, 1, false));
    let shape = plain.splats.scale_opacity[3];
    let expected = [(-4.0f32).exp(), (-4.7f32).exp(), (-3.0f32).exp(), 1.0 / (1.0 + (-1.5f32).exp())];
    assert!(shape.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{shape:?}");
    assert_eq!(plain.splats.rotation[0].map(f32::to_bits), [0.0, -0.5, 0.0, 1.0].map(f32::to_bits));
    for (double, big) in [(false, true), (true, false), (true, true)] {
        let other = SplatFile::parse(&file(&names, "", double, big)).unwrap();
        let pairs = |s: &SplatFile| [&s.splats.center, &s.splats.scale_opacity, &s.splats.harmonics].map(Clone::clone);
        for (a, b) in pairs(&plain).iter().zip(pairs(&other)) {
            assert!(a.as_flattened().iter().zip(b.as_flattened()).all(|(a, b)| (a - b).abs() < 1e-6), "{double} {big}");
        }
    }
}

#[test]
fn degrees_are_read_up_to_two_and_the_third_is_reported() {
    for (rest, degree, order) in [(0, 0, HarmonicOrder::Zero), (24, 2, HarmonicOrder::Two), (45, 3, HarmonicOrder::Two)]
    {
        let read = SplatFile::parse(&file(&names(rest, false), "", false, false)).unwrap();
        assert_eq!((read.degree, read.splats.order), (degree, order));
    }
    // Channel by channel: the first coefficients of red, green, blue of degree 3 are f_rest_0, 15 and 30.
    let read = SplatFile::parse(&file(&names(45, false), "", false, false)).unwrap();
    let expected = SplatFile::parse(&file(&names(24, false), "", false, false)).unwrap();
    let (first, other) = (read.splats.harmonics[1], expected.splats.harmonics[1]);
    let ratio = |k: f64| (k / 64.0 - 0.4) as f32;
    assert!((first[0] - other[0]).abs() < 1e-6);
    assert!((first[1] / other[1] - ratio(15.0) / ratio(8.0)).abs() < 1e-4, "{first:?} {other:?}");
    for rest in [3, 8, 44, 72] {
        assert!(matches!(SplatFile::parse(&file(&names(rest, false), "", false, false)), Err(PlyError::Header(_))));
    }
}

#[test]
fn flat_gaussians_get_a_thin_axis() {
    let read = SplatFile::parse(&file(&names(0, true), "", false, false)).unwrap();
    assert!(read.is_flat);
    for [a, b, c, _] in read.splats.scale_opacity {
        assert!((c / a.min(b) - FLAT).abs() < 1e-5, "{a} {b} {c}");
    }
    assert_eq!(read.splats.rotation[2].map(f32::to_bits), [0.0, -0.5, 0.0, 1.0].map(f32::to_bits));
}

#[test]
fn the_filter_follows_from_the_comment() {
    let filter = |head: &str| SplatFile::parse(&file(&names(0, false), head, false, false)).unwrap().filter;
    assert_eq!(filter("comment SplatRenderMode: mip\n"), SplatFilter::Mip);
    for classic in ["", "comment SplatRenderMode: default\n", "comment made in a workshop\n"] {
        assert_eq!(filter(classic), SplatFilter::Classic);
    }
    let plain = RasterSettings::default();
    assert_eq!(SplatFilter::Mip.applied(plain), plain);
    let classic = SplatFilter::Classic.applied(plain);
    assert!(classic.filter_keeps_opacity && (classic.filter_variance_px2 - 0.3).abs() < 1e-6);
}

#[test]
fn poisoned_rows_are_counted() {
    let names = names(9, false);
    let mut bytes = file(&names, "", false, false);
    let start = bytes.len() - 5 * 4 * names.len();
    for (row, column, poison) in [(0, 0, f32::NAN), (2, 9, f32::INFINITY), (4, names.len() - 1, f32::NAN)] {
        let at = start + 4 * (row * names.len() + column);
        bytes[at..at + 4].copy_from_slice(&poison.to_le_bytes());
    }
    let read = SplatFile::parse(&bytes).unwrap();
    assert_eq!((read.splats.count(), read.left_out), (2, 3));
}

#[test]
fn files_without_gaussians_are_refused_with_a_reason() {
    let plain = names(0, false);
    let mesh: Vec<String> = plain[..6].to_vec();
    assert_eq!(SplatFile::parse(&file(&mesh, "", false, false)), Err(PlyError::Missing("f_dc_0".to_owned())));
    let packed = [plain, vec!["packed_position".to_owned()]].concat();
    assert_eq!(SplatFile::parse(&file(&packed, "", false, false)), Err(PlyError::Packed));
    assert_eq!(SplatFile::parse(b"ply\n"), Err(PlyError::NoEnd));
}
