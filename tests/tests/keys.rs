//! Keys from the command line: a key file alone lets another computer watch the rig or send cameras.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::process::{Command, Stdio};

use flyrig_tests::{Running, free_port, run};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

#[test]
fn a_key_file_is_all_that_another_computer_needs() {
    let folder = tempfile::tempdir().unwrap();
    let port = free_port().to_string();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    let command = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let done = |args: &[&str]| {
        let output = command(args);
        assert_eq!(output.code, Some(0), "{args:?}: {output:?}");
        output
    };
    let refused = |args: &[&str], part: &str| {
        let output = command(args);
        assert_eq!(output.code, Some(1), "{args:?}: {output:?}");
        assert!(output.stderr.contains(part), "{args:?}: {}", output.stderr);
    };
    write("sim.toml", "width = 64\nheight = 64\ntexture_px = 64\nfps = 10.0\ncameras.count = 2\n");
    let simulated = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\ncameras = [\"00\", \"01\"]\n";
    write("cameras.toml", &format!("[rig]\nname = \"elsewhere\"\n{simulated}"));
    done(&["sim", "export", "sim.toml", "--out", "calibration", "--frames", "1", "--no-truth"]);

    let made = done(&["keys", "new", "stage", "--host", "127.0.0.1", "--port", &port]);
    assert!(made.stdout.trim() == "stage-keys" && made.stderr.contains("keys = \"stage-keys\""), "{made:?}");
    done(&["keys", "add", "left-pc", "--role", "cameras", "--camera", "00", "--camera", "01"]);
    done(&["keys", "add", "one", "--role", "cameras", "--camera", "00"]);
    done(&["keys", "add", "desk"]);
    let listed = done(&["keys", "list"]).stdout;
    for (name, role) in [("left-pc", "cameras"), ("desk", "viewer")] {
        assert!(listed.lines().any(|line| line.starts_with(name) && line.contains(role) && line.ends_with("valid")));
    }
    refused(&["keys", "add", "desk"], "desk.key is there already");
    refused(&["keys", "new", "stage", "--host", "127.0.0.1"], "stage-keys: is there already");
    refused(&["keys", "revoke", "nobody"], "'nobody' has no key; known: left-pc, one, desk");
    refused(&["keys", "add", "two", "--camera", "00"], "add --role cameras");
    refused(&["capture", "cameras.toml", "--key", "one.key"], "camera 01: the key of 'one' is for 00");
    refused(&["capture", "cameras.toml", "--key", "desk.key"], "desk.key: is a key of role viewer");
    refused(&["watch", "left-pc.key", "--seconds", "1"], "left-pc.key: is a key of role cameras");
    refused(&["watch", "cameras.toml", "--seconds", "1"], "cameras.toml: is no key");
    refused(&["watch", "desk.key", "--record", "x.mcap", "--seconds", "5"], "no rig answers at 127.0.0.1");

    // The camera computer gets the rig's address from its key, and does not listen.
    let mut cameras = Command::new(PROGRAM);
    cameras.args(["capture", "cameras.toml", "--key", "left-pc.key"]).current_dir(folder.path()).stderr(Stdio::null());
    let cameras = Running(cameras.spawn().unwrap());
    let rig = "[rig]\nname = \"stage\"\n[source]\nkind = \"network\"\npath = \"calibration\"\ncameras = [\"00\", \"01\"]\n\
               [perception]\npose = \"estimated\"\nmasks = \"estimated\"\n[transport]\n";
    write("rig.toml", &format!("{rig}keys = \"stage-keys\"\n"));
    write("open.toml", &format!("{rig}keys = \"stage-keys\"\nlisten = [\"tcp/0.0.0.0:7447\"]\n"));
    write("bare.toml", &format!("{rig}listen = [\"tcp/0.0.0.0:7447\"]\nconnect = [\"tcp/10.0.0.2:7447\"]\n"));
    write("other.toml", &format!("{}keys = \"stage-keys\"\n", rig.replace("stage", "hall")));
    refused(&["config", "check", "open.toml"], "holders of keys connect at the address in transport.keys");
    refused(&["config", "check", "bare.toml"], "flyrig keys new stage --host NAME-OF-THIS-COMPUTER");
    refused(&["record", "other.toml", "--out", "x.mcap", "--seconds", "1"], "of the rig 'stage', not of 'hall'");
    let take = |n: u32| format!("take{n}.mcap");
    let sets = |n: u32| {
        // A recording without any frame is not kept.
        let recorded = command(&["record", "rig.toml", "--out", &take(n), "--seconds", "4"]);
        let is_empty = recorded.stderr.contains("no frame was recorded");
        assert_eq!(recorded.code, Some(i32::from(is_empty)), "{recorded:?}");
        let replayed = command(&["replay", &take(n)]).stdout;
        replayed.lines().find_map(|line| line.strip_prefix("sets: ")?.split(' ').next()?.parse::<usize>().ok())
    };
    assert!((0..20).filter_map(sets).any(|complete| complete > 3), "no frame sets arrived");

    // Revoke the key, then renew it.
    done(&["keys", "revoke", "left-pc"]);
    assert!(
        done(&["keys", "list"]).stdout.lines().any(|line| line.starts_with("left-pc") && line.ends_with("revoked"))
    );
    // The camera computer tries its key again after a while.
    let mut silent = String::new();
    let is_told = (0..20).any(|_| {
        let recorded = command(&["record", "rig.toml", "--out", "none.mcap", "--seconds", "3"]);
        assert_eq!(recorded.code, Some(1), "{recorded:?}");
        silent = recorded.stderr;
        let parts = ["its key was revoked", "run `flyrig capture rig.toml --key KEY` on it"];
        parts.iter().all(|part| silent.contains(part))
    });
    assert!(is_told, "{silent}");
    drop(cameras);
    std::fs::remove_file(folder.path().join("desk.key")).unwrap();
    let renewed = done(&["keys", "renew", "desk"]);
    assert!(renewed.stderr.contains("the old key of 'desk' is refused"), "{}", renewed.stderr);
}

/// Returns the names of valid keys, as `keys list` prints them.
fn valid_names(folder: &std::path::Path) -> Vec<String> {
    let listed = run(PROGRAM, &["keys", "list"], folder).unwrap();
    assert_eq!(listed.code, Some(0), "{listed:?}");
    let valid = |line: &str| line.ends_with(" valid").then(|| line.split(' ').next().map(str::to_owned)).flatten();
    let mut names: Vec<String> = listed.stdout.lines().filter_map(valid).collect();
    names.sort();
    names
}

fn key_files(folder: &std::path::Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = entries.filter_map(|name| name.strip_suffix(".key").map(str::to_owned)).collect();
    names.sort();
    names
}

fn spawn(args: &[&str], folder: &std::path::Path) -> Running {
    let mut command = Command::new(PROGRAM);
    command.args(args).current_dir(folder).stdout(Stdio::null()).stderr(Stdio::null());
    Running(command.spawn().unwrap())
}

#[test]
fn a_hundred_commands_at_once_lose_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let done = |args: &[&str]| assert_eq!(run(PROGRAM, args, path).unwrap().code, Some(0), "{args:?}");
    done(&["keys", "new", "stage", "--host", "127.0.0.1"]);
    for n in 0..20 {
        done(&["keys", "add", &format!("old{n:02}")]);
    }
    let mut commands = Vec::new();
    for n in 0..80 {
        commands.push(spawn(&["keys", "add", &format!("new{n:02}")], path));
        if n % 8 == 0 {
            commands.push(spawn(&["keys", "revoke", &format!("old{:02}", n / 8)], path));
            let name = format!("old{:02}", 10 + n / 8);
            commands.push(spawn(&["keys", "renew", &name, "--out", &format!("{name}b.key")], path));
        }
    }
    for command in &mut commands {
        assert!(command.0.wait().unwrap().success());
    }
    let mut expected: Vec<String> = (0..80).map(|n| format!("new{n:02}")).collect();
    expected.extend((10..20).map(|n| format!("old{n:02}")));
    assert_eq!(valid_names(path), expected, "every command took effect, and every revocation holds");
    let mut files = expected;
    files.extend((0..10).map(|n| format!("old{n:02}")));
    files.extend((10..20).map(|n| format!("old{n:02}b")));
    files.sort();
    assert_eq!(key_files(path), files);
}

#[test]
fn commands_that_are_killed_leave_keys_and_list_equal() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let made = run(PROGRAM, &["keys", "new", "stage", "--host", "127.0.0.1"], path).unwrap();
    assert_eq!(made.code, Some(0), "{made:?}");
    let started = std::time::Instant::now();
    drop(run(PROGRAM, &["keys", "add", "desk"], path).unwrap());
    let whole = started.elapsed();
    // More than forty where the machine has become slower meanwhile, until one is not killed.
    for n in 0..400u32 {
        if n >= 40 && key_files(path).len() > 1 {
            break;
        }
        // Killed at moments spread over the time that the command takes.
        let command = spawn(&["keys", "add", &format!("new{n:02}")], path);
        std::thread::sleep(whole * n / 30);
        drop(command);
        let valid = valid_names(path);
        assert_eq!(key_files(path), valid, "after {n} commands");
    }
    assert!(key_files(path).len() > 1, "some commands came to their end");
}
