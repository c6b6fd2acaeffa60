//! Persons who are known before the first image, from `body.avatar`.

use anyhow::{Context as _, Result};
use flyrig_avatar::{Avatar, AvatarError};
use flyrig_body::Template;
use flyrig_fusion::{BodySettings, PersonMemory, person_gaussians};

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
/// The body has the mean shape of clothes and hair, and the avatar's colours lie on the Gaussians that a session samples there. With
/// `for_viewers`, the stream carries the avatar itself, so that viewers render it.
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
    let template = avatar.surface();
    let surface = person_gaussians(&template, body).context("body.avatar")?;
    let mut memory = PersonMemory::of_colors(&template, &avatar.surface_colors(&surface));
    if for_viewers {
        memory = memory.with_stream(encode_avatar(&avatar).context("body.avatar")?);
    }
    Ok(Some(KnownBody { template, memory: Some(memory) }))
}
