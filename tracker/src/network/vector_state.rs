//! Clears the vector registers after a network's products.
//!
//! tract's products (0.23, written in assembly) return without `vzeroupper`. The upper halves of the vector registers then
//! still are in use, and on x86 processors every SSE instruction of the thread must merge with them until they are cleared:
//! box means ran 3.5 times slower on threads that had run a network.

use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::*;
use tract_onnx::tract_core::ops::matmul::optimized::OptMatMul;

/// Clears the upper halves of this thread's vector registers. Changes no result.
pub(crate) fn clear_upper_halves() {
    #[cfg(target_arch = "x86_64")]
    if let Some(v3) = pulp::x86::V3::try_new() {
        v3.avx._mm256_zeroupper();
    }
}

/// Operator that passes a tensor on unchanged, after [`clear_upper_halves`].
#[derive(Debug, Clone, Hash, PartialEq, Eq)]
struct ClearUpperHalves;

/// Inserts a [`ClearUpperHalves`] after each product of an optimised network, for the operators between the products.
pub(crate) fn clear_after_products(model: &mut TypedModel) -> TractResult<()> {
    for id in 0..model.nodes.len() {
        if model.node(id).op_is::<OptMatMul>() {
            let outlet = OutletId::new(id, 0);
            let (name, fact) = (format!("{}.clear", model.node(id).name), model.outlet_fact(outlet)?.clone());
            TypedModelPatch::intercept(model, outlet, name, ClearUpperHalves, fact)?.apply(model)?;
        }
    }
    Ok(())
}

impl Op for ClearUpperHalves {
    fn name(&self) -> StaticName {
        "ClearUpperHalves".into()
    }

    op_as_typed_op!();
}

impl EvalOp for ClearUpperHalves {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        clear_upper_halves();
        Ok(inputs)
    }
}

impl TypedOp for ClearUpperHalves {
    as_op!();

    fn output_facts(&self, inputs: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(inputs[0].clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_product_of_the_pose_network_is_followed_by_a_clearing_that_changes_nothing() {
        let mut bytes = &include_bytes!("../../assets/pose_full.onnx")[..];
        let fact = f32::fact(tvec!(1, 256, 256, 3)).into();
        let model = onnx().model_for_read(&mut bytes).and_then(|model| model.with_input_fact(0, fact)).unwrap();
        let plain = model.into_optimized().unwrap();
        let mut cleared = plain.clone();
        clear_after_products(&mut cleared).unwrap();
        let products = plain.nodes.iter().filter(|node| node.op_is::<OptMatMul>()).count();
        let clearings: Vec<_> = cleared.nodes.iter().filter(|node| node.op_is::<ClearUpperHalves>()).collect();
        assert!(products > 20 && clearings.len() == products, "{} after {products} products", clearings.len());
        assert!(clearings.iter().all(|node| cleared.node(node.inputs[0].node).op_is::<OptMatMul>()));
        let pixels: Vec<f32> = (0..256 * 256 * 3).map(|i| ((i * 7919) % 256) as f32 / 255.0).collect();
        let run = |model: TypedModel| {
            let input = Tensor::from_shape(&[1, 256, 256, 3], &pixels).unwrap();
            let outputs = model.into_runnable().unwrap().run(tvec!(input.into())).unwrap();
            outputs.iter().map(|output| output.to_plain_array_view::<f32>().unwrap().to_owned()).collect::<Vec<_>>()
        };
        assert!(run(plain) == run(cleared));
    }
}
