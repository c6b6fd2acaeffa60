//! The image loss against a plain f64 reference, its derivatives against differences of that reference.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use flyrig_gpu::{GpuContext, StorageBuffer, testing::on_both};
use flyrig_renderer::{
    ImageGradients, ImageLoss, ImageSums, LossSettings, RenderTarget, WantedImage, linear_from_srgb,
};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

struct Case {
    source: [u32; 2],
    level: u32,
    rgba: Vec<u8>,
    drawn: Vec<[f32; 4]>,
    settings: LossSettings,
}

/// Halved image: premultiplied linear colour and coverage.
fn wanted(case: &Case) -> (usize, usize, Vec<[f64; 4]>) {
    let side = 1usize << case.level;
    let (width, height) = (case.source[0] as usize >> case.level, case.source[1] as usize >> case.level);
    let pixel = |at: usize| -> [f64; 4] {
        let mut sum = [0.0; 4];
        for v in 0..side {
            for u in 0..side {
                let i = 4 * ((at / width * side + v) * case.source[0] as usize + at % width * side + u);
                let mask = f64::from(case.rgba[i + 3]) / 255.0;
                for (c, sum) in sum.iter_mut().enumerate() {
                    let value =
                        if c < 3 { f64::from(linear_from_srgb(f32::from(case.rgba[i + c]) / 255.0)) } else { 1.0 };
                    *sum += value * mask / (side * side) as f64;
                }
            }
        }
        sum
    };
    (width, height, (0..width * height).map(pixel).collect())
}

/// Loss of one pixel at the drawn value `seen`.
fn pixel_loss(settings: &LossSettings, goal: [f64; 4], seen: [f64; 4]) -> f64 {
    let squared: f64 = (0..3).map(|c| (seen[c] - goal[c]).powi(2)).sum();
    f64::from(settings.color_weight) * squared + f64::from(settings.mask_weight) * (seen[3] - goal[3]).powi(2)
}

fn check(gpu: &GpuContext, loss: &mut ImageLoss, case: &Case, name: &str) {
    let (width, height, goal) = wanted(case);
    let target = RenderTarget::new(gpu, width as u32, height as u32).unwrap();
    target.color.write(gpu, &case.drawn);
    let picture = WantedImage::zeroed(gpu, case.source, case.level).unwrap();
    let image = StorageBuffer::from_bytes(gpu, "image", &case.rgba).unwrap();
    assert_eq!(picture.size(), [width as u32, height as u32]);
    let out = ImageGradients::zeroed(gpu, width as u32, height as u32).unwrap();
    loss.reserve(gpu, 2).unwrap();
    let run = || {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        loss.prepare(gpu, &mut encoder, &picture, &image, &case.settings);
        loss.encode(gpu, &mut encoder, 1, &target, &picture, &case.settings, &out);
        gpu.queue.submit([encoder.finish()]);
        (loss.read(gpu, 2).unwrap()[1], out.color.read(gpu).unwrap(), out.depth_carry.read(gpu).unwrap())
    };
    let (sums, color, carry) = run();
    assert!(run() == (sums, color.clone(), carry.clone()), "{name}: the same bytes again");

    let [left, top, right, bottom] = case.settings.area.map(|v| v as usize);
    let (right, bottom) = (right.min(width), bottom.min(height));
    let mut expected = ImageSums::default();
    let at_drawn = |at: usize| case.drawn[at].map(f64::from);
    let mut worst = [0.0f64; 2];
    for y in top..bottom {
        for x in left..right {
            let at = y * width + x;
            let (seen, goal_here) = (at_drawn(at), goal[at]);
            let squared: f64 = (0..3).map(|c| (seen[c] - goal_here[c]).powi(2)).sum();
            expected.loss += pixel_loss(&case.settings, goal_here, seen);
            expected.mask += (seen[3] - goal_here[3]).powi(2);
            expected.color += goal_here[3] * squared;
            expected.wanted += goal_here[3];
            for c in 0..4 {
                let moved = |by: f64| {
                    let mut seen = seen;
                    seen[c] += by;
                    pixel_loss(&case.settings, goal_here, seen)
                };
                let slope = (moved(1e-5) - moved(-1e-5)) / 2e-5;
                worst[0] = worst[0].max((slope - f64::from(color[at][c])).abs() / (1.0 + slope.abs()));
            }
            let inner = x > left && y > top && x + 1 < right && y + 1 < bottom;
            let mut bend = [0.0; 3];
            if inner {
                let slopes = |step: usize| -> [f64; 4] {
                    std::array::from_fn(|c| 0.5 * (at_drawn(at + step)[c] - at_drawn(at - step)[c]))
                };
                let (dx, dy) = (slopes(1), slopes(width));
                for c in 0..4 {
                    let weight = 2.0 * f64::from([case.settings.color_weight, case.settings.mask_weight][c / 3]);
                    for (bend, product) in bend.iter_mut().zip([dx[c] * dx[c], dx[c] * dy[c], dy[c] * dy[c]]) {
                        *bend += weight * product;
                    }
                }
            }
            for (k, bend) in bend.into_iter().enumerate() {
                worst[1] = worst[1].max((bend - f64::from(carry[at][k + 1])).abs() / (1.0 + bend.abs()));
            }
        }
    }
    let near = |a: f64, b: f64| (a - b).abs() < 1e-5 * (1.0 + b.abs());
    println!("{name}: loss {} of {}, slopes within {worst:?}", sums.loss, expected.loss);
    assert!(near(sums.loss, expected.loss) && near(sums.mask, expected.mask), "{name}: {sums:?} {expected:?}");
    assert!(near(sums.color, expected.color) && near(sums.wanted, expected.wanted), "{name}: {sums:?} {expected:?}");
    assert!(worst[0] < 1e-4 && worst[1] < 1e-4, "{name}: {worst:?}");
    // Outside of the area nothing was touched.
    for (at, (color, carry)) in color.iter().zip(&carry).enumerate() {
        let (x, y) = (at % width, at / width);
        if !((left..right).contains(&x) && (top..bottom).contains(&y)) {
            assert!(color.iter().chain(carry).all(|v| *v == 0.0), "{name}: {x} {y}");
        }
    }
}

fn case(rng: &mut StdRng, source: [u32; 2], level: u32, settings: LossSettings, coverage: Option<u8>) -> Case {
    let pixels = (source[0] * source[1]) as usize;
    let (center, radius) = ([source[0] as f32 * 0.4, source[1] as f32 * 0.5], source[1] as f32 * 0.3);
    let rgba = (0..pixels)
        .flat_map(|at| {
            let (x, y) = ((at as u32 % source[0]) as f32, (at as u32 / source[0]) as f32);
            let inside = radius - (x - center[0]).hypot(y - center[1]);
            let mask = coverage.unwrap_or((inside * 128.0 + 128.0).clamp(0.0, 255.0) as u8);
            [rng.random(), rng.random(), rng.random(), mask]
        })
        .collect();
    let working = (source[0] as usize >> level) * (source[1] as usize >> level);
    let drawn = (0..working).map(|_| std::array::from_fn(|_| rng.random_range(0.0..1.0))).collect();
    Case { source, level, rgba, drawn, settings }
}

#[test]
fn losses_and_slopes_match_the_reference() {
    on_both(|gpu| {
        let mut loss = ImageLoss::new(gpu).unwrap();
        let mut rng = StdRng::seed_from_u64(4);
        let both = LossSettings { color_weight: 2.0, mask_weight: 3.0, area: [0, 0, 96, 80], with_unknown: false };
        for (name, source, level, settings, coverage) in [
            ("everything", [96, 80], 0, both, None),
            ("masks only", [96, 80], 0, LossSettings { color_weight: 0.0, ..both }, None),
            ("halved", [193, 161], 1, both, None),
            ("an eighth", [768, 640], 3, both, None),
            ("an area", [96, 80], 0, LossSettings { area: [7, 5, 61, 78], ..both }, None),
            ("an area that is too large", [96, 80], 0, LossSettings { area: [16, 0, 4000, 4000], ..both }, None),
            ("nobody", [96, 80], 0, both, Some(0)),
            ("everywhere", [96, 80], 0, both, Some(255)),
            ("one pixel", [1, 1], 0, both, Some(200)),
            ("one row", [70, 1], 0, both, None),
        ] {
            check(gpu, &mut loss, &case(&mut rng, source, level, settings, coverage), name);
        }
    });
}

#[test]
fn an_empty_area_and_a_buffer_that_does_not_fit_cost_nothing() {
    on_both(|gpu| {
        let mut loss = ImageLoss::new(gpu).unwrap();
        let mut rng = StdRng::seed_from_u64(5);
        let settings = LossSettings { color_weight: 1.0, mask_weight: 1.0, area: [9, 9, 9, 20], with_unknown: false };
        let case = case(&mut rng, [32, 32], 0, settings, None);
        assert_eq!(WantedImage::zeroed(gpu, [1, 5], 2).unwrap().size(), [1, 5], "not below a pixel");
        let picture = WantedImage::zeroed(gpu, case.source, 0).unwrap();
        let image = StorageBuffer::from_bytes(gpu, "image", &case.rgba).unwrap();
        let target = RenderTarget::new(gpu, 32, 32).unwrap();
        let (fits, small) = (ImageGradients::zeroed(gpu, 32, 32).unwrap(), ImageGradients::zeroed(gpu, 8, 8).unwrap());
        loss.reserve(gpu, 1).unwrap();
        for (area, out) in [([9, 9, 9, 20], &fits), ([0, 0, 32, 32], &small), ([40, 0, 50, 9], &fits)] {
            let settings = LossSettings { area, ..settings };
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            loss.prepare(gpu, &mut encoder, &picture, &image, &settings);
            loss.encode(gpu, &mut encoder, 0, &target, &picture, &settings, out);
            gpu.queue.submit([encoder.finish()]);
            assert_eq!(loss.read(gpu, 1).unwrap(), [ImageSums::default()]);
        }
    });
}

#[test]
fn a_number_that_is_not_finite_is_told_and_stays_where_it_is() {
    on_both(|gpu| {
        let mut loss = ImageLoss::new(gpu).unwrap();
        let mut rng = StdRng::seed_from_u64(6);
        let settings = LossSettings { color_weight: 2.0, mask_weight: 2.0, area: [4, 3, 30, 28], with_unknown: false };
        let case = case(&mut rng, [32, 32], 0, settings, None);
        let picture = WantedImage::zeroed(gpu, case.source, 0).unwrap();
        let image = StorageBuffer::from_bytes(gpu, "image", &case.rgba).unwrap();
        let target = RenderTarget::new(gpu, 32, 32).unwrap();
        let out = ImageGradients::zeroed(gpu, 32, 32).unwrap();
        loss.reserve(gpu, 1).unwrap();
        let run = |drawn: &[[f32; 4]]| {
            target.color.write(gpu, drawn);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            loss.prepare(gpu, &mut encoder, &picture, &image, &settings);
            loss.encode(gpu, &mut encoder, 0, &target, &picture, &settings, &out);
            gpu.queue.submit([encoder.finish()]);
            (loss.read(gpu, 1).unwrap()[0], out.color.read(gpu).unwrap(), out.depth_carry.read(gpu).unwrap())
        };
        let sound = run(&case.drawn);
        assert!(sound.0.loss.is_finite());
        for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
            for channel in 0..4 {
                let mut drawn = case.drawn.clone();
                drawn[10 * 32 + 12][channel] = bad;
                let (sums, color, carry) = run(&drawn);
                assert!(!sums.loss.is_finite(), "{bad} in channel {channel}: {sums:?}");
                for at in 0..32 * 32usize {
                    let far = (at % 32).abs_diff(12) + (at / 32).abs_diff(10) > 1;
                    assert!(!far || (color[at], carry[at]) == (sound.1[at], sound.2[at]), "{bad} at {at}");
                }
            }
            // Outside of the area nobody looks.
            let mut drawn = case.drawn.clone();
            drawn[2 * 32 + 12] = [bad; 4];
            assert!(run(&drawn) == sound);
        }
    });
}
