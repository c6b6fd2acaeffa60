//! Files of a rig whose cameras the boards do not join: the lenses, and a page that shows which cameras share boards.

use std::path::Path;

use anyhow::{Context as _, Error, Result};
use flyrig_calib::save_lenses;

use super::{
    advice::CalibrationState,
    lens::Lenses,
    output::{LENSES, PAGE},
    page,
    views::SeenBoards,
};

/// Writes the lenses that were calibrated and the page, and returns sentences that name them.
pub(super) fn write(out: &Path, seen: &SeenBoards, lenses: &Lenses, error: &Error) -> Result<String> {
    std::fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    let state = CalibrationState {
        ids: &seen.ids,
        sizes: &seen.sizes,
        shots: &seen.shots,
        with_lenses: lenses.are_new,
        solved: None,
        target_mm: 0.0,
    };
    page::unjoined(&state, format!("{error:#}")).save(&out.join(PAGE))?;
    let mut written = format!("{} shows how many boards the cameras share", out.join(PAGE).display());
    let found = seen.ids.iter().zip(&lenses.by_slot).filter_map(|(id, lens)| Some((id.clone(), *lens.as_ref().ok()?)));
    let found: Vec<_> = found.collect();
    if lenses.are_new && !found.is_empty() {
        let folder = out.join(LENSES);
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
        save_lenses(&folder, &found)?;
        written += &match found.len() == seen.ids.len() {
            true => format!("; the lenses are known: film what is missing and add --lenses {}", folder.display()),
            false => format!("; {} holds the lenses of the other cameras", folder.display()),
        };
    }
    Ok(written)
}
