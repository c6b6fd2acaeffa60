//! State of a fit between two steps: a fit that resumes from it ends with the same bytes as an uninterrupted one.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::descent::Fit;
use crate::error::FitError;
use crate::model::Model;

/// Key of the description in the file's metadata.
const HEADER: &str = "flyrig-fit";

/// Progress of a fit: completed steps and total.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FitProgress {
    /// Description of take and settings; a state with another description is rejected.
    pub settings: String,
    /// Completed steps.
    pub done: u64,
    /// Total steps.
    pub total: u64,
}

impl<M: Model> Fit<M> {
    /// Returns the state after the last step, the model's included, as a file's bytes. `settings` describes all that the
    /// result depends on, `total` is the number of all steps.
    ///
    /// # Errors
    /// [`FitError::Checkpoint`] for a description that cannot be serialised.
    pub fn checkpoint(&mut self, settings: &str, total: u64) -> Result<Vec<u8>, FitError> {
        let fail = |problem: String| FitError::Checkpoint(problem);
        let progress = FitProgress { settings: settings.to_owned(), done: self.step, total };
        let header = serde_json::to_string(&progress).map_err(|error| fail(error.to_string()))?;
        let state = self.model.state();
        let views: Vec<_> = state
            .iter()
            .map(|(name, values)| {
                let view = TensorView::new(Dtype::F32, vec![values.len()], bytemuck::cast_slice(values))?;
                Ok((name.as_str(), view))
            })
            .collect::<Result<_, safetensors::SafeTensorError>>()
            .map_err(|error| fail(error.to_string()))?;
        safetensors::serialize(views, Some(HashMap::from([(HEADER.to_owned(), header)])))
            .map_err(|error| fail(error.to_string()))
    }

    /// Restores the state of a [`Self::checkpoint`]. A rejected state changes nothing.
    ///
    /// # Errors
    /// A text where the bytes are no state, are damaged, or belong to another take or other settings.
    pub fn resume(&mut self, bytes: &[u8], settings: &str) -> Result<FitProgress, String> {
        let none = || "is no state of a fit".to_owned();
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|_| none())?;
        let header = metadata.metadata().as_ref().and_then(|all| all.get(HEADER)).ok_or_else(none)?;
        let progress: FitProgress = serde_json::from_str(header).map_err(|error| format!("is damaged: {error}"))?;
        if progress.settings != settings {
            return Err("is of another take or of other settings".to_owned());
        }
        let file = SafeTensors::deserialize(bytes).map_err(|error| format!("is damaged: {error}"))?;
        let mut found = HashMap::new();
        for (name, tensor) in file.iter() {
            let values: Vec<f32> = tensor.data().chunks_exact(4).map(bytemuck::pod_read_unaligned).collect();
            found.insert(name.to_owned(), values);
        }
        let state = self.model.state();
        for (name, own) in &state {
            let belongs =
                |values: &&Vec<f32>| values.len() == own.len() && values.iter().all(|value| value.is_finite());
            found.get(name).filter(belongs).ok_or_else(|| format!("is damaged: {name} is missing or another"))?;
        }
        for (name, own) in state {
            if let Some(values) = found.get(&name) {
                own.copy_from_slice(values);
            }
        }
        self.step = progress.done;
        self.model.restore(progress.done);
        Ok(progress)
    }
}
