//! Simulated cameras in, the held-out ones come out like the truth, and each part of the method earns its place.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_tests::{Dataset, FRAMES, SIDE, run, write_dataset};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

fn eval(data: &Dataset, inputs: &str, mode: &str) -> serde_json::Value {
    let (root, out) = (data.root.to_str().unwrap().to_owned(), data.out().to_str().unwrap().to_owned());
    let args = [
        "eval",
        &root,
        "--inputs",
        inputs,
        "--holdout",
        "01,03,04,06",
        "--out",
        &out,
        "--gaussians",
        "12000",
        "--nodes",
        "800",
        "--appearance",
        mode,
    ];
    let finished = run(PROGRAM, &args, data.root.parent().unwrap()).unwrap();
    assert_eq!(finished.code, Some(0), "{finished:?}");
    serde_json::from_slice(&std::fs::read(data.out().join("metrics.json")).unwrap()).unwrap()
}

#[test]
fn held_out_views_are_predicted_and_no_part_of_the_method_loses() {
    let data = write_dataset().unwrap();
    let mean = |metrics: &serde_json::Value, key: &str| metrics["mean"][key].as_f64().unwrap();
    // A single view, where most of the person is unseen, and three.
    let [_, full] = ["00", "00,02,05"].map(|inputs| {
        let steps = ["direct-no-space-time", "direct-no-time", "direct"].map(|mode| eval(&data, inputs, mode));
        for (name, metrics) in ["projection", "space", "full"].iter().zip(&steps) {
            println!(
                "{inputs} {name}: PSNR {:.2} SSIM {:.4} FLIP {:.4} IoU {:.4}",
                mean(metrics, "psnr_db"),
                mean(metrics, "ssim"),
                mean(metrics, "flip"),
                mean(metrics, "iou")
            );
        }
        for pair in steps.windows(2) {
            assert!(mean(&pair[1], "psnr_db") >= mean(&pair[0], "psnr_db") - 0.02, "{inputs}");
            assert!(mean(&pair[1], "ssim") >= mean(&pair[0], "ssim") - 0.001, "{inputs}");
        }
        let [.., full] = steps;
        full
    });
    assert!(mean(&full, "psnr_db") > 22.0 && mean(&full, "iou") > 0.85);

    // What was promised lies in the folder.
    let picture = image::open(data.out().join("03/000002.png")).unwrap();
    assert_eq!((picture.width(), picture.height(), picture.color()), (SIDE, SIDE, image::ColorType::Rgba8));
    assert_eq!(full["frames"], FRAMES);
    assert!(std::fs::read(data.out().join("surface/000000.ply")).unwrap().starts_with(b"ply"));
    let html = std::fs::read_to_string(data.out().join("index.html")).unwrap();
    assert!(html.contains("data:image/png;base64,") && !html.contains("http"), "self-contained");
}
