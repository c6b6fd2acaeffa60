//! `flyrig eval TAKE` without options: cameras are held out in turn, the report says in words what is wrong, and the take is shown as a page and
//! a film.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::time::Duration;

use flyrig_capture::{CameraSource as _, VideoOptions, VideoReplay};
use flyrig_tests::{Dataset, FRAMES, Finished, run, write_dataset};
use serde_json::Value;

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

/// Runs `flyrig eval data` beside the data set, with few Gaussians.
fn eval(data: &Dataset, more: &[&str]) -> Finished {
    let small = ["eval", "data", "--gaussians", "4000", "--nodes", "200"];
    run(PROGRAM, &[&small, more].concat(), data.root.parent().unwrap()).unwrap()
}

fn read(data: &Dataset, file: &str) -> String {
    std::fs::read_to_string(data.root.parent().unwrap().join(file)).unwrap()
}

fn metrics(data: &Dataset, out: &str) -> Value {
    serde_json::from_str(&read(data, &format!("{out}/metrics.json"))).unwrap()
}

#[test]
fn each_camera_is_held_out_in_turn_with_the_numbers_of_holding_it_out_alone() {
    let data = write_dataset().unwrap();
    let finished = eval(&data, &["--orbit", "out/eval/walk.mp4"]);
    assert_eq!(finished.code, Some(0), "{finished:?}");
    assert!(
        finished.stderr.contains("eval: pose given with the take, masks given with the take, shape given"),
        "{finished:?}"
    );
    assert!(finished.stdout.contains("Each camera was held out in turn"), "{}", finished.stdout);
    let turned = metrics(&data, "out/eval");
    assert_eq!((&turned["in_turn"], turned["holdout"].as_array().unwrap().len()), (&true.into(), 7));
    assert_eq!(turned["frames"], FRAMES);
    for verdict in turned["verdicts"].as_array().unwrap() {
        assert!(verdict["outline_px"].as_f64().unwrap() < 2.0, "{verdict}");
    }

    // No other camera's reconstruction reaches that of 01.
    let alone = eval(&data, &["--inputs", "00,02,03,04,05,06", "--holdout", "01", "--out", "alone"]);
    assert_eq!(alone.code, Some(0), "{alone:?}");
    let of_01 = |metrics: &Value| -> Vec<Value> {
        let frames = metrics["per_frame"].as_array().unwrap();
        frames.iter().filter(|score| score["camera"] == "01").cloned().collect()
    };
    let (turned, alone) = (of_01(&turned), of_01(&metrics(&data, "alone")));
    assert_eq!((turned.len() as u64, &turned), (FRAMES, &alone));

    let html = read(&data, "out/eval/index.html");
    for words in [
        "Camera 06 is ",
        "FLIP is the share",
        "held-out 03: mask green, ours magenta",
        "href=\"take.html\"",
        "href=\"walk.mp4\"",
    ] {
        assert!(html.contains(words), "{words}");
    }
    assert!(!html.contains("http"), "self-contained");
    let page = read(&data, "out/eval/take.html");
    assert!(page.contains("<title>data</title>") && !page.contains("http") && !page.contains("src="), "one file");

    // The film lasts a whole turn, and the person is in the middle of its first and last image.
    let film = data.root.parent().unwrap().join("out/eval/walk.mp4");
    let mut video = VideoReplay::open(&"film".into(), &film, &VideoOptions::default()).unwrap();
    let images: Vec<_> = std::iter::from_fn(|| video.next_frame(Duration::ZERO).ok()).collect();
    assert!(images.len() > 200, "{}", images.len());
    for image in [images.first().unwrap(), images.last().unwrap()] {
        let rgb = flyrig_capture::to_rgb8(&image.image).unwrap();
        let (width, height) = (image.image.width() as usize, image.image.height() as usize);
        let at = |x: usize, y: usize| &rgb[3 * (y * width + x)..][..3];
        let differs = |y: usize| at(width / 2, y).iter().zip(at(5, 5)).any(|(a, b)| a.abs_diff(*b) > 20);
        let rows = (height / 8..height - height / 8).filter(|&y| differs(y)).count();
        assert!(rows > height / 3, "{rows} of {height} rows show the person");
    }
}

#[test]
fn three_cameras_and_one_say_what_is_possible() {
    let data = write_dataset().unwrap();
    for (inputs, words, cameras) in [("00,02,05", "Three cameras: no number", 3), ("00", "One camera: no number", 1)] {
        let finished = eval(&data, &["--inputs", inputs, "--out", "few"]);
        assert_eq!(finished.code, Some(0), "{finished:?}");
        assert!(finished.stdout.contains(words), "{}", finished.stdout);
        let metrics = metrics(&data, "few");
        assert!(metrics["mean"].is_null() && metrics["holdout"].as_array().unwrap().is_empty());
        assert_eq!(metrics["verdicts"].as_array().unwrap().len(), cameras, "{}", metrics["verdicts"]);
        let html = read(&data, "few/index.html");
        assert!(html.contains(words) && html.contains("inputs") && !html.contains("PSNR dB"));
        assert!(read(&data, "few/take.html").contains("<title>data"));
        std::fs::remove_dir_all(data.root.parent().unwrap().join("few")).unwrap();
    }
}

#[test]
fn a_camera_that_looks_beside_is_named_with_its_remedy() {
    let data = write_dataset().unwrap();
    // As if camera 03 had been turned after the calibration: everything lies six pixels to the right.
    for frame in 0..FRAMES {
        for path in [data.picture("03", frame), data.mask("03", frame)] {
            let before = image::open(&path).unwrap();
            let mut after = before.clone();
            image::imageops::replace(&mut after, &before, 6, 0);
            after.save(&path).unwrap();
        }
    }
    let finished = eval(&data, &["--inputs", "00,02,03,05", "--out", "beside"]);
    assert_eq!(finished.code, Some(0), "{finished:?}");
    let metrics = metrics(&data, "beside");
    let verdict = |camera: &str| {
        let verdicts = metrics["verdicts"].as_array().unwrap();
        verdicts.iter().find(|verdict| verdict["camera"] == camera).unwrap().clone()
    };
    let moved = verdict("03");
    assert!((4.0..8.0).contains(&moved["outline_px"].as_f64().unwrap()), "{moved}");
    assert_eq!(moved["grade"], "bad");
    let html = read(&data, "beside/index.html");
    assert!(html.contains("03 disturbs the others: without it their outlines are"), "{}", finished.stdout);
    let next = html.split("Next: ").nth(1).unwrap().split('<').next().unwrap();
    assert!(next.starts_with("the outline of 03 is ") && next.contains("flyrig calibrate person data"), "{next}");
}

#[test]
fn what_the_take_lacks_is_estimated_and_what_is_named_stays() {
    let data = write_dataset().unwrap();
    let sources = |data: &Dataset, more: &[&str]| {
        // No such frame: the sources are chosen before.
        let args = [&["--inputs", "00,02", "--frames", "90..91", "--out", "none"], more].concat();
        let stderr = eval(data, &args).stderr;
        stderr.lines().find_map(|line| line.strip_prefix("eval: pose ").map(str::to_owned)).unwrap_or(stderr)
    };
    let given = "given with the take";
    assert_eq!(sources(&data, &[]), format!("{given}, masks {given}, shape {given}"));
    assert_eq!(sources(&data, &["--pose", "estimated"]), format!("estimated, masks {given}, shape estimated"));
    // Plates stand in for masks; the export has them.
    std::fs::remove_dir_all(data.root.join("mask/02")).unwrap();
    assert_eq!(sources(&data, &[]), format!("{given}, masks estimated, shape {given}"));
    std::fs::remove_dir_all(data.root.join("background")).unwrap();
    assert_eq!(sources(&data, &[]), "estimated, masks estimated, shape estimated");
    std::fs::remove_file(data.root.join("subject.glb")).unwrap();
    assert_eq!(sources(&data, &[]), "estimated, masks estimated, shape estimated");
    let refused = eval(&data, &["--pose", "given", "--masks", "given", "--out", "none"]);
    assert!(refused.code == Some(1) && refused.stderr.contains("mask"), "{refused:?}");

    // A camera without images is left out; a take without any says so.
    std::fs::remove_dir_all(data.root.join("images/06")).unwrap();
    let all = eval(&data, &["--frames", "90..91", "--out", "none"]);
    assert!(all.stderr.contains("without images, so left out: 06"), "{}", all.stderr);
}
