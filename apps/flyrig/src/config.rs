//! The configuration file: one commented default, strict reading, errors that name line and key.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use flyrig_capture::Rotation;
use flyrig_fusion::{
    AppearanceOptions, BodySettings, BudgetSettings, Origin, OutputSettings, PerceptionSettings, SessionSettings,
    TrackingSettings,
};
use flyrig_sim::SimConfig;
use flyrig_sync::SyncSettings;
use flyrig_takes::{SourceKind, SourceSection, TakeConfig};
use flyrig_transport::TransportConfig;
use flyrig_web::WebConfig;
use serde::{Deserialize, Serialize};

/// The commented default file, as `flyrig config print` writes it. A test keeps it equal to `Config::default()`.
pub const DEFAULT_TOML: &str = include_str!("../assets/default.toml");

/// Keys that stand in `[perception]`, but stood in `[body]` in earlier versions.
const MOVED_FROM_BODY: [&str; 3] = ["pose", "masks", "shape"];

/// Configuration of `flyrig run`; the keys are explained in `assets/default.toml`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub rig: RigSection,
    pub source: SourceSection,
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

/// How the calibration is looked after while the rig runs.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationSection {
    pub watch: WatchMode,
}

/// Whether cameras are watched for bumps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WatchMode {
    Off,
    #[default]
    Warn,
    Correct,
}

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

/// What `flyrig capture` sends.
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

/// What recordings hold.
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

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GpuSection {
    pub adapter: String,
}

#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HealthSection {
    pub listen: String,
}

impl Config {
    /// Reads and checks a file.
    pub fn load(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("in the configuration {}", path.display()))
    }

    /// Reads and checks a text.
    pub fn parse(text: &str) -> Result<Self> {
        let config = Self::parse_values(text)?;
        config.check_scene()?;
        Ok(config)
    }

    /// Reads a file for `flyrig capture`, which needs neither a calibration nor a person.
    pub fn load_for_capture(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        let in_file = || format!("in the configuration {}", path.display());
        let config = Self::parse_values(&text).with_context(in_file)?;
        if config.source.kind != SourceKind::Cameras {
            config.check_scene().with_context(in_file)?;
        }
        Ok(config)
    }

    fn parse_values(text: &str) -> Result<Self> {
        match toml::from_str::<Self>(text) {
            Ok(config) => {
                config.check_values()?;
                Ok(config)
            }
            Err(error) => {
                let hint = match error.message() {
                    // Where these keys stood before.
                    message
                        if MOVED_FROM_BODY.iter().any(|key| message.starts_with(&format!("unknown field `{key}`"))) =>
                    {
                        "pose, masks and shape are keys of [perception]".to_owned()
                    }
                    message => nearest_key(message).map(|key| format!("did you mean `{key}`?")).unwrap_or_default(),
                };
                bail!("{}{hint}", error.to_string().trim_end_matches(' '))
            }
        }
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
        range("source.fps", self.source.fps, 0.1, 1000.0)?;
        self.source.validate()?;
        self.sim.validate().context("in [sim]")?;
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

    /// The settings of a session.
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

    /// The settings of the transport session.
    pub fn transport(&self) -> TransportConfig {
        TransportConfig { rig: self.rig.name.clone(), ..self.transport.clone() }
    }

    /// What tracking needs beyond values in their ranges.
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

/// Of a "unknown field `x`, expected one of `a`, `b`" message the listed key closest to `x`.
fn nearest_key(message: &str) -> Option<String> {
    let mut quoted = message.split('`').skip(1).step_by(2);
    let unknown = quoted.next().filter(|_| message.starts_with("unknown"))?;
    quoted
        .max_by(|a, b| strsim::jaro_winkler(unknown, a).total_cmp(&strsim::jaro_winkler(unknown, b)))
        .map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_printed_default_is_the_default() {
        assert_eq!(Config::parse(DEFAULT_TOML).unwrap(), Config::default());
        assert_eq!(Config::parse("").unwrap(), Config::default());
        // Every key is in it, so that nobody has to guess.
        fn missing(all: &toml::Table, printed: &toml::Table, path: &str) -> Vec<String> {
            let of = |(key, value): (&String, &toml::Value)| match (value, printed.get(key)) {
                // Lists are empty at first: tables to copy stand there as comments.
                (toml::Value::Array(list), None) if list.is_empty() => Vec::new(),
                (_, None) => vec![format!("{path}{key}")],
                (toml::Value::Table(all), Some(toml::Value::Table(printed))) => {
                    missing(all, printed, &format!("{path}{key}."))
                }
                _ => Vec::new(),
            };
            all.iter().flat_map(of).collect()
        }
        let all = toml::Table::try_from(Config::default()).unwrap();
        // It stands there as a comment, since it would exclude tables of real cameras.
        let names = "# cameras = [\"00\", \"03\", \"05\"]\n";
        assert_eq!(missing(&all, &DEFAULT_TOML.parse().unwrap(), ""), ["source.cameras"]);
        let uncommented = DEFAULT_TOML.replace(names, &names[2..]);
        assert_ne!(uncommented, DEFAULT_TOML);
        assert_eq!(Config::parse(&uncommented).unwrap(), Config::default());
        assert_eq!(missing(&all, &uncommented.parse().unwrap(), ""), Vec::<String>::new());
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
        let error = Config::parse("[apearance]\n").unwrap_err().to_string();
        assert!(error.ends_with("did you mean `appearance`?"), "{error}");
    }

    #[test]
    fn values_out_of_range_are_named() {
        for (text, expected) in [
            ("[sync]\nwindow_ms = nan\n", "sync.window_ms is NaN"),
            ("[body]\npose = \"given\"\n", "pose, masks and shape are keys of [perception]"),
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
            ("[sim]\nwidth = -4\n", "invalid value: integer `-4`"),
        ] {
            let error = format!("{:#}", Config::parse(text).unwrap_err());
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
