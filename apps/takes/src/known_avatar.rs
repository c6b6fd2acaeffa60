//! `body.avatar`: an avatar as the start of tracking and colours.

use anyhow::{Context as _, Result};
use flyrig_avatar::{Avatar, AvatarError};
use flyrig_fusion::{BodySettings, PersonMemory, person_gaussians};

use crate::{KnownBody, encode_avatar};

/// Reads the avatar that the settings name, as the person of the first place: its body with the mean shape of clothes and hair, and its
/// colours on the Gaussians that a session samples there. None where no avatar is named. `for_viewers`: viewers draw the avatar itself.
///
/// # Errors
/// One line that names the file and the fix.
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
