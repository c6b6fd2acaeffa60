//! Tests of products with planes, against f64 and tract's own.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

use tract_onnx::tract_core::ops::cnn::{Conv, KernelFormat, PaddingSpec, PoolSpec};
use tract_onnx::tract_core::ops::math::{add, max, min};
use tract_onnx::tract_core::ops::nn::DataFormat;
use tract_onnx::tract_core::plan::eval;

use super::*;
use crate::network::depthwise::replace_depthwise;

/// Convolution with a clip to 0..=6 behind it; then an addition and a clip to 1..=5.
struct Case {
    format: DataFormat,
    planes: usize,
    channels: usize,
    size: [usize; 2],
    adds: bool,
}

impl Case {
    fn shape(&self, channels: usize) -> Vec<usize> {
        self.format.from_n_c_hw(1, channels, self.size).unwrap().shape.to_vec()
    }

    fn weights(&self) -> Vec<f32> {
        (0..self.channels * self.planes).map(|i| ((i * 7919) % 101) as f32 * 0.004 - 0.18).collect()
    }

    fn biases(&self) -> Vec<f32> {
        (0..self.channels).map(|i| (i % 7) as f32 * 0.3).collect()
    }

    fn model(&self) -> TypedModel {
        let mut model = TypedModel::default();
        let input = model.add_source("input", f32::fact(self.shape(self.planes))).unwrap();
        let shape = [self.channels, self.planes, 1, 1];
        let weights = model.add_const("weights", Tensor::from_shape(&shape, &self.weights()).unwrap()).unwrap();
        let biases = model.add_const("biases", tensor1(&self.biases())).unwrap();
        let pool_spec = PoolSpec {
            data_format: self.format,
            kernel_shape: tvec!(1, 1),
            padding: PaddingSpec::Valid,
            dilations: None,
            strides: None,
            input_channels: self.planes,
            output_channels: self.channels,
        };
        let conv = Conv { pool_spec, kernel_fmt: KernelFormat::OIHW, group: 1, q_params: None };
        let mut wire = model.wire_node("conv", conv, &[input, weights, biases]).unwrap();
        let ones = vec![1; self.shape(1).len()];
        let clip = |model: &mut TypedModel, wire: OutletId, name: &str, range: [f32; 2]| {
            let [low, high] = range.map(|bound| Tensor::from_shape(&ones, &[bound]).unwrap());
            let low = model.add_const(format!("{name}.low"), low).unwrap();
            let high = model.add_const(format!("{name}.high"), high).unwrap();
            let wire = model.wire_node(format!("{name}.max"), max(), &[wire, low]).unwrap();
            model.wire_node(format!("{name}.min"), min(), &[wire[0], high]).unwrap()
        };
        wire = clip(&mut model, wire[0], "first", [0.0, 6.0]);
        if self.adds {
            let added = model.add_source("added", f32::fact(self.shape(self.channels))).unwrap();
            wire = model.wire_node("sum", add(), &[added, wire[0]]).unwrap();
            wire = clip(&mut model, wire[0], "second", [1.0, 5.0]);
        }
        model.select_output_outlets(&wire).unwrap();
        model.into_decluttered().unwrap()
    }

    /// Output by the definition, in f64.
    fn plain(&self, input: &[f32], added: &[f32]) -> Vec<f64> {
        let pixels: usize = self.size.iter().product();
        let (weights, biases) = (self.weights(), self.biases());
        let clip = |sum: f64, low: f64, high: f64| if sum.is_nan() { sum } else { sum.clamp(low, high) };
        let pixel = |at: usize| {
            let (channel, pixel) = (at / pixels, at % pixels);
            let mut sum = f64::from(biases[channel]);
            for plane in 0..self.planes {
                let weight = weights[channel * self.planes + plane];
                sum += f64::from(input[plane * pixels + pixel]) * f64::from(weight);
            }
            let sum = clip(sum, 0.0, 6.0);
            if self.adds { clip(sum + f64::from(added[at]), 1.0, 5.0) } else { sum }
        };
        (0..self.channels * pixels).map(pixel).collect()
    }

    fn run(&self, model: TypedModel, input: &[f32], added: &[f32]) -> Vec<f32> {
        let mut inputs = tvec!(Tensor::from_shape(&self.shape(self.planes), input).unwrap().into());
        if self.adds {
            inputs.push(Tensor::from_shape(&self.shape(self.channels), added).unwrap().into());
        }
        let output = model.into_optimized().unwrap().into_runnable().unwrap().run(inputs).unwrap().remove(0);
        output.to_plain_array_view::<f32>().unwrap().iter().copied().collect()
    }

    /// Model with this operator in place of everything.
    fn replaced(&self) -> TypedModel {
        let mut model = self.model();
        replace_pointwise(&mut model).unwrap();
        model.compact().unwrap();
        let is_replaced = |node: &TypedNode| node.op_is::<Pointwise>();
        let left = model.nodes.iter().filter(|node| node.op_is::<TypedBinOp>() || node.op_is::<EinSum>()).count();
        assert!(!is_wide() || model.nodes.iter().any(is_replaced) && left == 0, "{model}");
        model
    }

    /// Outputs of this operator with the processor's instructions and with fewer.
    fn found(&self, input: &[f32], added: &[f32]) -> Vec<Vec<f32>> {
        let model = self.replaced();
        let mut outputs = vec![];
        if let Some(op) = model.nodes.iter().find_map(|node| node.op_as::<Pointwise>()) {
            let fewer: &[pulp::Arch] = &[
                pulp::Arch::Scalar,
                #[cfg(target_arch = "x86_64")]
                pulp::x86::V3::try_new().map_or(pulp::Arch::Scalar, pulp::Arch::V3),
            ];
            for instructions in fewer {
                let mut output = vec![0.0; self.channels * self.size.iter().product::<usize>()];
                instructions.dispatch(op.mix(0, input, self.adds.then_some(added), &mut output).unwrap());
                outputs.push(output);
            }
        }
        outputs.push(self.run(model, input, added));
        outputs
    }
}

fn is_wide() -> bool {
    flyrig_types::vectorized(Lanes) >= 8
}

fn cases() -> impl Iterator<Item = Case> {
    let sizes = [[1, 1], [2, 3], [3, 5], [4, 4], [7, 7], [8, 8], [3, 31], [14, 14], [64, 65]];
    let counts = [(2, 2), (2, 5), (3, 8), (8, 4), (17, 39), (24, 16), (40, 33)];
    let all = sizes.into_iter().flat_map(move |size| counts.map(|count| (size, count))).enumerate();
    all.map(|(i, (size, (planes, channels)))| {
        let format = [DataFormat::CHW, DataFormat::NCHW][i % 2];
        Case { format, planes, channels, size, adds: i % 3 != 0 }
    })
}

fn numbers(count: usize) -> Vec<f32> {
    (0..count).map(|i| ((i * 7919) % 211) as f32 * 0.02 - 2.0).collect()
}

/// Numbers of the input and of what is added.
fn inputs(case: &Case) -> (Vec<f32>, Vec<f32>) {
    let pixels: usize = case.size.iter().product();
    (numbers(case.planes * pixels), numbers(case.channels * pixels + 3)[3..].to_vec())
}

#[test]
fn every_pixel_is_as_defined_and_as_tract_computes_it() {
    for case in cases() {
        let (input, added) = inputs(&case);
        let plain = case.plain(&input, &added);
        let tract = case.run(case.model(), &input, &added);
        for found in case.found(&input, &added) {
            assert_eq!([found.len(), tract.len()], [plain.len(); 2]);
            for ((plain, found), tract) in plain.iter().zip(found).zip(&tract) {
                assert!(
                    (plain - f64::from(found)).abs() < 1e-5 && (found - tract).abs() < 1e-5,
                    "{plain} {found} {tract}"
                );
            }
        }
    }
}

#[test]
fn poison_stays_within_its_pixel() {
    if !is_wide() {
        return; // tract's own clips turn NaN into a bound
    }
    for case in cases() {
        for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let (mut input, mut added) = inputs(&case);
            let (middle, last) = (input.len() / 2, added.len() - 1);
            input[middle] = poison;
            added[last] = poison;
            let plain = case.plain(&input, &added);
            for found in case.found(&input, &added) {
                for (plain, found) in plain.iter().zip(found) {
                    let same = plain.is_nan() && found.is_nan() || (plain - f64::from(found)).abs() < 1e-5;
                    assert!(same, "{poison}: {plain} {found}");
                }
            }
        }
    }
}

#[test]
fn tensors_of_other_sizes_are_refused() {
    let case = Case { format: DataFormat::CHW, planes: 3, channels: 8, size: [4, 6], adds: true };
    let model = case.replaced();
    let Some(op) = model.nodes.iter().find_map(|node| node.op_as::<Pointwise>()) else { return };
    let zero = |shape: &[usize]| Tensor::zero::<f32>(shape).unwrap().into_tvalue();
    let (input, added) = (zero(&[3, 4, 6]), zero(&[8, 4, 6]));
    assert!(op.eval_out_of_plan(tvec!(input.clone(), added.clone())).unwrap().is_some());
    assert!(op.eval_out_of_plan(tvec!(zero(&[3, 4, 5]), added.clone())).is_err());
    assert!(op.eval_out_of_plan(tvec!(input.clone(), zero(&[8, 4, 5]))).is_err());
    assert!(op.eval_out_of_plan(tvec!(input, added.clone(), added)).is_err());
    assert!(op.eval_out_of_plan(tvec!()).is_err());
}

#[test]
fn products_of_another_kind_are_kept() {
    let kept = |case: Case| {
        let mut model = case.model();
        replace_pointwise(&mut model).unwrap();
        !model.nodes.iter().any(TypedNode::op_is::<Pointwise>)
    };
    let case = |format| Case { format, planes: 3, channels: 8, size: [4, 6], adds: true };
    assert!(kept(case(DataFormat::HWC)) && kept(case(DataFormat::NHWC)));
    assert_ne!(kept(case(DataFormat::CHW)), is_wide());
}

/// Compares all layers of a network with tract's own products, each on what this network gives it.
#[test]
fn the_built_in_networks_layers_are_as_tract_computes_them() {
    let networks: [(&[u8], usize, usize); 3] = [
        (include_bytes!("../../assets/pose_full.onnx"), 256, 52),
        (include_bytes!("../../assets/hand_lite.onnx"), 224, 30),
        (include_bytes!("../../assets/face.onnx"), 192, 22),
    ];
    for (mut bytes, side, count) in networks {
        let fact = f32::fact(tvec!(1, side, side, 3)).into();
        let model = onnx().model_for_read(&mut bytes).and_then(|model| model.with_input_fact(0, fact)).unwrap();
        let mut model = model.into_typed().unwrap().into_decluttered().unwrap();
        replace_depthwise(&mut model).unwrap();
        let plain = model.into_decluttered().unwrap();
        let mut replaced = plain.clone();
        replace_pointwise(&mut replaced).unwrap();
        let found = replaced.into_optimized().unwrap();
        let found = found.nodes.iter().filter(|node| node.op_is::<Pointwise>()).count();
        assert_eq!(found, if is_wide() { count } else { 0 });
        let numbers = numbers(side * side * 3).iter().map(|value| (value + 2.0) / 4.22).collect::<Vec<f32>>();
        let input = Tensor::from_shape(&[1, side, side, 3], &numbers).unwrap();
        let mut layers = 0;
        let mut compare = |product: &EinSum, node: &TypedNode, input: &TValue, output: &TValue| {
            let Some(op) = Pointwise::of(product, &plain, node).unwrap() else { return };
            let found = op.eval_out_of_plan(tvec!(input.clone())).unwrap().unwrap().remove(0);
            assert_eq!(output.shape(), found.shape());
            let [output, found] = [output, &found].map(|output| output.to_plain_array_view::<f32>().unwrap());
            let largest = output.iter().fold(1.0f32, |largest, value| largest.max(value.abs()));
            let worst = output.iter().zip(found).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()));
            assert!(worst < 1e-5 * largest, "{}: {worst} of {largest}", node.name);
            layers += 1;
        };
        let run = |context: &EvalContext,
                   state: Option<&mut (dyn OpState + 'static)>,
                   node: &TypedNode,
                   inputs: TVec<TValue>| {
            let outputs = eval(context, state, node, inputs.clone())?;
            if let Some(product) = node.op_as::<EinSum>() {
                compare(product, node, &inputs[0], &outputs[0]);
            }
            TractResult::Ok(outputs)
        };
        let plan = plain.clone().into_runnable().unwrap();
        plan.spawn().unwrap().run_plan_with_eval(tvec!(input.into()), run).unwrap();
        assert_eq!(layers, count);
    }
}
