//! The configuration file: one commented default, strict reading, errors that name line and key.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail, ensure};
use clap::ValueEnum;
use flyrig_calib::ClockKind;
use flyrig_renderer::AppearanceSettings;
use flyrig_sim::SimConfig;
use flyrig_stfa::{EMBEDDED, Parameters};
use flyrig_tracker::{DeformSettings, DeformSolver, PoseFreedom};
use serde::{Deserialize, Serialize};

use crate::{cameras::CameraEntry, cli::NetworkUse, deformation::DeformOptions, network};

/// The commented default file, as `flyrig config print` writes it. A test keeps it equal to `Config::default()`.
pub const DEFAULT_TOML: &str = include_str!("../assets/default.toml");

/// Everything `flyrig run` can be told; the keys are explained in `assets/default.toml`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    pub rig: RigSection,
    pub source: SourceSection,
    pub sim: SimConfig,
    pub sync: SyncSection,
    pub body: BodySection,
    pub tracking: TrackingSection,
    pub appearance: AppearanceSection,
    pub output: OutputSection,
    pub capture: CaptureSection,
    pub record: RecordSection,
    pub transport: TransportSection,
    pub health: HealthSection,
    pub gpu: GpuSection,
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

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SourceKind {
    Sim,
    Folder,
    Video,
    #[serde(alias = "v4l2")]
    Cameras,
    Network,
    Mcap,
}

impl SourceKind {
    /// Whether frames come when they are taken, with the time of this computer.
    pub fn is_live(self) -> bool {
        matches!(self, Self::Cameras | Self::Network)
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SourceSection {
    pub kind: SourceKind,
    pub path: PathBuf,
    pub cameras: Vec<CameraEntry>,
    pub fps: f64,
    pub real_time: bool,
}

impl SourceSection {
    /// Names of the chosen cameras; none for all.
    pub fn names(&self) -> Vec<String> {
        self.cameras.iter().map(|entry| entry.name().to_owned()).collect()
    }

    fn check(&self) -> Result<()> {
        for (i, entry) in self.cameras.iter().enumerate() {
            let name = entry.name();
            ensure!(
                self.cameras[..i].iter().all(|before| before.name() != name),
                "camera {name} is listed twice in source.cameras"
            );
            match entry {
                CameraEntry::Named(_) if self.kind == SourceKind::Cameras => {
                    entry.device()?;
                }
                CameraEntry::Named(_) => {}
                CameraEntry::Device(section) => {
                    ensure!(
                        self.kind == SourceKind::Cameras,
                        "camera {name} of source.cameras is a table, but source.kind is not \"cameras\""
                    );
                    section.check()?;
                }
            }
        }
        ensure!(
            self.kind != SourceKind::Network || !self.cameras.is_empty(),
            "source.kind is \"network\" but source.cameras names no camera"
        );
        ensure!(
            self.kind != SourceKind::Cameras || !self.cameras.is_empty(),
            "source.kind is \"cameras\" but there is no table [[source.cameras]]"
        );
        Ok(())
    }
}

impl Default for SourceSection {
    fn default() -> Self {
        Self {
            kind: SourceKind::Sim,
            path: PathBuf::new(),
            cameras: ["00", "03", "05"].map(|name| CameraEntry::Named(name.to_owned())).to_vec(),
            fps: 30.0,
            real_time: true,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SyncSection {
    pub window_ms: f64,
    pub lags_ms: BTreeMap<String, f64>,
    pub max_wait_ms: f64,
    pub master: String,
    pub clocks: ClockKind,
}

impl Default for SyncSection {
    fn default() -> Self {
        Self {
            window_ms: 0.0,
            lags_ms: BTreeMap::new(),
            max_wait_ms: 0.0,
            master: String::new(),
            clocks: ClockKind::Shared,
        }
    }
}

/// Where a pose or a mask comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// From the source or the data set.
    Given,
    /// From the pictures.
    Estimated,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BodySection {
    pub template: PathBuf,
    pub pose: Origin,
    pub masks: Origin,
    pub gaussians: usize,
    pub nodes: usize,
}

impl Default for BodySection {
    fn default() -> Self {
        Self { template: PathBuf::new(), pose: Origin::Given, masks: Origin::Given, gaussians: 115_000, nodes: 1620 }
    }
}

/// How the body is deformed beyond its pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Skinned only.
    #[value(name = "off", alias = "none")]
    #[serde(rename = "off", alias = "none")]
    None,
    /// Gradient descent as in the paper.
    Paper,
    /// Damped Gauss-Newton with the graph Laplacian.
    #[value(name = "default", alias = "gauss-newton")]
    #[serde(rename = "default", alias = "gauss-newton")]
    GaussNewton,
}

impl Solver {
    /// What the deformation is told; none when the body is only skinned. An estimated pose is corrected as well.
    pub fn options(self, pose: Origin) -> Option<DeformOptions> {
        let default = DeformSettings::default();
        match self {
            Self::None => None,
            Self::Paper => Some(DeformOptions::full(DeformSettings {
                solver: DeformSolver::Paper { rate: PAPER_RATE },
                regularization: PAPER_REGULARIZATION,
                // The paper iterates on every frame.
                rest: 0.0,
                ..default
            })),
            Self::GaussNewton => Some(DeformOptions {
                pose: (pose == Origin::Estimated).then(PoseFreedom::default),
                ..DeformOptions::coarse(DeformSettings { anchor: ANCHOR, ..default })
            }),
        }
    }
}

/// Price of the nodes' distance from where clothes of their part's thickness would be: holds what no view tells, the depth
/// before a single camera or a shift of all nodes that a corrected pose explains as well.
const ANCHOR: f64 = 100.0;

/// λ_reg of the paper's Eq. 3.
const PAPER_REGULARIZATION: f64 = 200.0;
impl TrackingSection {
    /// What the deformation is told; none when the body is only skinned.
    pub fn options(&self, pose: Origin) -> Option<DeformOptions> {
        let mut options = self.solver.options(pose)?;
        if self.solver == Solver::GaussNewton {
            options.gaussians = self.gaussians;
            options.views = self.views;
            if !self.level_of_detail {
                options = options.without_level_of_detail();
            }
            options.solver.rest = self.rest;
        }
        Some(options)
    }
}

/// Rate of the paper's gradient descent, square metres a unit of loss. The paper does not tell its own; of 1e-8 to 1e-5
/// this one lowered the loss most on a simulated person at 512x512.
const PAPER_RATE: f64 = 3e-6;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackingSection {
    pub solver: Solver,
    pub gaussians: usize,
    pub level_of_detail: bool,
    pub views: usize,
    pub rest: f64,
    pub per_view_time: bool,
}

impl Default for TrackingSection {
    fn default() -> Self {
        Self {
            solver: Solver::GaussNewton,
            gaussians: 30_000,
            level_of_detail: true,
            views: 0,
            rest: 0.01,
            per_view_time: true,
        }
    }
}

/// How Gaussians get their colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum AppearanceMode {
    /// Projection, spatial diffusion and temporal memory.
    Direct,
    /// Without the temporal memory.
    DirectNoTime,
    /// Projection only, as the paper's "w/o ST" baseline.
    DirectNoSpaceTime,
    /// `direct`, and what trained networks add to it.
    Stfa,
    /// The same without the temporal memory.
    StfaNoTime,
    /// The same without graph and memory.
    StfaNoSpaceTime,
}

impl AppearanceMode {
    /// What the renderer is told.
    pub fn settings(self) -> AppearanceSettings {
        let (space, time) = match self {
            Self::Direct | Self::Stfa => (true, true),
            Self::DirectNoTime | Self::StfaNoTime => (true, false),
            Self::DirectNoSpaceTime | Self::StfaNoSpaceTime => (false, false),
        };
        AppearanceSettings { space, time, ..AppearanceSettings::default() }
    }

    /// Whether networks add to direct appearance.
    pub fn is_learned(self) -> bool {
        matches!(self, Self::Stfa | Self::StfaNoTime | Self::StfaNoSpaceTime)
    }

    /// The networks that add to it, from this file or those of this name that come with the program. None for the direct modes.
    pub fn networks(self, weights: Option<&Path>) -> Result<Option<Parameters>> {
        if !self.is_learned() {
            return Ok(None);
        }
        Ok(Some(Parameters::named(weights.unwrap_or(Path::new(EMBEDDED[0].0)))?))
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AppearanceSection {
    pub mode: AppearanceMode,
    /// Weights file of the learned modes, or the name of networks that come with the program; empty: the first of those.
    pub weights: PathBuf,
    /// Inputs of a Gaussian that changed by no more than this leave what the networks add to its colour as it was.
    pub reuse: f32,
    pub networks_on: NetworksOn,
}

/// Where networks run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum NetworksOn {
    /// All cores.
    #[default]
    Processor,
    /// The graphics adapter that draws.
    Adapter,
}

impl AppearanceSection {
    /// How they are used.
    pub fn network_use(&self) -> NetworkUse {
        NetworkUse { reuse: self.reuse, networks_on: self.networks_on }
    }

    /// What adds to direct appearance.
    pub fn networks(&self) -> Result<Option<Parameters>> {
        self.mode.networks(Some(self.weights.as_path()).filter(|path| !path.as_os_str().is_empty()))
    }
}

impl Default for AppearanceSection {
    fn default() -> Self {
        Self { mode: AppearanceMode::Direct, weights: PathBuf::new(), reuse: 0.0, networks_on: NetworksOn::default() }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OutputSection {
    pub views: usize,
    pub width: u32,
    pub height: u32,
    pub jpeg_quality: u8,
    pub splats: bool,
}

impl Default for OutputSection {
    fn default() -> Self {
        Self { views: 1, width: 512, height: 512, jpeg_quality: 85, splats: true }
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
}

impl Default for RecordSection {
    fn default() -> Self {
        Self { jpeg_quality: 95 }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TransportSection {
    pub listen: Vec<String>,
    pub connect: Vec<String>,
    pub max_viewers: usize,
}

impl Default for TransportSection {
    fn default() -> Self {
        Self { listen: vec!["tcp/127.0.0.1:7447".to_owned()], connect: Vec::new(), max_viewers: 4 }
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
                let hint = nearest_key(error.message()).map(|key| format!("did you mean `{key}`?")).unwrap_or_default();
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
        self.source.check()?;
        self.sim.validate().context("in [sim]")?;
        range("sync.window_ms", self.sync.window_ms, 0.0, 10_000.0)?;
        for (camera, lag) in &self.sync.lags_ms {
            range(&format!("sync.lags_ms of {camera}"), *lag, -1000.0, 1000.0)?;
        }
        range("sync.max_wait_ms", self.sync.max_wait_ms, 0.0, 60_000.0)?;
        range("body.gaussians", self.body.gaussians as f64, 100.0, 2_000_000.0)?;
        range("body.nodes", self.body.nodes as f64, 4.0, 100_000.0)?;
        ensure!(
            self.body.nodes <= self.body.gaussians,
            "body.nodes is {}, more than body.gaussians ({}): nodes are chosen among the Gaussians",
            self.body.nodes,
            self.body.gaussians
        );
        range("tracking.gaussians", self.tracking.gaussians as f64, 100.0, 2_000_000.0)?;
        range("tracking.views", self.tracking.views as f64, 0.0, 1000.0)?;
        range("tracking.rest", self.tracking.rest, 0.0, 0.5)?;
        range("appearance.reuse", f64::from(self.appearance.reuse), 0.0, 1.0)?;
        self.appearance.network_use().check()?;
        range("output.views", self.output.views as f64, 0.0, 16.0)?;
        range("output.width", f64::from(self.output.width), 16.0, 4096.0)?;
        range("output.height", f64::from(self.output.height), 16.0, 4096.0)?;
        range("output.jpeg_quality", f64::from(self.output.jpeg_quality), 1.0, 100.0)?;
        range("capture.jpeg_quality", f64::from(self.capture.jpeg_quality), 0.0, 100.0)?;
        range("record.jpeg_quality", f64::from(self.record.jpeg_quality), 0.0, 100.0)?;
        range("transport.max_viewers", self.transport.max_viewers as f64, 0.0, 64.0)?;
        network::transport(self).validate().context("in [rig] or [transport]")
    }

    /// What tracking needs beyond values in their ranges.
    pub fn check_scene(&self) -> Result<()> {
        ensure!(
            self.source.kind == SourceKind::Sim || !self.source.path.as_os_str().is_empty(),
            "source.path is empty: name the folder of the data set, the folder of the calibration for real cameras, or the recording"
        );
        ensure!(
            self.source.kind != SourceKind::Network || !self.transport.connect.is_empty(),
            "source.kind is \"network\" but transport.connect is empty: name the computers with cameras, such as \
             tcp/10.0.0.2:7447"
        );
        ensure!(
            self.source.kind == SourceKind::Sim
                || self.body.pose == Origin::Estimated
                || !self.body.template.as_os_str().is_empty(),
            "body.pose is \"given\" but body.template is empty: name a skinned glTF file with an animation, or set body.pose = \"estimated\""
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
    use crate::deformation::PAPER_COLOR_WEIGHT;

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
        assert_eq!(missing(&all, &DEFAULT_TOML.parse().unwrap(), ""), Vec::<String>::new());
    }

    #[test]
    fn the_papers_solver_is_measured_as_the_paper_tells() {
        let options = Solver::Paper.options(Origin::Given).unwrap();
        assert!((options.color_weight - PAPER_COLOR_WEIGHT).abs() < 1e-6);
        assert!((options.solver.regularization - 200.0).abs() < 1e-9);
        assert!(options.solver.rest <= 0.0, "every frame has its iterations");
        assert_eq!((options.gaussians, options.max_level), (usize::MAX, 0));
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
            ("[body]\ngaussians = 3\n", "body.gaussians is 3, it must lie between 100 and 2000000"),
            ("[body]\ngaussians = 200\nnodes = 1000\n", "body.nodes is 1000, more than body.gaussians"),
            ("[source]\nkind = \"folder\"\n", "source.path is empty"),
            ("[source]\nkind = \"folder\"\npath = \"x\"\n", "body.template is empty"),
            ("[rig]\nname = \"a/b\"\n", "rig.name is 'a/b'"),
            ("[sim]\nwidth = -4\n", "invalid value: integer `-4`"),
        ] {
            let error = format!("{:#}", Config::parse(text).unwrap_err());
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
