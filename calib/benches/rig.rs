//! Benchmark of a rig's calibration on simulated corners: run time and errors over cameras, boards and noise.
//!
//!     cargo bench -p flyrig-calib --bench rig

use std::{error::Error, time::Instant};

use flyrig_calib::{
    Board, Pattern, RigOptions, calibrate_rig,
    testing::{Random, pose_errors, ring, shots},
};
use flyrig_types::{CameraId, Intrinsics};

/// Simulated rigs per row.
const SEEDS: u64 = 4;

fn main() -> Result<(), Box<dyn Error>> {
    println!(
        "| cameras | boards | noise px | corners | solve s | direction, degrees | place, mm | largest, mm | within two deviations |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    let rows = [(3, 50), (8, 50), (8, 100), (8, 200), (8, 400), (2, 100), (4, 100), (12, 100), (16, 100)];
    for (cameras, boards) in rows {
        row(cameras, boards, 0.2)?;
    }
    for noise_px in [0.05, 0.5, 1.0] {
        row(8, 100, noise_px)?;
    }
    Ok(())
}

fn row(cameras: usize, boards: usize, noise_px: f64) -> Result<(), Box<dyn Error>> {
    let board = Board { columns: 9, rows: 6, square_mm: 40.0, pattern: Pattern::Chessboard };
    let (mut secs, mut corners, mut errors, mut inside) = (0.0, 0, Vec::new(), 0);
    for seed in 0..SEEDS {
        let mut random = Random(1000 + seed);
        let truth = ring(&mut random, cameras);
        let shots = shots(&mut random, &board, &truth, boards, noise_px);
        let ids: Vec<CameraId> = truth.iter().map(|camera| camera.id.clone()).collect();
        let lenses: Vec<Intrinsics> = truth.iter().map(|camera| camera.intrinsics).collect();
        let start = Instant::now();
        let fit = calibrate_rig(&board, &ids, &lenses, &shots, RigOptions::default())?;
        secs += start.elapsed().as_secs_f64();
        corners += fit.cameras.iter().map(|camera| camera.corners.len()).sum::<usize>();
        for (camera, (deg, mm)) in fit.cameras[1..].iter().zip(pose_errors(&fit.rig.cameras, &truth)) {
            let (deg_sigma, mm_sigma) = camera.deviation.ok_or("no deviation")?;
            inside += usize::from(deg < 2.0 * deg_sigma) + usize::from(mm < 2.0 * mm_sigma);
            errors.push((deg, mm));
        }
    }
    let mean = |of: fn(&(f64, f64)) -> f64| errors.iter().map(of).sum::<f64>() / errors.len() as f64;
    println!(
        "| {cameras} | {boards} | {noise_px} | {} | {:.2} | {:.4} | {:.2} | {:.2} | {} of {} |",
        corners / SEEDS as usize,
        secs / SEEDS as f64,
        mean(|e| e.0),
        mean(|e| e.1),
        errors.iter().map(|e| e.1).fold(0.0, f64::max),
        inside,
        2 * errors.len()
    );
    Ok(())
}
