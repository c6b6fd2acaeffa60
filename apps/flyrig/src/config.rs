//! The configuration file: one commented default, strict reading, errors that name line and key.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use flyrig_capture::Rotation;
use flyrig_fusion::{
    AppearanceOptions, BodySettings, BudgetSettings, Origin, OutputSettings, PerceptionSettings, SessionSettings,
    TrackingSettings,
};
use flyrig_sim::SimConfig;
use flyrig_sync::SyncSettings;
use flyrig_takes::{SourceKind, SourceSection, TakeConfig};
use flyrig_tracker::PoseNet;
use flyrig_transport::TransportConfig;
use flyrig_web::WebConfig;
use serde::{Deserialize, Serialize};

use crate::{simulator_file, toml_errors::explain};

/// Commented default file, as `flyrig config print` writes it; a test keeps it equal to `Config::default()`.
pub const DEFAULT_TOML: &str = include_str!("../assets/default.toml");

/// Names of `appearance.weights` that are no files.
const BUNDLED: [&str; 2] = ["small", "tiny"];

/// Tables and keys of earlier versions, and what to do about each.
const REMOVED: [(&str, &str); 9] = [
    ("body.pose", "it is a key of [perception]"),
    ("body.masks", "it is a key of [perception]"),
    ("body.shape", "it is a key of [perception]"),
    ("tracking.level_of_detail", "delete it: images are compared as finely as they resolve"),
    ("tracking.rest", "delete it: the solver rests once it has converged"),
    ("tracking.per_view_time", "delete it: every image is explained at its own capture time"),
    ("appearance.networks_on", "delete it: networks run on the processor"),
    ("appearance.reuse", "delete it: networks compute every frame anew"),
    ("transport.viewpoint_lease_millis", "delete it: a viewpoint lives for 3 s after its viewer's last request"),
];

/// Configuration of `flyrig run`; the keys are explained in `assets/default.toml`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub rig: RigSection,
    pub source: SourceSection,
    /// Simulated rig, from the file that `source.path` names where `source.kind` is "sim", or written here.
    #[serde(skip_serializing)]
    pub sim: SimConfig,
    pub sync: SyncSettings,
    pub calibration: CalibrationSection,
    pub perception: PerceptionSettings,
    pub body: BodySettings,
    pub tracking: TrackingSettings,
    pub appearance: AppearanceOptions,
    pub budget: BudgetSettings,
    pub output: OutputSettings,
    pub capture: CaptureSection,
    pub record: RecordSection,
    pub transport: TransportConfig,
    pub web: WebConfig,
    pub health: HealthSection,
    pub gpu: GpuSection,
}

/// Supervision of the calibration while the rig runs.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationSection {
    pub watch: WatchMode,
}

/// Reaction to bumped cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WatchMode {
    Off,
    #[default]
    Warn,
    Correct,
}

/// The table `[rig]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigSection {
    pub name: String,
}

impl Default for RigSection {
    fn default() -> Self {
        Self { name: "flyrig".to_owned() }
    }
}

/// Settings of `flyrig capture`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureSection {
    pub jpeg_quality: u8,
}

impl Default for CaptureSection {
    fn default() -> Self {
        Self { jpeg_quality: 90 }
    }
}

/// Settings of recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordSection {
    pub jpeg_quality: u8,
    pub rotate: Rotation,
}

impl Default for RecordSection {
    fn default() -> Self {
        Self { jpeg_quality: 95, rotate: Rotation::default() }
    }
}

/// The table `[gpu]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GpuSection {
    pub adapter: String,
}

/// The table `[health]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HealthSection {
    pub listen: String,
}

impl Config {
    /// Reads and checks a file, and the simulator's file that it names.
    ///
    /// # Errors
    /// Names the file, the key, its value and what is expected.
    pub fn load(path: &Path) -> Result<Self> {
        let config = Self::load_for_capture(path)?;
        config.check_scene().with_context(|| in_file(path))?;
        Ok(config)
    }

    /// Reads and checks a file for `flyrig capture`, which needs neither a calibration nor a person.
    ///
    /// # Errors
    /// Those of [`Self::load`].
    pub fn load_for_capture(path: &Path) -> Result<Self> {
        check_is_configuration(path)?;
        let text = flyrig_types::read_text(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        let mut config = Self::parse_values(&text).with_context(|| in_file(path))?;
        if let Some(folder) = path.parent() {
            config.resolve_paths(folder);
        }
        if config.source.kind != SourceKind::Cameras {
            config.check_scene().with_context(|| in_file(path))?;
        }
        if let Some(file) = config.simulator_file() {
            ensure!(
                config.sim == SimConfig::default(),
                "{}: [sim] and source.path both describe the simulated rig; delete one of them",
                path.display()
            );
            config.sim = simulator_file::load(file)?;
        }
        Ok(config)
    }

    /// Reads and checks a text, without the simulator's file that it may name.
    ///
    /// # Errors
    /// Names the key, its value and what is expected.
    pub fn parse(text: &str) -> Result<Self> {
        let config = Self::parse_values(text)?;
        config.check_scene()?;
        Ok(config)
    }

    fn parse_values(text: &str) -> Result<Self> {
        let config: Self = toml::from_str(text).map_err(|error| match removed_key(text, &error) {
            Some(advice) => anyhow!(advice),
            None => explain::<Self>(text, &error, &toml::Table::try_from(Self::default()).unwrap_or_default()),
        })?;
        config.check_values()?;
        Ok(config)
    }

    /// Makes relative paths relative to the folder of the configuration.
    fn resolve_paths(&mut self, folder: &Path) {
        let (source, perception, body) = (&mut self.source, &mut self.perception, &mut self.body);
        let paths = [
            &mut source.path,
            &mut source.calibration,
            &mut perception.plates,
            &mut body.template,
            &mut body.person,
            &mut body.avatar,
            &mut self.transport.keys,
            &mut self.web.certificate,
            &mut self.web.key,
        ];
        for path in paths.into_iter().filter(|path| !path.as_os_str().is_empty()) {
            *path = folder.join(&path);
        }
        // Names of networks that come with flyrig are no paths.
        if !PoseNet::is_built_in(&perception.network) {
            perception.network = folder.join(&perception.network);
        }
        if let Some(weights) =
            self.appearance.weights.as_mut().filter(|path| !BUNDLED.iter().any(|name| path.as_os_str() == *name))
        {
            *weights = folder.join(&weights);
        }
        simulator_file::resolve_paths(&mut self.sim, folder);
    }

    /// Returns the simulator's file; `None` for its defaults and for other sources.
    fn simulator_file(&self) -> Option<&Path> {
        Some(self.source.path.as_path())
            .filter(|path| self.source.kind == SourceKind::Sim && !path.as_os_str().is_empty())
    }

    fn check_values(&self) -> Result<()> {
        let range = |key: &str, value: f64, low: f64, high: f64| -> Result<()> {
            ensure!(
                value.is_finite() && (low..=high).contains(&value),
                "{key} is {value}, it must lie between {low} and {high}"
            );
            Ok(())
        };
        ensure!(
            !self.rig.name.is_empty() && self.rig.name.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c)),
            "rig.name is '{}', it must be letters, digits, '-' and '_'",
            self.rig.name
        );
        self.sim.validate().context("in [sim]")?;
        range("source.fps", self.source.fps, 0.1, 1000.0)?;
        self.source.validate()?;
        ensure!(
            !self.appearance.mode.is_ablation(),
            "appearance.mode is an ablation, which `flyrig-bench appearance` measures; it must be \"direct\" or \"stfa\""
        );
        self.session().validate()?;
        self.output.validate()?;
        ensure!(
            !self.output.avatar || self.body.avatar_file().is_some(),
            "output.avatar is true but body.avatar is empty: name the avatar that viewers draw, or set output.avatar = false"
        );
        range("capture.jpeg_quality", f64::from(self.capture.jpeg_quality), 0.0, 100.0)?;
        range("record.jpeg_quality", f64::from(self.record.jpeg_quality), 0.0, 100.0)?;
        self.web.validate()?;
        self.transport().validate().context("in [rig] or [transport]")
    }

    /// Returns the settings of a session.
    pub fn session(&self) -> SessionSettings {
        SessionSettings {
            perception: self.perception.clone(),
            body: self.body.clone(),
            tracking: self.tracking.clone(),
            appearance: self.appearance.clone(),
            budget: self.budget,
        }
    }

    /// Returns the sections that say where frames come from and what is known about the person.
    pub fn take(&self) -> TakeConfig {
        TakeConfig {
            source: self.source.clone(),
            sim: self.sim.clone(),
            sync: self.sync.clone(),
            perception: self.perception.clone(),
            template: self.body.template.clone(),
            transport: self.transport(),
        }
    }

    /// Returns the settings of the transport session.
    pub fn transport(&self) -> TransportConfig {
        TransportConfig { rig: self.rig.name.clone(), ..self.transport.clone() }
    }

    /// Checks the requirements of tracking beyond the ranges of the values.
    ///
    /// # Errors
    /// Names the missing key and what to do.
    pub fn check_scene(&self) -> Result<()> {
        ensure!(
            self.source.kind == SourceKind::Sim
                || !self.source.path.as_os_str().is_empty()
                || self.source.kind.is_live() && !self.source.calibration.as_os_str().is_empty(),
            "source.path is empty: name the folder of the data set, the folder of the calibration for real cameras, or the recording"
        );
        ensure!(
            self.source.kind != SourceKind::Network
                || !self.transport.connect.is_empty()
                || !self.transport.keys.as_os_str().is_empty(),
            "source.kind is \"network\" but neither transport.keys nor transport.connect is set: give the computers with \
             cameras keys (`flyrig keys`), or name them, such as tcp/10.0.0.2:7447"
        );
        ensure!(
            self.source.kind == SourceKind::Sim
                || self.perception.pose == Origin::Estimated
                || !self.body.template.as_os_str().is_empty(),
            "perception.pose is \"given\" but body.template is empty: name a skinned glTF file with an animation, or set \
             perception.pose = \"estimated\""
        );
        Ok(())
    }
}

/// Checks that a path is not a folder or a recording, which `[source]` names.
fn check_is_configuration(path: &Path) -> Result<()> {
    let is_recording = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("mcap"));
    let (what, kind) = match (path.is_dir(), is_recording) {
        (true, _) => ("a folder", "folder"),
        (false, true) => ("a recording", "mcap"),
        (false, false) => return Ok(()),
    };
    bail!(
        "{} is {what}, not a configuration (*.toml): write one with [source] kind = \"{kind}\" and path = \"{}\" (`flyrig \
         config print` shows every key)",
        path.display(),
        path.display()
    )
}

fn in_file(path: &Path) -> String {
    format!("in the configuration {}", path.display())
}

/// Says what to do about a key of an earlier version that made the text invalid.
fn removed_key(text: &str, error: &toml::de::Error) -> Option<String> {
    let table: toml::Table = text.parse().ok()?;
    let is_in = |path: &str| {
        let (first, rest) = path.split_once('.').unwrap_or((path, ""));
        let found = table.get(first);
        if rest.is_empty() { found.is_some() } else { found.and_then(|value| value.get(rest)).is_some() }
    };
    let is_named = |path: &str| {
        let key = path.rsplit('.').next().unwrap_or(path);
        error.message().starts_with(&format!("unknown field `{key}`"))
    };
    let (path, advice) = REMOVED.iter().find(|(path, _)| is_named(path) && is_in(path))?;
    let line = error.span().map_or(0, |span| text.get(..span.start).unwrap_or_default().matches('\n').count() + 1);
    let name = if path.contains('.') { (*path).to_owned() } else { format!("[{path}]") };
    Some(format!("line {line}: {name} is no longer read: {advice}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toml_errors::missing_keys;

    #[test]
    fn the_printed_default_is_the_default() {
        assert_eq!(Config::parse(DEFAULT_TOML).unwrap(), Config::default());
        assert_eq!(Config::parse("").unwrap(), Config::default());
        let all = toml::Table::try_from(Config::default()).unwrap();
        // A comment in the file: the key would exclude tables of real cameras.
        let names = "# cameras = [\"00\", \"03\", \"05\"]\n";
        assert_eq!(missing_keys(&all, &DEFAULT_TOML.parse().unwrap(), ""), ["source.cameras"]);
        let uncommented = DEFAULT_TOML.replace(names, &names[2..]);
        assert_ne!(uncommented, DEFAULT_TOML);
        assert_eq!(Config::parse(&uncommented).unwrap(), Config::default());
        assert_eq!(missing_keys(&all, &uncommented.parse().unwrap(), ""), Vec::<String>::new());
    }

    #[test]
    fn real_cameras_can_be_added_to_the_printed_default() {
        let tables = "\n[[source.cameras]]\nname = \"left\"\nserial = \"A1\"\nsize = [1280, 720]\n";
        let text = format!("{}{tables}", DEFAULT_TOML.replace("kind = \"sim\"", "kind = \"cameras\""));
        let text = text.replacen("path = \"\"", "path = \"calibration\"", 1);
        let config = Config::parse(&text).unwrap();
        assert_eq!(config.source.names(), ["left"]);
    }

    #[test]
    fn an_unknown_key_names_line_and_nearest_key() {
        let error = Config::parse("[sync]\nwindow_ms = 4.0\nmax_wait = 5.0\n").unwrap_err().to_string();
        assert!(error.contains("line 3"), "{error}");
        assert!(error.contains("unknown field `max_wait`"), "{error}");
        assert!(error.ends_with("did you mean `max_wait_ms`?"), "{error}");
        let error = Config::parse("[perception]\nfloor = 1.0\n").unwrap_err().to_string();
        assert!(error.starts_with("line 2: perception.floor: unknown field `floor`"), "{error}");
        assert!(error.ends_with("did you mean `floor_m`?"), "{error}");
        let error = Config::parse("[rig]\n[perception]\npeople = 1\nfloor_m = true\n").unwrap_err().to_string();
        assert!(error.starts_with("line 4: perception.floor_m: invalid type: boolean `true`, expected f64"), "{error}");
        let error = Config::parse("[apearance]\n").unwrap_err().to_string();
        assert!(error.ends_with("did you mean `appearance`?"), "{error}");
    }

    #[test]
    fn values_out_of_range_are_named() {
        for (text, expected) in [
            ("[sync]\nwindow_ms = nan\n", "sync.window_ms is NaN"),
            ("[body]\npose = \"given\"\n", "line 2: body.pose is no longer read: it is a key of [perception]"),
            ("[tracking]\nrest = 0.0\n", "line 2: tracking.rest is no longer read: delete it"),
            ("[appearance]\nmode = \"direct-no-time\"\n", "appearance.mode is an ablation"),
            ("[perception]\nheight_m = 9.0\n", "perception.height_m is 9, it must lie between 0.5 and 2.5"),
            ("[body]\ngaussians = 3\n", "body.gaussians is 3, it must lie between 100 and 2000000"),
            ("[body]\ngaussians = 200\nnodes = 1000\n", "body.nodes is 1000, more than body.gaussians"),
            ("[source]\nkind = \"folder\"\n", "source.path is empty"),
            ("[source]\nkind = \"folder\"\npath = \"x\"\n[perception]\npose = \"given\"\n", "body.template is empty"),
            ("[rig]\nname = \"a/b\"\n", "rig.name is 'a/b'"),
            ("[output]\navatar = true\n", "output.avatar is true but body.avatar is empty: name the avatar"),
            ("[body]\navatar = \"a\"\nperson = \"b\"\n", "body.avatar (a) and body.person (b) both say"),
            ("[transport]\ninbox_bytes = 1000\n", "in [rig] or [transport]: inbox_bytes: is 1000, expected 65536 to"),
            (
                "[transport]\nviewpoint_pixels_per_second = 1000000000000\n",
                "viewpoint_pixels_per_second: is 1000000000000, at most",
            ),
            ("[record]\nrotate = \"4\"\n", "without a unit"),
        ] {
            let error = format!("{:#}", Config::parse(text).unwrap_err());
            assert!(error.contains(expected), "{text}: {error}");
        }
    }

    #[test]
    fn the_simulated_rig_may_be_a_table() {
        let config = Config::parse("[sim]\nwidth = 64\n[sim.motion]\nkind = \"walk\"\n").unwrap();
        assert_eq!(config.sim.width, 64);
        let error = format!("{:#}", Config::parse("[rig]\n[sim]\nwidht = 64\n").unwrap_err());
        assert!(error.contains("line 3") && error.ends_with("did you mean `width`?"), "{error}");
        let error = format!("{:#}", Config::parse("[sim]\nwidth = 1\n").unwrap_err());
        assert!(error.starts_with("in [sim]: simulation: width is 1"), "{error}");
    }

    #[test]
    fn a_key_of_another_table_with_the_name_of_a_removed_one_is_only_unknown() {
        let error = Config::parse("[sync]\nrest = 1\n").unwrap_err().to_string();
        assert!(error.contains("unknown field `rest`") && !error.contains("no longer"), "{error}");
    }

    #[test]
    fn paths_are_relative_to_the_file_and_names_are_none() {
        let folder = tempfile::tempdir().unwrap();
        let rig = folder.path().join("rig.toml");
        let text = "[body]\navatar = \"anna.flyavatar\"\n[transport]\nkeys = \"keys\"\n[web]\nkey = \"/etc/key.pem\"\n\
                    [appearance]\nweights = \"tiny\"\n[perception]\nnetwork = \"lite\"\n[sim.motion]\nbvh = \"walk.bvh\"\n";
        std::fs::write(&rig, text).unwrap();
        let config = Config::load(&rig).unwrap();
        let at = |name: &str| folder.path().join(name);
        assert_eq!((&config.body.avatar, &config.transport.keys), (&at("anna.flyavatar"), &at("keys")));
        assert_eq!(
            (config.sim.motion.bvh, config.web.key.as_path()),
            (Some(at("walk.bvh")), Path::new("/etc/key.pem"))
        );
        assert_eq!(config.appearance.weights.as_deref(), Some(Path::new("tiny")));
        assert_eq!(config.perception.network, Path::new("lite"));
        assert!(config.source.path.as_os_str().is_empty() && config.perception.plates.as_os_str().is_empty());
        std::fs::write(&rig, text.replace("tiny", "mine.safetensors").replace("lite", "light.toml")).unwrap();
        let config = Config::load(&rig).unwrap();
        assert_eq!(config.appearance.weights, Some(at("mine.safetensors")));
        assert_eq!(config.perception.network, at("light.toml"));
    }

    #[test]
    fn the_simulators_file_is_read_and_checked_with_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let (rig, sim) = (folder.path().join("rig.toml"), folder.path().join("sim.toml"));
        std::fs::write(&rig, format!("[source]\npath = {:?}\n", sim.display().to_string())).unwrap();
        std::fs::write(&sim, "width = 64\n[motion]\nkind = \"walk\"\n").unwrap();
        assert_eq!(Config::load(&rig).unwrap().sim.width, 64);
        std::fs::write(&sim, "width = -4\n").unwrap();
        let error = format!("{:#}", Config::load(&rig).unwrap_err());
        assert!(error.contains("sim.toml") && error.contains("invalid value: integer `-4`"), "{error}");
    }
}
