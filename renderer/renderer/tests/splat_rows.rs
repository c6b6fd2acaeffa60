//! The image as a matrix over the colours is the image that the rasteriser draws.
#![allow(clippy::unwrap_used)] // helpers of tests

mod support;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_renderer::{Outputs, PosedGaussians, RasterSettings, Rasterizer, pixel_shares};
use support::{body_scene, render, upload};

const SIZE: (u32, u32) = (128, 160);

#[test]
fn rows_times_colours_are_the_rendered_image() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let scene = body_scene::body(12_000).unwrap();
    let camera = body_scene::camera(&scene, SIZE.0, SIZE.1, 0.7);
    let settings = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
    let mut rasterizer = Rasterizer::new(&gpu, scene.center_scale.len()).unwrap();
    let buffers = upload(&gpu, &scene).unwrap();
    let drawn = render(&gpu, &mut rasterizer, &buffers, &camera, &settings, SIZE).unwrap();

    let pixels: Vec<[u32; 2]> = (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| [x, y])).collect();
    let gaussians = PosedGaussians { center_scale: &scene.center_scale, normal: &scene.normal };
    let shares = pixel_shares(&camera, gaussians, &pixels, &settings);
    let (mut worst, mut sum, mut covered) = (0.0f32, 0.0, 0);
    for (row, drawn) in shares.rows.iter().zip(&drawn.color) {
        let mut ours = [0.0f32; 4];
        for &(gaussian, share) in row {
            let color = scene.color[gaussian as usize];
            for c in 0..3 {
                ours[c] += share * color[c];
            }
            ours[3] += share;
        }
        let error = ours.iter().zip(drawn).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        worst = worst.max(error);
        sum += error;
        covered += usize::from(drawn[3] > 0.5);
    }
    assert!(covered > 1500, "{covered} pixels show the body");
    // Two splats of nearly equal depth may change places: the sort key of the GPU has 24 bits.
    assert!(worst < 0.05 && sum / (pixels.len() as f32) < 2e-4, "worst {worst}, mean {}", sum / pixels.len() as f32);
}

#[test]
fn poisoned_gaussians_and_absurd_pixels_give_empty_rows() {
    let scene = body_scene::body(2000).unwrap();
    let camera = body_scene::camera(&scene, SIZE.0, SIZE.1, 0.0);
    let mut center_scale = scene.center_scale.clone();
    for (i, center) in center_scale.iter_mut().enumerate() {
        match i % 4 {
            0 => center[0] = f32::NAN,
            1 => center[3] = 0.0,
            2 => center[2] = 1e30,
            _ => center[1] = f32::INFINITY,
        }
    }
    let poisoned = PosedGaussians { center_scale: &center_scale, normal: &scene.normal };
    let pixels = [[64, 80], [u32::MAX, 3], [0, u32::MAX]];
    let shares = pixel_shares(&camera, poisoned, &pixels, &RasterSettings::default());
    assert_eq!(shares.rows, vec![Vec::new(); 3]);
    let whole = PosedGaussians { center_scale: &scene.center_scale, normal: &scene.normal };
    let shares = pixel_shares(&camera, whole, &pixels, &RasterSettings::default());
    assert!(!shares.rows[0].is_empty() && shares.rows[1].is_empty() && shares.rows[2].is_empty());
}
