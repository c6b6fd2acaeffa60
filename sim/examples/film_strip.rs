//! Writes film strips of a simulated person: one row per clip, with time advancing from left to right.
//!
//! `cargo run --release -p flyrig-sim --example film_strip -- OUT SEED CLIP [CLIP ...] [--columns N] [--height PX]
//! [--secs S] [--speed S] [--orbit DEGREES] [--focal HEIGHTS]`
//!
//! CLIP is a `motion.kind`; `SEED:CLIP@FROM` takes another person for its row and starts `FROM` seconds into the clip.
//! A row shows `--secs` seconds, otherwise one whole cycle; `--orbit` moves the camera around the person.

use std::error::Error;
use std::path::Path;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{SimConfig, Simulator};

/// Options after the clips.
struct Options {
    columns: u32,
    height: u32,
    secs: Option<f64>,
    speed: f64,
    orbit: f64,
    focal: f64,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let usage = "film_strip OUT SEED CLIP [CLIP ...]";
    let out = args.next().ok_or(usage)?;
    let seed: u64 = args.next().ok_or(usage)?.parse()?;
    let mut options = Options { columns: 10, height: 300, secs: None, speed: 1.0, orbit: 0.0, focal: 1.45 };
    let mut clips = Vec::new();
    while let Some(arg) = args.next() {
        let mut number = || -> Result<f64, Box<dyn Error>> { Ok(args.next().ok_or("a number is missing")?.parse()?) };
        match arg.as_str() {
            "--columns" => options.columns = number()?.max(1.0) as u32,
            "--height" => options.height = number()? as u32,
            "--secs" => options.secs = Some(number()?),
            "--speed" => options.speed = number()?,
            "--orbit" => options.orbit = number()?,
            "--focal" => options.focal = number()?,
            clip => clips.push(clip.to_owned()),
        }
    }
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let width = options.height * 11 / 20;
    let mut strip = image::RgbImage::new(options.columns * width, clips.len() as u32 * options.height);
    for (row, clip) in (0u32..).zip(&clips) {
        let (seed, kind) = match clip.split_once(':') {
            Some((seed, kind)) => (seed.parse()?, kind),
            None => (seed, clip.as_str()),
        };
        let (kind, from) = match kind.split_once('@') {
            Some((kind, from)) => (kind, from.parse()?),
            None => (kind, 0.0),
        };
        let text =
            format!("seed = {seed}\nwidth = {width}\nheight = {}\n[motion]\nkind = \"{kind}\"\n", options.height);
        let mut config: SimConfig = toml::from_str(&text)?;
        config.motion.speed = options.speed;
        // One of twelve cameras stands at the wanted angle.
        config.cameras.count = 12;
        config.cameras.focal_heights = options.focal;
        config.cameras.target_height_m = 0.92;
        config.cameras.radial = [0.0; 2];
        let slot = (options.orbit / 30.0).rem_euclid(12.0) as usize;
        let mut simulator = Simulator::new(&gpu, &config)?;
        let round = simulator.track().span_nanos().1 as f64 * 1e-9;
        for column in 0..options.columns {
            let secs = from + options.secs.unwrap_or(round) * f64::from(column) / f64::from(options.columns);
            let (picture, _) = simulator.capture((secs * 1e9) as i64, slot)?;
            for (i, pixel) in (0u32..).zip(picture.bytes().chunks_exact(3)) {
                let (x, y) = (column * width + i % width, row * options.height + i / width);
                strip.put_pixel(x, y, image::Rgb([pixel[0], pixel[1], pixel[2]]));
            }
        }
        println!("{kind}: {round:.2} s a round");
    }
    if Path::new(&out).extension().is_some_and(|ending| ending == "jpg") {
        let mut file = std::io::BufWriter::new(std::fs::File::create(&out)?);
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 80).encode_image(&strip)?;
    } else {
        strip.save(&out)?;
    }
    println!("{out}");
    Ok(())
}
