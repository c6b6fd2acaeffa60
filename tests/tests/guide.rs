//! The README and the guide are followed: every command in them is one that the program knows, and those that need no hardware, no other
//! computer and no patience are run in the order of their page.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::OnceLock,
    time::Duration,
};

use flyrig_tests::{
    Running, copy_folder, free_port,
    guide::{Block, blocks},
    run,
};

use crate::support::{SMALL_SIM, wait_until};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

/// Simulated rig whose person is large enough in the images to be found in them. Its recordings have these frames on any machine: a
/// person is not believed in three frame sets, which is all that a loaded one renders in six seconds.
const SEEN_SIM: &str = "width = 160\nheight = 160\ntexture_px = 256\nfps = 6.0\nframes = 20\n";

/// Lengths and cameras in the guide, and those of the test.
const SHORTER: [(&str, &str); 11] = [
    ("--seconds 20", "--seconds 8"),
    ("--seconds 30", "--seconds 20"),
    ("--frames 60", "--frames 4"),
    ("--frames 0..60", "--frames 0..4"),
    ("--frames 60..90", "--frames 2..4"),
    ("--frame 12", "--frame 2"),
    // The simulated cameras have numbers.
    ("--inputs left,right,back --holdout front", "--inputs 00,01,02 --holdout 03"),
    ("--inputs left,right --holdout back", "--inputs 00,02 --holdout 01"),
    // Each camera in turn takes minutes, and the simulated cameras stand far apart.
    ("eval take.mcap", "eval take.mcap --inputs 00,02 --holdout 01"),
    ("--size 1080x1080", "--size 108x108"),
    ("--frames 0..90", "--frames 0..2"),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Returns the README and the pages of the guide, by name.
fn pages() -> Vec<(String, Vec<Block>)> {
    let guide = fs::read_dir(root().join("docs/guide")).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> = guide.filter(|path| path.extension().is_some_and(|ending| ending == "md")).collect();
    files.push(root().join("README.md"));
    files.sort();
    let read = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        (name, blocks(&fs::read_to_string(path).unwrap()))
    };
    files.iter().map(read).collect()
}

#[test]
fn every_command_of_the_guide_is_known_to_the_program() {
    let (mut found, mut wrong) = (0, Vec::new());
    for (page, blocks) in pages() {
        for (line, mut words) in blocks.iter().flat_map(Block::commands) {
            words.truncate(words.iter().position(|word| word == ">" || word == "|").unwrap_or(words.len()));
            if words[0] != "flyrig" {
                continue;
            }
            found += 1;
            if let Err(error) = flyrig::check_command(&words) {
                wrong.push(format!("{page}:{line}: {}\n{error}", words.join(" ")));
            }
        }
    }
    assert!(found > 80, "only {found} commands");
    let mistyped = ["flyrig", "eval", "DATASET", "--inptus", "01,02", "--holdout", "03", "--out", "out"];
    assert!(flyrig::check_command(&mistyped.map(str::to_owned)).is_err());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn every_page_is_followed_or_marked() {
    let followed = include_str!("guide.rs");
    for (page, blocks) in pages() {
        let runs = blocks.iter().any(|block| block.commands().iter().any(|(_, words)| block.runs(words)));
        let call = format!("follow(\"{page}\"");
        assert!(
            !runs || followed.contains(&call),
            "{page} has commands to run: mark them, or follow the page in this file"
        );
    }
}

/// Takes and files that a reader has, made once: `DATASET` and `TAKE` of five simulated cameras, and a small rig.
fn supplies() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::write(at("sim.toml"), format!("{SEEN_SIM}cameras.count = 5\n")).unwrap();
        done(folder.path(), &["sim", "export", "sim.toml", "--out", "DATASET", "--frames", "6", "--no-truth"]);
        for camera in ["00", "01", "02", "03", "04"] {
            let images = at("EMPTY_TAKE/images").join(camera);
            fs::create_dir_all(&images).unwrap();
            for frame in 0..4 {
                let plate = at("DATASET/background").join(format!("{camera}.png"));
                fs::copy(plate, images.join(format!("{frame:06}.png"))).unwrap();
            }
        }
        let convert = ["calibrate", "convert", "DATASET", "--out"];
        done(folder.path(), &[&convert[..], &["calibration"]].concat());
        done(folder.path(), &[&convert[..], &["nerf", "--to", "nerfstudio"]].concat());
        fs::rename(at("nerf/transforms.json"), at("transforms.json")).unwrap();
        for name in ["walk.bvh", "dance.bvh"] {
            fs::write(at(name), walk_bvh()).unwrap();
        }
        copy_folder(&at("DATASET"), &at("TAKE")).unwrap();
        fs::remove_file(at("sim.toml")).unwrap();
        folder
    });
    folder.path()
}

/// Returns a motion of four frames, in which the thighs swing; lengths in centimetres.
fn walk_bvh() -> String {
    let end = |offset: &str| format!("End Site {{ OFFSET {offset} }}\n");
    let joint = |name: &str, offset: &str, children: &str| {
        let channels = "CHANNELS 3 Zrotation Xrotation Yrotation";
        format!("JOINT {name} {{ OFFSET {offset} {channels}\n{children} }}\n")
    };
    let leg = |side: &str, x: f64| {
        let foot = joint(&format!("{side}Foot"), "0 -42 0", &end("0 -7 14"));
        let shin = joint(&format!("{side}Leg"), "0 -42 0", &foot);
        joint(&format!("{side}UpLeg"), &format!("{x} -4 0"), &shin)
    };
    let arm = |side: &str, sign: f64| {
        let hand = joint(&format!("{side}Hand"), &format!("{} 0 0", 25.0 * sign), &end("8 0 0"));
        let lower = joint(&format!("{side}ForeArm"), &format!("{} 0 0", 28.0 * sign), &hand);
        joint(&format!("{side}Arm"), &format!("{} 18 0", 17.0 * sign), &lower)
    };
    let head = joint("Neck", "0 24 0", &joint("Head", "0 9 0", &end("0 20 0")));
    let spine = joint("Spine", "0 12 0", &joint("Spine1", "0 20 0", &(head + &arm("Left", 1.0) + &arm("Right", -1.0))));
    let joints = spine + &leg("Left", 9.0) + &leg("Right", -9.0);
    let channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation";
    let mut text = format!(
        "HIERARCHY\nROOT Hips {{ OFFSET 0 0 0 {channels}\n{joints} }}\nMOTION\nFrames: 4\nFrame Time: 0.0333\n"
    );
    let rows = 3 * (joints.matches("JOINT").count() - 6);
    for frame in 0..4 {
        let swing = 10.0 * f64::from(frame);
        let thigh = |angle: f64| format!("0 {angle} 0 0 0 0 0 0 0");
        text += &format!("0 95 {swing} 0 0 0{} {} {}\n", " 0".repeat(rows), thigh(swing), thigh(-swing));
    }
    text
}

/// Runs a command that must succeed.
fn done(folder: &Path, args: &[&str]) {
    let finished = run(PROGRAM, args, folder).unwrap();
    assert_eq!(finished.code, Some(0), "flyrig {}\n{}{}", args.join(" "), finished.stdout, finished.stderr);
}

/// Reader of one page, in a folder of their own.
struct Reader {
    folder: tempfile::TempDir,
    endpoint: String,
    /// Rig that runs beside all commands of the page.
    beside: Option<Running>,
    /// Commands that go on until they are stopped, each with its place.
    running: Vec<(String, Running)>,
}

impl Reader {
    fn new(page: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        copy_folder(supplies(), folder.path()).unwrap();
        let cameras = "cameras = [\"00\", \"03\"]";
        let endpoint = support::small_rig("flyrig", folder.path(), "");
        // Recordings of these pages are scored against cameras that are held out, and people are found in their images.
        if page == "recordings.md" || page == "troubleshooting.md" {
            let rig = folder.path().join("rig.toml");
            let text = fs::read_to_string(&rig).unwrap();
            let all = "cameras = [\"00\", \"01\", \"02\", \"03\"]\nreal_time = false";
            fs::write(&rig, text.replace(cameras, all)).unwrap();
            fs::write(folder.path().join("sim.toml"), SEEN_SIM).unwrap();
        }
        Self { folder, endpoint, beside: None, running: Vec::new() }
    }

    /// Removes the calibration, which the page makes, or comes before it.
    fn forget_calibration(&mut self) {
        fs::remove_dir_all(self.path().join("calibration")).unwrap();
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Writes the file of a block.
    fn write(&self, name: &str, lines: &[String]) {
        let small = if lines.iter().any(|line| line == "[source]") {
            "\n[body]\ngaussians = 3000\nnodes = 100\n[output]\nwidth = 96\nheight = 96\n"
        } else {
            ""
        };
        let text = format!("{}\n{small}[transport]\nlisten = [\"{}\"]\n", lines.join("\n"), self.endpoint);
        fs::write(self.path().join(name), text).unwrap();
    }

    /// Runs a command to its end, or starts one that goes on until Ctrl-C.
    fn follow(&mut self, place: &str, words: &[String]) {
        let mut line = words.join(" ");
        for (long, short) in SHORTER {
            line = line.replace(long, short);
        }
        let mut args: Vec<&str> = line.split(' ').skip(1).collect();
        let target = args.iter().position(|word| *word == ">").map(|at| {
            let target = args[at + 1].to_owned();
            args.truncate(at);
            target
        });
        self.clear(&args);
        let endpoint = self.endpoint.clone();
        let own_endpoint = format!("tcp/127.0.0.1:{}", free_port());
        match args[0] {
            "watch" if args.contains(&"--record") => args.extend(["--connect", &endpoint, "--seconds", "20"]),
            "watch" => args.extend(["--connect", &endpoint, "--count", "2"]),
            "serve" => args.extend(["--connect", &endpoint, "--listen", "127.0.0.1:0"]),
            "play" if !args.contains(&"--orbit") => args.extend(["--listen", &own_endpoint]),
            "eval" => args.extend(["--gaussians", "3000", "--nodes", "100"]),
            _ => {}
        }
        eprintln!("{place}: flyrig {}", args.join(" "));
        if matches!(args[0], "run" | "serve" | "capture" | "play") && !args.contains(&"--orbit") {
            return self.start(place, &args);
        }
        let finished = run(PROGRAM, &args, self.path()).unwrap();
        assert_eq!(
            finished.code,
            Some(0),
            "{place}: flyrig {}\n{}{}",
            args.join(" "),
            finished.stdout,
            finished.stderr
        );
        if let Some(name) = target {
            let text = if name == "sim.toml" { SMALL_SIM.to_owned() } else { finished.stdout };
            // Another rig may run on this computer.
            let text = text.replace("tcp/127.0.0.1:7447", &self.endpoint);
            fs::write(self.path().join(name), text).unwrap();
        }
    }

    /// Removes what a reader who tries two ways would name differently: commands do not overwrite files.
    fn clear(&self, args: &[&str]) {
        for option in ["--out", "--record", "--export"] {
            let Some(at) = args.iter().position(|word| *word == option) else { continue };
            let path = self.path().join(args[at + 1]);
            if path.is_file() && matches!(args[0], "record" | "run" | "watch") {
                fs::remove_file(&path).unwrap();
            } else if args[0] == "replay" && path.is_dir() {
                fs::remove_dir_all(&path).unwrap();
            }
        }
    }

    /// Starts a command that goes on, and waits until it runs.
    fn start(&mut self, place: &str, args: &[&str]) {
        let mut process = self.spawn(place, args);
        let log = self.path().join("command.log");
        wait_until(place, || {
            let text = fs::read_to_string(&log).unwrap();
            let has_ended = process.0.try_wait().unwrap();
            assert!(has_ended.is_none_or(|status| status.success()), "{place}: {text}");
            has_ended.is_some() || text.contains("(Ctrl-C ends)") || text.contains(" shows it")
        });
        self.running.push((format!("{place}: flyrig {}", args.join(" ")), process));
    }

    /// Starts a command, whose messages go to `command.log`.
    fn spawn(&self, place: &str, args: &[&str]) -> Running {
        let child = Command::new(PROGRAM)
            .args(args)
            .current_dir(self.path())
            .env_remove("RUST_LOG")
            .stdout(Stdio::null())
            .stderr(fs::File::create(self.path().join("command.log")).unwrap())
            .spawn();
        Running(child.unwrap_or_else(|error| panic!("{place}: {error}")))
    }

    /// Ends the commands that go on, as Ctrl-C does.
    fn stop(&mut self) {
        while let Some((line, mut process)) = self.running.pop() {
            if process.0.try_wait().unwrap().is_none() {
                // A recording has its first frames by then: more bytes than the calibration before them.
                if let Some((_, recording)) = line.split_once(" --record ") {
                    let path = self.path().join(recording.split(' ').next().unwrap());
                    wait_until("frames of the recording", || fs::metadata(&path).is_ok_and(|file| file.len() > 50_000));
                }
                std::thread::sleep(Duration::from_secs(2));
                let killed = Command::new("kill").args(["-INT", &process.0.id().to_string()]).status().unwrap();
                assert!(killed.success(), "{line}");
            }
            let status = process.0.wait().unwrap();
            let log = || String::from_utf8_lossy(&fs::read(self.path().join("command.log")).unwrap()).into_owned();
            assert!(status.success(), "{line}: {status}\n{}", log());
        }
    }
}

/// Follows a page; `prepare` makes what its reader has beyond the supplies.
fn follow(page: &str, prepare: impl FnOnce(&mut Reader)) {
    let (_, blocks) = pages().into_iter().find(|(name, _)| name == page).unwrap();
    let mut reader = Reader::new(page);
    prepare(&mut reader);
    for block in blocks {
        if let Some(name) = block.file() {
            reader.write(name, &block.lines);
        }
        for (line, words) in block.commands().into_iter().filter(|(_, words)| block.runs(words)) {
            let place = format!("{page}:{line}");
            let is_simple = words[0] == "flyrig" && !words.iter().any(|word| word == "|" || word == "&&");
            assert!(is_simple, "{place}: mark `{}` with <!-- not run: REASON -->", words.join(" "));
            reader.follow(&place, &words);
            // A rig that records, or a page that is served, runs beside nothing else.
            reader.stop();
        }
    }
}

#[test]
fn the_readme_is_true() {
    follow("README.md", |_| {});
}

#[test]
fn footage_of_ones_own_is_evaluated() {
    follow("own-footage.md", |reader| fs::remove_dir_all(reader.path().join("DATASET/background")).unwrap());
}

#[test]
fn recordings_are_made_and_replayed() {
    follow("recordings.md", |_| {});
}

#[test]
fn the_simulator_is_used() {
    follow("simulated-rig.md", |_| {});
}

#[test]
fn keys_are_managed() {
    follow("keys.md", |_| {});
}

#[test]
fn calibrations_are_converted() {
    follow("calibration.md", Reader::forget_calibration);
}

#[test]
fn cameras_and_keys_are_set_up() {
    follow("cameras-and-sync.md", Reader::forget_calibration);
}

#[test]
fn appearance_is_compared() {
    follow("learned-appearance.md", |_| {});
}

#[test]
fn problems_are_looked_into() {
    follow("troubleshooting.md", |_| {});
}

#[test]
fn avatars_are_drawn_and_edited() {
    follow("avatars.md", |reader| {
        let take = ["avatar", "build", "DATASET", "--inputs", "00,02,04", "--pose", "given", "--masks", "given"];
        let small = ["--gaussians", "2000", "--nodes", "100", "--steps", "20", "--out", "anna.flyavatar"];
        done(reader.path(), &[&take[..], &small].concat());
        done(reader.path(), &["avatar", "export", "anna.flyavatar", "--out", "painted.png"]);
    });
}

#[test]
fn a_running_rig_is_watched() {
    follow("viewing.md", |reader| {
        reader.start("the rig", &["run", "rig.toml"]);
        reader.beside = reader.running.pop().map(|(_, rig)| rig);
        // The first image is that of a person.
        let endpoint = reader.endpoint.clone();
        done(reader.path(), &["watch", "--connect", &endpoint, "--count", "1"]);
    });
}
