//! Memory of a subject: saving, resuming and forgetting what was learnt about the person.

use std::sync::Arc;

use flyrig_avatar::Avatar;
use flyrig_gpu::GpuContext;

use super::{memory::PersonMemory, person::Subject};
use crate::error::FusionError;

impl Subject {
    /// Forgets clothes and colours, since another person may come. Returns to those known before the first image, where there are any.
    pub(crate) fn forget(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        self.schedule.restart();
        self.geometry.reset();
        self.painter.reset();
        match self.start.clone() {
            Some(start) => self.show(gpu, &start),
            None => Ok(()),
        }
    }

    /// Reads back what was learnt about the person.
    pub(crate) fn memory(&self, gpu: &GpuContext) -> Result<PersonMemory, FusionError> {
        let translations = self.node_translations().to_vec();
        let networks = self.painter.network_memory();
        let memory = self.painter.memory(gpu)?;
        let colors = self.painter.direct_colors(gpu, self.geometry.painted())?;
        let known = PersonMemory::new((self.body(), self.outfit()), translations, memory, colors, networks);
        Ok(PersonMemory { avatar: self.geometry.avatar().cloned(), ..known })
    }

    /// Resumes from what an earlier session has learnt about the same person.
    pub(crate) fn restore(&mut self, gpu: &GpuContext, memory: &PersonMemory) -> Result<(), FusionError> {
        if memory.avatar.is_some() && self.geometry.avatar().is_none() {
            tracing::warn!("person {} has another body than the avatar and starts without it", self.id);
            return Ok(());
        }
        let count = self.gaussians().count();
        if memory.colors.len() != count {
            return Err(FusionError::SavedPerson {
                name: self.id.to_string(),
                problem: format!(
                    "it has {} Gaussians, the session {count}; set body.gaussians to {0}, or delete it",
                    memory.colors.len()
                ),
            });
        }
        self.show(gpu, memory)?;
        if memory.is_start {
            self.start_from(Arc::new(memory.clone()));
        }
        if let Some(networks) = &memory.networks {
            self.painter.resume_networks(networks);
        }
        self.track.watch.resume();
        Ok(())
    }

    /// Returns the avatar whose Gaussians the person is made of.
    pub(crate) fn avatar(&self) -> Option<&Arc<Avatar>> {
        self.geometry.avatar()
    }

    /// Keeps what is known before the first image.
    fn start_from(&mut self, start: Arc<PersonMemory>) {
        if let Some(avatar) = &start.stream {
            if avatar.template.joints().len() == self.shape.template.skeleton.joints().len() {
                self.shape.stream = Some(Arc::clone(avatar));
            } else {
                tracing::warn!("person {} has other joints than the avatar: viewers get surface and colours", self.id);
            }
        }
        self.start = Some(start);
    }

    /// Shows the deformation and colours of a memory with the same number of Gaussians.
    fn show(&mut self, gpu: &GpuContext, memory: &PersonMemory) -> Result<(), FusionError> {
        self.geometry.resume(gpu, &memory.translations)?;
        self.painter.resume(gpu, self.geometry.painted(), memory)
    }

    /// Takes over what belongs to no device (poses, tracking quality, the networks' memory) from the subject of the same person on
    /// another device.
    pub(crate) fn take_over(&mut self, old: &Self) {
        let resumed = self.track.watch.is_resumed();
        self.track.curve.clone_from(&old.track.curve);
        self.track.last_pose.clone_from(&old.track.last_pose);
        self.track.viewed.clone_from(&old.track.viewed);
        self.track.confidence = old.track.confidence;
        self.shape_number = old.shape_number;
        self.geometry.hold(old.geometry.is_held());
        if let Some(start) = &old.start {
            self.start_from(Arc::clone(start));
        }
        if resumed {
            self.track.watch.clone_from(&old.track.watch);
            self.painter.take_over(&old.painter);
        }
    }
}
