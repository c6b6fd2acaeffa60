//! Avatars: built from a take, scored, driven by a motion, edited and exported; every unsupported input has a named error.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use flyrig_capture::{CameraSource as _, VideoOptions, VideoReplay};
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_stream::{Posed, PosedAxes};
use flyrig_tests::{run, write_dataset};
use flyrig_transport::TransportConfig;
use flyrig_viewer::{PeopleScene, Receiver, ShownPerson, clock_secs};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
const GIVEN: [&str; 4] = ["--pose", "given", "--masks", "given"];

#[test]
fn an_avatar_is_built_scored_driven_and_exported() {
    let data = write_dataset().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let take = data.root.to_string_lossy().into_owned();
    let avatar = |args: &[&str]| run(PROGRAM, &[&["avatar"], args].concat(), folder.path()).unwrap();
    let build = |out: &str, more: &[&str]| {
        let args = ["build", &take, "--inputs", "00,02,04", "--frames", "0..4", "--out", out, "--gaussians", "4000"];
        avatar(&[&args[..], &["--nodes", "100", "--harmonics", "1"], &GIVEN, more].concat())
    };
    let built = build("a.flyavatar", &["--steps", "60"]);
    assert_eq!(built.code, Some(0), "{built:?}");
    assert!(folder.path().join("a.png").exists());
    // "training images B -> A dB".
    let figures = built.stdout.split("training images ").nth(1).unwrap();
    let figures: Vec<f64> = figures.split([' ', ';']).filter_map(|word| word.parse().ok()).take(2).collect();
    assert!(figures[1] > figures[0] + 1.0, "{}", built.stdout);
    assert_eq!(build("b.flyavatar", &["--steps", "60"]).code, Some(0));
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    assert!(bytes("a.flyavatar") == bytes("b.flyavatar"), "the same steps gave different bytes");

    let info = avatar(&["info", "a.flyavatar"]);
    assert!(info.stdout.contains("\"steps\": 60") && info.stdout.contains("4000 Gaussians"), "{}", info.stdout);
    let eval = |more: &[&str]| {
        let args =
            ["eval", "a.flyavatar", &take, "--inputs", "00,02,04", "--holdout", "01", "--frames", "0..4", "--out", "e"];
        avatar(&[&args[..], &GIVEN, more].concat())
    };
    for more in [&[][..], &["--deformed"]] {
        let scored = eval(more);
        assert_eq!(scored.code, Some(0), "{scored:?}");
        let metrics: serde_json::Value = serde_json::from_slice(&bytes("e/metrics.json")).unwrap();
        assert!(metrics["mean"]["psnr_db"].as_f64().unwrap() > 15.0, "{metrics}");
        assert_eq!(metrics["per_frame"].as_array().unwrap().len(), 4);
    }
    assert!(folder.path().join("e/01/000003.png").exists());

    let motion = data.root.join("subject.glb").to_string_lossy().into_owned();
    let drawn =
        avatar(&["render", "a.flyavatar", "--motion", &motion, "--out", "r", "--frames", "0..2", "--size", "64x96"]);
    assert_eq!(drawn.code, Some(0), "{drawn:?}");
    let shown = image::open(folder.path().join("r/000001.png")).unwrap().to_rgba8();
    assert!(shown.pixels().filter(|pixel| pixel.0[3] > 200).count() > 200, "no person in the image");
    let exported = avatar(&["export", "a.flyavatar", "--out", "a.ply", "--motion", &motion]);
    assert!(exported.stdout.contains("4000 splats in a.ply"), "{exported:?}");
    // A generated motion as a video: the person is in every image, on a floor.
    let film = ["render", "a.flyavatar", "--motion", "walk", "--frames", "0..40", "--turn", "90", "--size", "96x96"];
    let drawn = avatar(&[&film[..], &["--out", "a.mp4"]].concat());
    assert_eq!(drawn.code, Some(0), "{drawn:?}");
    assert!(drawn.stdout.contains("40 frames of") && !drawn.stdout.contains("cut off"), "{}", drawn.stdout);
    let mut video = VideoReplay::open(&"a".into(), &folder.path().join("a.mp4"), &VideoOptions::default()).unwrap();
    let frames: Vec<_> = std::iter::from_fn(|| video.next_frame(std::time::Duration::ZERO).ok()).collect();
    assert_eq!(frames.len(), 40);
    let dark = |frame: &flyrig_types::Frame| frame.image.bytes().iter().filter(|byte| **byte < 120).count();
    assert!(frames.iter().all(|frame| dark(frame) > 150), "{:?}", frames.iter().map(dark).collect::<Vec<_>>());
    let aside = avatar(&[&film[..], &["--out", "b.avi", "--eye", "-0.3,-0.6,1.6", "--target", "0,0,0.5"]].concat());
    assert!(aside.code == Some(0) && aside.stdout.contains("the person is cut off in"), "{aside:?}");

    // Textures: an untouched texture changes nothing, a painted one changes the avatar.
    let done = |args: &[&str]| {
        let finished = avatar(args);
        assert_eq!(finished.code, Some(0), "{finished:?}");
        finished.stdout
    };
    done(&["export", "a.flyavatar", "--out", "a-texture.png", "--side", "128"]);
    let edit =
        |texture: &str, out: &str| done(&["edit", "a.flyavatar", "--texture", texture, "--side", "128", "--out", out]);
    assert!(edit("a-texture.png", "same.flyavatar").contains("0 texels differ"));
    assert!(bytes("same.flyavatar") == bytes("a.flyavatar"));
    let mut texture = image::open(folder.path().join("a-texture.png")).unwrap().into_rgb8();
    texture.pixels_mut().for_each(|pixel| pixel.0 = [0, 255, 0]);
    texture.save(folder.path().join("green.png")).unwrap();
    edit("green.png", "green.flyavatar");
    done(&["render", "green.flyavatar", "--motion", &motion, "--out", "g", "--frames", "0..1", "--size", "64x96"]);
    let shown = image::open(folder.path().join("g/000000.png")).unwrap().to_rgba8();
    let opaque = || shown.pixels().filter(|pixel| pixel.0[3] > 200);
    let green = opaque().filter(|pixel| pixel.0[1] > 2 * pixel.0[0].max(pixel.0[2])).count();
    assert!(green * 10 > opaque().count() * 7, "{green} of {}", opaque().count());
    // Shapes, meshes and splats for other programs.
    let height = done(&["edit", "a.flyavatar", "--shape", "height=0.7", "--out", "tall.flyavatar"]);
    let heights: Vec<f64> = height.split_whitespace().filter_map(|word| word.parse().ok()).take(2).collect();
    assert!(heights[1] > heights[0] + 0.05, "{height}");
    let mesh = ["mesh", "tall.flyavatar", "--out", "tall", "--motion", &motion, "--texture", "128", "--voxel", "20"];
    let meshed = run(PROGRAM, &mesh, folder.path()).unwrap();
    assert_eq!(meshed.code, Some(0), "{meshed:?}");
    done(&["render", "a.flyavatar", "--motion", "tall/mesh.glb", "--out", "t", "--frames", "0..1", "--size", "64x96"]);
    assert!(done(&["export", "a.flyavatar", "--out", "a.glb"]).contains("4000 splats"));

    // Unsupported inputs.
    let refused = |args: &[&str], expected: &str| {
        let finished = avatar(args);
        assert_eq!(finished.code, Some(1), "{finished:?}");
        assert!(finished.stderr.contains(expected), "{}", finished.stderr);
    };
    std::fs::write(folder.path().join("broken.flyavatar"), &bytes("a.flyavatar")[..4000]).unwrap();
    refused(&["info", "broken.flyavatar"], "broken.flyavatar: is no avatar");
    refused(
        &["edit", "a.flyavatar", "--texture", "a-texture.png", "--out", "no.flyavatar"],
        "a-texture.png has 128x128 texels, the avatar's texture 1024x1024",
    );
    refused(&["edit", "a.flyavatar", "--shape", "hight=1", "--out", "no.flyavatar"], "did you mean height");
    refused(&["edit", "a.flyavatar", "--out", "no.flyavatar"], "nothing to edit");
    refused(&["export", "a.flyavatar", "--out", "a.obj"], "a.obj is neither");
    assert!(!folder.path().join("no.flyavatar").exists());
    refused(&["info", "nowhere.flyavatar"], "nowhere.flyavatar does not exist; `flyrig avatar build` makes an avatar");
    refused(&["render", "a.flyavatar", "--motion", "a.png", "--out", "r"], "a.png is neither BVH nor glTF");
    refused(&["render", "a.flyavatar", "--motion", "wlk", "--out", "r"], "one of still, turn, walk, wave, squat,");
    let past = |more: &[&str]| {
        refused(&[more, &["a.flyavatar", "--motion", &motion]].concat(), "frame 899 is past the end: ");
    };
    past(&["render", "--out", "past", "--frames", "3..900"]);
    past(&["export", "--out", "past.ply", "--frame", "899"]);
    assert!(!folder.path().join("past").exists() && !folder.path().join("past.ply").exists());
    refused(
        &["render", "a.flyavatar", "--motion", "walk", "--out", "a.mov"],
        "name a video *.mp4 or *.avi, or a folder",
    );
    let nowhere = ["--eye", "0,0,1", "--target", "0,0,1"];
    refused(
        &[&["render", "a.flyavatar", "--motion", "walk", "--out", "a2.mp4"], &nowhere[..]].concat(),
        "--eye and --target are the same place",
    );
    refused(
        &[&["build", &take, "--inputs", "00,02", "--out", "no/folder/a.flyavatar"], &GIVEN[..]].concat(),
        "the folder no/folder does not exist",
    );
    refused(&[&["build", &take, "--inputs", "00,77", "--out", "c.flyavatar"], &GIVEN[..]].concat(), "77");
    assert!(!folder.path().join("c.flyavatar").exists());
}

#[test]
fn a_build_that_was_killed_goes_on() {
    let data = write_dataset().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let take = data.root.to_string_lossy().into_owned();
    let args = ["avatar", "build", &take, "--inputs", "00,02", "--frames", "0..2", "--out", "a.flyavatar"];
    let args = [&args[..], &["--steps", "700", "--gaussians", "1000", "--nodes", "50"], &GIVEN].concat();
    let build = || {
        let finished = run(PROGRAM, &args, folder.path()).unwrap();
        assert_eq!(finished.code, Some(0), "{finished:?}");
        (finished.stdout, std::fs::read(folder.path().join("a.flyavatar")).unwrap())
    };
    let (_, whole) = build();
    std::fs::remove_file(folder.path().join("a.flyavatar")).unwrap();
    let state = folder.path().join("a.fit");
    let mut killed = std::process::Command::new(PROGRAM).args(&args).current_dir(folder.path()).spawn().unwrap();
    while !state.exists() && killed.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    killed.kill().unwrap(); // SIGKILL
    killed.wait().unwrap();
    assert!(state.exists(), "the build ended before it could be killed");
    assert!(!folder.path().join("a.flyavatar").exists(), "a killed build left an avatar");
    let (printed, resumed) = build();
    assert!(printed.contains("going on after 500 of 700 steps"), "{printed}");
    assert!(whole == resumed, "the resumed build gave different bytes");
    assert!(!state.exists());
}

#[test]
fn a_recording_gives_the_avatar_of_its_exported_folder() {
    let folder = tempfile::tempdir().unwrap();
    let rig = "[source]\nkind = \"sim\"\npath = \"sim.toml\"\nreal_time = false\ncameras = [\"00\", \"02\", \"04\"]\n\
        [perception]\npose = \"given\"\nmasks = \"given\"\n[record]\njpeg_quality = 95\n";
    let sim = "seed = 5\nwidth = 192\nheight = 192\ntexture_px = 128\nframes = 6\ncameras.count = 6\n";
    std::fs::write(folder.path().join("sim.toml"), sim).unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let flyrig = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    for args in
        [&["record", "rig.toml", "--out", "take.mcap"][..], &["replay", "take.mcap", "--export", "folder/take.mcap"]]
    {
        let finished = flyrig(args);
        assert_eq!(finished.code, Some(0), "{finished:?}");
    }
    // Calibrations that differ by rounding spread the Gaussians differently, which is worth 0.5 dB with 2,000 Gaussians and 0.1 dB with
    // these.
    let build = |take: &str, out: &str, more: &[&str]| {
        let args =
            ["avatar", "build", take, "--inputs", "00,02,04", "--out", out, "--gaussians", "8000", "--nodes", "50"];
        flyrig(&[&args[..], &["--steps", "40", "--frames", "1..5"], more].concat())
    };
    let estimated = ["--pose", "estimated", "--masks", "estimated"];
    // Cards name their takes. A folder rounds calibration and timestamps, so the bytes may differ.
    let cards = ["take.mcap", "folder/take.mcap"].map(|take| {
        let built = build(take, "a.flyavatar", &estimated);
        assert_eq!(built.code, Some(0), "{built:?}");
        let info = flyrig(&["avatar", "info", "a.flyavatar"]).stdout;
        let mut card: serde_json::Value = serde_json::from_str(&info[..=info.rfind('}').unwrap()]).unwrap();
        let decibels = card["training_db"].take().as_f64().unwrap();
        (card, decibels)
    });
    let [(recorded, of_recording), (exported, of_folder)] = &cards;
    assert!(recorded == exported && recorded["frames"] == serde_json::json!([1, 5]), "{cards:?}");
    assert!(*of_recording > 30.0 && (of_recording - of_folder).abs() < 0.5, "{cards:?}");

    // Held-out cameras of a recording get the scores of its exported folder.
    let eval = |take: &str| {
        let args = ["avatar", "eval", "a.flyavatar", take, "--inputs", "00,02", "--holdout", "04", "--out", "e"];
        let scored = flyrig(&[&args[..], &["--frames", "2..4"], &estimated].concat());
        assert_eq!(scored.code, Some(0), "{scored:?}");
        let metrics = std::fs::read(folder.path().join("e/metrics.json")).unwrap();
        let metrics: serde_json::Value = serde_json::from_slice(&metrics).unwrap();
        assert!(folder.path().join("e/04/000003.png").exists());
        (metrics["per_frame"].as_array().unwrap().len(), metrics["mean"]["psnr_db"].as_f64().unwrap())
    };
    let (recorded, exported) = (eval("take.mcap"), eval("folder/take.mcap"));
    assert!(recorded.0 == 2 && exported.0 == 2 && (recorded.1 - exported.1).abs() < 0.5, "{recorded:?} {exported:?}");

    let refused = build("take.mcap", "no.flyavatar", &["--pose", "given", "--masks", "given"]);
    assert_eq!(refused.code, Some(1), "{refused:?}");
    assert!(refused.stderr.contains("add --pose estimated --masks estimated"), "{}", refused.stderr);
    let refused = build("take.mcap", "no.flyavatar", &[&estimated[..], &["--shape", "given"]].concat());
    assert!(refused.code == Some(1) && refused.stderr.contains("holds no body"), "{}", refused.stderr);
    let beyond = ["eval", "take.mcap", "--inputs", "00,02", "--holdout", "04", "--frames", "9..12", "--out", "e"];
    let beyond = flyrig(&[&beyond[..], &estimated].concat());
    assert!(beyond.code == Some(1) && beyond.stderr.contains("there are frames 0 to 5"), "{}", beyond.stderr);
    let missing = build("nothing.mcap", "no.flyavatar", &estimated);
    assert!(missing.code == Some(1) && missing.stderr.contains("nothing.mcap"), "{missing:?}");
    assert!(!folder.path().join("no.flyavatar").exists());
}

#[test]
fn the_live_rig_starts_from_an_avatar() {
    let data = write_dataset().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let take = data.root.to_string_lossy().into_owned();
    let flyrig = |args: &[&str]| run(PROGRAM, args, folder.path()).unwrap();
    let args = ["avatar", "build", &take, "--inputs", "00,02,04,05", "--frames", "0..4", "--out", "a.flyavatar"];
    let built = flyrig(&[&args[..], &["--gaussians", "4000", "--nodes", "100", "--steps", "60"], &GIVEN].concat());
    assert_eq!(built.code, Some(0), "{built:?}");

    // One camera sees the person; a held-out camera is scored in the first frame after the avatar's take.
    let eval = |more: &[&str]| {
        let args = ["eval", &take, "--inputs", "00", "--holdout", "03", "--frames", "4..5", "--out", "e"];
        flyrig(&[&args[..], &["--gaussians", "6000", "--nodes", "200"], &GIVEN, more].concat())
    };
    let score = |more: &[&str]| {
        let scored = eval(more);
        assert_eq!(scored.code, Some(0), "{scored:?}");
        let metrics = std::fs::read(folder.path().join("e/metrics.json")).unwrap();
        let metrics: serde_json::Value = serde_json::from_slice(&metrics).unwrap();
        assert_eq!(metrics["avatar"].is_string(), !more.is_empty());
        metrics["per_frame"][0]["psnr_db"].as_f64().unwrap()
    };
    let (without, with) = (score(&[]), score(&["--avatar", "a.flyavatar"]));
    assert!(with > without + 1.0, "{with} dB with the avatar, {without} without");

    // A running rig with the body and the poses of the take.
    let endpoint = support::small_rig("avatars", folder.path(), "");
    let simulated = std::fs::read_to_string(folder.path().join("rig.toml")).unwrap();
    std::fs::write(folder.path().join("sim.toml"), format!("{}frames = 3\n", support::SMALL_SIM)).unwrap();
    let simulated = simulated.replace("[source]\n", "[source]\nreal_time = false\n");
    let config = simulated.replace("path = \"sim.toml\"\n", &format!("kind = \"folder\"\npath = {take:?}\n"));
    let config = config.replace("[body]\n", &format!("[body]\ntemplate = {:?}\n", format!("{take}/subject.glb")));
    let with = |keys: &str| {
        let text = config.replace("nodes = 100\n", &format!("nodes = 100\n{keys}\n"));
        std::fs::write(folder.path().join("rig.toml"), text).unwrap();
        flyrig(&["run", "rig.toml"])
    };
    let ran = with("avatar = \"a.flyavatar\"");
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains("the person starts from the avatar a.flyavatar"), "{}", ran.stderr);

    // Viewers that draw the avatar themselves receive it once, then poses alone.
    let text = config.replace("nodes = 100\n", "nodes = 100\navatar = \"a.flyavatar\"\n");
    // The take has six frames; they last long enough for a viewer on a busy machine.
    let text = text.replace("real_time = false\n", "fps = 0.2\n").replace("[output]\n", "[output]\navatar = true\n");
    std::fs::write(folder.path().join("rig.toml"), text).unwrap();
    let rig = support::Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "avatars");
    let viewer = TransportConfig { connect: vec![endpoint], ..TransportConfig::subscriber("avatars") };
    let receiver = Receiver::start(&viewer, || {}).unwrap();
    let mut first = None;
    {
        let (camera, posed, axes, colors) = support::wait_for("an avatar that moves twice", || {
            let mut state = receiver.state();
            let mut camera = state.rig.as_ref()?.cameras[0].clone();
            camera.intrinsics.lens = flyrig_types::Lens::PINHOLE;
            let person = state.people.get_mut(0).filter(|person| person.is_complete())?;
            let motion = person.motion_at(clock_secs(), false)?;
            // Colours would have come between one motion and the next.
            if *first.get_or_insert(motion.stamp.frame) == motion.stamp.frame {
                return None;
            }
            assert_eq!(person.color_changes(), 0, "colours were sent beside the avatar");
            assert!(motion.nodes.is_empty());
            let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
            let colors = person.pose(&motion, &mut posed);
            assert!(person.pose_axes(&motion, &posed, &mut axes) && axes.rotation.len() == 4000);
            Some((camera, posed, axes, colors))
        });
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap().fastest();
        let mut scene = PeopleScene::new(&gpu).unwrap();
        scene.set_people([ShownPerson { posed: &posed, colors: &colors, axes: Some(&axes) }]).unwrap();
        let view = scene.draw(&camera).unwrap();
        let shown = view.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 200).count();
        assert!(shown > 300, "{shown} pixels show the person");
    }
    // The next rig has the same address.
    drop((receiver, rig));

    // Errors are one line with the fix.
    let refused = |finished: flyrig_tests::Finished, expected: &[&str]| {
        assert_eq!(finished.code, Some(1), "{finished:?}");
        let line = finished.stderr.lines().find(|line| line.starts_with("error:")).unwrap_or_default();
        assert!(expected.iter().all(|part| line.contains(part)), "{}", finished.stderr);
    };
    let bytes = std::fs::read(folder.path().join("a.flyavatar")).unwrap();
    std::fs::write(folder.path().join("cut.flyavatar"), &bytes[..bytes.len() / 2]).unwrap();
    let newer = bytes.windows(13).position(|part| part == b"\\\"version\\\":2").unwrap();
    let mut other = bytes.clone();
    other[newer + 12] = b'9';
    std::fs::write(folder.path().join("newer.flyavatar"), other).unwrap();
    refused(with("avatar = \"none.flyavatar\""), &["body.avatar: none.flyavatar: ", "flyrig avatar build"]);
    refused(with("avatar = \"cut.flyavatar\""), &["body.avatar: cut.flyavatar: ", "flyrig avatar build"]);
    refused(with("avatar = \"newer.flyavatar\""), &["newer.flyavatar: has version 9", "update flyrig"]);
    let both = "avatar = \"a.flyavatar\"\nperson = \"me.person\"";
    refused(with(both), &["body.avatar (a.flyavatar) and body.person (me.person)", "leave one of them empty"]);
    refused(eval(&["--avatar", "none.flyavatar"]), &["body.avatar: none.flyavatar: "]);
    // The simulator's person orders its joints differently from an exported one.
    let text = simulated.replace("nodes = 100\n", "nodes = 100\navatar = \"a.flyavatar\"\n");
    std::fs::write(folder.path().join("rig.toml"), text).unwrap();
    refused(flyrig(&["run", "rig.toml"]), &["body.avatar: ", "among its joints", "use the same body for both"]);
}
