//! Effect of skipping back-facing Gaussians on a closed surface.

mod support;

use flyrig_gpu::testing::on_both;
use flyrig_renderer::{RasterSettings, Rasterizer};
use support::body_scene::{body, camera};
use support::reference::Picture;
use support::{Difference, render, upload};

#[test]
fn culling_changes_little_where_the_front_is_dense() {
    on_both(|gpu| {
        let scene = body(115_000).unwrap();
        let mut rasterizer = Rasterizer::new(gpu, scene.center_scale.len()).unwrap();
        let (width, height) = (512, 512);
        // The template's own scale leaves 2 % of the background visible through the front alone. The far side
        // has the complementary colour of the front here, so that this shows as strongly as it can.
        for (scale, allowed) in [(1.0, 0.03), (1.3, 0.004)] {
            let mut scene = scene.clone();
            scene.center_scale.iter_mut().for_each(|c| c[3] *= scale);
            let gaussians = upload(gpu, &scene).unwrap();
            for azimuth in [0.0, 0.8, 1.6] {
                let camera = camera(&scene, width, height, azimuth);
                let mut draw = |cull_backfacing| {
                    let settings = RasterSettings { cull_backfacing, ..Default::default() };
                    let pictures =
                        render(gpu, &mut rasterizer, &gaussians, &camera, &settings, (width, height)).unwrap();
                    (pictures, rasterizer.stats(gpu).unwrap().visible_gaussians)
                };
                let ((culled, kept), (all, total)) = (draw(true), draw(false));
                let d = Difference::between(&culled, &Picture::from(&all));
                let body = all.color.iter().filter(|c| c[3] > 0.0).count() as f64 / all.color.len() as f64;
                let mean = d.color_mean / body;
                println!(
                    "scale x{scale}, azimuth {azimuth}: {kept} of {total} Gaussians, over the body max {:.2} mean {mean:.4}, \
                 {:.1} % of the pixels by more than 1/255",
                    d.color_max,
                    d.color_visible / body * 100.0
                );
                assert!(kept < total * 7 / 10, "{kept} of {total}");
                assert!(mean < allowed, "{mean}");
            }
        }
    });
}
