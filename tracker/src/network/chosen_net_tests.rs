//! Tests of networks of the user's choice, on networks of one or two layers whose answer is known, and on BlazePose itself.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use prost::Message;
use tract_onnx::pb;

use super::*;
use crate::error::TrackErrorKind;
use crate::landmarks::keypoints::LANDMARK_NAMES;
use crate::network::pose_net::PoseNet;

const WIDTH: usize = 48;
const HEIGHT: usize = 64;

/// Landmarks of the red, green and blue spot; the least that a description needs.
const SPOTS: &str = r#"
    "left shoulder" = 0
    "right shoulder" = 1
    "left hip" = 2
    "right hip" = 2
    "left elbow" = 0
    "right elbow" = 1
    "left knee" = 2
    "right knee" = 2
"#;

fn described(head: &str, landmarks: &str) -> NetworkFile {
    NetworkFile::parse(&format!("file = \"test.onnx\"\n{head}\n[landmarks]\n{landmarks}")).unwrap()
}

fn value(name: &str, shape: &[i64]) -> pb::ValueInfoProto {
    use pb::tensor_shape_proto::{Dimension, dimension::Value};
    let dim = shape.iter().map(|side| Dimension {
        denotation: String::new(),
        value: Some(if *side > 0 { Value::DimValue(*side) } else { Value::DimParam(format!("{name}{side}")) }),
    });
    let tensor = pb::type_proto::Tensor {
        elem_type: pb::tensor_proto::DataType::Float as i32,
        shape: Some(pb::TensorShapeProto { dim: dim.collect() }),
    };
    let of_tensor = pb::type_proto::Value::TensorType(tensor);
    pb::ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(pb::TypeProto { denotation: String::new(), value: Some(of_tensor) }),
        doc_string: String::new(),
    }
}

fn ints(name: &str, ints: &[i64]) -> pb::AttributeProto {
    let r#type = pb::attribute_proto::AttributeType::Ints as i32;
    pb::AttributeProto { name: name.to_owned(), r#type, ints: ints.to_vec(), ..Default::default() }
}

fn node(op: &str, output: &str, attribute: Vec<pb::AttributeProto>) -> pb::NodeProto {
    pb::NodeProto {
        op_type: op.to_owned(),
        name: output.to_owned(),
        input: vec!["image".to_owned()],
        output: vec![output.to_owned()],
        attribute,
        ..Default::default()
    }
}

/// Returns an ONNX file of nodes on one image.
fn onnx(input: &[i64], nodes: Vec<pb::NodeProto>, outputs: Vec<pb::ValueInfoProto>) -> Vec<u8> {
    let graph = pb::GraphProto {
        node: nodes,
        name: "test".to_owned(),
        input: vec![value("image", input)],
        output: outputs,
        ..Default::default()
    };
    let opset_import = vec![pb::OperatorSetIdProto { domain: String::new(), version: 11 }];
    pb::ModelProto { ir_version: 6, opset_import, graph: Some(graph), ..Default::default() }.encode_to_vec()
}

/// Means over 4 x 4 pixels of each channel: three heatmaps.
fn heatmap_onnx(input: &[i64]) -> Vec<u8> {
    let pool = node("AveragePool", "maps", vec![ints("kernel_shape", &[4, 4]), ints("strides", &[4, 4])]);
    onnx(input, vec![pool], vec![value("maps", &[1, 3, 16, 12])])
}

/// Nodes that take the highest value of each channel by column, and by row.
fn simcc_onnx(input: &[i64]) -> Vec<u8> {
    let reduce = |output, axis| {
        let keep = pb::AttributeProto {
            name: "keepdims".to_owned(),
            r#type: pb::attribute_proto::AttributeType::Int as i32,
            i: 0,
            ..Default::default()
        };
        node("ReduceMax", output, vec![ints("axes", &[axis]), keep])
    };
    let outputs = vec![value("x", &[1, 3, WIDTH as i64]), value("y", &[1, 3, HEIGHT as i64])];
    onnx(input, vec![reduce("x", 2), reduce("y", 3)], outputs)
}

const IMAGE: usize = 200;
/// Red, green and blue spot in the image.
const PLACES: [[f64; 2]; 3] = [[90.0, 70.0], [110.0, 72.0], [101.0, 120.0]];

/// Returns an image with a spot of each colour.
fn picture() -> Rgb<'static> {
    let brightness = |x: usize, y: usize, [cx, cy]: [f64; 2]| {
        let d2 = (x as f64 - cx).powi(2) + (y as f64 - cy).powi(2);
        (255.0 * (-d2 / 50.0).exp()) as u8
    };
    let pixel = |at: usize| PLACES.map(|place| brightness(at % IMAGE, at / IMAGE, place));
    Rgb { width: IMAGE, height: IMAGE, bytes: (0..IMAGE * IMAGE).flat_map(pixel).collect() }
}

/// Returns a rotated crop around the spots.
fn crop() -> Crop {
    Crop { center: DVec2::new(100.0, 95.0), side: 96.0, turn: DVec2::from_angle(0.2) }
}

/// Distance of the landmarks of shoulders and hip from the spots, pixels.
fn errors(net: &ChosenNet) -> [f64; 3] {
    let output = net.infer(&picture(), crop()).unwrap();
    assert!(output.mask.is_none() && (0.8..=1.0).contains(&output.presence), "{}", output.presence);
    assert!(output.landmarks[0].x.is_nan() && output.landmarks[0].confidence <= 0.0, "the nose is not given");
    let keypoints = crop().keypoints(&output);
    std::array::from_fn(|i| keypoints[[11, 12, 23][i]].pixel.distance(PLACES[i].into()))
}

#[test]
fn heatmaps_are_read_between_their_pixels() {
    let file = described("output = \"heatmaps\"\ncertain = 0.8", SPOTS);
    let net = ChosenNet::new(file, &heatmap_onnx(&[1, 3, HEIGHT as i64, WIDTH as i64])).unwrap();
    // A cell of 4 pixels, of 2 pixels of the image each, stands for its first one; these hold means, whose middle is 1.5 pixels on
    // in x and y.
    let shift = 1.5 * 2.0 * 2f64.sqrt();
    assert!(errors(&net).iter().all(|error| (error - shift).abs() < 1.2), "{:?}", errors(&net));
}

#[test]
fn rows_and_columns_are_read_and_an_open_size_comes_from_the_description() {
    let simcc = simcc_onnx(&[-1, 3, -2, -3]);
    let file = described("output = \"simcc\"", SPOTS);
    let error = ChosenNet::new(file.clone(), &simcc).err().unwrap().to_string();
    assert!(error.contains("test.onnx") && error.contains("input = "), "{error}");
    let file = NetworkFile { input: Some([WIDTH, HEIGHT]), ..file };
    let net = ChosenNet::new(file, &simcc).unwrap();
    assert!(errors(&net).iter().all(|error| *error < 1.5), "{:?}", errors(&net));
}

#[test]
fn channels_mean_and_deviation_are_those_of_the_description() {
    let simcc = simcc_onnx(&[1, 3, HEIGHT as i64, WIDTH as i64]);
    // The blue spot is where the first channel is, and values have to be brought back to 0..=1.
    let bgr = SPOTS.replace("= 2", "= 9").replace("= 0", "= 2").replace("= 9", "= 0");
    let head = "output = \"simcc\"\nchannels = \"bgr\"\nmean = [10, 20, 30]\ndeviation = [50, 50, 50]\ncertain = 5";
    let net = ChosenNet::new(described(head, &bgr), &simcc).unwrap();
    let output = net.infer(&picture(), crop()).unwrap();
    let keypoints = crop().keypoints(&output);
    for (landmark, place, mean) in [(11, PLACES[0], 30.0), (12, PLACES[1], 20.0), (23, PLACES[2], 10.0)] {
        let seen = keypoints[landmark];
        assert!(seen.pixel.distance(place.into()) < 1.5);
        let expected: f64 = (255.0 - mean) / 50.0 / 5.0;
        assert!((seen.confidence / expected.min(1.0) - 1.0).abs() < 0.05, "{} for {expected}", seen.confidence);
    }
}

#[test]
fn blazepose_that_is_described_sees_what_the_built_in_one_sees() {
    let onnx = include_bytes!("../../assets/pose_full.onnx");
    let names: Vec<String> =
        LANDMARK_NAMES.iter().enumerate().map(|(index, name)| format!("\"{name}\" = {index}")).collect();
    let head = "output = \"points\"\npoint = [\"x\", \"y\", \"skip\", \"logit\", \"logit\"]";
    let chosen = ChosenNet::new(described(head, &names.join("\n")), onnx).unwrap();
    let built_in = PoseNet::embedded().unwrap();
    let [seen, expected] = [chosen.infer(&picture(), crop()).unwrap(), built_in.infer(&picture(), crop()).unwrap()];
    for (seen, expected) in seen.landmarks.iter().zip(&expected.landmarks) {
        assert!((seen.x - expected.x).abs() < 0.02 && (seen.y - expected.y).abs() < 0.02, "{seen:?} {expected:?}");
        assert!((seen.confidence - expected.confidence).abs() < 1e-3);
    }
}

#[test]
fn a_network_that_does_not_fit_its_description_is_named_with_what_it_has() {
    let heatmaps = heatmap_onnx(&[1, 3, HEIGHT as i64, WIDTH as i64]);
    let refused = |head: &str, landmarks: &str, onnx: &[u8]| {
        let error = ChosenNet::new(described(head, landmarks), onnx).err().unwrap();
        assert_eq!(error.kind, TrackErrorKind::Net);
        error.to_string()
    };
    let error = refused("output = \"simcc\"", SPOTS, &heatmaps);
    assert!(error.contains("test.onnx") && error.contains("[1, 3, 16, 12]"), "{error}");
    let error = refused("output = \"heatmaps\"", &SPOTS.replace("= 2", "= 7"), &heatmaps);
    assert!(error.contains("8 landmarks"), "{error}");
    let error = refused("output = \"heatmaps\"\ninput = [64, 64]", SPOTS, &heatmaps);
    assert!(error.contains("48x64"), "{error}");
    let error = refused(
        "output = \"points\"\npoint = [\"x\", \"y\", \"skip\", \"skip\", \"skip\", \"skip\", \"skip\"]",
        SPOTS,
        &heatmaps,
    );
    assert!(error.contains("point"), "{error}");
    let error = refused("output = \"heatmaps\"", SPOTS, &heatmap_onnx(&[1, 5, HEIGHT as i64, WIDTH as i64]));
    assert!(error.contains("three channels"), "{error}");
    let error = refused("output = \"heatmaps\"", SPOTS, &heatmaps[..heatmaps.len() / 2]);
    assert!(error.contains("does not load"), "{error}");
    let error = refused("output = \"heatmaps\"", SPOTS, b"nothing");
    assert!(error.contains("does not load"), "{error}");
}

#[test]
fn numbers_that_are_not_finite_are_refused() {
    let net = heatmap_onnx(&[1, 3, HEIGHT as i64, WIDTH as i64]);
    let net = ChosenNet::new(described("output = \"heatmaps\"\ndeviation = [1e-38, 1, 1]", SPOTS), &net).unwrap();
    assert_eq!(net.infer(&picture(), crop()).unwrap_err().kind, TrackErrorKind::Net);
}

#[test]
fn peaks_lie_between_bins_and_flat_rows_do_no_harm() {
    let parabola = |x: f64| -(x - 0.3).powi(2);
    let at = |x: f64| Some(parabola(x) as f32);
    assert!((between(at(-1.0), parabola(0.0) as f32, at(1.0)) - 0.3).abs() < 1e-5);
    for (before, value, after) in
        [(Some(1.0), 1.0, Some(1.0)), (None, 1.0, Some(0.5)), (Some(f32::NAN), 1.0, Some(0.0))]
    {
        assert!(between(before, value, after).abs() <= 0.5);
    }
    assert_eq!(highest(&[]), None);
}
