//! Timeline of stages as a file for Perfetto and Chrome's `about:tracing`.

use std::path::Path;

use anyhow::{Result, ensure};
use flyrig_fusion::{TracedStage, start_stage_trace, take_stage_trace};
use serde_json::{Value, json};

use crate::write_whole;

/// Runs a command and writes its stages to the file, if one is named, even if the command fails.
///
/// # Errors
/// Errors of the command; the file cannot be written, which is checked beforehand if its folder is missing.
pub fn traced(path: Option<&Path>, command: impl FnOnce() -> Result<()>) -> Result<()> {
    let Some(path) = path else { return command() };
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    ensure!(
        folder.is_none_or(Path::is_dir) && !path.is_dir(),
        "--trace: cannot write {}; name a file in a folder that exists",
        path.display()
    );
    start_stage_trace();
    let result = command();
    let stages = take_stage_trace();
    let written = write_whole(path, &serde_json::to_vec(&document(&stages))?);
    if written.is_ok() {
        tracing::info!("{} stages are in {}; open it at https://ui.perfetto.dev", stages.len(), path.display());
    }
    result.and(written)
}

/// Formats stages in the Trace Event Format: one complete event per stage, one thread per track.
fn document(stages: &[TracedStage]) -> Value {
    let mut tracks: Vec<&str> = Vec::new();
    let mut events = Vec::new();
    for TracedStage { name, track, start, time } in stages {
        let thread = tracks.iter().position(|known| known == track).unwrap_or_else(|| {
            tracks.push(track);
            events.push(
                json!({"ph": "M", "name": "thread_name", "pid": 1, "tid": tracks.len(), "args": {"name": track}}),
            );
            tracks.len() - 1
        });
        let [start, time] = [start, time].map(|time| time.as_secs_f64() * 1e6);
        events.push(
            json!({"ph": "X", "cat": "stage", "name": name, "pid": 1, "tid": thread + 1, "ts": start, "dur": time}),
        );
    }
    json!({"displayTimeUnit": "ms", "traceEvents": events})
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn every_stage_becomes_an_event_of_its_thread() {
        let stage = |name, track: &str, start| TracedStage {
            name,
            track: track.to_owned(),
            start: Duration::from_millis(start),
            time: Duration::from_micros(1500),
        };
        let stages = [stage("deformation", "main", 3), stage("network", "perception", 1), stage("skinning", "main", 5)];
        let document = document(&stages);
        let events = document["traceEvents"].as_array().unwrap();
        let named = |name: &str| events.iter().find(|event| event["name"] == name && event["ph"] == "X").unwrap();
        assert_eq!(events.len(), 5, "three stages and the names of two threads");
        assert_eq!(
            (named("deformation")["ts"].as_f64(), named("deformation")["dur"].as_f64()),
            (Some(3e3), Some(1.5e3))
        );
        assert_eq!(named("deformation")["tid"], named("skinning")["tid"]);
        assert_ne!(named("deformation")["tid"], named("network")["tid"]);
    }

    #[test]
    fn a_missing_folder_is_named_before_anything_runs() {
        let folder = tempfile::tempdir().unwrap();
        let error = traced(Some(&folder.path().join("none/trace.json")), || unreachable!()).unwrap_err();
        assert!(error.to_string().contains("none/trace.json; name a file in a folder that exists"), "{error}");
        let file = folder.path().join("trace.json");
        let failed = traced(Some(&file), || anyhow::bail!("no camera")).unwrap_err();
        assert_eq!(failed.to_string(), "no camera");
        let written: Value = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        assert!(written["traceEvents"].is_array());
        assert!(traced(None, || Ok(())).is_ok());
    }
}
