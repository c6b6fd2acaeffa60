//! Writes a contact sheet of simulated people: one row per seed, one column per camera, with time advancing from row to
//! row.
//!
//! `cargo run --release -p flyrig-sim --example contact_sheet -- OUT.png [SEEDS] [CAMERAS] [SIDE_PX] [FOCAL_HEIGHTS [TARGET_HEIGHT_M]]`

use std::error::Error;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{MotionKind, SimConfig, Simulator, find_debian_clip};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let out = args.first().map_or("contact_sheet.png", String::as_str);
    let number = |index: usize, default: u32| args.get(index).map_or(Ok(default), |text| text.parse());
    let (seeds, cameras, side) = (number(1, 4)?, number(2, 5)?, number(3, 384)?);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut sheet = image::RgbImage::new(cameras * side, seeds * side);
    for row in 0..seeds {
        let mut config = SimConfig { seed: u64::from(row) + 1, width: side, height: side, ..SimConfig::default() };
        config.cameras.count = cameras as usize;
        if let Some(focal_heights) = args.get(4) {
            // A close-up.
            config.cameras.focal_heights = focal_heights.parse()?;
            config.cameras.target_height_m = args.get(5).map_or(Ok(1.55), |height| height.parse())?;
            config.cameras.radial = [0.0; 2];
        }
        // Every third person moves by a clip where there is one.
        if row % 3 == 2 && find_debian_clip().is_ok() {
            config.motion.kind = MotionKind::Bvh;
        }
        let start = Instant::now();
        let mut simulator = Simulator::new(&gpu, &config)?;
        let setup = start.elapsed();
        let start = Instant::now();
        for column in 0..cameras {
            let nanos = simulator.frame_nanos(u64::from(row) * 45);
            let (picture, _) = simulator.capture(nanos, column as usize)?;
            for (i, pixel) in (0u32..).zip(picture.bytes().chunks_exact(3)) {
                let (x, y) = (column * side + i % side, row * side + i / side);
                sheet.put_pixel(x, y, image::Rgb([pixel[0], pixel[1], pixel[2]]));
            }
        }
        println!("seed {}: set up in {setup:.2?}, {:.2?} an image", row + 1, start.elapsed() / cameras);
    }
    sheet.save(out)?;
    println!("{out}");
    Ok(())
}
