//! Evaluation on simulated cameras: held-out views match the ground truth, and every part of the method improves the scores.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::{Dataset, FRAMES, SIDE, run, write_dataset_of};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");
/// Seeds of the simulated people. Scores are averaged: a part may cost a single person slightly.
const SEEDS: [u64; 4] = [1, 2, 3, 4];
/// Appearance mode and solver, from the bare method to the complete one, one part at a time.
const STEPS: [[&str; 2]; 4] =
    [["direct-no-space-time", "none"], ["direct-no-time", "none"], ["direct", "none"], ["direct", "gauss-newton"]];

fn eval(data: &Dataset, inputs: &str, [mode, solver]: [&str; 2]) -> serde_json::Value {
    let (root, out) = (data.root.to_str().unwrap().to_owned(), data.out().to_str().unwrap().to_owned());
    let mut args = vec!["eval", &root, "--inputs", inputs, "--holdout", "01,03,04,06", "--out", &out];
    args.extend(["--gaussians", "12000", "--nodes", "800", "--appearance", mode, "--solver", solver]);
    let finished = run(PROGRAM, &args, data.root.parent().unwrap()).unwrap();
    assert_eq!(finished.code, Some(0), "{finished:?}");
    serde_json::from_slice(&std::fs::read(data.out().join("metrics.json")).unwrap()).unwrap()
}

#[test]
#[ignore = "minutes: run by make test-long"]
fn held_out_views_are_predicted_and_no_part_of_the_method_loses() {
    let people = SEEDS.map(|seed| write_dataset_of(seed).unwrap());
    // One view, which leaves most of the person unseen, and three views.
    for inputs in ["00", "00,02,05"] {
        let steps = STEPS.map(|step| {
            let scores: Vec<[f64; 4]> = people
                .iter()
                .map(|data| {
                    let metrics = eval(data, inputs, step);
                    ["psnr_db", "ssim", "flip", "iou"].map(|key| metrics["mean"][key].as_f64().unwrap())
                })
                .collect();
            let mean = [0, 1, 2, 3].map(|i| scores.iter().map(|s| s[i]).sum::<f64>() / scores.len() as f64);
            println!("{inputs} {step:?}: PSNR, SSIM, FLIP, IoU {mean:.4?} of {scores:.3?}");
            mean
        });
        let names = ["projection", "space", "time", "deformation"];
        for (i, pair) in steps.windows(2).enumerate() {
            assert!(pair[1][0] >= pair[0][0] - 0.02, "{inputs}: {} costs PSNR", names[i + 1]);
            assert!(pair[1][1] >= pair[0][1] - 0.001, "{inputs}: {} costs SSIM", names[i + 1]);
        }
        let [.., full] = steps;
        assert!(inputs == "00" || (full[0] > 22.0 && full[3] > 0.85), "{full:?}");
    }

    // The folder holds the documented files.
    let data = &people[0];
    let picture = image::open(data.out().join("03/000002.png")).unwrap();
    assert_eq!((picture.width(), picture.height(), picture.color()), (SIDE, SIDE, image::ColorType::Rgba8));
    let metrics: serde_json::Value =
        serde_json::from_slice(&std::fs::read(data.out().join("metrics.json")).unwrap()).unwrap();
    assert_eq!(metrics["frames"], FRAMES);
    assert!(std::fs::read(data.out().join("surface/000000.ply")).unwrap().starts_with(b"ply"));
    let html = std::fs::read_to_string(data.out().join("index.html")).unwrap();
    assert!(html.contains("data:image/png;base64,") && !html.contains("http"), "self-contained");
}
