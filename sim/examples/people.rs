//! Writes a sheet of simulated people, one per seed.
//!
//! `cargo run --release -p flyrig-sim --example people -- OUT.jpg [COUNT] [COLUMNS] [FIRST_SEED] [HEIGHT_PX] [FOCAL_HEIGHTS] [TARGET_HEIGHT_M] [DEGREES]`

use std::error::Error;
use std::path::Path;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator, describe_person};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let out = args.first().map_or("people.jpg", String::as_str);
    let number = |index: usize, default: f64| args.get(index).map_or(Ok(default), |text| text.parse());
    let (count, columns) = (number(1, 48.0)? as u32, (number(2, 12.0)? as u32).max(1));
    let (first, height) = (number(3, 1.0)? as u64, number(4, 400.0)? as u32);
    let width = height * 9 / 20;
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut sheet = image::RgbImage::new(columns * width, count.div_ceil(columns) * height);
    for index in 0..count {
        let mut config = SimConfig { seed: first + u64::from(index), width, height, ..SimConfig::default() };
        config.cameras.count = 1;
        config.cameras.focal_heights = number(5, 1.52)?;
        config.cameras.target_height_m = number(6, 0.88)?;
        config.cameras.radial = [0.0; 2];
        let mut simulator = Simulator::new(&gpu, &config)?;
        // Turned by up to 50 degrees to either side by default.
        let degrees = number(7, f64::from(index * 37 % 101) - 50.0)?;
        let nanos = (degrees.rem_euclid(360.0) / 360.0 * config.motion.turn_secs * 1e9) as i64;
        let (picture, _) = simulator.capture(nanos, 0)?;
        for (i, pixel) in (0u32..).zip(picture.bytes().chunks_exact(3)) {
            let (x, y) = (index % columns * width + i % width, index / columns * height + i / width);
            sheet.put_pixel(x, y, image::Rgb([pixel[0], pixel[1], pixel[2]]));
        }
        println!("{}: {}", config.seed, describe_person(&config));
    }
    if Path::new(out).extension().is_some_and(|ending| ending == "jpg") {
        let mut file = std::io::BufWriter::new(std::fs::File::create(out)?);
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 78).encode_image(&sheet)?;
    } else {
        sheet.save(out)?;
    }
    println!("{out}");
    Ok(())
}
