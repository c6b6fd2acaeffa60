//! Clips that follow an operator of a network, taken over by our own operators.

use pulp::Simd;
use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::*;
use tract_onnx::tract_core::ops::binary::TypedBinOp;
use tract_onnx::tract_core::ops::math::{Max, Min};

/// Least and greatest value of an operator's output. NaN passes.
#[derive(Debug, Clone, Copy, Hash, PartialEq, Eq)]
pub(super) struct Clip {
    /// The bounds' bits: an operator must be hashable.
    bits: [u32; 2],
}

impl Clip {
    /// Clips nothing.
    pub const NONE: Self = Self { bits: [f32::NEG_INFINITY.to_bits(), f32::INFINITY.to_bits()] };

    fn range(self) -> [f32; 2] {
        self.bits.map(f32::from_bits)
    }

    /// Returns the least and the greatest value for [`clipped`].
    #[inline(always)]
    pub fn splat<S: Simd>(self, simd: S) -> [S::f32s; 2] {
        self.range().map(|bound| simd.splat_f32s(bound))
    }

    /// Takes over the clips that follow the node `last` of a model; returns the last of them, or `last`.
    pub fn take(&mut self, model: &TypedModel, mut last: usize) -> TractResult<usize> {
        while let Some(next) = only_successor(model, last) {
            let node = model.node(next.node);
            let Some(TypedBinOp(op, None)) = node.op_as::<TypedBinOp>() else { break };
            let &other = &node.inputs[1 - next.slot];
            let Some(bound) = model.outlet_fact(other)?.konst.as_ref().filter(|bound| bound.len() == 1) else { break };
            let bound = bound.try_as_plain_ram()?.as_slice::<f32>()?[0];
            let [low, high] = self.range();
            let range = if op.is::<Max>() {
                [low.max(bound), high.max(bound)]
            } else if op.is::<Min>() {
                [low.min(bound), high.min(bound)]
            } else {
                break;
            };
            self.bits = range.map(f32::to_bits);
            last = next.node;
        }
        Ok(last)
    }
}

/// Clips numbers to a range.
#[inline(always)]
pub(super) fn clipped<S: Simd>(simd: S, value: S::f32s, [low, high]: [S::f32s; 2]) -> S::f32s {
    // Keeps NaN, unlike a maximum.
    let value = simd.select_f32s(simd.less_than_f32s(value, low), low, value);
    simd.select_f32s(simd.greater_than_f32s(value, high), high, value)
}

/// Returns where the output of a node goes, if to one place alone.
pub(super) fn only_successor(model: &TypedModel, node: usize) -> Option<InletId> {
    match model.node(node).outputs[0].successors[..] {
        [next] if !model.outputs.contains(&node.into()) => Some(next),
        _ => None,
    }
}
