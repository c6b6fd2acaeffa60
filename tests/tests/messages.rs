//! Mistakes of newcomers are answered word by word as `docs/benchmarks/messages.md` states: one error that names the item and the fix.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::{
    fs,
    net::TcpListener,
    path::{Path, PathBuf},
};

use flyrig_tests::{Finished, copy_folder, free_port, guide::words, run};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

/// Row of the table: a command, and its answer.
struct Mistake {
    command: Vec<String>,
    answer: String,
}

fn table() -> Vec<Mistake> {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/benchmarks/messages.md");
    let text = fs::read_to_string(page).unwrap();
    let span = |cell: &str| cell.trim().trim_matches('`').trim().to_owned();
    let rows = text.lines().filter(|line| line.starts_with("| ") && line.contains("`flyrig "));
    let row = |line: &str| {
        let cells: Vec<&str> = line.trim_matches('|').split('|').collect();
        let [_, command, _, answer] = cells.as_slice() else { panic!("not four cells: {line}") };
        Mistake { command: words(&span(command)), answer: span(answer) }
    };
    rows.map(row).collect()
}

/// Returns the error of a command as the table writes it: in one line, without the usage.
fn answer(finished: &Finished) -> String {
    let lines: Vec<&str> = finished.stderr.lines().collect();
    let at = lines.iter().position(|line| line.starts_with("error: ")).unwrap_or_else(|| panic!("{finished:?}"));
    let text = lines[at..].join(" ").replace('|', "¦");
    let text = text.split("Usage:").next().unwrap().split("For more information").next().unwrap();
    text.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
}

fn copy_without(take: &Path, name: &str, missing: &[&str]) {
    let to = take.with_file_name(name);
    copy_folder(take, &to).unwrap();
    for path in missing.iter().map(|path| to.join(path)) {
        if path.is_dir() { fs::remove_dir_all(path).unwrap() } else { fs::remove_file(path).unwrap() }
    }
}

/// Takes, recordings and configurations of the table, in a folder of their own.
struct Inputs {
    folder: tempfile::TempDir,
    free: u16,
    taken: TcpListener,
}

impl Inputs {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let free = free_port();
        let inputs = Self { folder, free, taken };
        inputs.write("sim.toml", "width = 96\nheight = 96\ntexture_px = 128\ncameras.count = 4\n");
        inputs.make(&["sim", "export", "sim.toml", "--out", "take", "--frames", "4", "--no-truth"]);
        let take = inputs.path("take");
        copy_without(&take, "bare", &["intri.yml", "extri.yml"]);
        copy_without(&take, "unmasked", &["mask"]);
        copy_without(&take, "nobody", &["subject.glb"]);
        fs::create_dir(inputs.path("empty")).unwrap();
        inputs.write("notes.txt", "notes\n");
        inputs.write("a.mp4", "no video\n");
        inputs.write_configurations();
        inputs.make(&["record", "right.toml", "--out", "take.mcap"]);
        inputs
    }

    fn write_configurations(&self) {
        let source = "[source]\nkind = \"folder\"\npath = \"take\"\ncameras = []\nreal_time = false\n";
        let listen = |port: u16| format!("[transport]\nlisten = [\"tcp/127.0.0.1:{port}\"]\n");
        let free = listen(self.free);
        self.write("right.toml", &format!("{source}{free}"));
        self.write("key.toml", &format!("{}{free}", source.replace("path", "pth")));
        self.write("folder.toml", &format!("{}{free}", source.replace("take", "takke")));
        self.write("names.toml", &format!("{}{free}", source.replace("cameras = []\n", "")));
        self.write("plates.toml", &format!("{source}[perception]\nplates = \"plats\"\n{free}"));
        self.write("keys.toml", &format!("{source}{free}keys = \"studio-keys\"\n"));
        self.write("port.toml", &format!("{source}{}", listen(self.port())));
    }

    fn port(&self) -> u16 {
        self.taken.local_addr().unwrap().port()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    fn run_in(&self, folder: &str, args: &[&str]) -> Finished {
        run(PROGRAM, args, &self.path(folder)).unwrap()
    }

    fn make(&self, args: &[&str]) {
        let finished = self.run_in("", args);
        assert_eq!(finished.code, Some(0), "{finished:?}");
    }
}

#[test]
fn mistakes_are_answered_as_the_table_states() {
    let inputs = Inputs::new();
    let table = table();
    assert!(table.len() >= 20, "{} rows", table.len());
    let mut wrong = Vec::new();
    for Mistake { command, answer: expected } in &table {
        let args: Vec<String> =
            command[1..].iter().map(|word| word.replace("FREE", &inputs.free.to_string())).collect();
        let finished = inputs.run_in("", &args.iter().map(String::as_str).collect::<Vec<_>>());
        let found = answer(&finished).replace(&inputs.port().to_string(), "PORT");
        let found = found.replace(&inputs.free.to_string(), "FREE");
        let errors = finished.stderr.lines().filter(|line| line.starts_with("error")).count();
        if !matches!(finished.code, Some(1 | 2)) || errors != 1 || found != *expected {
            wrong.push(format!("{}\n  stated: {expected}\n  found:  {found} ({:?})", command.join(" "), finished.code));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn paths_are_relative_to_the_configuration_wherever_it_is_read() {
    let inputs = Inputs::new();
    fs::create_dir(inputs.path("elsewhere")).unwrap();
    let checked = inputs.run_in("elsewhere", &["config", "check", "../right.toml"]);
    assert_eq!((checked.code, checked.stdout.as_str()), (Some(0), "../right.toml is right\n"), "{checked:?}");
    let recorded = inputs.run_in("elsewhere", &["record", "../right.toml", "--out", "x.mcap"]);
    assert_eq!(recorded.code, Some(0), "{recorded:?}");
    assert!(inputs.path("elsewhere/x.mcap").exists());
    // A simulator's file names its motion beside itself.
    inputs.write("rig.toml", "[source]\npath = \"scene/sim.toml\"\ncameras = []\n");
    fs::create_dir(inputs.path("scene")).unwrap();
    inputs.write("scene/sim.toml", "width = 32\nheight = 32\n[motion]\nkind = \"bvh\"\nbvh = \"walk.bvh\"\n");
    let refused = inputs.run_in("elsewhere", &["record", "../rig.toml", "--out", "y.mcap", "--seconds", "1"]);
    assert!(refused.stderr.contains("../scene/walk.bvh"), "{refused:?}");
}

#[test]
fn a_configuration_without_its_calibration_yet_and_one_with_two_faults() {
    let inputs = Inputs::new();
    let listen = format!("[transport]\nlisten = [\"tcp/127.0.0.1:{}\"]\n", inputs.free);
    let camera = "[[source.cameras]]\nname = \"left\"\nserial = \"A1\"\nsize = [64, 64]\n";
    inputs.write("rig.toml", &format!("[source]\nkind = \"cameras\"\npath = \"calibration\"\n{camera}{listen}"));
    let checked = inputs.run_in("", &["config", "check", "rig.toml"]);
    assert_eq!(checked.code, Some(0), "{checked:?}");
    let expected = "right for `flyrig capture` and `flyrig doctor` alone: calibration holds no calibration yet; make one with \
                    `flyrig calibrate live rig.toml --out calibration`";
    assert!(checked.stdout.contains(expected), "{checked:?}");
    let text = fs::read_to_string(inputs.path("folder.toml")).unwrap();
    inputs.write("two.toml", &format!("{text}keys = \"studio-keys\"\n"));
    let checked = inputs.run_in("", &["config", "check", "two.toml"]);
    assert_eq!(checked.code, Some(1), "{checked:?}");
    for part in
        ["error: 2 problems in the configuration two.toml", "takke does not exist", "studio-keys does not exist"]
    {
        assert!(checked.stderr.contains(part), "{checked:?}");
    }
    assert_eq!(inputs.run_in("", &["config", "check", "--offline", "two.toml"]).code, Some(0));
}

#[test]
fn a_long_command_says_first_what_it_opens_and_libraries_are_silent() {
    let inputs = Inputs::new();
    let finished = inputs.run_in("", &["sim", "export", "sim.toml", "--out", "second", "--frames", "1", "--no-truth"]);
    assert_eq!(finished.stderr.lines().next(), Some("sim export: simulating 1 frames for second"), "{finished:?}");
    assert_eq!(finished.stderr.lines().count(), 1, "{finished:?}");
    let finished = inputs.run_in("", &["eval", "nowhere", "--inputs", "00", "--holdout", "01", "--out", "out"]);
    assert_eq!(finished.stderr.lines().next(), Some("eval: opening nowhere"), "{finished:?}");
    let listed = inputs.run_in("", &["eval", "nowhere", "--inputs", "00, 02", "--holdout", "01", "--out", "out"]);
    assert_eq!(listed.code, Some(1), "a list with blanks is a list: {listed:?}");
}
