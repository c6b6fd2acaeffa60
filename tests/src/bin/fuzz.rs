//! Fuzzing of every decoder of foreign data: `make fuzz MINUTES=10`.
//!
//! The generator needs only stable Rust. It truncates, splices and flips the seeds in `tests/corpus`, and inserts boundary
//! values. An input whose outcome has a new text is kept and mutated further, which reaches every branch with a message of
//! its own without instrumentation. A panic, an input that takes seconds, or excessive memory ends the program; the input is
//! saved to a file.

mod fuzz {
    pub mod mutate;
    pub mod targets;
}

use std::{
    collections::BTreeSet,
    fs,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Mutex,
    time::{Duration, Instant},
};

use flyrig_types::lock;

use fuzz::{
    mutate::Mutator,
    targets::{TARGETS, Target},
};

/// Time limit of one input, with a margin for a busy machine.
const SLOW: Duration = Duration::from_secs(10);
/// Input being processed (target, start, bytes), for the watch thread.
static CURRENT: Mutex<Option<(&str, Instant, Vec<u8>)>> = Mutex::new(None);
/// Limit of the peak memory, MiB.
const MOST_MIB: f64 = 3000.0;
/// Maximum number of distinct outcomes that are tracked.
const MOST_KEPT: usize = 2000;
/// Maximum length of a mutated input, bytes.
const LONGEST: usize = 1 << 16;
/// Number of inputs between two memory checks.
const LOOK: u64 = 64;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let number = |name: &str, default: f64| {
        let at = args.iter().position(|arg| arg == name);
        at.and_then(|at| args.get(at + 1)?.parse().ok()).unwrap_or(default)
    };
    let (minutes, seed) = (number("--minutes", 1.0), number("--seed", 1.0) as u64);
    let wanted: Vec<&String> =
        args.iter().filter(|arg| TARGETS.iter().any(|target| target.name == arg.as_str())).collect();
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    // Panics are caught and reported once, in the result of the target.
    std::panic::set_hook(Box::new(|_| {}));
    if let Err(error) = std::thread::Builder::new().name("watch".to_owned()).spawn(watch) {
        println!("fuzz: hangs are not detected: {error}");
    }
    let mut clean = true;
    for target in TARGETS.iter().filter(|target| wanted.is_empty() || wanted.iter().any(|name| *name == target.name)) {
        match run(target, &corpus.join(target.name), flyrig_types::saturating_secs(minutes * 60.0), seed) {
            Ok(line) => println!("fuzz {}: {line}", target.name),
            Err(problem) => {
                println!("fuzz {}: FAILED: {problem}", target.name);
                clean = false;
            }
        }
    }
    if clean { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn run(target: &Target, corpus: &Path, time: Duration, seed: u64) -> Result<String, String> {
    let mut inputs = seeds(corpus)?;
    let seeds = inputs.len();
    let mut random = Mutator::new(seed, target.words);
    let (mut outcomes, mut tried, mut taken) = (BTreeSet::new(), 0u64, 0u64);
    let mut slowest = Duration::ZERO;
    let started = Instant::now();
    while started.elapsed() < time {
        // Unchanged seeds come first.
        let input = match inputs.get(tried as usize) {
            Some(seed) if (tried as usize) < seeds => seed.clone(),
            _ => random.child(&inputs, LONGEST),
        };
        let begin = Instant::now();
        *lock(&CURRENT) = Some((target.name, begin, input.clone()));
        let outcome = catch_unwind(AssertUnwindSafe(|| (target.run)(&input)));
        let took = begin.elapsed();
        tried += 1;
        slowest = slowest.max(took);
        let outcome = outcome.map_err(|panic| {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
            format!("panic: {}; {}", text.unwrap_or_default(), keep(target.name, &input))
        })?;
        if took > SLOW {
            return Err(format!("one input took {:.1} s; {}", took.as_secs_f64(), keep(target.name, &input)));
        }
        if tried.is_multiple_of(LOOK) && peak_mib() > MOST_MIB {
            return Err(format!("memory ran away to {:.0} MiB; {}", peak_mib(), keep(target.name, &input)));
        }
        taken += u64::from(outcome.is_ok());
        let text = outcome.unwrap_or_else(|text| text);
        // Letters alone: numbers in a message would make every outcome distinct.
        let shape: String = text.chars().filter(|c| c.is_alphabetic() || *c == ' ').take(200).collect();
        if outcomes.len() < MOST_KEPT && outcomes.insert(shape) && tried as usize > seeds {
            inputs.push(input);
        }
    }
    *lock(&CURRENT) = None;
    Ok(format!(
        "{tried} inputs in {:.0} s from {seeds} seeds, {taken} read, {} different outcomes, slowest {:.0} ms, peak {:.0} MiB",
        started.elapsed().as_secs_f64(),
        outcomes.len(),
        slowest.as_secs_f64() * 1e3,
        peak_mib()
    ))
}

/// Ends the program when an input hangs.
fn watch() {
    loop {
        std::thread::sleep(Duration::from_secs(1));
        let current = lock(&CURRENT);
        if let Some((target, since, input)) = &*current
            && since.elapsed() > 3 * SLOW
        {
            println!("fuzz {target}: FAILED: an input hangs; {}", keep(target, input));
            std::process::exit(1);
        }
    }
}

fn seeds(corpus: &Path) -> Result<Vec<Vec<u8>>, String> {
    let read = |error: std::io::Error| format!("{}: {error}", corpus.display());
    let mut paths: Vec<PathBuf> = fs::read_dir(corpus)
        .map_err(read)?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<Result<_, _>>()
        .map_err(read)?;
    paths.sort();
    paths.iter().map(|path| fs::read(path).map_err(read)).collect()
}

/// Saves an input to the folder of temporary files, and returns a message with its path.
fn keep(target: &str, input: &[u8]) -> String {
    let path = std::env::temp_dir().join(format!("fuzz-{target}-{}.bin", std::process::id()));
    match fs::write(&path, input) {
        Ok(()) => format!("the input is {}", path.display()),
        Err(error) => format!("the input of {} bytes could not be saved: {error}", input.len()),
    }
}

/// Returns the peak resident memory of this process, MiB; 0 where the system does not report it.
fn peak_mib() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib: Option<f64> = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    kib.unwrap_or(0.0) / 1024.0
}
