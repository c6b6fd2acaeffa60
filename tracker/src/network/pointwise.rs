//! Convolutions of 1x1 taps: products of the weights with the planes, in which a pixel's neighbours lie side by side. tract's own
//! copy all planes into panels first and compute few channels together.
//!
//! A panel of some pixels of all planes is copied once, small enough to stay near the processor, and multiplied by the weights of four or
//! eight channels at a time, whose sums stay in registers. Bias, clip and the addition of other planes are part of the same pass.

use std::sync::Arc;

use pulp::{Simd, WithSimd};
use tract_linalg::multithread::par_chunks_mut;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::*;
use tract_onnx::tract_core::ops::binary::TypedBinOp;
use tract_onnx::tract_core::ops::einsum::EinSum;
use tract_onnx::tract_core::ops::math::Add;

use crate::network::clip::{Clip, clipped, only_successor};

/// Channels whose weights lie together, input by input.
const BLOCK: usize = 4;
/// Numbers of a cache line.
const LINE: usize = 16;

/// Operator that mixes the planes of an `f32` tensor pixel by pixel: a weighted sum of all for each plane of the output, and a bias, clipped;
/// then the planes of a second tensor are added where there is one, and the sum is clipped again.
#[derive(Debug, Clone, Hash, PartialEq, Eq)]
struct Pointwise {
    /// Weights in blocks of [`BLOCK`] channels of the output: for each plane of the input one number per channel. Zero beyond the last one.
    weights: Arc<Tensor>,
    /// Added to each pixel, one number per channel of the output; zero beyond the last one.
    biases: Arc<Tensor>,
    /// Bounds of the weighted sums, and of the output.
    clips: [Clip; 2],
    /// Planes of the input and of the output, and pixels of a plane.
    sizes: [usize; 3],
    /// Axis of the output's channels; those before it have one side.
    axis: usize,
    /// Shape of the output.
    shape: TVec<usize>,
}

/// Replaces a decluttered network's convolutions of 1x1 taps, and the biases, clips and additions that follow them, where channels come before
/// rows and columns. Those of one plane or to one plane may be kept; without AVX2 or AVX-512 all are.
pub(crate) fn replace_pointwise(model: &mut TypedModel) -> TractResult<()> {
    if flyrig_types::vectorized(Lanes) < 8 {
        return Ok(());
    }
    for id in 0..model.nodes.len() {
        let node = model.node(id);
        let Some(product) = node.op_as::<EinSum>() else { continue };
        let Some(mut op) = Pointwise::of(product, model, node)? else { continue };
        let (last, added) = op.take_followers(model, id)?;
        let mut patch = TypedModelPatch::default();
        let mut inputs = tvec!(patch.tap_model(model, node.inputs[0])?);
        if let Some(added) = added {
            inputs.push(patch.tap_model(model, added)?);
        }
        let wire = patch.wire_node(&node.name, op, &inputs)?[0];
        patch.shunt_outside(model, last.into(), wire)?;
        patch.obliterate(id)?;
        patch.apply(model)?;
    }
    Ok(())
}

impl Pointwise {
    /// Returns the operator of a product; `None` where it is no mix of planes by constant weights.
    fn of(product: &EinSum, model: &TypedModel, node: &TypedNode) -> TractResult<Option<Self>> {
        let &[input, weights] = &node.inputs[..] else { return Ok(None) };
        let [input, weights] = [model.outlet_fact(input)?, model.outlet_fact(weights)?];
        let output = &node.outputs[0].fact;
        let are_floats = [input.datum_type, weights.datum_type, output.datum_type] == [f32::datum_type(); 3];
        let (Some(from), Some(to), Some(weights)) =
            (input.shape.as_concrete(), output.shape.as_concrete(), &weights.konst)
        else {
            return Ok(None);
        };
        let &[channels, planes] = weights.shape() else { return Ok(None) };
        let pixels = to.iter().product::<usize>() / channels.max(1);
        if !are_floats || product.q_params.is_some() || pixels == 0 || planes == 0 {
            return Ok(None);
        }
        let Some(axis) = channels_axis(&product.axes, from, to) else { return Ok(None) };
        let values = weights.try_as_plain_ram()?.as_slice::<f32>()?;
        let mut blocks = vec![0.0; channels.next_multiple_of(BLOCK) * planes];
        for (channel, row) in values.chunks_exact(planes).enumerate() {
            let block = &mut blocks[channel / BLOCK * BLOCK * planes..];
            block.iter_mut().skip(channel % BLOCK).step_by(BLOCK).zip(row).for_each(|(to, from)| *to = *from);
        }
        Ok(Some(Self {
            weights: tensor1(&blocks).into_arc_tensor(),
            biases: tensor1(&vec![0.0f32; channels.next_multiple_of(BLOCK)]).into_arc_tensor(),
            clips: [Clip::NONE; 2],
            sizes: [planes, channels, pixels],
            axis,
            shape: to.into(),
        }))
    }

    /// Takes over the operators that follow the product `id`; returns the last node whose result this operator gives, and the tensor that it adds.
    fn take_followers(&mut self, model: &TypedModel, id: usize) -> TractResult<(usize, Option<OutletId>)> {
        let mut last = self.take_bias(model, id)?;
        last = self.clips[0].take(model, last)?;
        let Some((sum, other)) = addition(model, last) else { return Ok((last, None)) };
        let fact = model.outlet_fact(other)?;
        if fact.shape.as_concrete() != Some(&self.shape) || fact.datum_type != f32::datum_type() {
            return Ok((last, None));
        }
        Ok((self.clips[1].take(model, sum)?, Some(other)))
    }

    /// Takes over the addition of one number per channel; returns its node, or `id`.
    fn take_bias(&mut self, model: &TypedModel, id: usize) -> TractResult<usize> {
        let Some((sum, other)) = addition(model, id) else { return Ok(id) };
        let fact = model.outlet_fact(other)?;
        let Some(bias) = fact.konst.as_ref().filter(|bias| bias.datum_type() == f32::datum_type()) else {
            return Ok(id);
        };
        let [_, channels, _] = self.sizes;
        let is_bias = bias.len() == channels && bias.rank() == self.shape.len() && bias.shape()[self.axis] == channels;
        if !is_bias {
            return Ok(id);
        }
        let mut values = bias.try_as_plain_ram()?.as_slice::<f32>()?.to_vec();
        values.resize(channels.next_multiple_of(BLOCK), 0.0);
        self.biases = tensor1(&values).into_arc_tensor();
        Ok(sum)
    }
}

/// Returns the output's axis of channels, if a product sums over planes and puts the sums in their place: nothing longer than one comes
/// before the planes, and what comes behind keeps its order.
fn channels_axis(axes: &AxesMapping, from: &[usize], to: &[usize]) -> Option<usize> {
    let mut kept = Vec::new();
    let (mut summed, mut written) = (None, None);
    for axis in axes.iter_all_axes() {
        match (&axis.inputs[0][..], &axis.inputs[1][..], &axis.outputs[0][..]) {
            (&[plane], &[1], &[]) => summed = Some(plane),
            (&[], &[0], &[channel]) => written = Some(channel),
            (&[a], &[], &[b]) if from[a] == to[b] => kept.push((a, b)),
            (&[a], &[], &[]) if from[a] == 1 => {}
            (&[], &[], &[b]) if to[b] == 1 => {}
            _ => return None,
        }
    }
    let (plane, channel) = (summed?, written?);
    kept.retain(|(a, _)| from[*a] > 1);
    kept.sort_unstable();
    let is_kept = kept.iter().all(|(a, b)| *a > plane && *b > channel) && kept.is_sorted_by_key(|(_, b)| *b);
    is_kept.then_some(channel)
}

/// Returns the only node that takes the output of `id`, if that is an addition, with the other summand.
fn addition(model: &TypedModel, id: usize) -> Option<(usize, OutletId)> {
    let next = only_successor(model, id)?;
    let node = model.node(next.node);
    let TypedBinOp(op, None) = node.op_as::<TypedBinOp>()? else { return None };
    op.is::<Add>().then(|| (next.node, node.inputs[1 - next.slot]))
}

/// Counts the numbers of a vector register.
struct Lanes;

impl WithSimd for Lanes {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> usize {
        S::F32_LANES
    }
}

/// Computes some consecutive planes.
struct Mix<'a> {
    op: &'a Pointwise,
    /// Weights and biases of these planes.
    weights: &'a [f32],
    biases: &'a [f32],
    input: &'a [f32],
    /// Values that are added to these planes and to those that follow them; `None` where nothing is added.
    added: Option<&'a [f32]>,
    output: &'a mut [f32],
}

impl WithSimd for Mix<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As many sums as leave registers for the pixels and a weight.
        if S::REGISTER_COUNT >= 32 { self.all::<S, 4>(simd) } else { self.all::<S, 2>(simd) }
    }
}

impl Mix<'_> {
    #[inline(always)]
    fn all<S: Simd, const VECTORS: usize>(mut self, simd: S) {
        let [planes, _, pixels] = self.op.sizes;
        let mut panel = vec![0.0; planes * VECTORS * S::F32_LANES + LINE];
        let start = panel.as_ptr().align_offset(size_of::<f32>() * LINE).min(LINE);
        let panel = &mut panel[start..];
        let mut first = 0;
        while first < pixels {
            let vectors = (pixels - first).div_ceil(S::F32_LANES).min(VECTORS);
            match vectors {
                1 => self.panel::<S, 4, 1>(simd, first, panel),
                2 => self.panel::<S, 1, 2>(simd, first, panel),
                3 => self.panel::<S, 1, 3>(simd, first, panel),
                _ => self.panel::<S, 1, 4>(simd, first, panel),
            }
            first += vectors * S::F32_LANES;
        }
    }

    /// Computes the pixels of all channels from `first` on, as many as fit into some vectors.
    #[inline(always)]
    fn panel<S: Simd, const BLOCKS: usize, const VECTORS: usize>(&mut self, simd: S, first: usize, panel: &mut [f32]) {
        let [planes, _, pixels] = self.op.sizes;
        let length = VECTORS * S::F32_LANES;
        let width = length.min(pixels - first);
        let panel = &mut panel[..planes * length];
        for (to, plane) in panel.chunks_exact_mut(length).zip(self.input.chunks_exact(pixels)) {
            if width == length {
                to.copy_from_slice(&plane[first..first + length]);
            } else {
                to[..width].copy_from_slice(&plane[first..first + width]);
            }
        }
        let panel = S::as_simd_f32s(panel).0.as_chunks::<VECTORS>().0;
        let (mut weights, mut biases) = (self.weights, self.biases);
        let mut channel = 0;
        while weights.len() >= BLOCKS * BLOCK * planes {
            let (these, rest) = weights.split_at(BLOCKS * BLOCK * planes);
            let (start, end) = biases.split_at(BLOCKS * BLOCK);
            let sums = sums::<S, BLOCKS, VECTORS>(simd, these, start, panel);
            self.store(simd, channel, first, width, &sums);
            (weights, biases) = (rest, end);
            channel += BLOCKS * BLOCK;
        }
        while weights.len() >= BLOCK * planes {
            let (these, rest) = weights.split_at(BLOCK * planes);
            let (start, end) = biases.split_at(BLOCK);
            let sums = sums::<S, 1, VECTORS>(simd, these, start, panel);
            self.store(simd, channel, first, width, &sums);
            (weights, biases) = (rest, end);
            channel += BLOCK;
        }
    }

    /// Clips the sums of some channels, adds the other tensor, and writes the output.
    #[inline(always)]
    fn store<S: Simd, const BLOCKS: usize, const VECTORS: usize>(
        &mut self,
        simd: S,
        channel: usize,
        first: usize,
        width: usize,
        sums: &[[[S::f32s; VECTORS]; BLOCK]; BLOCKS],
    ) {
        let [_, _, pixels] = self.op.sizes;
        let [clip, last_clip] = self.op.clips.map(|clip| clip.splat(simd));
        let start = channel * pixels;
        for (row, sums) in sums.as_flattened().iter().enumerate() {
            let at = start + row * pixels + first;
            let Some(output) = self.output.get_mut(at..at + width) else { break };
            let added = self.added.map(|added| &added[at..at + width]);
            for (vector, sum) in sums.iter().enumerate() {
                let mut value = clipped(simd, *sum, clip);
                let range = (vector * S::F32_LANES).min(width)..((vector + 1) * S::F32_LANES).min(width);
                if let Some(added) = added {
                    let added = &added[range.clone()];
                    let added = match S::as_simd_f32s(added).0 {
                        [whole] => *whole,
                        _ => simd.partial_load_f32s(added),
                    };
                    value = clipped(simd, simd.add_f32s(value, added), last_clip);
                }
                let output = &mut output[range];
                match S::as_mut_simd_f32s(output).0 {
                    [whole] => *whole = value,
                    _ => simd.partial_store_f32s(output, value),
                }
            }
        }
    }
}

/// Returns the weighted sums of a panel's pixels, with the bias, for some blocks of channels.
#[inline(always)]
fn sums<S: Simd, const BLOCKS: usize, const VECTORS: usize>(
    simd: S,
    weights: &[f32],
    biases: &[f32],
    panel: &[[S::f32s; VECTORS]],
) -> [[[S::f32s; VECTORS]; BLOCK]; BLOCKS] {
    let mut sums = [[[simd.splat_f32s(0.0); VECTORS]; BLOCK]; BLOCKS];
    for (sum, bias) in sums.as_flattened_mut().iter_mut().zip(biases) {
        *sum = [simd.splat_f32s(*bias); VECTORS];
    }
    let length = panel.len();
    let blocks: [&[[f32; BLOCK]]; BLOCKS] =
        std::array::from_fn(|block| &weights.as_chunks::<BLOCK>().0[block * length..(block + 1) * length]);
    for (at, pixels) in panel.iter().enumerate() {
        for (sums, weights) in sums.iter_mut().zip(blocks) {
            let weights = &weights[at];
            for channel in 0..BLOCK {
                let weight = simd.splat_f32s(weights[channel]);
                for vector in 0..VECTORS {
                    sums[channel][vector] = simd.mul_add_e_f32s(weight, pixels[vector], sums[channel][vector]);
                }
            }
        }
    }
    sums
}

impl Op for Pointwise {
    fn name(&self) -> StaticName {
        "Pointwise".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Pointwise {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let [planes, channels, pixels] = self.sizes;
        let (input, added) = match &inputs[..] {
            [input] => (input, None),
            [input, added] => (input, Some(added)),
            _ => bail!("one or two tensors, not {}", inputs.len()),
        };
        let input = input.try_as_plain_ram()?.as_slice::<f32>()?;
        let added = added.map(|added| added.try_as_plain_ram()?.as_slice::<f32>()).transpose()?;
        let expected = channels * pixels;
        ensure!(
            input.len() == planes * pixels && added.is_none_or(|added| added.len() == expected),
            "{planes} planes of {pixels} pixels, and {channels} to add, not {inputs:?}"
        );
        let mut output = Tensor::zero::<f32>(&self.shape)?;
        let mut plain = output.try_as_plain_ram_mut()?;
        // Threads begin at whole blocks.
        let step = [2 * BLOCK, BLOCK].into_iter().find(|step| channels.is_multiple_of(*step)).unwrap_or(channels);
        // A number takes as long as many products of it.
        let work = expected * planes / 32;
        par_chunks_mut(plain.as_slice_mut::<f32>()?, step * pixels, work, |first, output| {
            flyrig_types::vectorized(self.mix(first * step, input, added, output)?);
            Ok(())
        })?;
        Ok(tvec!(output.into_tvalue()))
    }
}

impl Pointwise {
    /// Returns the work on the output's planes from `first` on, the first of a block.
    fn mix<'a>(
        &'a self,
        first: usize,
        input: &'a [f32],
        added: Option<&'a [f32]>,
        output: &'a mut [f32],
    ) -> TractResult<Mix<'a>> {
        let [planes, _, pixels] = self.sizes;
        let end = first + (output.len() / pixels).next_multiple_of(BLOCK);
        let weights = &self.weights.try_as_plain_ram()?.as_slice::<f32>()?[first * planes..end * planes];
        let biases = &self.biases.try_as_plain_ram()?.as_slice::<f32>()?[first..end];
        let added = added.map(|added| &added[first * pixels..]);
        Ok(Mix { op: self, weights, biases, input, added, output })
    }
}

impl TypedOp for Pointwise {
    as_op!();

    fn output_facts(&self, inputs: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(inputs[0].datum_type.fact(&*self.shape)))
    }
}

#[cfg(test)]
#[path = "pointwise_tests.rs"]
mod tests;
