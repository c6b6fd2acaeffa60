//! Landmark networks through tract: loading, running and checking of outputs.

use std::sync::Arc;

use tract_linalg::multithread::{Executor, multithread_tract_scope};
use tract_onnx::prelude::*;

use crate::upsample::replace_doublings;
use crate::{TrackError, TrackErrorKind};

/// A network that takes one square RGB crop.
#[derive(Clone)]
pub(crate) struct LandmarkNet {
    model: Arc<TypedRunnableModel>,
    /// Side of the crop, pixels.
    side: usize,
    /// Name in messages: "pose", "hand" or "face".
    name: &'static str,
}

impl LandmarkNet {
    /// Loads an ONNX file whose input is `side` x `side` x 3.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the file does not load.
    pub fn load(mut bytes: &[u8], side: usize, name: &'static str) -> Result<Self, TrackError> {
        let failed = |error: TractError| {
            TrackError::new(
                TrackErrorKind::Net,
                format!("the {name} network does not load ({error:#}); use a file that convert_mediapipe.py made"),
            )
        };
        let length = side as i64;
        let model = onnx()
            .model_for_read(&mut bytes)
            .and_then(|model| model.with_input_fact(0, f32::fact(tvec!(1, length, length, 3)).into()))
            .and_then(InferenceModelExt::into_optimized)
            .and_then(|mut model| replace_doublings(&mut model).and_then(|()| model.into_runnable()))
            .map_err(failed)?;
        Ok(Self { model, side, name })
    }

    /// Runs one crop: RGB in 0..=1, row by row.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when the length is wrong or the network fails.
    pub fn run(&self, rgb: &[f32]) -> Result<NetOutputs, TrackError> {
        let failed = |error: TractError| self.failed(&format!("failed: {error:#}"));
        let input = Tensor::from_shape(&[1, self.side, self.side, 3], rgb).map_err(failed)?;
        // All cores share the products. Not so on one of rayon's threads: while it waits for another one's share it would take up
        // other work, and tract panics where that is another run.
        let is_of_pool = rayon::current_thread_index().is_some();
        let executor = if is_of_pool { Executor::SingleThread } else { Executor::RayonGlobal };
        let outputs = multithread_tract_scope(executor, || self.model.run(tvec!(input.into()))).map_err(failed)?;
        Ok(NetOutputs { net: self.clone(), outputs })
    }

    /// Zeros in the size of a crop.
    pub fn blank(&self) -> Vec<f32> {
        vec![0.0; self.side * self.side * 3]
    }

    fn failed(&self, message: &str) -> TrackError {
        TrackError::new(TrackErrorKind::Net, format!("the {} network {message}", self.name))
    }
}

/// Outputs of one run.
pub(crate) struct NetOutputs {
    net: LandmarkNet,
    outputs: TVec<TValue>,
}

impl NetOutputs {
    /// Returns the output of a size.
    ///
    /// # Errors
    /// Kind [`TrackErrorKind::Net`] when there is none or a number is not finite.
    pub fn of_size(&self, count: usize) -> Result<Vec<f32>, TrackError> {
        let output = self.outputs.iter().find(|output| output.len() == count).ok_or_else(|| {
            self.net.failed(&format!("has no output of {count} numbers; use a file that convert_mediapipe.py made"))
        })?;
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

/// Probability of a logit.
pub(crate) fn sigmoid(logit: f64) -> f64 {
    1.0 / (1.0 + (-logit).exp())
}
