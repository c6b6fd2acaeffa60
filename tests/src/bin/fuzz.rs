//! Everything that reads what others wrote, fed with damaged input: `make fuzz MINUTES=10`.
//!
//! A generator of its own, on stable Rust: seeds from `tests/corpus` are cut, spliced, flipped and filled with numbers that
//! hurt. An input whose outcome reads differently from all before it is kept and mutated further; that finds the branches
//! that speak, without instrumentation. A panic, an input that takes seconds, or memory that runs away ends the program
//! with the input in a file.

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

/// Longest that one input may take: a machine that is busy included.
const SLOW: Duration = Duration::from_secs(10);
/// The input in work, for whoever finds that it does not end.
static CURRENT: Mutex<Option<(&str, Instant, Vec<u8>)>> = Mutex::new(None);
/// Memory that no input may take, MiB.
const MOST_MIB: f64 = 3000.0;
/// Inputs that are kept beside the seeds, and their longest.
const MOST_KEPT: usize = 2000;
const LONGEST: usize = 1 << 16;
/// Memory is looked at once in so many inputs.
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
    // Panics are caught and told once.
    std::panic::set_hook(Box::new(|_| {}));
    if let Err(error) = std::thread::Builder::new().name("watch".to_owned()).spawn(watch) {
        println!("fuzz: nobody watches for inputs that do not end: {error}");
    }
    let mut clean = true;
    for target in TARGETS.iter().filter(|target| wanted.is_empty() || wanted.iter().any(|name| *name == target.name)) {
        match run(target, &corpus.join(target.name), Duration::from_secs_f64(minutes * 60.0), seed) {
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
        // The seeds themselves come first.
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
        // Numbers and quoted pieces differ for ever.
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

/// Ends the program when an input does not end.
fn watch() {
    loop {
        std::thread::sleep(Duration::from_secs(1));
        let current = lock(&CURRENT);
        if let Some((target, since, input)) = &*current
            && since.elapsed() > 3 * SLOW
        {
            println!("fuzz {target}: FAILED: an input does not end; {}", keep(target, input));
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

/// Writes an input where it can be found again.
fn keep(target: &str, input: &[u8]) -> String {
    let path = std::env::temp_dir().join(format!("fuzz-{target}-{}.bin", std::process::id()));
    match fs::write(&path, input) {
        Ok(()) => format!("the input is {}", path.display()),
        Err(error) => format!("the input of {} bytes could not be kept: {error}", input.len()),
    }
}

/// Most memory that this process has ever had, where the system tells it.
fn peak_mib() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib: Option<f64> = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
    kib.unwrap_or(0.0) / 1024.0
}
