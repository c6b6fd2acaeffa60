//! Depthwise convolutions of 3x3 and 5x5 taps, plane by plane: tract's own walk the image pixel by pixel where the stride is 2, and
//! clip in a second pass.
//!
//! Each plane is copied once into zero-padded planes, one per phase of the stride (even and odd rows and columns). There every tap is an
//! offset, so that all rows of the output are computed as a single one, a few pixels beyond each row included; bias and clip are part of
//! the same pass.

use std::sync::Arc;

use pulp::{Simd, WithSimd};
use tract_linalg::multithread::par_chunks_mut;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::*;
use tract_onnx::tract_core::ops::cnn::{Conv, KernelFormat};

use crate::network::clip::{Clip, clipped};

/// Operator that filters each plane of an `f32` tensor (its last two axes are rows and columns) by its own kernel, adds a bias and clips.
#[derive(Debug, Clone, Hash, PartialEq, Eq)]
struct Depthwise {
    /// Taps, one kernel per channel, row by row.
    kernels: Arc<Tensor>,
    /// Added to each pixel, one number per channel.
    biases: Arc<Tensor>,
    clip: Clip,
    geometry: Geometry,
}

/// Sizes of a convolution: height before width, pixels.
#[derive(Debug, Clone, Copy, Hash, PartialEq, Eq)]
struct Geometry {
    input: [usize; 2],
    output: [usize; 2],
    /// Zeros above and left of the input.
    before: [usize; 2],
    /// Side of the kernel: 3 or 5.
    side: usize,
    /// Distance of the output's pixels in the input: 1 or 2.
    stride: usize,
}

/// Replaces a decluttered network's depthwise convolutions and the clips that follow them. Those with other kernels than 3x3 or 5x5 or other strides
/// than 1 or 2 are kept.
pub(crate) fn replace_depthwise(model: &mut TypedModel) -> TractResult<()> {
    for id in 0..model.nodes.len() {
        let node = model.node(id);
        let Some(conv) = node.op_as::<Conv>() else { continue };
        let Some(mut op) = Depthwise::of(conv, model, node)? else { continue };
        let last = op.clip.take(model, id)?;
        let mut patch = TypedModelPatch::default();
        let mut wire = patch.tap_model(model, node.inputs[0])?;
        // Where channels come last, tract moves the changes of axes into the products before and after.
        let axis = model.outlet_fact(node.inputs[0])?.rank() - 1;
        let channels_last = conv.pool_spec.data_format.c_is_last();
        if channels_last {
            wire = patch.wire_node(format!("{}.planes", node.name), AxisOp::Move(axis, axis - 2), &[wire])?[0];
        }
        wire = patch.wire_node(&node.name, op, &[wire])?[0];
        if channels_last {
            wire = patch.wire_node(format!("{}.pixels", node.name), AxisOp::Move(axis - 2, axis), &[wire])?[0];
        }
        patch.shunt_outside(model, last.into(), wire)?;
        patch.obliterate(id)?;
        patch.apply(model)?;
    }
    Ok(())
}

impl Depthwise {
    /// Returns the operator of a convolution; `None` where it cannot stand in for it.
    fn of(conv: &Conv, model: &TypedModel, node: &TypedNode) -> TractResult<Option<Self>> {
        let &[input, kernels, biases] = &node.inputs[..] else { return Ok(None) };
        let [input, kernels, biases] =
            [model.outlet_fact(input)?, model.outlet_fact(kernels)?, model.outlet_fact(biases)?];
        let (Some(shape), Some(kernels), Some(biases)) = (input.shape.as_concrete(), &kernels.konst, &biases.konst)
        else {
            return Ok(None);
        };
        let pool = &conv.pool_spec;
        let channels = pool.output_channels;
        let are_floats = [input.datum_type, kernels.datum_type(), biases.datum_type()] == [f32::datum_type(); 3];
        let is_depthwise = [conv.group, pool.input_channels] == [channels; 2] && conv.kernel_fmt == KernelFormat::OIHW;
        let (&[side, width], &[stride, across]) = (&pool.kernel_shape[..], &pool.strides()[..]) else {
            return Ok(None);
        };
        let is_square = side == width && stride == across && pool.dilations().iter().all(|step| *step == 1);
        let is_known = matches!(side, 3 | 5) && matches!(stride, 1 | 2) && kernels.len() == channels * side * side;
        if !(are_floats && is_depthwise && is_square && is_known && biases.len() == channels) {
            return Ok(None);
        }
        let shape = pool.data_format.shape(shape)?;
        let sizes = pool.computed_padding(shape.hw_dims());
        let (&[height, width], [rows, columns]) = (shape.hw_dims(), &sizes[..]) else { return Ok(None) };
        if height == 0 || width == 0 {
            return Ok(None);
        }
        let geometry = Geometry {
            input: [height, width],
            output: [rows.convoluted, columns.convoluted],
            before: [rows.pad_before, columns.pad_before],
            side,
            stride,
        };
        Ok(Some(Self { kernels: kernels.clone(), biases: biases.clone(), clip: Clip::NONE, geometry }))
    }
}

impl Geometry {
    /// Returns the number of pixels that a kernel reaches beyond the output's pixel, in a phase.
    fn reach(&self) -> usize {
        (self.side - 1) / self.stride
    }

    /// Returns the length of a row of a phase, in which the rows of the output lie too.
    fn row(&self) -> usize {
        self.output[1] + self.reach()
    }

    /// Returns the number of pixels from the first one of the output to the last one.
    fn span(&self) -> usize {
        (self.output[0] - 1) * self.row() + self.output[1]
    }

    /// Returns the number of pixels of a phase, those that are read beyond the last row included. `lanes` pixels are computed
    /// together.
    fn phase(&self, lanes: usize) -> usize {
        self.span().next_multiple_of(lanes) + self.reach() * (self.row() + 1)
    }

    /// Returns where each tap reads the first pixel of the output, row by row. `phase` is the length of a phase.
    fn taps<const TAPS: usize>(&self, phase: usize) -> [usize; TAPS] {
        std::array::from_fn(|tap| {
            let (y, x) = (tap / self.side, tap % self.side);
            let index = y % self.stride * self.stride + x % self.stride;
            index * phase + y / self.stride * self.row() + x / self.stride
        })
    }

    /// Copies a plane into its phases of the length `phase`, whose margins are zero.
    #[inline(always)]
    fn pad(&self, plane: &[f32], phases: &mut [f32], phase: usize) {
        let (length, before) = (self.row(), self.before[1]);
        let rows = (self.output[0] + self.reach()) * self.stride;
        for (row, y) in plane.chunks_exact(self.input[1]).zip(self.before[0]..rows) {
            let start = y % self.stride * self.stride * phase + y / self.stride * length;
            if self.stride == 1 {
                let to = &mut phases[start..start + length];
                to.iter_mut().skip(before).zip(row).for_each(|(to, from)| *to = *from);
            } else {
                let (even, odd) = phases[start..].split_at_mut(phase);
                let (even, odd) = (&mut even[..length], &mut odd[..length]);
                // Column 0 of the padded plane is even.
                let (first, second) = if before.is_multiple_of(2) { (even, odd) } else { (odd, even) };
                let (pairs, rest) = row.as_chunks::<2>();
                first.iter_mut().skip(before / 2).zip(pairs).for_each(|(to, pair)| *to = pair[0]);
                second.iter_mut().skip(before.div_ceil(2)).zip(pairs).for_each(|(to, pair)| *to = pair[1]);
                if let (Some(to), Some(from)) = (first.get_mut(before / 2 + pairs.len()), rest.first()) {
                    *to = *from;
                }
            }
        }
    }
}

/// Filters some consecutive planes.
struct Filter<'a, const TAPS: usize> {
    geometry: &'a Geometry,
    input: &'a [f32],
    kernels: &'a [[f32; TAPS]],
    biases: &'a [f32],
    clip: Clip,
    /// Index of the first plane of `output` in `input`.
    first: usize,
    output: &'a mut [f32],
}

impl<const TAPS: usize> WithSimd for Filter<'_, TAPS> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { geometry, input, kernels, biases, clip, first, output } = self;
        let range = clip.splat(simd);
        let phase = geometry.phase(S::F32_LANES);
        let taps = geometry.taps::<TAPS>(phase);
        let mut phases = vec![0.0; geometry.stride * geometry.stride * phase];
        let mut rows = vec![0.0; geometry.span().next_multiple_of(S::F32_LANES)];
        let planes = input.chunks_exact(geometry.input.iter().product()).enumerate().skip(first);
        for ((index, plane), output) in planes.zip(output.chunks_exact_mut(geometry.output.iter().product())) {
            geometry.pad(plane, &mut phases, phase);
            let channel = index % biases.len();
            let bias = simd.splat_f32s(biases[channel]);
            let kernel = kernels[channel].map(|weight| simd.splat_f32s(weight));
            let sums = S::as_mut_simd_f32s(&mut rows).0;
            let sources = taps.map(|tap| &S::as_simd_f32s(&phases[tap..]).0[..sums.len()]);
            for (at, sum) in sums.iter_mut().enumerate() {
                let mut value = bias;
                for (source, weight) in sources.iter().zip(kernel) {
                    value = simd.mul_add_e_f32s(source[at], weight, value);
                }
                *sum = clipped(simd, value, range);
            }
            let rows = rows.chunks(geometry.row());
            for (output, row) in output.chunks_exact_mut(geometry.output[1]).zip(rows) {
                output.copy_from_slice(&row[..geometry.output[1]]);
            }
        }
    }
}

impl Op for Depthwise {
    fn name(&self) -> StaticName {
        "Depthwise".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Depthwise {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let input = args_1!(inputs);
        let mut shape: TVec<usize> = input.shape().into();
        let Some(([.., channels], size)) = shape.split_last_chunk_mut::<2>() else { bail!("planes, not {input:?}") };
        let expected = (self.biases.len(), self.geometry.input);
        ensure!((*channels, *size) == expected, "channels and size of planes {expected:?}, not {input:?}");
        size.copy_from_slice(&self.geometry.output);
        let mut output = Tensor::zero::<f32>(&shape)?;
        if output.len() > 0 {
            let input = input.try_as_plain_ram()?.as_slice::<f32>()?;
            let mut plain = output.try_as_plain_ram_mut()?;
            match self.geometry.side {
                3 => self.filter::<9>(input, plain.as_slice_mut()?)?,
                _ => self.filter::<25>(input, plain.as_slice_mut()?)?,
            }
        }
        Ok(tvec!(output.into_tvalue()))
    }
}

impl Depthwise {
    /// Filters all planes, on the threads that tract's products use.
    fn filter<const TAPS: usize>(&self, input: &[f32], output: &mut [f32]) -> TractResult<()> {
        let kernels = self.kernels.try_as_plain_ram()?.as_slice::<f32>()?.as_chunks::<TAPS>().0;
        let biases = self.biases.try_as_plain_ram()?.as_slice::<f32>()?;
        let (geometry, clip, total) = (&self.geometry, self.clip, output.len());
        par_chunks_mut(output, geometry.output.iter().product(), total, |first, output| {
            flyrig_types::vectorized(Filter { geometry, input, kernels, biases, clip, first, output });
            Ok(())
        })
    }
}

impl TypedOp for Depthwise {
    as_op!();

    fn output_facts(&self, inputs: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        let mut shape = inputs[0].shape.to_tvec();
        for (side, size) in shape.iter_mut().rev().zip(self.geometry.output.iter().rev()) {
            *side = size.to_dim();
        }
        Ok(tvec!(inputs[0].datum_type.fact(&shape)))
    }
}

#[cfg(test)]
mod tests {
    use tract_onnx::tract_core::ops::binary::TypedBinOp;
    use tract_onnx::tract_core::ops::cnn::{PaddingSpec, PoolSpec};
    use tract_onnx::tract_core::ops::math::{max, min};
    use tract_onnx::tract_core::ops::nn::DataFormat;
    use tract_onnx::tract_core::plan::eval;

    use super::*;

    /// Convolution with a clip to 0..=6 behind it.
    struct Case {
        format: DataFormat,
        channels: usize,
        input: [usize; 2],
        side: usize,
        stride: usize,
        before: [usize; 2],
        after: [usize; 2],
    }

    impl Case {
        fn shape(&self) -> Vec<usize> {
            let [height, width] = self.input;
            self.format.from_n_c_hw(1, self.channels, [height, width]).unwrap().shape.to_vec()
        }

        fn kernels(&self) -> Vec<f32> {
            (0..self.channels * self.side * self.side).map(|i| ((i * 7919) % 101) as f32 * 0.02 - 0.9).collect()
        }

        fn biases(&self) -> Vec<f32> {
            (0..self.channels).map(|i| i as f32 * 0.3).collect()
        }

        fn model(&self) -> TypedModel {
            let mut model = TypedModel::default();
            let input = model.add_source("input", f32::fact(self.shape())).unwrap();
            let shape = [self.channels, 1, self.side, self.side];
            let kernels = model.add_const("kernels", Tensor::from_shape(&shape, &self.kernels()).unwrap()).unwrap();
            let biases = model.add_const("biases", tensor1(&self.biases())).unwrap();
            let pool_spec = PoolSpec {
                data_format: self.format,
                kernel_shape: tvec!(self.side, self.side),
                padding: PaddingSpec::Explicit(
                    tvec!(self.before[0], self.before[1]),
                    tvec!(self.after[0], self.after[1]),
                ),
                dilations: None,
                strides: Some(tvec!(self.stride, self.stride)),
                input_channels: self.channels,
                output_channels: self.channels,
            };
            let conv = Conv { pool_spec, kernel_fmt: KernelFormat::OIHW, group: self.channels, q_params: None };
            let mut wire = model.wire_node("conv", conv, &[input, kernels, biases]).unwrap();
            let ones = vec![1; self.shape().len()];
            for (name, bound, op) in [("low", 0.0f32, max()), ("high", 6.0, min())] {
                let bound =
                    model.add_const(format!("{name}.bound"), Tensor::from_shape(&ones, &[bound]).unwrap()).unwrap();
                wire = model.wire_node(name, op, &[wire[0], bound]).unwrap();
            }
            model.select_output_outlets(&wire).unwrap();
            model.into_decluttered().unwrap()
        }

        /// Output by the definition, in f64, in planes.
        fn plain(&self, input: &[f32]) -> Vec<f64> {
            let (side, [height, width]) = (self.side, self.input);
            let [rows, columns] =
                [0, 1].map(|k| (self.input[k] + self.before[k] + self.after[k] - side) / self.stride + 1);
            let (kernels, biases) = (self.kernels(), self.biases());
            let at = |channel: usize, y: usize, x: usize| match self.format.c_is_last() {
                true => input[(y * width + x) * self.channels + channel],
                false => input[(channel * height + y) * width + x],
            };
            let pixel = |channel: usize, y: usize, x: usize| {
                let mut sum = f64::from(biases[channel]);
                for tap in 0..side * side {
                    let v = (y * self.stride + tap / side).checked_sub(self.before[0]).filter(|v| *v < height);
                    let u = (x * self.stride + tap % side).checked_sub(self.before[1]).filter(|u| *u < width);
                    if let (Some(v), Some(u)) = (v, u) {
                        sum += f64::from(at(channel, v, u)) * f64::from(kernels[channel * side * side + tap]);
                    }
                }
                if sum.is_nan() { sum } else { sum.clamp(0.0, 6.0) }
            };
            let pixels = (0..self.channels).flat_map(|channel| (0..rows * columns).map(move |at| (channel, at)));
            pixels.map(|(channel, at)| pixel(channel, at / columns, at % columns)).collect()
        }

        /// Output of this operator, in planes.
        fn found(&self, input: &[f32]) -> Vec<f32> {
            let mut model = self.model();
            replace_depthwise(&mut model).unwrap();
            let model = model.into_optimized().unwrap();
            let left = model.nodes.iter().filter(|node| node.op_is::<TypedBinOp>()).count();
            assert!(model.nodes.iter().any(TypedNode::op_is::<Depthwise>) && left == 0, "{model}");
            self.run(model, input)
        }

        fn run(&self, model: TypedModel, input: &[f32]) -> Vec<f32> {
            let input = Tensor::from_shape(&self.shape(), input).unwrap();
            let output = model.into_runnable().unwrap().run(tvec!(input.into())).unwrap().remove(0).into_tensor();
            let rank = output.rank();
            let output = if self.format.c_is_last() { output.move_axis(rank - 1, rank - 3).unwrap() } else { output };
            output.to_plain_array_view::<f32>().unwrap().iter().copied().collect()
        }
    }

    fn cases() -> impl Iterator<Item = Case> {
        let sizes = [[1, 1], [2, 3], [7, 7], [8, 8], [5, 64], [33, 16], [16, 33], [100, 31]];
        let margins = [([1, 1], [1, 1]), ([0, 0], [1, 1]), ([2, 2], [2, 2]), ([1, 2], [2, 1]), ([0, 3], [4, 0])];
        let formats = [DataFormat::CHW, DataFormat::NCHW, DataFormat::HWC, DataFormat::NHWC];
        let kinds = [(3, 1), (3, 2), (5, 1), (5, 2)];
        let all = sizes.into_iter().flat_map(move |input| kinds.map(|kind| (input, kind)));
        let all = all.flat_map(move |(input, kind)| margins.map(|margin| (input, kind, margin))).enumerate();
        all.filter_map(move |(i, (input, (side, stride), (before, after)))| {
            let fits = (0..2).all(|k| input[k] + before[k] + after[k] >= side);
            let format = formats[i % formats.len()];
            fits.then_some(Case { format, channels: 1 + i % 5, input, side, stride, before, after })
        })
    }

    fn numbers(count: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919) % 211) as f32 * 0.02 - 2.0).collect()
    }

    #[test]
    fn every_pixel_is_as_defined_and_as_tract_computes_it() {
        let mut count = 0;
        for case in cases() {
            let input = numbers(case.shape().iter().product());
            let (plain, found) = (case.plain(&input), case.found(&input));
            let tract = case.run(case.model().into_optimized().unwrap(), &input);
            assert_eq!([found.len(), tract.len()], [plain.len(); 2]);
            for ((plain, found), tract) in plain.into_iter().zip(found).zip(tract) {
                assert!(
                    (plain - f64::from(found)).abs() < 1e-5 && (found - tract).abs() < 1e-5,
                    "{plain} {found} {tract}"
                );
            }
            count += 1;
        }
        assert!(count > 100, "{count}");
    }

    #[test]
    fn poison_stays_within_reach_of_its_pixel() {
        for case in cases() {
            for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut input = numbers(case.shape().iter().product());
                let middle = input.len() / 2;
                input[middle] = poison;
                for (plain, found) in case.plain(&input).into_iter().zip(case.found(&input)) {
                    let same = plain.is_nan() && found.is_nan() || (plain - f64::from(found)).abs() < 1e-5;
                    assert!(same, "{poison}: {plain} {found}");
                }
            }
        }
    }

    #[test]
    fn planes_of_another_size_are_refused() {
        let case = Case {
            format: DataFormat::CHW,
            channels: 2,
            input: [4, 6],
            side: 3,
            stride: 1,
            before: [1; 2],
            after: [1; 2],
        };
        let mut model = case.model();
        replace_depthwise(&mut model).unwrap();
        let op = model.nodes.iter().find_map(|node| node.op_as::<Depthwise>()).unwrap();
        let eval = |shape: &[usize]| op.eval_out_of_plan(tvec!(Tensor::zero::<f32>(shape).unwrap().into()));
        assert_eq!(eval(&[0, 2, 4, 6]).unwrap().unwrap()[0].len(), 0);
        for shape in [&[2, 4, 5][..], &[3, 4, 6], &[4, 6], &[], &[2, 0, 6]] {
            assert!(eval(shape).is_err(), "{shape:?}");
        }
    }

    /// Compares all depthwise layers of a network with tract's own, each on what tract's own network gives it.
    #[test]
    fn the_built_in_networks_layers_are_as_tract_computes_them() {
        let networks: [(&[u8], usize, usize); 3] = [
            (include_bytes!("../../assets/pose_full.onnx"), 256, 38),
            (include_bytes!("../../assets/hand_lite.onnx"), 224, 16),
            (include_bytes!("../../assets/face.onnx"), 192, 20),
        ];
        for (mut bytes, side, count) in networks {
            let fact = f32::fact(tvec!(1, side, side, 3)).into();
            let model = onnx().model_for_read(&mut bytes).and_then(|model| model.with_input_fact(0, fact)).unwrap();
            let plain = model.into_typed().unwrap().into_decluttered().unwrap();
            let mut replaced = plain.clone();
            replace_depthwise(&mut replaced).unwrap();
            let replaced = replaced.into_optimized().unwrap();
            assert_eq!(replaced.nodes.iter().filter(|node| node.op_is::<Depthwise>()).count(), count);
            let numbers = numbers(side * side * 3).iter().map(|value| (value + 2.0) / 4.22).collect::<Vec<f32>>();
            let input = Tensor::from_shape(&[1, side, side, 3], &numbers).unwrap();
            let plan = plain.clone().into_runnable().unwrap();
            let mut layers = 0;
            let mut compare = |conv: &Conv, node: &TypedNode, input: &Tensor, output: &Tensor| {
                let Some(op) = Depthwise::of(conv, &plain, node).unwrap() else { return };
                let planes = |tensor: &Tensor| match (conv.pool_spec.data_format.c_is_last(), tensor.rank() - 1) {
                    (true, last) => tensor.clone().move_axis(last, last - 2).unwrap(),
                    (false, _) => tensor.clone(),
                };
                let found = op.eval_out_of_plan(tvec!(planes(input).into())).unwrap().unwrap().remove(0);
                let plain = planes(output);
                assert_eq!(plain.shape(), found.shape());
                let [plain, found] = [&plain, &*found].map(|output| output.to_plain_array_view::<f32>().unwrap());
                let largest = plain.iter().fold(1.0f32, |largest, value| largest.max(value.abs()));
                let worst = plain.iter().zip(found).fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()));
                assert!(worst < 1e-5 * largest, "{}: {worst} of {largest}", node.name);
                layers += 1;
            };
            let run = |context: &EvalContext,
                       state: Option<&mut (dyn OpState + 'static)>,
                       node: &TypedNode,
                       inputs: TVec<TValue>| {
                let outputs = eval(context, state, node, inputs.clone())?;
                if let Some(conv) = node.op_as::<Conv>() {
                    compare(conv, node, &inputs[0], &outputs[0]);
                }
                TractResult::Ok(outputs)
            };
            plan.spawn().unwrap().run_plan_with_eval(tvec!(input.into()), run).unwrap();
            assert_eq!(layers, count);
        }
    }
}
