//! Times the pose network on crops, one thread, and writes its landmarks. `assets/compare_runtimes.py` calls it to compare it
//! with other runtimes on the same crops.
//!
//! ```text
//! cargo bench -p flyrig-tracker --bench network -- CROPS.f32 LANDMARKS.f32
//! ```
//!
//! `CROPS.f32` holds crops of 256 x 256 x 3 numbers, RGB in 0..=1; `LANDMARKS.f32` receives 33 x 3 numbers a crop, metres.
//! Prints the elapsed time of each crop in milliseconds: median, least and most over 20 rounds. Without arguments it prints
//! its usage.

use std::path::Path;
use std::time::Instant;

use flyrig_tracker::PoseNet;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Numbers of one crop.
const CROP: usize = 256 * 256 * 3;
/// Rounds over all crops.
const ROUNDS: usize = 20;

fn main() -> Result<()> {
    // Cargo adds "--bench".
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let [crops, landmarks] = arguments.as_slice() else {
        println!("usage: CROPS.f32 LANDMARKS.f32");
        return Ok(());
    };
    let bytes = std::fs::read(crops)?;
    let numbers: Vec<f32> = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    if numbers.is_empty() || !numbers.len().is_multiple_of(CROP) {
        return Err(format!("{crops}: {} numbers are no crops of {CROP}", numbers.len()).into());
    }
    // Within a pool of one thread the network's products stay on that thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    for (name, with_mask) in [("all", true), ("no mask", false)] {
        let net = PoseNet::load(Path::new(""), with_mask)?;
        let mut found = Vec::new();
        let mut times = Vec::new();
        for round in 0..ROUNDS {
            for crop in numbers.chunks_exact(CROP) {
                let start = Instant::now();
                let points = pool.install(|| net.crop_world_landmarks(crop))?;
                times.push(1e3 * start.elapsed().as_secs_f64());
                if round == 0 {
                    found.extend(points.iter().flatten().flat_map(|value| (*value as f32).to_le_bytes()));
                }
            }
        }
        std::fs::write(landmarks, found)?;
        times.sort_by(f64::total_cmp);
        println!("{name}: {:.2} {:.2} {:.2}", times[times.len() / 2], times[0], times[times.len() - 1]);
    }
    Ok(())
}
