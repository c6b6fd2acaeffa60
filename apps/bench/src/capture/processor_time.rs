//! Processor time by thread.

use std::{collections::BTreeMap, fs};

/// Returns the processor time of this process' threads by name, in ticks of 10 ms; empty where the system does not report it.
pub fn cpu_ticks() -> BTreeMap<String, u64> {
    let mut ticks = BTreeMap::new();
    for task in fs::read_dir("/proc/self/task").into_iter().flatten().flatten() {
        let Ok(stat) = fs::read_to_string(task.path().join("stat")) else { continue };
        // The name is in parentheses and may hold anything, spaces too.
        let Some((head, tail)) = stat.rsplit_once(')') else { continue };
        let name = head.split_once('(').map_or("", |(_, name)| name);
        let mut fields = tail.split_whitespace().skip(11).filter_map(|field| field.parse::<u64>().ok());
        let used = fields.next().unwrap_or(0) + fields.next().unwrap_or(0);
        *ticks.entry(name.to_owned()).or_insert(0) += used;
    }
    ticks
}

/// Returns the used cores by thread name between two samples.
pub fn cpu_share(before: &BTreeMap<String, u64>, after: &BTreeMap<String, u64>, seconds: f64) -> BTreeMap<String, f64> {
    let used = |(name, ticks): (&String, &u64)| {
        let ticks = ticks.saturating_sub(before.get(name).copied().unwrap_or(0));
        (name.clone(), ticks as f64 / 100.0 / seconds.max(1e-9))
    };
    after.iter().map(used).collect()
}
