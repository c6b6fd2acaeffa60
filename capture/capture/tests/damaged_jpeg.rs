//! Damaged JPEG images of cameras that decode: few are used, and good ones are not refused, whatever the scene does.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use std::{collections::BTreeMap, time::Instant};

use ac_ffmpeg::{
    codec::{
        Encoder as _,
        video::{PixelFormat as FramePixels, VideoEncoder, VideoFrameMut, VideoFrameScaler},
    },
    time::{TimeBase, Timestamp},
};
use flyrig_capture::{Decoding, FrameStage as _};
use flyrig_types::{Frame, Image, PixelFormat};
use jpeg_encoder::{ChromaSubsamplingMethod, ColorType, SamplingFactor};
use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

/// Mean difference from the undamaged image from which damage does harm, grey levels.
const HARM: f64 = 3.0;

struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n.max(1)
    }

    /// Returns a number from -1 to 1, most often near 0.
    fn bell(&mut self) -> f32 {
        (0..4).map(|_| self.below(2001) as f32 / 1000.0 - 1.0).sum::<f32>() / 4.0
    }
}

/// Scene before a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    /// Walls, floor, furniture with straight edges, texture, a person who walks.
    Room,
    /// That scene at a fiftieth of the light.
    Dark,
    /// Colours that change slowly.
    Gradient,
    /// A value of its own for each pixel.
    Noise,
}

/// Scene in front of a camera that does not move: linear values of red, green and blue.
struct Scene {
    kind: Kind,
    size: [usize; 2],
    background: Vec<[f32; 3]>,
    light: f32,
    person: Option<f32>,
    random: Random,
}

impl Scene {
    fn new(kind: Kind, size: [usize; 2], seed: u64) -> Self {
        let mut scene =
            Self { kind, size, background: Vec::new(), light: 1.0, person: Some(0.3), random: Random(seed * 977 + 5) };
        scene.background = scene.draw();
        scene
    }

    fn draw(&mut self) -> Vec<[f32; 3]> {
        let [width, height] = self.size;
        let mut pixels = vec![[128.0f32; 3]; width * height];
        let position = |i: usize| ((i % width) as f32 / width as f32, (i / width) as f32 / height as f32);
        match self.kind {
            Kind::Noise => {}
            Kind::Gradient => {
                let slopes: [f32; 6] = std::array::from_fn(|_| 250.0 * self.random.bell());
                for (i, pixel) in pixels.iter_mut().enumerate() {
                    let (x, y) = position(i);
                    *pixel = [0, 2, 4].map(|c| 128.0 + slopes[c] * (x - 0.5) + slopes[c + 1] * (y - 0.5));
                }
            }
            Kind::Room | Kind::Dark => {
                let floor = height / 2 + self.random.below(height / 3);
                for (i, pixel) in pixels.iter_mut().enumerate() {
                    *pixel = if i / width < floor { [170.0, 175.0, 165.0] } else { [95.0, 85.0, 70.0] };
                }
                for _ in 0..10 {
                    let [left, top] = self.size.map(|side| self.random.below(side));
                    let [across, down] = self.size.map(|side| 4 + self.random.below(side / 3));
                    let color = [0; 3].map(|_| self.random.below(256) as f32);
                    for y in top..(top + down).min(height) {
                        pixels[y * width + left..y * width + (left + across).min(width)].fill(color);
                    }
                }
                for scale in [64, 32, 16, 8, 4, 2] {
                    self.add_texture(&mut pixels, scale);
                }
            }
        }
        pixels
    }

    /// Adds a smooth random field of one scale, pixels.
    fn add_texture(&mut self, pixels: &mut [[f32; 3]], scale: usize) {
        let across = self.size[0] / scale + 2;
        let knots: Vec<[f32; 3]> = (0..across * (self.size[1] / scale + 2))
            .map(|_| [0; 3].map(|_| self.random.bell() * 6.0 * (scale as f32).sqrt()))
            .collect();
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let (x, y) = (i % self.size[0], i / self.size[0]);
            let (column, row) = (x / scale, y / scale);
            let (u, v) = ((x % scale) as f32 / scale as f32, (y % scale) as f32 / scale as f32);
            for (c, value) in pixel.iter_mut().enumerate() {
                let knot = |dx: usize, dy: usize| knots[(row + dy) * across + column + dx][c];
                let (upper, lower) = (knot(0, 0) * (1.0 - u) + knot(1, 0) * u, knot(0, 1) * (1.0 - u) + knot(1, 1) * u);
                *value += upper * (1.0 - v) + lower * v;
            }
        }
    }

    /// Returns the next image: 3 bytes per pixel. The person walks in and out; now and then the light is switched, a
    /// flash lights all rows or, by the rolling shutter, some of them, or the camera sees another scene altogether.
    fn next(&mut self) -> Vec<u8> {
        let [width, height] = self.size;
        let mut flash = (1.0, 0, 0);
        match self.random.below(60) {
            0 => self.light = if self.light < 1.0 { 1.0 } else { 0.15 + 0.5 * self.random.below(100) as f32 / 100.0 },
            1 => flash = (1.5 + self.random.below(20) as f32 / 10.0, 0, height),
            2 => flash = (2.0, self.random.below(height), 1 + self.random.below(height)),
            3 => self.background = self.draw(),
            4 | 5 => self.person = self.person.is_none().then(|| self.random.below(100) as f32 / 100.0),
            _ => {}
        }
        self.person = self.person.map(|x| (x + 0.02).rem_euclid(1.0));
        let light = self.light * if self.kind == Kind::Dark { 0.02 } else { 1.0 };
        let center = self.person.map(|x| x * width as f32);
        let mut bytes = Vec::with_capacity(3 * width * height);
        for (i, pixel) in self.background.iter().enumerate() {
            let (x, y) = (i % width, i / width);
            let (across, down) = (width as f32 / 14.0, height as f32 / 2.5);
            let is_person = center.is_some_and(|center| {
                let (u, v) = ((x as f32 - center) / across, (y as f32 - height as f32 * 0.55) / down);
                u * u + v * v < 1.0
            });
            let color = match self.kind {
                Kind::Noise => [0; 3].map(|_| self.random.below(256) as f32),
                _ if is_person => [150.0 + 60.0 * (y as f32 / 9.0).sin(), 90.0, 60.0],
                _ => *pixel,
            };
            let lit = if (flash.1..flash.1 + flash.2).contains(&y) { light * flash.0 } else { light };
            let noise = 3.0 * self.random.bell();
            bytes.extend(color.map(|value| (value * lit + noise).clamp(0.0, 255.0) as u8));
        }
        bytes
    }
}

/// Encoder of a camera.
enum Encoder {
    /// 4:2:0 as libjpeg writes it; quality, MCUs between two restart markers.
    Subsampled(u8, u16),
    /// 4:4:4 with the standard's Huffman tables; quality.
    Plain(u8),
    /// FFmpeg with 4:2:2 and the standard's Huffman tables, as most USB cameras.
    Usb(Box<(VideoEncoder, VideoFrameScaler)>, i64),
}

impl Encoder {
    fn usb([width, height]: [usize; 2], quality: u32) -> Self {
        let [rgb, format]: [FramePixels; 2] = ["rgb24", "yuvj422p"].map(|name| name.parse().unwrap());
        let encoder = VideoEncoder::builder("mjpeg").unwrap().pixel_format(format).width(width).height(height);
        let encoder = encoder
            .time_base(TimeBase::new(1, 30))
            .set_option("flags", "+qscale")
            .set_option("global_quality", 118 * quality)
            .set_option("huffman", "default");
        let scaler = VideoFrameScaler::builder().source_pixel_format(rgb).source_width(width).source_height(height);
        let scaler = scaler.target_pixel_format(format).target_width(width).target_height(height);
        Self::Usb(Box::new((encoder.build().unwrap(), scaler.build().unwrap())), 0)
    }

    fn encode(&mut self, rgb: &[u8], [width, height]: [usize; 2]) -> Vec<u8> {
        match self {
            Self::Subsampled(quality, interval) => {
                let mut bytes = Vec::new();
                let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, *quality);
                encoder.set_sampling_factor(SamplingFactor::R_4_2_0);
                encoder.set_chroma_subsampling_method(ChromaSubsamplingMethod::Average);
                encoder.set_restart_interval(*interval);
                encoder.encode(rgb, width as u16, height as u16, ColorType::Rgb).unwrap();
                bytes
            }
            Self::Plain(quality) => {
                let mut bytes = Vec::new();
                let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, *quality);
                encoder.encode(rgb, width as u32, height as u32, image::ExtendedColorType::Rgb8).unwrap();
                bytes
            }
            Self::Usb(parts, count) => {
                let (encoder, scaler) = &mut **parts;
                let mut frame = VideoFrameMut::black("rgb24".parse().unwrap(), width, height);
                for (line, row) in frame.planes_mut()[0].lines_mut().zip(rgb.chunks_exact(3 * width)) {
                    line[..row.len()].copy_from_slice(row);
                }
                *count += 1;
                let time_base = TimeBase::new(1, 30);
                let frame = frame.with_time_base(time_base).with_pts(Timestamp::new(*count, time_base)).freeze();
                encoder.push(scaler.scale(&frame).unwrap()).unwrap();
                encoder.take().unwrap().unwrap().data().to_vec()
            }
        }
    }
}

/// Marker segments up to the scan: position and marker.
fn segments(bytes: &[u8]) -> Vec<(usize, u8)> {
    let (mut found, mut at) = (Vec::new(), 2);
    while let Some(&[0xff, marker, high, low]) = bytes.get(at..at + 4) {
        found.push((at, marker));
        if marker == 0xda {
            break;
        }
        at += 2 + usize::from(u16::from_be_bytes([high, low]));
    }
    found
}

/// Splits off the Huffman tables, which USB cameras leave out.
fn without_tables(bytes: &[u8]) -> (Vec<u8>, Vec<u8>) {
    let found = segments(bytes);
    let (mut bare, mut tables) = (bytes[..2].to_vec(), Vec::new());
    for pair in found.windows(2) {
        let part = if pair[0].1 == 0xc4 { &mut tables } else { &mut bare };
        part.extend(&bytes[pair[0].0..pair[1].0]);
    }
    bare.extend(&bytes[found[found.len() - 1].0..]);
    (bare, tables)
}

const DAMAGE: [&str; 10] = [
    "one bit flipped",
    "up to 8 bits flipped",
    "one byte overwritten",
    "up to 64 bytes overwritten",
    "a packet of 1024 bytes lost",
    "up to 3 packets of 3072 bytes lost",
    "up to 64 bytes inserted",
    "cut, end marker appended",
    "up to 512 bytes zero",
    "joined with the next image",
];

/// Damages an image behind its start marker; the end marker stays.
fn damaged(bytes: &[u8], next: &[u8], kind: usize, random: &mut Random) -> Vec<u8> {
    let mut found = bytes.to_vec();
    let last = bytes.len() - 2;
    let at = 2 + random.below(last - 2);
    let run = |most: usize, random: &mut Random| at..(at + 1 + random.below(most)).min(last);
    match kind {
        0 => found[at] ^= 1 << random.below(8),
        1 => (0..1 + random.below(8)).for_each(|_| found[2 + random.below(last - 2)] ^= 1 << random.below(8)),
        2 => found[at] = random.below(256) as u8,
        3 => run(64, random).for_each(|i| found[i] = random.below(256) as u8),
        4 => drop(found.drain(at..(at + 1024).min(last))),
        5 => drop(found.drain(at..(at + 3072 * (1 + random.below(3))).min(last))),
        6 => drop(found.splice(at..at, (0..1 + random.below(64)).map(|_| random.below(256) as u8).collect::<Vec<_>>())),
        7 => drop(found.splice(at..last, [])),
        8 => found[run(512, random)].fill(0),
        // In the scan: before it, the result is the next image.
        _ => {
            let start = segments(bytes).last().map_or(0, |scan| scan.0 + 12);
            let at = start + random.below(bytes.len().min(next.len()).saturating_sub(start + 2));
            found.splice(at.., next[at..].iter().copied());
        }
    }
    found
}

/// Decodes without any check of its own, with tables that the camera left out; `None` where the decoder refuses.
fn pixels(bytes: &[u8], tables: &[u8]) -> Option<Vec<u8>> {
    let found = segments(bytes);
    let mut bytes = bytes.to_vec();
    if let (Some((scan, 0xda)), true) = (found.last(), found.iter().all(|segment| segment.1 != 0xc4)) {
        bytes.splice(*scan..*scan, tables.iter().copied());
    }
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(1280)
        .set_max_height(1280)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    JpegDecoder::new_with_options(ZCursor::new(&bytes[..]), options).decode().ok()
}

fn is_used(decoding: &mut Decoding, bytes: &[u8], [width, height]: [usize; 2]) -> Option<Vec<u8>> {
    let image = Image::new(width as u32, height as u32, PixelFormat::Mjpeg, bytes.to_vec()).unwrap();
    let frame = Frame { camera: "a".into(), sequence: 0, capture_nanos: 0, exposure_nanos: None, image, mask: None };
    decoding.process(frame).ok().map(|frame| frame.image.bytes().to_vec())
}

/// Counts of images.
#[derive(Debug, Default)]
struct Counts {
    good: usize,
    good_refused: usize,
    /// Damaged images by kind of damage: all, those that decode to something harmful, and those of them that were used.
    damaged: BTreeMap<usize, [usize; 3]>,
    /// Time of decoding a good image, seconds in all.
    seconds: f64,
}

/// Sends images of several cameras through decoding, one damaged one after each good one.
fn run(size: [usize; 2], images: usize) -> Counts {
    let kinds = [Kind::Room, Kind::Room, Kind::Room, Kind::Dark, Kind::Gradient, Kind::Room, Kind::Room, Kind::Noise];
    let across = size[0].div_ceil(16) as u16;
    let mut counts = Counts::default();
    let mut random = Random(11);
    for (camera, kind) in kinds.into_iter().enumerate() {
        let mut scene = Scene::new(kind, size, camera as u64);
        let mut encoder = match camera {
            0 => Encoder::Subsampled(50, 0),
            1 => Encoder::Subsampled(85, 0),
            2 => Encoder::Subsampled(80, across),
            3 | 6 => Encoder::Plain(80),
            5 => Encoder::usb(size, 9),
            _ => Encoder::usb(size, 4),
        };
        let mut decoding = Decoding::new(Some(size.map(|side| side as u32)));
        // A USB camera leaves out its tables; the other encoders make their own for each image.
        let is_bare = !matches!(encoder, Encoder::Subsampled(..));
        let mut shoot = || {
            let whole = encoder.encode(&scene.next(), size);
            if is_bare { without_tables(&whole) } else { (whole, Vec::new()) }
        };
        let (mut image, tables) = shoot();
        for i in 0..images / kinds.len() {
            let (next, _) = shoot();
            let started = Instant::now();
            let good = is_used(&mut decoding, &image, size);
            counts.seconds += started.elapsed().as_secs_f64();
            counts.good += 1;
            counts.good_refused += usize::from(good.is_none());
            let kind = i % DAMAGE.len();
            let bad = damaged(&image, &next, kind, &mut random);
            let [all, harmful, used] = counts.damaged.entry(kind).or_default();
            *all += 1;
            let is_bad_used = is_used(&mut decoding, &bad, size).is_some();
            let clean = good.or_else(|| pixels(&image, &tables));
            if let (Some(clean), Some(found)) = (clean, pixels(&bad, &tables))
                && clean.len() == found.len()
            {
                let sum: u64 = clean.iter().zip(&found).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
                let is_harmful = sum as f64 > HARM * clean.len() as f64;
                *harmful += usize::from(is_harmful);
                *used += usize::from(is_harmful && is_bad_used);
            }
            image = next;
        }
    }
    counts
}

fn check(counts: &Counts) -> (f64, f64) {
    let mut sums = [0; 3];
    println!("{:36} {:>8} {:>8} {:>8}", "damage", "images", "harmful", "used");
    for (kind, counts) in &counts.damaged {
        println!("{:36} {:>8} {:>8} {:>8}", DAMAGE[*kind], counts[0], counts[1], counts[2]);
        for (sum, count) in sums.iter_mut().zip(counts) {
            *sum += count;
        }
    }
    let (used, refused) = (
        100.0 * sums[2] as f64 / sums[1].max(1) as f64,
        100.0 * counts.good_refused as f64 / counts.good.max(1) as f64,
    );
    println!(
        "of {} damaged images {} decode and differ by more than {HARM} grey levels; {used:.2} % of them used",
        sums[0], sums[1]
    );
    println!("of {} good images {} refused: {refused:.3} %", counts.good, counts.good_refused);
    println!("{:.2} ms per good image, decoding and all checks", 1e3 * counts.seconds / counts.good.max(1) as f64);
    assert!(sums[1] > sums[0] / 4, "the damage did no harm");
    (used, refused)
}

#[test]
fn few_damaged_images_are_used_and_no_good_one_is_refused() {
    let (used, refused) = check(&run([320, 240], 1600));
    assert!(used <= 2.0, "{used} % of the harmful images used");
    assert!(refused <= 0.1, "{refused} % of the good images refused");
}

#[test]
#[ignore = "100,000 good and as many damaged images: `make test-long`"]
fn few_of_100000_damaged_images_are_used() {
    let (used, refused) = check(&run([640, 480], 100_000));
    assert!(used <= 2.0, "{used} % of the harmful images used");
    assert!(refused <= 0.1, "{refused} % of the good images refused");
    println!("1280x720:");
    check(&run([1280, 720], 800));
}
