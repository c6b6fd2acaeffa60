//! Writes a picture of each kind of scene, for as many seeds.
//!
//! `cargo run --release -p flyrig-sim --example scenes -- OUT.png [SEEDS] [SIDE_PX] [OCCLUDERS] [PASSER_BY]`

use std::error::Error;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SceneKind, SimConfig, Simulator};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let out = args.first().map_or("scenes.png", String::as_str);
    let number = |index: usize, default: u32| args.get(index).map_or(Ok(default), |text| text.parse());
    let (seeds, side) = (number(1, 1)?, number(2, 448)?);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let kinds = [SceneKind::Studio, SceneKind::Office, SceneKind::Cluttered];
    let mut sheet = image::RgbImage::new(3 * side, 3 * seeds * side);
    for row in 0..3 * seeds {
        let mut config = SimConfig { seed: u64::from(row / 3) + 1, width: side, height: side, ..SimConfig::default() };
        config.scene.kind = kinds[row as usize % 3];
        config.scene.occluders = number(3, 0)?;
        config.scene.passer_by = number(4, 0)? > 0;
        let start = std::time::Instant::now();
        let mut simulator = Simulator::new(&gpu, &config)?;
        println!("{:?} set up in {:.2?}", config.scene.kind, start.elapsed());
        for (column, slot) in [0, 2, 4].into_iter().enumerate() {
            let (picture, _) = simulator.capture(700_000_000, slot)?;
            for (i, pixel) in (0u32..).zip(picture.bytes().chunks_exact(3)) {
                let (x, y) = (column as u32 * side + i % side, row * side + i / side);
                sheet.put_pixel(x, y, image::Rgb([pixel[0], pixel[1], pixel[2]]));
            }
        }
    }
    sheet.save(out)?;
    println!("{out}");
    Ok(())
}
