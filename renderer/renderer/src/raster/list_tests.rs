//! The lists of the tiles, for both ways of cutting the work.

use flyrig_body::{ShapeParams, default_template, sample_surface};
use flyrig_gpu::AdapterChoice;
use flyrig_types::{Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

use super::*;
use crate::buffers::GaussianBuffers;

#[test]
fn every_tile_lists_its_gaussians_by_depth() {
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
    let surface = sample_surface(&default_template(&ShapeParams::default()).unwrap(), 115_000, 1).unwrap();
    let count = surface.positions.len();
    let gaussians = GaussianBuffers::zeroed(&gpu, count).unwrap();
    let center_scale: Vec<_> =
        surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| p.extend(*s).to_array()).collect();
    gaussians.center_scale.write(&gpu, &center_scale);
    gaussians.color.write(&gpu, &vec![[1.0; 4]; count]);
    let middle = DVec3::new(0.0, 0.85, 0.0);
    let camera = Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "test".into(),
        intrinsics: Intrinsics {
            width: 1920,
            height: 1080,
            focal_px: DVec2::splat(1500.0),
            center_px: DVec2::new(959.5, 539.5),
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::look_at(middle + DVec3::new(1.5, 0.3, 2.6), middle, DVec3::Y),
    };
    let settings = RasterSettings { cull_backfacing: false, outputs: Outputs::COLOR, ..Default::default() };
    let target = RenderTarget::new(&gpu, 1920, 1080).unwrap();
    for side in [Tile::SOFTWARE, Tile::HARDWARE] {
        let mut rasterizer = DeviceRasterizer::with_tile(&gpu, count, side).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let drawn = Gaussians::Isotropic(&gaussians);
        rasterizer.encode_timed(&gpu, &mut encoder, drawn, (&camera, &settings), &target, None).unwrap();
        gpu.queue.submit([encoder.finish()]);
        let visible = rasterizer.sort.valid().read(&gpu).unwrap()[0] as usize;
        let ordered = rasterizer.sort.output(Keys::Scaled).read(&gpu).unwrap();
        assert!(ordered[..visible].is_sorted(), "by depth, then by number");
        let rects = rasterizer.rects.read(&gpu).unwrap();
        let picture = rasterizer.picture.as_ref().unwrap();
        let layout = picture.layout();
        let mut expected = vec![Vec::new(); (layout.tiles[0] * layout.tiles[1]) as usize];
        for [_, gaussian] in &ordered[..visible] {
            let corners = rects[*gaussian as usize].map(|xy| (xy & 0xffff, xy >> 16));
            for y in corners[0].1..=corners[1].1 {
                for x in corners[0].0..=corners[1].0 {
                    expected[(y * layout.tiles[0] + x) as usize].push(*gaussian);
                }
            }
        }
        let ends = picture.ends.read(&gpu).unwrap();
        let lists = picture.lists().read(&gpu).unwrap();
        let mut begin = 0;
        for (tile, list) in expected.iter().enumerate() {
            let end = ends[tile] as usize;
            let found: Vec<u32> = lists[begin..end].iter().map(|pair| pair[1]).collect();
            assert!(found == *list, "tile {tile} of {side:?}: {} {}", end - begin, list.len());
            begin = end;
        }
        assert!(begin > count, "{begin} pairs");
    }
}
