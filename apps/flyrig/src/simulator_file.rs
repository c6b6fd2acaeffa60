//! The file of the simulated rig: one commented default, strict reading.

use std::path::Path;

use anyhow::{Context as _, Result};
use flyrig_sim::SimConfig;

use crate::{config::Config, toml_errors};

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
    parse(&text).with_context(in_file)
}

/// Reads and checks a file of the simulated rig, or a rig's configuration with a table `[sim]`.
///
/// # Errors
/// Those of [`load`] and [`Config::load_for_capture`].
pub fn load_any(path: &Path) -> Result<SimConfig> {
    let is_rig = std::fs::read_to_string(path)
        .is_ok_and(|text| text.parse::<toml::Table>().is_ok_and(|table| table.contains_key("sim")));
    if is_rig { Ok(Config::load_for_capture(path)?.sim) } else { load(path) }
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
    fn the_table_of_a_rigs_configuration_is_read_too() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rig.toml");
        std::fs::write(&file, "[source]\nkind = \"sim\"\n[sim]\nwidth = 32\nheight = 48\n").unwrap();
        let config = load_any(&file).unwrap();
        assert_eq!((config.width, config.height), (32, 48));
        std::fs::write(&file, "[sim]\nwidht = 32\n").unwrap();
        let error = format!("{:#}", load_any(&file).unwrap_err());
        assert!(error.contains("line 2") && error.ends_with("did you mean `width`?"), "{error}");
        std::fs::write(&file, "width = 64\n").unwrap();
        assert_eq!(load_any(&file).unwrap().width, 64);
    }

    #[test]
    fn an_unknown_key_names_line_and_nearest_key() {
        let error = parse("seed = 1\nwidht = 64\n").unwrap_err().to_string();
        assert!(error.contains("line 2") && error.ends_with("did you mean `width`?"), "{error}");
    }
}
