//! Drawing, and its derivative, in a part of the image only.

#![allow(clippy::float_cmp)] // the same bytes are what is promised

mod support;

use flyrig_gpu::testing::on_both;
use flyrig_renderer::{
    BackwardRasterizer, Carry, GaussianGradients, ImageGradients, Outputs, RasterSettings, Rasterizer, RenderTarget,
};
use support::body_scene::{body, camera};
use support::upload;

#[test]
fn an_area_is_drawn_as_in_the_whole_image_and_the_rest_stays() {
    on_both(|gpu| {
        let scene = body(6000).unwrap();
        let gaussians = upload(gpu, &scene).unwrap();
        let (width, height) = (200, 180);
        let camera = camera(&scene, width, height, 0.3);
        let mut rasterizer = Rasterizer::new(gpu, gaussians.count()).unwrap();
        let mut backward = BackwardRasterizer::new(gpu).unwrap();
        let target = RenderTarget::new(gpu, width, height).unwrap();
        let incoming = ImageGradients::zeroed(gpu, width, height).unwrap();
        let pixels = (width * height) as usize;
        let mark = [7.0; 4];
        // Derivatives of the whole image's pixels within `within` only.
        let mut run = |area: Option<[u32; 4]>, within: [u32; 4]| {
            target.color.write(gpu, &vec![mark; pixels]);
            let inside = |at: u32| {
                (within[0]..within[2]).contains(&(at % width)) && (within[1]..within[3]).contains(&(at / width))
            };
            let slopes: Vec<[f32; 4]> = (0..pixels as u32)
                .map(|at| if inside(at) { [0.3, -0.2, 0.1, (at % 7) as f32] } else { [0.0; 4] })
                .collect();
            incoming.color.write(gpu, &slopes);
            let out = GaussianGradients::zeroed(gpu, gaussians.count()).unwrap();
            let settings = RasterSettings { outputs: Outputs::COLOR, area, ..Default::default() };
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            rasterizer.encode(gpu, &mut encoder, &gaussians, &camera, &settings, &target).unwrap();
            backward
                .encode(gpu, &mut encoder, &rasterizer, &gaussians, &target, (&incoming, Carry::Sum), &out)
                .unwrap();
            gpu.queue.submit([encoder.finish()]);
            (target.color.read(gpu).unwrap(), out.center.read(gpu).unwrap())
        };
        let area = [64, 48, 144, 112];
        let (whole, whole_slopes) = run(None, area);
        assert!(whole_slopes.iter().any(|s| s[3] > 0.0));
        let (part, part_slopes) = run(Some(area), area);
        for at in 0..pixels {
            let (x, y) = (at as u32 % width, at as u32 / width);
            let inside = (area[0]..area[2]).contains(&x) && (area[1]..area[3]).contains(&y);
            assert_eq!(part[at], if inside { whole[at] } else { mark }, "{x} {y}");
        }
        assert!(part_slopes == whole_slopes, "what lies outside passes nothing on");
        // Beyond the image, empty, and at its ragged end.
        for area in [[500, 500, 900, 900], [20, 20, 20, 20], [192, 176, 4000, 4000]] {
            let (part, _) = run(Some(area), area);
            let touched = part.iter().filter(|p| **p != mark).count();
            assert_eq!(touched, if area[0] == 192 { 8 * 4 } else { 0 }, "{area:?}");
        }
    });
}
