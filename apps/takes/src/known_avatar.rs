//! Persons who are known before the first image, from `body.avatar`.

use std::sync::Arc;

use anyhow::{Context as _, Result};
use flyrig_avatar::{Avatar, AvatarError};
use flyrig_body::Template;
use flyrig_fusion::{BodySettings, PersonMemory};

use crate::avatar_stream::encode_avatar;

/// Person who is known before the first image.
#[derive(Debug, Clone)]
pub struct KnownBody {
    /// Dressed body.
    pub template: Template,
    /// Initial colours; `None` if they come from the images.
    pub memory: Option<PersonMemory>,
}

impl From<Template> for KnownBody {
    fn from(template: Template) -> Self {
        Self { template, memory: None }
    }
}

/// Loads the avatar that the settings name as the known first person; `None` if no avatar is named.
///
/// The person is made of the avatar's Gaussians. With `for_viewers`, the stream carries the avatar itself, so that viewers render it from
/// poses alone.
///
/// # Errors
/// Names the file and the fix in one line.
pub fn known_body(body: &BodySettings, for_viewers: bool) -> Result<Option<KnownBody>> {
    let Some(path) = body.avatar_file() else { return Ok(None) };
    let avatar = match Avatar::load(path) {
        Err(AvatarError::File { path, source }) => {
            anyhow::bail!("body.avatar: {}: {source}; name a file of `flyrig avatar build`, or none", path.display())
        }
        other => other.context("body.avatar")?,
    };
    let template = avatar.template.clone();
    let stream = for_viewers.then(|| encode_avatar(&avatar)).transpose().context("body.avatar")?;
    let mut memory = PersonMemory::of_avatar(Arc::new(avatar));
    if let Some(stream) = stream {
        memory = memory.with_stream(stream);
    }
    Ok(Some(KnownBody { template, memory: Some(memory) }))
}
