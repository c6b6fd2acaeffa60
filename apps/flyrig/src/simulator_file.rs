//! The file of the simulated rig: one commented default, strict reading.

use std::path::Path;

use anyhow::{Context as _, Result};
use flyrig_sim::SimConfig;

use crate::toml_errors;

/// Commented default file, as `flyrig sim print` writes it.
pub const DEFAULT_TOML: &str = include_str!("../assets/sim.toml");

/// Reads and checks a file.
///
/// # Errors
/// Names the file, the key, its value and what is expected.
pub fn load(path: &Path) -> Result<SimConfig> {
    let in_file = || format!("in the simulator's configuration {}", path.display());
    let text = flyrig_types::read_text(path)
        .with_context(|| format!("cannot read the simulator's configuration {}", path.display()))?;
    let mut config = parse(&text).with_context(in_file)?;
    if let Some(folder) = path.parent() {
        resolve_paths(&mut config, folder);
    }
    Ok(config)
}

/// Makes relative paths relative to the folder of the file that holds them.
pub fn resolve_paths(config: &mut SimConfig, folder: &Path) {
    for path in [&mut config.motion.bvh, &mut config.motion.gltf].into_iter().flatten() {
        *path = folder.join(&path);
    }
}

/// Reads and checks a text.
///
/// # Errors
/// Names the key, its value and what is expected.
pub fn parse(text: &str) -> Result<SimConfig> {
    let config: SimConfig =
        toml::from_str(text).map_err(|error| toml_errors::explain::<SimConfig>(text, &error, &toml::Table::new()))?;
    config.validate()?;
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_printed_default_is_the_default() {
        assert_eq!(parse(DEFAULT_TOML).unwrap(), SimConfig::default());
        assert_eq!(parse("").unwrap(), SimConfig::default());
        let all = toml::Table::try_from(SimConfig::default()).unwrap();
        let printed: toml::Table = DEFAULT_TOML.parse().unwrap();
        assert_eq!(toml_errors::missing_keys(&all, &printed, ""), Vec::<String>::new());
    }

    #[test]
    fn an_unknown_key_names_line_and_nearest_key() {
        let error = parse("seed = 1\nwidht = 64\n").unwrap_err().to_string();
        assert!(error.contains("line 2") && error.ends_with("did you mean `width`?"), "{error}");
    }
}
