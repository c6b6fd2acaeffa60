//! State of a fit between two steps: a fit that resumes from it ends with the same bytes as an uninterrupted one.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};

use crate::error::AvatarError;
use crate::fit::descent::Fit;
use crate::model::avatar::Avatar;

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

impl Fit {
    /// Returns the state after the last step, including the avatar, as a file's bytes.
    ///
    /// # Errors
    /// [`AvatarError::Format`] for a description that cannot be serialised.
    pub fn checkpoint(&mut self, avatar: &mut Avatar, settings: &str, total: u64) -> Result<Vec<u8>, AvatarError> {
        let fail = |problem: String| AvatarError::Format { path: "checkpoint".into(), problem };
        let progress = FitProgress { settings: settings.to_owned(), done: self.step, total };
        let header = serde_json::to_string(&progress).map_err(|error| fail(error.to_string()))?;
        let state = self.state(avatar);
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
    pub fn resume(&mut self, avatar: &mut Avatar, bytes: &[u8], settings: &str) -> Result<FitProgress, String> {
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
        let state = self.state(avatar);
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
        if let Some(skin) = &self.skin {
            skin.bake(&mut avatar.skin);
        }
        if let Some(local) = &mut self.local {
            local.resume(progress.done, &mut avatar.parameters);
        }
        Ok(progress)
    }

    /// Returns all numbers that change from step to step, by name.
    fn state<'a>(&'a mut self, avatar: &'a mut Avatar) -> Vec<(String, &'a mut [f32])> {
        let mut all = Vec::new();
        for (number, list) in avatar.parameters.lists_mut().into_iter().enumerate() {
            all.push((format!("list.{number}"), list.as_flattened_mut()));
        }
        all.push(("light".to_owned(), avatar.light.terms.as_flattened_mut()));
        for (number, moment) in self.light.moments.iter_mut().enumerate() {
            all.push((format!("light.{number}"), moment.as_mut_slice()));
        }
        if let Some(poses) = &mut self.poses {
            all.push(("poses".to_owned(), poses.corrections.as_mut_slice()));
            all.push(("poses.squares".to_owned(), poses.squares.as_mut_slice()));
        }
        if let Some(skin) = &mut self.skin {
            all.push(("skin".to_owned(), skin.factors.as_flattened_mut()));
            for (k, list) in skin.adam.lists_mut().into_iter().enumerate() {
                all.push((format!("skin.adam.{k}"), list.as_flattened_mut()));
            }
        }
        for (number, adam) in self.moments.iter_mut().enumerate() {
            for (k, list) in adam.lists_mut().into_iter().enumerate() {
                all.push((format!("adam.{k}.{number}"), list.as_flattened_mut()));
            }
        }
        all.extend(self.local.iter_mut().flat_map(|local| local.state()));
        all
    }
}
