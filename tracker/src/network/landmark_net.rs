//! Loads, runs and checks networks that take one crop of an image, through tract.
//!
//! Operations of the loaded network are replaced where tract's own are slow: depthwise convolutions
//! ([`depthwise`](crate::network::depthwise)), those of 1x1 taps ([`pointwise`](crate::network::pointwise)), bilinear doublings ([`upsample`](crate::network::upsample)), and the state of the
//! vector registers after products ([`vector_state`](crate::network::vector_state)).

use std::sync::Arc;

use tract_linalg::multithread::{Executor, multithread_tract_scope};
use tract_onnx::prelude::*;
use tract_onnx::tract_hir::infer::Factoid as _;

use crate::error::{TrackError, TrackErrorKind};
use crate::network::depthwise::replace_depthwise;
use crate::network::pointwise::replace_pointwise;
use crate::network::upsample::replace_doublings;
use crate::network::vector_state::{clear_after_products, clear_upper_halves};

/// Network that takes one crop of an image.
#[derive(Clone)]
pub(crate) struct LandmarkNet {
    model: Arc<TypedRunnableModel>,
    /// Shape of the input: batch of 1, then rows, columns and channels in the network's order.
    shape: [usize; 4],
    /// Name in error messages: "pose", "hand", "face", or that of a file.
    name: Arc<str>,
}

impl LandmarkNet {
    /// Loads an ONNX file that takes square RGB crops of `side` x `side` x 3.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the file does not load.
    pub fn load(bytes: &[u8], side: usize, name: &str) -> Result<Self, TrackError> {
        LoadedNet::of_crops(bytes, side, name)?.runnable()
    }

    /// Loads an ONNX file. `shape` chooses the shape of the input from its sides; those that the file leaves open are
    /// `None`.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the file does not load, or with the message of `shape`.
    pub fn load_shaped(
        bytes: &[u8],
        shape: impl FnOnce(&[Option<usize>]) -> Result<[usize; 4], String>,
        name: &str,
    ) -> Result<Self, TrackError> {
        LoadedNet::new(bytes, shape, name)?.runnable()
    }

    /// Runs one crop, whose numbers are in the order of the input's shape.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the length is wrong or the network fails.
    pub fn run(&self, crop: &[f32]) -> Result<NetOutputs, TrackError> {
        let failed = |error: TractError| self.failed(&format!("failed: {error:#}"));
        let input = Tensor::from_shape(&self.shape, crop).map_err(failed)?;
        // All cores share the products, except on one of rayon's threads: while such a thread waits for the others' share it would
        // pick up other work, and tract panics where that is another run.
        let is_of_pool = rayon::current_thread_index().is_some();
        let executor = if is_of_pool { Executor::SingleThread } else { Executor::RayonGlobal };
        let outputs = multithread_tract_scope(executor, || self.model.run(tvec!(input.into())));
        clear_upper_halves();
        if !is_of_pool {
            rayon::spawn_broadcast(|_| clear_upper_halves());
        }
        let outputs = outputs.map_err(failed)?;
        Ok(NetOutputs { net: self.clone(), outputs })
    }

    /// Returns zeros in the size of a crop.
    pub fn blank(&self) -> Vec<f32> {
        vec![0.0; self.shape.iter().product()]
    }

    /// Creates an error that names this network.
    pub fn failed(&self, message: &str) -> TrackError {
        failed(&self.name, message)
    }
}

/// Network that was read from its file and can be made ready to run, whole or in part.
pub(crate) struct LoadedNet {
    model: TypedModel,
    shape: [usize; 4],
    name: Arc<str>,
}

impl LoadedNet {
    /// Reads an ONNX file as [`LandmarkNet::load`] does.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the file does not load.
    pub fn of_crops(bytes: &[u8], side: usize, name: &str) -> Result<Self, TrackError> {
        let hint = "use a file that convert_mediapipe.py made";
        Self::new(bytes, |_| Ok([1, side, side, 3]), name).map_err(|mut error| {
            error.message = format!("{}; {hint}", error.message);
            error
        })
    }

    /// Reads an ONNX file as [`LandmarkNet::load_shaped`] does.
    fn new(
        mut bytes: &[u8],
        shape: impl FnOnce(&[Option<usize>]) -> Result<[usize; 4], String>,
        name: &str,
    ) -> Result<Self, TrackError> {
        let model = onnx().model_for_read(&mut bytes).map_err(|error| failed_load(name, &error))?;
        let sides = &model.input_fact(0).map_err(|error| failed_load(name, &error))?.shape;
        let sides: Vec<Option<usize>> = sides
            .dims()
            .map(|side| {
                side.concretize().and_then(|side| side.to_i64().ok()).and_then(|side| usize::try_from(side).ok())
            })
            .collect();
        let shape = shape(&sides).map_err(|what| failed(name, &what))?;
        let model = model
            .with_input_fact(0, f32::fact(shape).into())
            .and_then(InferenceModelExt::into_typed)
            .and_then(TypedModel::into_decluttered)
            .and_then(|mut model| replace_depthwise(&mut model).map(|()| model))
            // Leaves channels before rows and columns wherever it can.
            .and_then(TypedModel::into_decluttered)
            .and_then(|mut model| replace_pointwise(&mut model).map(|()| model))
            .map_err(|error| failed_load(name, &error))?;
        Ok(Self { model, shape, name: name.into() })
    }

    /// Drops the outputs of `count` numbers, and what only they need.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when nothing would be left.
    pub fn without_output(mut self, count: usize) -> Result<Self, TrackError> {
        let of_size = |outlet: &OutletId| {
            let shape =
                self.model.outlet_fact(*outlet).ok().and_then(|fact| fact.shape.as_concrete().map(<[_]>::to_vec));
            shape.is_some_and(|shape| shape.iter().product::<usize>() == count)
        };
        let kept: Vec<OutletId> = self.model.outputs.iter().filter(|outlet| !of_size(outlet)).copied().collect();
        if kept.is_empty() {
            return Err(failed(&self.name, &format!("has no output but those of {count} numbers")));
        }
        self.model.select_output_outlets(&kept).map_err(|error| failed_load(&self.name, &error))?;
        Ok(self)
    }

    /// Makes the network ready to run.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when an operation cannot be prepared.
    pub fn runnable(self) -> Result<LandmarkNet, TrackError> {
        let Self { model, shape, name } = self;
        let model = model
            .into_optimized()
            .and_then(|mut model| {
                replace_doublings(&mut model)?;
                clear_after_products(&mut model)?;
                model.into_runnable()
            })
            .map_err(|error| failed_load(&name, &error))?;
        Ok(LandmarkNet { model, shape, name })
    }
}

fn failed(name: &str, what: &str) -> TrackError {
    TrackError::new(TrackErrorKind::Net, format!("the {name} network {what}"))
}

fn failed_load(name: &str, error: &TractError) -> TrackError {
    failed(name, &format!("does not load ({error:#})"))
}

/// Shape of an output and its numbers, row by row.
pub(crate) type ShapedNumbers = (Vec<usize>, Vec<f32>);

/// Outputs of one run.
pub(crate) struct NetOutputs {
    net: LandmarkNet,
    outputs: TVec<TValue>,
}

impl NetOutputs {
    /// Returns the output of `count` numbers.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when there is no such output or a number is not finite.
    pub fn of_size(&self, count: usize) -> Result<Vec<f32>, TrackError> {
        let output = self.outputs.iter().find(|output| output.len() == count).ok_or_else(|| {
            self.net.failed(&format!("has no output of {count} numbers; use a file that convert_mediapipe.py made"))
        })?;
        self.numbers(output)
    }

    /// Returns all outputs: their shapes and numbers.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when one holds no numbers, or one that is not finite.
    pub fn all(&self) -> Result<Vec<ShapedNumbers>, TrackError> {
        self.outputs.iter().map(|output| Ok((output.shape().to_vec(), self.numbers(output)?))).collect()
    }

    /// Returns the numbers of an output, all finite.
    fn numbers(&self, output: &TValue) -> Result<Vec<f32>, TrackError> {
        let values =
            output.to_plain_array_view::<f32>().map_err(|error| self.net.failed(&format!("failed: {error:#}")))?;
        let values: Vec<f32> = values.iter().copied().collect();
        if values.iter().all(|value| value.is_finite()) {
            Ok(values)
        } else {
            Err(self.net.failed("gave a value that is not finite"))
        }
    }
}

/// Returns the probability of a logit.
pub(crate) fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}
