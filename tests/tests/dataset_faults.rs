//! Damaged data sets: the command fails with one clear line, or loses only the damaged image.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::{Dataset, FRAMES, Finished, run, write_dataset};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

fn eval(data: &Dataset, extra: &[&str]) -> Finished {
    let (root, out) = (data.root.to_str().unwrap().to_owned(), data.out().to_str().unwrap().to_owned());
    let mut args = vec!["eval", &root, "--inputs", "00,02,05", "--holdout", "01", "--out", &out];
    args.extend(["--gaussians", "4000", "--nodes", "200"]);
    args.extend(extra);
    run(PROGRAM, &args, data.root.parent().unwrap()).unwrap()
}

/// Asserts that the command failed with this text alone and left no results.
fn assert_refused(data: &Dataset, finished: &Finished, expected: &str) {
    assert_eq!(finished.code, Some(1), "{finished:?}");
    assert!(finished.stderr.contains(expected), "expected '{expected}' in: {}", finished.stderr);
    assert!(!finished.stderr.contains("panicked"), "{}", finished.stderr);
    assert!(!data.out().join("metrics.json").exists());
}

#[test]
fn a_missing_camera_is_named_with_the_existing_ones() {
    let data = write_dataset().unwrap();
    std::fs::remove_dir_all(data.root.join("images/02")).unwrap();
    let finished = eval(&data, &[]);
    assert_refused(&data, &finished, "02");
    assert!(finished.stderr.contains("00"), "lists what there is: {}", finished.stderr);

    // A calibration without image sizes gives the same error.
    let intri = data.root.join("intri.yml");
    let text = std::fs::read_to_string(&intri).unwrap();
    let sizeless: Vec<&str> = text.lines().filter(|line| !line.starts_with("H_") && !line.starts_with("W_")).collect();
    std::fs::write(&intri, sizeless.join("\n")).unwrap();
    assert_refused(&data, &eval(&data, &[]), "camera 02: is not in");

    let data = write_dataset().unwrap();
    let root = data.root.to_str().unwrap();
    let finished = run(
        PROGRAM,
        &["eval", root, "--inputs", "00,9", "--holdout", "01", "--out", "out"],
        data.root.parent().unwrap(),
    )
    .unwrap();
    assert_refused(&data, &finished, "camera 9 is not in the calibration");
}

#[test]
fn a_truncated_image_costs_that_image() {
    let data = write_dataset().unwrap();
    let path = data.picture("02", 1);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let finished = eval(&data, &[]);
    assert_eq!(finished.code, Some(0), "{finished:?}");
    assert!(finished.stderr.contains("camera 02") && finished.stderr.contains("going on"), "{}", finished.stderr);
    let metrics: serde_json::Value =
        serde_json::from_slice(&std::fs::read(data.out().join("metrics.json")).unwrap()).unwrap();
    assert_eq!(metrics["frames"], FRAMES, "every frame must be rendered");
    assert_eq!(metrics["sync"]["partial"], 1);
    assert_eq!(metrics["sync"]["broken_images"], 1);
}

#[test]
fn an_empty_mask_costs_that_view() {
    let data = write_dataset().unwrap();
    let black = image::GrayImage::new(flyrig_tests::SIDE, flyrig_tests::SIDE);
    for frame in 0..FRAMES {
        black.save(data.mask("05", frame)).unwrap();
    }
    let finished = eval(&data, &[]);
    assert_eq!(finished.code, Some(0), "{finished:?}");
    let metrics: serde_json::Value =
        serde_json::from_slice(&std::fs::read(data.out().join("metrics.json")).unwrap()).unwrap();
    assert_eq!(metrics["counts"]["without_mask"], FRAMES);
    assert!(finished.stderr.contains("camera=05") && finished.stderr.contains("no person"), "{}", finished.stderr);
    let psnr = metrics["mean"]["psnr_db"].as_f64().unwrap();
    assert!(psnr.is_finite() && psnr > 10.0, "{psnr}");
}

#[test]
fn a_mask_of_another_size_costs_that_image_and_names_both_sizes() {
    let data = write_dataset().unwrap();
    image::GrayImage::new(30, 20).save(data.mask("00", 0)).unwrap();
    let finished = eval(&data, &[]);
    assert_eq!(finished.code, Some(0), "{finished:?}");
    assert!(finished.stderr.contains("30x20") && finished.stderr.contains("160x160"), "{}", finished.stderr);
}

#[test]
fn nan_in_the_calibration_is_refused_by_file_and_camera() {
    let data = write_dataset().unwrap();
    let path = data.root.join("intri.yml");
    let text = std::fs::read_to_string(&path).unwrap();
    // Replace the first number of the first camera matrix.
    let start = text.find("K_00").unwrap();
    let data_at = start
        + text[start..].find("data:").unwrap()
        + text[start..][text[start..].find("data:").unwrap()..].find('[').unwrap()
        + 1;
    let end = data_at + text[data_at..].find(',').unwrap();
    std::fs::write(&path, format!("{} .Nan{}", &text[..data_at], &text[end..])).unwrap();
    let finished = eval(&data, &[]);
    assert_refused(&data, &finished, "intri.yml");
    assert!(finished.stderr.contains("00"), "{}", finished.stderr);
}

#[test]
fn other_mistakes_are_reported_in_one_line() {
    let data = write_dataset().unwrap();
    let both = eval(&data, &["--holdout", "02"]);
    assert_ne!(both.code, Some(0));
    std::fs::remove_file(data.root.join("subject.glb")).unwrap();
    let finished = eval(&data, &["--pose", "given"]);
    assert_refused(&data, &finished, "--pose given needs one skinned glTF file");
    let finished = eval(&data, &["--frames", "5..2"]);
    assert_eq!(finished.code, Some(2), "clap's own refusal: {}", finished.stderr);
    std::fs::write(data.root.join("subject.glb"), b"glTF\x02\0\0\0\xff\xff\xff\xff").unwrap();
    assert_refused(&data, &eval(&data, &[]), "subject.glb");
}
