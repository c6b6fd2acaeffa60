//! Writes a sheet of scenes, lamps and cameras: each kind of room, a switching lamp, a passer-by, occluding furniture,
//! and close-ups of blur, rolling shutter, defocus, a fisheye lens and noise.
//!
//! `cargo run --release -p flyrig-sim --example scenes -- OUT.jpg [SEED] [SIDE_PX]`

use std::error::Error;
use std::fs::File;
use std::io::BufWriter;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_sim::{LightConfig, LightSwitch, MotionKind, OpticsConfig, SceneKind, SensorConfig, SimConfig, Simulator};

const COLUMNS: u32 = 4;

/// Change of the configuration, time and camera of an image.
type Tile = (&'static str, fn(&mut SimConfig), f64, usize);

const TILES: [Tile; 16] = [
    ("studio", |_| {}, 0.3, 0),
    ("office", |c| c.scene.kind = SceneKind::Office, 0.9, 0),
    ("cluttered", |c| c.scene.kind = SceneKind::Cluttered, 1.5, 0),
    ("cluttered, another seed", |c| (c.scene.kind, c.scene.seed) = (SceneKind::Cluttered, Some(5)), 2.1, 4),
    ("lamps before a switch", lamps, 0.9, 1),
    ("lamps after it", lamps, 1.1, 1),
    ("studio, another seed", |c| c.scene.seed = Some(4), 0.7, 3),
    ("office, another camera", |c| (c.scene.kind, c.scene.seed) = (SceneKind::Office, Some(2)), 1.2, 5),
    ("passer-by", |c| (c.scene.kind, c.scene.passer_by) = (SceneKind::Office, true), 2.0, 0),
    ("passer-by later", |c| (c.scene.kind, c.scene.passer_by) = (SceneKind::Cluttered, true), 2.9, 0),
    ("furniture in the way", |c| (c.scene.occluders, c.cameras.height_m) = (5, 1.0), 0.6, 0),
    (
        "furniture in the way of another",
        |c| {
            (c.scene.kind, c.scene.seed) = (SceneKind::Office, Some(3));
            (c.scene.occluders, c.cameras.height_m) = (5, 1.1);
        },
        0.6,
        0,
    ),
    (
        "motion blur",
        |c| {
            fast(c);
            c.optics = vec![OpticsConfig { exposure_ms: 40.0, samples: 24, ..OpticsConfig::default() }];
        },
        0.55,
        0,
    ),
    (
        "rolling shutter",
        |c| {
            fast(c);
            c.optics = vec![OpticsConfig { readout_ms: 120.0, ..OpticsConfig::default() }];
        },
        0.55,
        0,
    ),
    (
        "defocus and noise",
        |c| {
            c.scene.kind = SceneKind::Cluttered;
            c.cameras.focal_heights = 2.6;
            c.cameras.target_height_m = 1.35;
            c.optics = vec![OpticsConfig { aperture_mm: 45.0, focus_m: 2.9, samples: 24, ..OpticsConfig::default() }];
            c.sensors = vec![SensorConfig {
                full_well_electrons: Some(900.0),
                read_noise_electrons: 8.0,
                vignetting: 0.5,
                ..SensorConfig::default()
            }];
        },
        0.1,
        0,
    ),
    (
        "fisheye",
        |c| {
            c.scene.kind = SceneKind::Office;
            c.cameras.fisheye = Some([0.05, -0.01, 0.0, 0.0]);
            c.cameras.focal_heights = 0.5;
            c.cameras.radius_m = 1.9;
        },
        0.1,
        1,
    ),
];

fn lamps(config: &mut SimConfig) {
    let blue = LightConfig {
        azimuth_deg: 35.0,
        elevation_deg: 30.0,
        intensity: 0.7,
        colour: [0.25, 0.45, 1.0],
        ..LightConfig::default()
    };
    let key =
        LightConfig { intensity: 0.75, switch: vec![LightSwitch { secs: 1.0, level: 0.0 }], ..LightConfig::default() };
    config.lights = vec![key, blue];
}

fn fast(config: &mut SimConfig) {
    (config.motion.kind, config.motion.speed) = (MotionKind::Dance, 2.0);
    config.cameras.focal_heights = 1.9;
    config.cameras.target_height_m = 1.15;
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let out = args.first().map_or("scenes.jpg", String::as_str);
    let number = |index: usize, default: u32| args.get(index).map_or(Ok(default), |text| text.parse());
    let (seed, side) = (number(1, 5)?, number(2, 320)?);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let mut sheet = image::RgbImage::new(COLUMNS * side, (TILES.len() as u32).div_ceil(COLUMNS) * side);
    for (index, (name, change, secs, slot)) in (0u32..).zip(TILES) {
        let mut config =
            SimConfig { seed: u64::from(seed + index / 2), width: side, height: side, ..SimConfig::default() };
        change(&mut config);
        let mut simulator = Simulator::new(&gpu, &config)?;
        let (picture, _) = simulator.capture((secs * 1e9) as i64, slot)?;
        for (i, pixel) in (0u32..).zip(picture.bytes().chunks_exact(3)) {
            let (x, y) = (index % COLUMNS * side + i % side, index / COLUMNS * side + i / side);
            sheet.put_pixel(x, y, image::Rgb([pixel[0], pixel[1], pixel[2]]));
        }
        println!("{name}");
    }
    image::codecs::jpeg::JpegEncoder::new_with_quality(BufWriter::new(File::create(out)?), 85).encode_image(&sheet)?;
    println!("{out}");
    Ok(())
}
