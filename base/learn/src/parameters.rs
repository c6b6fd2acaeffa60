//! Parameters of networks: initialisation, and conversion to tensors.

use std::collections::BTreeMap;

use burn_tensor::{Device, Gradients, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};

/// Values of one parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Shape: rows, columns and so on; their product is the number of values.
    pub shape: Vec<usize>,
    /// Values, row by row.
    pub values: Vec<f32>,
}

/// Name, shape and initial standard deviation (0: all zero, negative: all one) of a parameter.
pub type Start = (String, Vec<usize>, f32);

/// Draws parameters from uniform distributions with the given standard deviations. Equal lists and seeds give equal values.
///
/// ```
/// let list = || vec![("weight".to_owned(), vec![3, 2], 0.1), ("bias".to_owned(), vec![2], 0.0)];
/// let parameters = flyrig_learn::drawn(list(), 7);
/// assert_eq!(flyrig_learn::count(&parameters), 8);
/// assert_eq!(parameters["bias"].values, [0.0, 0.0]);
/// assert_eq!(parameters["weight"].values, flyrig_learn::drawn(list(), 7)["weight"].values);
/// ```
#[must_use]
pub fn drawn(list: Vec<Start>, seed: u64) -> BTreeMap<String, Parameter> {
    let mut rng = SmallRng::seed_from_u64(seed);
    list.into_iter()
        .map(|(name, shape, spread)| {
            let count = shape.iter().product();
            let mut draw =
                || if spread > 0.0 { rng.random_range(-1.0f32..1.0) * spread * 3f32.sqrt() } else { -spread };
            let values = (0..count).map(|_| draw()).collect();
            (name, Parameter { shape, values })
        })
        .collect()
}

/// Returns the number of values in all parameters.
#[must_use]
pub fn count(parameters: &BTreeMap<String, Parameter>) -> usize {
    parameters.values().map(|p| p.values.len()).sum()
}

/// Returns whether all values are finite.
#[must_use]
pub fn is_finite(parameters: &BTreeMap<String, Parameter>) -> bool {
    parameters.values().all(|p| p.values.iter().all(|v| v.is_finite()))
}

/// Parameters as flat tensors on a device.
#[derive(Debug, Clone, Default)]
pub struct Tensors {
    by_name: BTreeMap<String, (Tensor<1>, Vec<usize>)>,
}

impl Tensors {
    /// Copies parameters to a device; with `trained`, they take part in derivatives.
    #[must_use]
    pub fn new(parameters: &BTreeMap<String, Parameter>, device: &Device, trained: bool) -> Self {
        let tensor = |p: &Parameter| {
            let flat = Tensor::<1>::from_data(TensorData::new(p.values.clone(), [p.values.len()]), device);
            (if trained { flat.require_grad() } else { flat }, p.shape.clone())
        };
        Self { by_name: parameters.iter().map(|(name, p)| (name.clone(), tensor(p))).collect() }
    }

    /// Returns a parameter in its shape; zeros for an unknown name, which is a bug of the caller.
    #[must_use]
    pub fn get<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        match self
            .by_name
            .get(name)
            .and_then(|(flat, shape)| Some((flat, <[usize; D]>::try_from(shape.as_slice()).ok()?)))
        {
            Some((flat, shape)) => flat.clone().reshape(shape),
            None => {
                debug_assert!(false, "{name}");
                Tensor::zeros([1; D], device)
            }
        }
    }

    /// Adds dL/d parameters to `into`; parameters without a gradient keep theirs.
    pub fn add_gradients(&self, gradients: &Gradients, into: &mut BTreeMap<String, Vec<f32>>) {
        for (name, (flat, _)) in &self.by_name {
            let Some(gradient) = flat.grad(gradients) else { continue };
            let values = to_vec(gradient);
            let sum = into.entry(name.clone()).or_insert_with(|| vec![0.0; values.len()]);
            for (sum, value) in sum.iter_mut().zip(values) {
                *sum += value;
            }
        }
    }
}

/// Returns the tensor's values in order.
#[must_use]
pub fn to_vec<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    // Tensors here are f32 on the CPU: the conversion cannot fail.
    tensor.into_data().try_into_vec::<f32>().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_start_is_that_of_the_seed_and_gradients_come_back() {
        let list =
            || vec![("a".to_owned(), vec![2, 3], 0.5), ("b".to_owned(), vec![3], 0.0), ("c".to_owned(), vec![1], -1.0)];
        let parameters = drawn(list(), 4);
        assert_eq!(parameters, drawn(list(), 4));
        assert!(parameters["b"].values == [0.0; 3] && parameters["c"].values == [1.0]);
        assert!(count(&parameters) == 10 && is_finite(&parameters));
        let device = Device::flex().autodiff();
        let tensors = Tensors::new(&parameters, &device, true);
        let sum = (tensors.get::<2>("a", &device) * 2.0).sum();
        let mut gradients = BTreeMap::new();
        tensors.add_gradients(&sum.backward(), &mut gradients);
        assert_eq!(gradients["a"], [2.0; 6]);
        assert!(gradients.get("b").is_none_or(|b| b.iter().all(|v| v.abs() <= 0.0)));
    }
}
