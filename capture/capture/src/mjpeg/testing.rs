//! Images for tests.

use opencv::{
    core::{Mat, MatTraitConst as _, Vector, VectorToVec as _},
    imgcodecs::{IMWRITE_JPEG_QUALITY, IMWRITE_JPEG_RST_INTERVAL, imencode},
};

/// Encodes a picture that moves by `shift` as 4:2:0 with a restart marker after every `interval` MCUs; none for 0.
pub fn encoded(width: i32, height: i32, interval: i32, shift: i32) -> Vec<u8> {
    let value = |i: i32| {
        let (x, y) = (i / 3 % width + shift, i / 3 / width);
        (128.0 + 60.0 * (f64::from(x) / 9.0).sin() + 40.0 * (f64::from(y + i % 3) / 7.0).cos()) as u8
    };
    let bytes: Vec<u8> = (0..3 * width * height).map(value).collect();
    let flat = Mat::from_slice(&bytes).unwrap();
    let mut jpeg = Vector::new();
    let options = Vector::from_slice(&[IMWRITE_JPEG_QUALITY, 85, IMWRITE_JPEG_RST_INTERVAL, interval]);
    imencode(".jpg", &flat.reshape(3, height).unwrap(), &mut jpeg, &options).unwrap();
    jpeg.to_vec()
}
