//! Statistics of the rig, JSON.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{
    error::TransportError,
    json::{from_json, to_json},
    printable::{clean, printable},
};

/// Run time of a stage of the pipeline.
///
/// On the wire the percentile is repeated under its former name `max_millis`, so that older and newer programs read each other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "WireStageStats", into = "WireStageStats")]
pub struct StageStats {
    /// Name of the stage.
    pub stage: String,
    /// Mean over the interval, milliseconds.
    pub mean_millis: f64,
    /// 95th percentile over the interval, milliseconds.
    pub p95_millis: f64,
}

#[derive(Serialize, Deserialize)]
struct WireStageStats {
    stage: String,
    mean_millis: f64,
    max_millis: f64,
    p95_millis: Option<f64>,
}

impl From<WireStageStats> for StageStats {
    fn from(wire: WireStageStats) -> Self {
        let WireStageStats { stage, mean_millis, max_millis, p95_millis } = wire;
        Self { stage, mean_millis, p95_millis: p95_millis.unwrap_or(max_millis) }
    }
}

impl From<StageStats> for WireStageStats {
    fn from(StageStats { stage, mean_millis, p95_millis }: StageStats) -> Self {
        Self { stage, mean_millis, max_millis: p95_millis, p95_millis: Some(p95_millis) }
    }
}

/// Output rate of a view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewRate {
    /// Name of the view.
    pub view: String,
    /// Images per second.
    pub per_second: f64,
    /// Bytes per second.
    pub bytes_per_second: f64,
}

/// Tracking quality of the first person at the last frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackingStats {
    /// State: "searching", "first", "steady", "recovering" or "lost".
    pub state: String,
    /// Fraction of the person that agrees with the images, 0 to 1; `None` when nothing was compared.
    pub quality: Option<f64>,
    /// Fraction that agrees in each camera; near 0 for a camera that is covered.
    pub cameras: BTreeMap<String, f64>,
}

/// Tracking quality of one person at the last frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SubjectStats {
    /// Number of the person as in [`flyrig_stream::SplatState::person`]; 0 is the first.
    pub person: u32,
    /// State as in [`TrackingStats::state`].
    pub state: String,
    /// Quality as in [`TrackingStats::quality`].
    pub quality: Option<f64>,
    /// Fractions as in [`TrackingStats::cameras`].
    pub cameras: BTreeMap<String, f64>,
}

/// Effort of a rig with a time budget.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct BudgetStats {
    /// Target rate, frame sets per second.
    pub fps: f64,
    /// Level of effort; 0 does all the work.
    pub level: u32,
    /// Number of levels.
    pub levels: u32,
    /// Smoothed cost of a frame set, seconds.
    pub set_secs: f64,
}

/// Progress of a rig that learns its first person.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct LearningStats {
    /// Number of the version that the person is made of; 0 while it is made of its surface.
    pub version: u32,
    /// Number of frame sets that it is learnt from, and compared on.
    pub key_sets: u32,
    /// Number of rounds of fitting.
    pub rounds: u32,
    /// Time of fitting and comparing, seconds.
    pub seconds: f64,
    /// Share by which the version in use reduced the error on images that it was not fitted to, when it was adopted; `None` before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain: Option<f64>,
}

/// Statistics of the rig over its last interval of about a second.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RigStats {
    /// Frame number of the rig.
    pub frame: u64,
    /// Capture time of the frame: `CLOCK_MONOTONIC` of the capturing host, or the own clock of recorded and simulated cameras.
    pub capture_nanos: i64,
    /// `CLOCK_MONOTONIC` minus the cameras' clock, nanoseconds, estimated from the frame set with the shortest delay; `None` where frame
    /// sets are ingested at another pace than they were captured, and from older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_offset_nanos: Option<i64>,
    /// Time since the rig started, seconds.
    pub uptime_secs: f64,
    /// Frame sets per second through the whole pipeline.
    pub frames_per_second: f64,
    /// Stages in the order of the pipeline.
    pub stages: Vec<StageStats>,
    /// Number of frames lost since the start at each place of the pipeline.
    pub dropped: BTreeMap<String, u64>,
    /// Rates of the published views.
    pub views: Vec<ViewRate>,
    /// Number of subscribers with a viewpoint of their own.
    pub viewers: u32,
    /// Level of effort; `None` without a budget, and from older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<BudgetStats>,
    /// Progress of learning; `None` where no person is learnt, and from older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learning: Option<LearningStats>,
    /// Tracking quality of the first of `subjects`, for programs that know one person. [`Self::encode`] fills it in from `subjects`, or
    /// `subjects` from it where that is empty; [`Self::decode`] does so with messages of older programs.
    #[serde(default)]
    pub tracking: TrackingStats,
    /// Tracking quality of each person.
    #[serde(default)]
    pub subjects: Vec<SubjectStats>,
    /// Time for which a person has been seen who is not among `subjects` yet, because the shape is being measured, seconds; `None` while
    /// there is no such person, and from older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measuring_secs: Option<f64>,
}

impl RigStats {
    /// Encodes the statistics as JSON.
    ///
    /// # Errors
    /// `Config` when a figure is NaN or infinite (JSON has no form for them) or the text is longer than 256 KiB.
    pub fn encode(&self) -> Result<Vec<u8>, TransportError> {
        let stats = self.clone().with_subjects();
        let figures_of = |subject: &SubjectStats| {
            subject.quality.into_iter().chain(subject.cameras.values().copied()).all(f64::is_finite)
        };
        let finite = [self.uptime_secs, self.frames_per_second]
            .into_iter()
            .chain(self.measuring_secs)
            .chain(self.learning.iter().flat_map(|learning| [Some(learning.seconds), learning.gain]).flatten())
            .chain(self.stages.iter().flat_map(|stage| [stage.mean_millis, stage.p95_millis]))
            .chain(self.views.iter().flat_map(|view| [view.per_second, view.bytes_per_second]))
            .all(f64::is_finite);
        if !finite || !stats.subjects.iter().all(figures_of) {
            return Err(TransportError::config("stats", "a figure is NaN or infinite; leave it out or send 0"));
        }
        to_json("stats", &stats)
    }

    /// Decodes statistics from JSON; all names are made [`printable()`].
    ///
    /// # Errors
    /// `UnknownVersion` or `Malformed`.
    pub fn decode(bytes: &[u8]) -> Result<Self, TransportError> {
        let mut stats: Self = from_json("stats", bytes)?;
        stats.stages.iter_mut().for_each(|stage| clean(&mut stage.stage));
        stats.views.iter_mut().for_each(|view| clean(&mut view.view));
        clean_keys(&mut stats.dropped);
        clean(&mut stats.tracking.state);
        clean_keys(&mut stats.tracking.cameras);
        for subject in &mut stats.subjects {
            clean(&mut subject.state);
            clean_keys(&mut subject.cameras);
        }
        Ok(stats.with_subjects())
    }

    /// Makes `tracking` and the first subject agree.
    fn with_subjects(mut self) -> Self {
        match self.subjects.first().cloned() {
            Some(SubjectStats { state, quality, cameras, .. }) => {
                self.tracking = TrackingStats { state, quality, cameras };
            }
            None if self.tracking != TrackingStats::default() => {
                let TrackingStats { state, quality, cameras } = self.tracking.clone();
                self.subjects = vec![SubjectStats { person: 0, state, quality, cameras }];
            }
            None => {}
        }
        self
    }
}

/// Makes the names in a map printable.
fn clean_keys<T>(map: &mut BTreeMap<String, T>) {
    *map = std::mem::take(map).into_iter().map(|(name, value)| (printable(&name).into_owned(), value)).collect();
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Statistics as a program without `subjects` and `p95_millis` reads them.
    #[derive(Deserialize)]
    struct OldStats {
        stages: Vec<OldStage>,
        #[serde(default)]
        tracking: TrackingStats,
    }

    #[derive(Deserialize)]
    struct OldStage {
        mean_millis: f64,
        max_millis: f64,
    }

    fn subject(person: u32) -> SubjectStats {
        let cameras = [("left".to_owned(), 0.5)].into();
        SubjectStats { person, state: "steady".to_owned(), quality: Some(0.75), cameras }
    }

    #[test]
    fn older_and_newer_programs_read_each_other() {
        let stages = vec![StageStats { stage: "draw".to_owned(), mean_millis: 2.0, p95_millis: 4.0 }];
        let sent = RigStats { stages, subjects: vec![subject(3), subject(7)], ..RigStats::default() };
        let bytes = sent.encode().unwrap();
        let found = RigStats::decode(&bytes).unwrap();
        assert_eq!((&found.stages, &found.subjects), (&sent.stages, &sent.subjects));
        let old: OldStats = serde_json::from_slice(&bytes).unwrap();
        assert_eq!((old.stages[0].mean_millis, old.stages[0].max_millis), (2.0, 4.0));
        assert_eq!((old.tracking.state.as_str(), old.tracking.quality), ("steady", Some(0.75)));

        let old = br#"{"schema_version":1,"frame":5,"capture_nanos":1,"uptime_secs":1,"frames_per_second":30,
            "stages":[{"stage":"draw","mean_millis":2,"max_millis":4}],"dropped":{},"views":[],"viewers":0,
            "tracking":{"state":"steady","quality":0.75,"cameras":{"left":0.5}}}"#;
        let found = RigStats::decode(old).unwrap();
        assert_eq!((&found.stages, found.subjects), (&sent.stages, vec![subject(0)]));
        // A rig of one person may fill in either.
        let TrackingStats { state, quality, cameras } = found.tracking;
        let one = RigStats { tracking: TrackingStats { state, quality, cameras }, ..RigStats::default() };
        assert_eq!(RigStats::decode(&one.encode().unwrap()).unwrap().subjects, [subject(0)]);
        assert!(RigStats::decode(&RigStats::default().encode().unwrap()).unwrap().subjects.is_empty());

        let mut poisoned = sent;
        poisoned.subjects[1].cameras.insert("right".to_owned(), f64::NAN);
        assert!(poisoned.encode().unwrap_err().to_string().contains("NaN"));
    }

    #[test]
    fn names_come_out_printable() {
        let bad = || "\u{1b}[2J\u{202e}".to_owned();
        let stats = RigStats {
            stages: vec![StageStats { stage: bad(), mean_millis: 1.0, p95_millis: 1.0 }],
            dropped: [(bad(), 1)].into(),
            views: vec![ViewRate { view: bad(), per_second: 1.0, bytes_per_second: 1.0 }],
            subjects: vec![SubjectStats { person: 1, state: bad(), quality: None, cameras: [(bad(), 1.0)].into() }],
            ..RigStats::default()
        };
        let found = format!("{:#?}", RigStats::decode(&stats.encode().unwrap()).unwrap());
        // Debug escapes a backslash once more, and a raw control character only once.
        assert_eq!(found.matches("\\\\u{1b}[2J\\\\u{202e}").count(), 7, "{found}");
        assert!(!found.contains("\"\\u{1b}"), "{found}");
    }
}
