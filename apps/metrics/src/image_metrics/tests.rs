//! Hand-made cases, and values from OpenCV's Gaussian blur.

use super::*;

/// A reproducible image with structure; the same formula made the OpenCV figures below.
fn waves(width: u32, height: u32, phase: f64) -> Picture {
    let value = |x: u32, y: u32, c: u32| {
        let (x, y, c) = (f64::from(x), f64::from(y), f64::from(c));
        ((0.7 * x + 0.3 * y * (c + 1.0) + phase).sin() * 100.0 + 128.0) as u8
    };
    let bytes: Vec<u8> =
        (0..height).flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| value(x, y, c)))).collect();
    Picture::from_rgb8(width, height, &bytes).unwrap()
}

#[test]
fn agrees_with_opencv() {
    // numpy and cv2.GaussianBlur((11, 11), 1.5, BORDER_REFLECT_101) on the same boxes, data range 1.
    let (a, b) = (waves(40, 30, 0.0), waves(40, 30, 0.4));
    for (area, expected_psnr, expected_ssim) in OPENCV {
        assert!((psnr(&a, &b, area).unwrap() - expected_psnr).abs() < 1e-4, "{area:?} {}", psnr(&a, &b, area).unwrap());
        assert!((ssim(&a, &b, area).unwrap() - expected_ssim).abs() < 1e-6, "{area:?} {}", ssim(&a, &b, area).unwrap());
    }
}

const OPENCV: [(PixelBox, f64, f64); 3] = [
    ([0, 0, 40, 30], 19.163_035_959, 0.913_514_686_694),
    ([5, 3, 25, 19], 19.157_035_831, 0.911_640_411_074),
    ([7, 7, 11, 10], 19.296_870_593, 0.843_398_525_626),
];

#[test]
fn equal_images_are_perfect() {
    let a = waves(20, 20, 0.0);
    let area = [2, 2, 18, 18];
    assert!((psnr(&a, &a, area).unwrap() - MAX_PSNR_DB).abs() < 1e-12);
    assert!((ssim(&a, &a, area).unwrap() - 1.0).abs() < 1e-12);
    let map = flip(&a, &a, area).unwrap();
    assert!(map.mean.abs() < 1e-6 && map.error.len() == 256);
    assert_eq!(map.to_rgb8()[..3], [0, 0, 4], "magma begins nearly black");
}

#[test]
fn flip_grows_with_the_error_and_sees_only_the_box() {
    let black = Picture::from_rgb8(32, 32, &[0; 32 * 32 * 3]).unwrap();
    let mut half = vec![0; 32 * 32 * 3];
    half[..16 * 32 * 3].fill(255);
    let half = Picture::from_rgb8(32, 32, &half).unwrap();
    let mean = |area| flip(&black, &half, area).unwrap().mean;
    assert!(mean([0, 0, 32, 16]) > 0.9, "{}", mean([0, 0, 32, 16]));
    assert!(mean([0, 16, 32, 32]) < 1e-6);
    let map = flip(&black, &half, [0, 0, 32, 32]).unwrap();
    let average = map.error.iter().map(|&e| f64::from(e)).sum::<f64>() / map.error.len() as f64;
    assert!((map.mean - average).abs() < 1e-3);
    assert!(map.to_rgb8().iter().any(|&c| c > 200));
}

#[test]
fn psnr_of_a_known_error() {
    let a = Picture::new(4, 4, vec![[0.5; 3]; 16]).unwrap();
    let b = Picture::new(4, 4, vec![[0.6; 3]; 16]).unwrap();
    assert!((psnr(&a, &b, [0, 0, 4, 4]).unwrap() - 20.0).abs() < 1e-4);
    // A box over the border is cut, as everywhere.
    assert!((psnr(&a, &b, [3, 3, 100, 100]).unwrap() - 20.0).abs() < 1e-4);
}

#[test]
fn images_composite_without_rounding() {
    let rgba = [100, 200, 50, 128, 10, 20, 30, 0];
    let black = Picture::on_black(2, 1, &rgba).unwrap();
    assert!((black.pixels()[0][0] - 100.0 / 255.0 * (128.0 / 255.0)).abs() < 1e-7);
    assert_eq!(black.pixels()[1].map(f32::to_bits), [0; 3]);
    let plate = Picture::from_rgb8(2, 1, &[255, 0, 255, 1, 2, 3]).unwrap();
    let scene = Picture::over(2, 1, &rgba, &plate).unwrap();
    assert!((scene.pixels()[0][0] - (black.pixels()[0][0] + 127.0 / 255.0)).abs() < 1e-6);
    assert_eq!(scene.pixels()[1].map(f32::to_bits), plate.pixels()[1].map(f32::to_bits));
}

#[test]
fn refusals_say_what_is_wrong() {
    let a = waves(20, 20, 0.0);
    let b = waves(20, 10, 0.0);
    for error in [psnr(&a, &b, [0, 0, 5, 5]).unwrap_err(), flip(&a, &b, [0, 0, 5, 5]).unwrap_err()] {
        assert_eq!(error.to_string(), "images of different size cannot be compared: 20x20 and 20x10");
    }
    for area in [[5, 5, 5, 9], [20, 0, 30, 5], [9, 9, 3, 3]] {
        for error in [psnr(&a, &a, area).unwrap_err(), ssim(&a, &a, area).unwrap_err(), flip(&a, &a, area).unwrap_err()]
        {
            assert!(matches!(error, MetricError::EmptyBox { .. }), "{error}");
        }
    }
    assert!(Picture::from_rgb8(3, 3, &[0; 26]).is_err());
    let error = Picture::new(2, 1, vec![[0.0; 3], [0.0, f32::NAN, 0.0]]).unwrap_err();
    assert_eq!(error.to_string(), "pixel (1, 0) is not a finite number");
}

#[test]
fn person_boxes_and_mask_overlap() {
    let mut coverage = vec![0; 40 * 30];
    coverage[12 * 40 + 15] = 128;
    coverage[12 * 40 + 38] = 255;
    let mask = Mask::new(40, 30, coverage).unwrap();
    assert_eq!(person_box(&mask, BOX_MARGIN_PX).unwrap(), [5, 2, 40, 23]);
    let empty = Mask::new(40, 30, vec![127; 40 * 30]).unwrap();
    assert_eq!(person_box(&empty, 10).unwrap_err(), MetricError::EmptyMask);
    let full = Mask::new(40, 30, vec![255; 40 * 30]).unwrap();
    assert!((mask_iou(&mask, &full).unwrap() - 2.0 / 1200.0).abs() < 1e-12);
    assert!(mask_iou(&empty, &empty).unwrap().abs() < 1e-12);
    assert!(mask_iou(&full, &Mask::new(1, 1, vec![255]).unwrap()).is_err());
}
