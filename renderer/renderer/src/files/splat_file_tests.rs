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
fn degrees_are_read_up_to_two_and_higher_ones_are_reported() {
    let two = HarmonicOrder::Two;
    for (rest, degree, order) in [(0, 0, HarmonicOrder::Zero), (24, 2, two), (45, 3, two), (72, 4, two)] {
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
    for rest in [3, 8, 44, 71, 75] {
        assert!(matches!(SplatFile::parse(&file(&names(rest, false), "", false, false)), Err(PlyError::Header(_))));
    }
}

/// Writes 5 Gaussians as a tool does: its header, in the order of `names`, each of which may begin with a type.
fn as_written_by(head: &str, names: &str, tail: &str) -> Vec<u8> {
    let columns: Vec<(&str, &str)> =
        names.split(' ').map(|name| name.split_once(':').unwrap_or(("float", name))).collect();
    let mut text = format!("ply\nformat binary_little_endian 1.0\n{head}element vertex 5\n");
    columns.iter().for_each(|(kind, name)| text += &format!("property {kind} {name}\n"));
    let mut bytes = format!("{text}{tail}end_header\n").into_bytes();
    for i in 0..5 {
        for (kind, name) in &columns {
            match *kind {
                "uchar" => bytes.push(if *name == "green" { 255 } else { 51 }),
                "double" => bytes.extend(value(name, i).to_le_bytes()),
                _ => bytes.extend((value(name, i) as f32).to_le_bytes()),
            }
        }
    }
    // Rows of the elements after the Gaussians.
    bytes.extend([7; 64]);
    bytes
}

fn numbers(from: std::ops::Range<usize>) -> String {
    from.map(|k| format!("f_rest_{k}")).collect::<Vec<_>>().join(" ")
}

#[test]
fn headers_of_other_tools_give_the_same_gaussians() {
    let rest = numbers(0..9);
    let reference = SplatFile::parse(&file(&names(9, false), "", false, false)).unwrap().splats;
    let constant = SplatFile::parse(&file(&names(0, false), "", false, false)).unwrap().splats;
    let brush =
        "comment Exported from Brush\ncomment Vertical axis: y\ncomment SH degree: 1\ncomment SplatRenderMode: mip\n";
    let shape = "scale_0 scale_1 scale_2";
    let turn = "rot_0 rot_1 rot_2 rot_3";
    let color = "f_dc_0 f_dc_1 f_dc_2";
    let sharp = "element extrinsic 16\nproperty float extrinsic\nelement color_space 1\nproperty uchar color_space\n";
    let cases = [
        (
            "the reference code",
            "",
            format!("x y z nx ny nz {color} {rest} opacity {shape} {turn}"),
            "",
            SplatFilter::Classic,
        ),
        ("Brush", brush, format!("x y z {shape} opacity {turn} {color} {rest}"), "", SplatFilter::Mip),
        ("gsplat", "", format!("x y z {color} {rest} opacity {shape} {turn}"), "", SplatFilter::Classic),
        (
            "Nerfstudio",
            "comment Generated by Nerstudio 1.1.5\ncomment Vertical Axis: z\n",
            format!("x y z nx ny nz {color} {rest} opacity {shape} {turn}"),
            "",
            SplatFilter::Classic,
        ),
        (
            "splat-transform from SOG",
            "",
            format!("x y z {shape} {color} opacity {turn} {rest}"),
            "",
            SplatFilter::Classic,
        ),
        (
            "splat-transform from packed PLY",
            "comment Generated by splat-transform 2.7.1\n",
            format!("x y z {color} opacity {turn} {shape} {rest}"),
            "",
            SplatFilter::Classic,
        ),
        (
            "colours beside",
            "",
            format!("double:x y z uchar:red uchar:green uchar:blue opacity {shape} {turn} {color} {rest}"),
            "",
            SplatFilter::Classic,
        ),
        (
            "elements after",
            "obj_info made elsewhere\n",
            format!("x y z {color} {rest} opacity {shape} {turn}"),
            sharp,
            SplatFilter::Classic,
        ),
    ];
    for (tool, head, names, tail, filter) in cases {
        let read = SplatFile::parse(&as_written_by(head, &names, tail)).unwrap();
        assert_eq!((read.splats, read.left_out, read.degree), (reference.clone(), 0, 1), "{tool}");
        assert_eq!(read.filter, filter, "{tool}");
        let without = names.replace(&format!(" {rest}"), "");
        let read = SplatFile::parse(&as_written_by(head, &without, tail)).unwrap();
        assert_eq!((read.splats, read.degree), (constant.clone(), 0), "{tool}");
    }
    // Packed ones, with and without ranges of colours and harmonics.
    let chunk = "element chunk 1\nproperty float min_x\nproperty float max_x\n";
    let packed = "uint:packed_position uint:packed_rotation uint:packed_scale uint:packed_color";
    for (head, tail) in [
        (chunk.to_owned(), ""),
        (
            format!("comment Generated by SuperSplat 2.4.1\n{chunk}property float min_r\n"),
            "element sh 5\nproperty uchar f_rest_0\n",
        ),
    ] {
        assert_eq!(SplatFile::parse(&as_written_by(&head, packed, tail)), Err(PlyError::Packed), "{head}");
    }
}

#[test]
fn plain_colors_of_nerfstudio_become_constant_harmonics() {
    let of = |kind: &str| {
        let colors = format!("{kind}red {kind}green {kind}blue");
        let names = format!("x y z nx ny nz {colors} opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3");
        SplatFile::parse(&as_written_by("", &names, "")).unwrap()
    };
    let read = of("uchar:");
    assert_eq!((read.splats.count(), read.degree, read.splats.order), (5, 0, HarmonicOrder::Zero));
    // 51 of 255 in sRGB, and all of it.
    let [red, green, ..] = read.splats.harmonics[2].map(|value| f64::from(value * SH_DEGREE_0));
    let linear = ((0.2f64 + 0.055) / 1.055).powf(2.4);
    assert!((red - linear).abs() < 1e-5 && (green - 1.0).abs() < 1e-5, "{red} {green}");
    // Floats are taken as 0..=1; the formula gives 0.
    assert!(of("").splats.harmonics[2].iter().all(|value| value.abs() < 1e-6));
    let mesh = as_written_by("", "x y z uchar:red uchar:green uchar:blue", "");
    assert_eq!(SplatFile::parse(&mesh), Err(PlyError::Missing("opacity".to_owned())));
}

/// Scales and opacity against a plain f64 reference: variances add, the integral over space stays.
#[test]
fn the_smoothing_filter_of_mip_splatting_is_applied() {
    let plain = names(0, false);
    let with = [plain.clone(), vec!["filter_3D".to_owned()]].concat();
    let mut bytes = file(&with, "", false, false);
    let start = bytes.len() - 5 * 4 * with.len();
    let mut set = |row: usize, deviation: f32| {
        let at = start + 4 * ((row + 1) * with.len() - 1);
        bytes[at..at + 4].copy_from_slice(&deviation.to_le_bytes());
    };
    for (row, deviation) in [0.01, 0.0, 0.3, f32::NAN, f32::INFINITY].into_iter().enumerate() {
        set(row, deviation);
    }
    let before = SplatFile::parse(&file(&plain, "", false, false)).unwrap().splats;
    let read = SplatFile::parse(&bytes).unwrap();
    assert_eq!((read.splats.count(), read.left_out, read.filter), (3, 2, SplatFilter::Mip));
    for (row, deviation) in [0.01f64, 0.0, 0.3].into_iter().enumerate() {
        let [.., opacity] = before.scale_opacity[row].map(f64::from);
        let own = before.scale_opacity[row].map(f64::from);
        let wide = [0, 1, 2].map(|k| own[k].hypot(deviation));
        let expected = opacity * (0..3).map(|k| own[k] / wide[k]).product::<f64>();
        let found = read.splats.scale_opacity[row].map(f64::from);
        assert!((0..3).all(|k| (found[k] - wide[k]).abs() < 1e-6 * wide[k]), "{found:?} {wide:?}");
        assert!((found[3] - expected).abs() < 1e-5 * expected, "{found:?} {expected}");
    }
    let named = SplatFile::parse(&file(&with, "comment SplatRenderMode: default\n", false, false)).unwrap();
    assert_eq!(named.filter, SplatFilter::Classic);
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
