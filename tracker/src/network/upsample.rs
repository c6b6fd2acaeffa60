//! Bilinear doubling of a network's grids, row by row: tract's own operator computes element by element.

use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::*;
use tract_onnx::tract_core::ops::nn::resize::{CoordTransformer, Interpolator, Resize};

/// Operator that doubles the last two axes of an `f32` tensor; pixel centres at half-integers ("half_pixel" of ONNX),
/// borders repeat.
#[derive(Debug, Clone, Hash, PartialEq, Eq)]
struct Upsample;

/// Replaces the operators of an optimised network that double height and width bilinearly.
pub(crate) fn replace_doublings(model: &mut TypedModel) -> TractResult<()> {
    for id in 0..model.nodes.len() {
        let node = model.node(id);
        let Some(resize) = node.op_as::<Resize>() else { continue };
        let (from, to) = (model.outlet_fact(node.inputs[0])?, model.outlet_fact(OutletId::new(id, 0))?);
        let is_f32 = from.datum_type == f32::datum_type();
        let (Some(from), Some(to)) = (from.shape.as_concrete(), to.shape.as_concrete()) else { continue };
        let doubles =
            matches!((from, to), ([n, c, h, w], [m, d, y, x]) if n == m && c == d && 2 * h == *y && 2 * w == *x);
        let is_bilinear = resize.interpolator == Interpolator::Linear
            && matches!(resize.coord_transformer, CoordTransformer::HalfPixel | CoordTransformer::PytorchHalfPixel);
        if is_f32 && doubles && is_bilinear {
            let patch = TypedModelPatch::replace_single_op(model, node, &node.inputs[..1], Upsample)?;
            patch.apply(model)?;
        }
    }
    Ok(())
}

/// Writes a row at twice its width; `out` is twice as long as `row`.
fn double_row(row: &[f32], out: &mut [f32]) {
    let Some((first, last)) = row.first().zip(row.last()) else { return };
    let [left_end, between @ .., right_end] = out else { return };
    (*left_end, *right_end) = (*first, *last);
    for ((pair, left), right) in between.as_chunks_mut::<2>().0.iter_mut().zip(row).zip(&row[1..]) {
        *pair = [0.75 * left + 0.25 * right, 0.25 * left + 0.75 * right];
    }
}

impl Op for Upsample {
    fn name(&self) -> StaticName {
        "Upsample".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Upsample {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let input = args_1!(inputs);
        let &[count, channels, height, width] = input.shape() else { bail!("a tensor of four axes, not {input:?}") };
        let mut output = Tensor::zero::<f32>(&[count, channels, 2 * height, 2 * width])?;
        let values = input.try_as_plain_ram()?.as_slice::<f32>()?;
        let mut plain = output.try_as_plain_ram_mut()?;
        let out = plain.as_slice_mut::<f32>()?;
        if width > 0 && height > 0 {
            let mut mixed = vec![0.0; width];
            for (grid, out) in values.chunks_exact(height * width).zip(out.chunks_exact_mut(4 * height * width)) {
                for (y, out) in out.chunks_exact_mut(2 * width).enumerate() {
                    let near = y / 2;
                    let far = if y % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min(height - 1) };
                    let row = |y: usize| &grid[y * width..(y + 1) * width];
                    for ((mixed, near), far) in mixed.iter_mut().zip(row(near)).zip(row(far)) {
                        *mixed = 0.75 * near + 0.25 * far;
                    }
                    double_row(&mixed, out);
                }
            }
        }
        Ok(tvec!(output.into_tvalue()))
    }
}

impl TypedOp for Upsample {
    as_op!();

    fn output_facts(&self, inputs: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        let mut shape = inputs[0].shape.to_tvec();
        for side in shape.iter_mut().skip(2) {
            *side = side.clone() * 2;
        }
        Ok(tvec!(inputs[0].datum_type.fact(&shape)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Output pixel (x, y) by the definition: the input at (x + 0.5) / 2 - 0.5, bilinear in f64.
    fn plain(values: &[f32], height: usize, width: usize) -> Vec<f64> {
        let at = |x: f64, y: f64| {
            let (x, y) = (x.clamp(0.0, width as f64 - 1.0), y.clamp(0.0, height as f64 - 1.0));
            let (x0, y0) = (x.floor() as usize, y.floor() as usize);
            let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
            let value = |x: usize, y: usize| f64::from(values[y * width + x]);
            let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
            let (u, v) = (x - x0 as f64, y - y0 as f64);
            mix(mix(value(x0, y0), value(x1, y0), u), mix(value(x0, y1), value(x1, y1), u), v)
        };
        let source = |i: usize| (i as f64 + 0.5) / 2.0 - 0.5;
        (0..4 * height * width).map(|i| at(source(i % (2 * width)), source(i / (2 * width)))).collect()
    }

    #[test]
    fn every_pixel_is_as_defined() {
        for (height, width) in [(1, 1), (1, 5), (4, 1), (2, 2), (7, 16), (13, 3)] {
            let values: Vec<f32> = (0..2 * height * width).map(|i| ((i * 7919) % 101) as f32 * 0.1 - 5.0).collect();
            let input = Tensor::from_shape(&[1, 2, height, width], &values).unwrap();
            let output = Upsample.eval_out_of_plan(tvec!(input.into())).unwrap().unwrap();
            assert_eq!(output[0].shape(), [1, 2, 2 * height, 2 * width]);
            let found: Vec<f32> = output[0].to_plain_array_view::<f32>().unwrap().iter().copied().collect();
            for (values, found) in values.chunks(height * width).zip(found.chunks(4 * height * width)) {
                for (expected, found) in plain(values, height, width).into_iter().zip(found) {
                    assert!((expected - f64::from(*found)).abs() < 1e-5, "{height}x{width}: {expected} {found}");
                }
            }
        }
    }

    #[test]
    fn an_empty_tensor_stays_empty_and_one_of_another_rank_is_refused() {
        let eval = |shape: &[usize]| Upsample.eval_out_of_plan(tvec!(Tensor::zero::<f32>(shape).unwrap().into()));
        assert_eq!(eval(&[1, 3, 0, 4]).unwrap().unwrap()[0].len(), 0);
        assert!(eval(&[3, 4]).is_err());
    }

    #[test]
    fn the_pose_networks_doublings_are_replaced() {
        let mut bytes = &include_bytes!("../../assets/pose_full.onnx")[..];
        let fact = f32::fact(tvec!(1, 256, 256, 3)).into();
        let model = onnx().model_for_read(&mut bytes).and_then(|model| model.with_input_fact(0, fact)).unwrap();
        let mut model = model.into_optimized().unwrap();
        let count = |model: &TypedModel| model.nodes.iter().filter(|node| node.op_is::<Resize>()).count();
        assert_eq!(count(&model), 5);
        replace_doublings(&mut model).unwrap();
        assert_eq!(count(&model), 0);
    }
}
