//! Calibrates the extrinsic take of a caliscope project from its own corners and compares the result with its published
//! array.
//!
//!     cargo run --release -p flyrig-calib --example caliscope -- PROJECT
//!
//! PROJECT holds camera_array.toml and calibration/extrinsic/xy.csv. The board has 4 x 5 squares.

use std::{collections::BTreeMap, error::Error, path::PathBuf, time::Instant};

use flyrig_calib::{Board, BoardShot, BoardView, LensModel, Pattern, RigFit, RigOptions, SeenCorner, calibrate_rig};
use flyrig_types::{CameraId, Intrinsics, Lens};
use glam::DVec2;

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(std::env::args().nth(1).ok_or("which project?")?);
    let board = Board { columns: 4, rows: 5, square_mm: 54.0, pattern: Pattern::Chessboard };
    let (ids, lenses) = cameras(&std::fs::read_to_string(root.join("camera_array.toml"))?)?;
    let shots = shots(&std::fs::read_to_string(root.join("calibration/extrinsic/xy.csv"))?, &ids)?;
    println!(
        "{} cameras, {} shots, {} views",
        ids.len(),
        shots.len(),
        shots.iter().map(|s| s.views.len()).sum::<usize>()
    );
    for (name, options) in [
        ("poses alone", RigOptions::default()),
        ("with time offsets", RigOptions { lags: true, ..RigOptions::default() }),
        ("with lenses", RigOptions { lens: Some(LensModel::RadialTangential), ..RigOptions::default() }),
        (
            "with time offsets and lenses",
            RigOptions { lags: true, lens: Some(LensModel::RadialTangential), ..RigOptions::default() },
        ),
    ] {
        let start = Instant::now();
        match calibrate_rig(&board, &ids, &lenses, &shots, options) {
            Ok(fit) => print(name, &fit, start.elapsed().as_secs_f64()),
            Err(error) => println!("{name}: {error}"),
        }
    }
    Ok(())
}

fn print(name: &str, fit: &RigFit, secs: f64) {
    let boards = fit.shots.len();
    println!("{name}: rms {:.3} px, noise {:.3} px, {boards} boards, {secs:.2} s", fit.rms_px, fit.sigma_px);
    for (camera, found) in fit.rig.cameras.iter().zip(&fit.cameras) {
        println!(
            "  {}: rms {:.3} px, +- {:.3?} degrees mm, halves {:.3?}, offset {:.1} +- {:.1} ms",
            camera.id,
            found.rms_px,
            found.deviation.unwrap_or((f64::NAN, f64::NAN)),
            found.halves.unwrap_or((f64::NAN, f64::NAN)),
            1e3 * found.lag_s.0,
            1e3 * found.lag_s.1
        );
    }
}

fn cameras(text: &str) -> Result<(Vec<CameraId>, Vec<Intrinsics>), Box<dyn Error>> {
    let file: toml::Table = text.parse()?;
    let numbers = |value: &toml::Value| -> Option<Vec<f64>> {
        let number = |v: &toml::Value| v.as_float().or(v.as_integer().map(|i| i as f64));
        value.as_array()?.iter().map(number).collect()
    };
    let (mut ids, mut lenses) = (Vec::new(), Vec::new());
    let known = file.get("cameras").and_then(toml::Value::as_table).ok_or("no cameras")?;
    for (name, table) in known {
        let rows = table.get("matrix").and_then(|m| m.as_array()).ok_or("no matrix")?;
        let k: Vec<Vec<f64>> = rows.iter().map(numbers).collect::<Option<_>>().ok_or("no matrix")?;
        let d = table.get("distortions").and_then(numbers).ok_or("no distortions")?;
        let size = table.get("size").and_then(numbers).ok_or("no size")?;
        ids.push(name.as_str().into());
        lenses.push(Intrinsics {
            width: size[0] as u32,
            height: size[1] as u32,
            focal_px: DVec2::new(k[0][0], k[1][1]),
            center_px: DVec2::new(k[0][2], k[1][2]),
            lens: Lens::RadialTangential { radial: [d[0], d[1], d[4]], tangential: [d[2], d[3]] },
        });
    }
    Ok((ids, lenses))
}

fn shots(text: &str, ids: &[CameraId]) -> Result<Vec<BoardShot>, Box<dyn Error>> {
    let mut sets: BTreeMap<i64, BTreeMap<usize, BoardView>> = BTreeMap::new();
    for line in text.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let camera = ids.iter().position(|id| id.as_str() == cells[1]).ok_or("an unknown camera")?;
        let nanos = (cells[3].parse::<f64>()? * 1e9) as i64;
        let view = BoardView { camera, nanos, corners: Vec::new() };
        let pixel = DVec2::new(cells[6].parse()?, cells[7].parse()?);
        let corner = SeenCorner { index: cells[5].parse()?, pixel };
        sets.entry(cells[0].parse()?).or_default().entry(camera).or_insert(view).corners.push(corner);
    }
    let shot = |views: BTreeMap<usize, BoardView>| {
        let views: Vec<BoardView> = views.into_values().collect();
        let nanos = views.iter().map(|view| view.nanos).sum::<i64>() / views.len() as i64;
        BoardShot { nanos, views }
    };
    Ok(sets.into_values().map(shot).collect())
}
