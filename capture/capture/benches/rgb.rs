//! Run time and error of the conversion of uncompressed images to RGB.
//!
//!     cargo bench -p flyrig-capture --bench rgb
#![allow(clippy::unwrap_used)] // a benchmark may end by panicking

use std::time::Instant;

use flyrig_capture::to_rgb8_into;
use flyrig_types::{Image, PixelFormat};

const SIZE: [u32; 2] = [1280, 720];
const RUNS: usize = 101;

/// Converts by the definition of BT.601 with limited range.
fn reference([y, u, v]: [u8; 3]) -> [f64; 3] {
    let (kr, kb) = (0.299, 0.114);
    let y = (f64::from(y) - 16.0) / 219.0;
    let (pb, pr) = ((f64::from(u) - 128.0) / 224.0, (f64::from(v) - 128.0) / 224.0);
    let (r, b) = (y + 2.0 * (1.0 - kr) * pr, y + 2.0 * (1.0 - kb) * pb);
    [r, (y - kr * r - kb * b) / (1.0 - kr - kb), b].map(|c| 255.0 * c.clamp(0.0, 1.0))
}

fn main() {
    let pixels = (SIZE[0] * SIZE[1]) as usize;
    println!("{}x{}, median of {RUNS} runs, one thread", SIZE[0], SIZE[1]);
    println!("{:<8} {:>8} {:>12} {:>18}", "format", "ms", "ns a pixel", "max error, levels");
    for format in [PixelFormat::Yuyv, PixelFormat::Uyvy, PixelFormat::Nv12] {
        let bytes = if format == PixelFormat::Nv12 { pixels * 3 / 2 } else { pixels * 2 };
        let mut state = 3u64;
        let noise = std::iter::repeat_with(|| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as u8
        });
        let bytes: Vec<u8> = noise.take(bytes).collect();
        let yuv = |i: usize| match format {
            PixelFormat::Yuyv => [bytes[2 * i], bytes[i / 2 * 4 + 1], bytes[i / 2 * 4 + 3]],
            PixelFormat::Uyvy => [bytes[2 * i + 1], bytes[i / 2 * 4], bytes[i / 2 * 4 + 2]],
            _ => {
                let (x, y) = (i % SIZE[0] as usize, i / SIZE[0] as usize);
                let uv = pixels + y / 2 * SIZE[0] as usize + x / 2 * 2;
                [bytes[i], bytes[uv], bytes[uv + 1]]
            }
        };
        let image = Image::new(SIZE[0], SIZE[1], format, bytes.clone()).unwrap();
        let mut rgb = Vec::new();
        let mut millis: Vec<f64> = (0..RUNS)
            .map(|_| {
                let start = Instant::now();
                to_rgb8_into(&image, &mut rgb).unwrap();
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        millis.sort_by(f64::total_cmp);
        let error = |(i, found): (usize, &[u8])| {
            let expected = reference(yuv(i));
            (0..3).map(|k| (f64::from(found[k]) - expected[k]).abs()).fold(0.0, f64::max)
        };
        let worst = rgb.chunks_exact(3).enumerate().map(error).fold(0.0, f64::max);
        let median = millis[RUNS / 2];
        println!("{:<8} {median:>8.2} {:>12.2} {worst:>18.2}", format!("{format:?}"), median * 1e6 / pixels as f64);
    }
}
