//! Files of a checked take.

use std::path::Path;

use anyhow::{Context as _, Result};
use flyrig_calib::{calibration_toml, save_calibration};
use flyrig_report::write_whole;
use flyrig_types::Rig;
use serde_json::{Value, json};

use super::checked::Checked;
use crate::dataset;

/// Figures of a check, with the calibration that was checked.
const CHECK: &str = "calibration.check.json";
/// The calibration before the first check.
const BEFORE: &str = "calibration.before.toml";
const CALIBRATION: &str = "calibration.toml";

/// Marks the calibration of a take folder as right: it is not checked by the person. For simulated takes, whose calibration is exact.
///
/// # Errors
/// The calibration cannot be read, or the file cannot be written.
pub fn mark_checked(root: &Path) -> Result<()> {
    mark(root, &dataset::load_rig(root, &[])?)
}

/// Marks a calibration of a take folder as right.
pub(super) fn mark(root: &Path, rig: &Rig) -> Result<()> {
    write(root, rig, &Value::Null, &[])
}

/// Returns whether this calibration of a take was checked.
pub(super) fn is_checked(root: &Path, rig: &Rig) -> Result<bool> {
    let Ok(text) = flyrig_types::read_text(&root.join(CHECK)) else { return Ok(false) };
    let known = serde_json::from_str::<Value>(&text).unwrap_or_default();
    Ok(known.get("calibration").and_then(Value::as_str) == Some(calibration_toml(rig, &[])?.as_str()))
}

/// Checks that files can be written into a folder.
pub(super) fn ensure_writable(root: &Path) -> Result<()> {
    let probe = root.join(".flyrig-check");
    std::fs::write(&probe, b"").with_context(|| root.display().to_string())?;
    Ok(std::fs::remove_file(&probe)?)
}

/// Writes the figures of a check into a take, and the calibration where it changed; the one that it replaces stays beside it.
///
/// # Errors
/// Names the file that cannot be written.
pub fn save_checked(root: &Path, checked: &Checked) -> Result<()> {
    if checked.is_changed {
        let (now, before) = (root.join(CALIBRATION), root.join(BEFORE));
        if now.exists() && !before.exists() {
            std::fs::copy(&now, &before).with_context(|| format!("cannot write {}", before.display()))?;
        }
        save_calibration(root, &checked.rig, &[])?;
    }
    // As the file has it, rounded.
    let rig = if root.join(CALIBRATION).exists() { dataset::load_rig(root, &[])? } else { checked.rig.clone() };
    write(root, &rig, &checked.report, &checked.sentences)
}

fn write(root: &Path, rig: &Rig, report: &Value, sentences: &[String]) -> Result<()> {
    let file = json!({ "calibration": calibration_toml(rig, &[])?, "sentences": sentences, "measured": report });
    write_whole(&root.join(CHECK), &serde_json::to_vec_pretty(&file)?)
}
