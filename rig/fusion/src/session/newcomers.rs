//! Preparation of subjects for people who arrive.
//!
//! Sampling a surface takes seconds. A live rig goes on meanwhile: each new person is prepared in a thread of its own, named "new person",
//! and shown once the thread has ended.

use std::{collections::BTreeMap, sync::Arc, thread::JoinHandle};

use flyrig_avatar::Avatar;
use flyrig_body::{Outfit, Template};
use flyrig_gpu::GpuContext;
use flyrig_types::{PersonId, Rig};

use super::perceiver::Newcomer;
use crate::{
    error::FusionError, health::release_free_memory, settings::session::SessionSettings, subject::person::Subject,
};

/// Name of the threads, in errors.
const NAME: &str = "new person";

/// People whose subjects are being prepared.
#[derive(Debug, Default)]
pub(crate) struct Newcomers {
    /// Whether subjects are prepared in threads of their own.
    beside: bool,
    /// Number of the shape, and thread, of each person.
    preparing: BTreeMap<PersonId, (u32, JoinHandle<Result<Subject, FusionError>>)>,
}

impl Newcomers {
    /// Prepares subjects in threads of their own from now on. Which frame set shows a new person first then depends on the machine.
    pub fn use_threads(&mut self) {
        self.beside = true;
    }

    /// Drops the people who are being prepared, for another device.
    pub fn clear(&mut self) {
        self.preparing.clear();
    }

    /// Returns whether a person's subject is being prepared.
    pub fn is_preparing(&self, person: PersonId) -> bool {
        self.preparing.contains_key(&person)
    }

    /// Returns whether any subject is being prepared.
    pub fn are_preparing(&self) -> bool {
        !self.preparing.is_empty()
    }

    /// Returns the subject of a newcomer, or `None` while it is being prepared: call it again with that newcomer.
    ///
    /// # Errors
    /// Those of [`Subject::new`]; [`FusionError::ThreadFailed`] after a panic.
    pub fn subject(
        &mut self,
        newcomer: Newcomer,
        avatar: Option<&Arc<Avatar>>,
        gpu: &GpuContext,
        (rig, settings): (&Rig, &SessionSettings),
    ) -> Result<Option<Subject>, FusionError> {
        let Newcomer { person, shape, template, outfit } = newcomer;
        // A person whose shape has changed meanwhile is begun again.
        if let Some((_, thread)) = self.preparing.remove(&person).filter(|(of, _)| *of == shape) {
            if !thread.is_finished() {
                self.preparing.insert(person, (shape, thread));
                return Ok(None);
            }
            let failed = |panic: Box<dyn std::any::Any + Send>| FusionError::ThreadFailed {
                name: NAME.to_owned(),
                panic: panic.downcast_ref::<String>().cloned().unwrap_or_else(|| "no message".to_owned()),
            };
            return thread.join().map_err(failed)?.map(Some);
        }
        if !self.beside {
            return prepare(person, shape, (template, outfit), avatar, gpu, (rig, settings)).map(Some);
        }
        let (gpu, rig, settings, avatar) = (gpu.clone(), rig.clone(), settings.clone(), avatar.cloned());
        let work = move || prepare(person, shape, (template, outfit), avatar.as_ref(), &gpu, (&rig, &settings));
        let thread = std::thread::Builder::new().name(NAME.to_owned()).spawn(work);
        let thread =
            thread.map_err(|error| FusionError::ThreadFailed { name: NAME.to_owned(), panic: error.to_string() })?;
        self.preparing.insert(person, (shape, thread));
        Ok(None)
    }
}

fn prepare(
    person: PersonId,
    shape: u32,
    worn: (Template, Outfit),
    avatar: Option<&Arc<Avatar>>,
    gpu: &GpuContext,
    (rig, settings): (&Rig, &SessionSettings),
) -> Result<Subject, FusionError> {
    let mut subject = Subject::new(gpu, person, worn, avatar, (rig, settings))?;
    subject.shape_number = shape;
    // The choice of evenly spaced points needs far more memory than its result.
    release_free_memory();
    Ok(subject)
}
