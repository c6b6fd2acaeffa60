//! Images for tests.

use jpeg_encoder::{ChromaSubsamplingMethod, ColorType, Encoder, SamplingFactor};

/// Encodes a picture that moves by `shift` as 4:2:0 with a restart marker after every `interval` MCUs; none for 0.
pub fn encoded(width: u16, height: u16, interval: u16, shift: i32) -> Vec<u8> {
    let (columns, rows) = (i32::from(width), i32::from(height));
    let value = |i: i32| {
        let (x, y) = (i / 3 % columns + shift, i / 3 / columns);
        (128.0 + 60.0 * (f64::from(x) / 9.0).sin() + 40.0 * (f64::from(y + i % 3) / 7.0).cos()) as u8
    };
    let bytes: Vec<u8> = (0..3 * columns * rows).map(value).collect();
    let mut jpeg = Vec::new();
    let mut encoder = Encoder::new(&mut jpeg, 85);
    encoder.set_sampling_factor(SamplingFactor::R_4_2_0);
    encoder.set_chroma_subsampling_method(ChromaSubsamplingMethod::Average);
    encoder.set_restart_interval(interval);
    encoder.encode(&bytes, width, height, ColorType::Rgb).unwrap();
    jpeg
}
