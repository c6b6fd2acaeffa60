//! Times flyrig's rasteriser against wgpu-3dgs-viewer: same scene, camera, device and run.
//!
//! `cargo run --release [PICTURE_FOLDER]` in this folder. On Mesa's software adapter the other renderer's radix
//! sort is only right with one thread (`LP_NUM_THREADS=1`), so compare there; without it both are faster, but
//! its picture is not the right one.

#[path = "../../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use flyrig_gpu::{AdapterChoice, GpuContext, read_back};
use flyrig_renderer::{Outputs, RasterSettings, Rasterizer, RenderTarget};
use flyrig_types::{Camera, Lens};
use glam_viewer::{Mat4, Quat, U8Vec4, UVec2, Vec3, Vec4};
use support::body_scene::{body, camera, save_png};
use support::reference::Scene;
use support::upload;
use wgpu_3dgs_viewer::core::{Gaussian, GaussianDisplayMode, GaussianMaxStdDev, GaussianShDegree};
use wgpu_3dgs_viewer::{CameraTrait, Viewer};

const RUNS: usize = 9;
const SIZE: u32 = 512;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = std::env::args().nth(1).map(PathBuf::from);
    let gpu = GpuContext::new(&AdapterChoice::Best)?;
    let threads = std::env::var("LP_NUM_THREADS").unwrap_or_else(|_| "not set".to_owned());
    println!("adapter {}, LP_NUM_THREADS {threads}, {SIZE}x{SIZE}, median of {RUNS} runs in turn", gpu.adapter_name());
    for count in [115_000, 57_000, 29_000] {
        let mut scene = body(count)?;
        // Both see colours of 8 bits.
        for c in scene.color.as_flattened_mut() {
            *c = (*c * 255.0).round() / 255.0;
        }
        let mut camera = camera(&scene, SIZE, SIZE, 0.5);
        camera.intrinsics.lens = Lens::PINHOLE;
        compare(&gpu, &scene, &camera, folder.as_deref())?;
    }
    Ok(())
}

fn compare(gpu: &GpuContext, scene: &Scene, camera: &Camera, folder: Option<&std::path::Path>) -> Result<(), Box<dyn Error>> {
    let count = scene.center_scale.len();
    let gaussians = upload(gpu, scene)?;
    let mut rasterizer = Rasterizer::new(gpu, count)?;
    let target = RenderTarget::new(gpu, SIZE, SIZE)?;
    let viewer = viewer(gpu, scene, camera)?;
    let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
        label: Some("other renderer"),
        size: wgpu::Extent3d { width: SIZE, height: SIZE, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let view = texture.create_view(&Default::default());
    let mut times = [const { Vec::new() }; 3];
    let mut pictures = Vec::new();
    for run in 0..RUNS + 2 {
        for (way, times) in times.iter_mut().enumerate() {
            let begin = Instant::now();
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            if way == 2 {
                viewer.render(&mut encoder, &view);
            } else {
                let settings =
                    RasterSettings { cull_backfacing: way == 0, outputs: Outputs::COLOR, ..Default::default() };
                rasterizer.encode(gpu, &mut encoder, &gaussians, camera, &settings, &target)?;
            }
            gpu.queue.submit([encoder.finish()]);
            gpu.wait()?;
            if run >= 2 {
                times.push(begin.elapsed());
            }
        }
        pictures.push(read_texture(gpu, &texture)?);
    }
    let [culled, all, other] = times.map(median);
    let unlike = pictures.iter().filter(|p| *p != &pictures[0]).count();
    println!(
        "{count:>7} Gaussians: ours {culled:.1} ms culled, {all:.1} ms all; wgpu-3dgs-viewer {other:.1} ms; \
         ratio {:.1} culled, {:.1} all; {unlike} of {} of its pictures differ from its first",
        other / culled,
        other / all,
        pictures.len()
    );
    // Ours was last drawn with every Gaussian; theirs is premultiplied by its blending onto black.
    let ours = target.color.read(gpu)?;
    let theirs: Vec<[f32; 4]> = pictures[0].iter().map(|p| p.map(|v| f32::from(v) / 255.0)).collect();
    let difference = ours.iter().zip(&theirs).map(|(a, b)| (0..3).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max));
    println!("        mean difference of the pictures {:.4} (linear, whole picture)", difference.sum::<f32>() / ours.len() as f32);
    if let Some(folder) = folder {
        std::fs::create_dir_all(folder)?;
        save_png(&folder.join(format!("{count}-ours.png")), &ours, SIZE, SIZE)?;
        save_png(&folder.join(format!("{count}-viewer.png")), &theirs, SIZE, SIZE)?;
    }
    Ok(())
}

fn viewer(gpu: &GpuContext, scene: &Scene, camera: &Camera) -> Result<Viewer, Box<dyn Error>> {
    let gaussians: Vec<Gaussian> = scene
        .center_scale
        .iter()
        .zip(&scene.color)
        .map(|(c, color)| Gaussian {
            rot: Quat::IDENTITY,
            pos: Vec3::new(c[0], c[1], c[2]),
            color: U8Vec4::from_array(color.map(|v| (v * 255.0).round() as u8)),
            sh: [Vec3::ZERO; 15],
            scale: Vec3::splat(c[3]),
        })
        .collect();
    let mut viewer = Viewer::new(&gpu.device, wgpu::TextureFormat::Rgba8Unorm, &gaussians)?;
    viewer.update_camera(&gpu.queue, &SameCamera(camera), UVec2::splat(SIZE));
    viewer.update_model_transform(&gpu.queue, Vec3::ZERO, Quat::IDENTITY, Vec3::ONE);
    let degree = GaussianShDegree::new(0).ok_or("spherical harmonics of degree 0")?;
    let extent = GaussianMaxStdDev::new(3.0).ok_or("a splat's extent of 3")?;
    viewer.update_gaussian_transform(&gpu.queue, 1.0, GaussianDisplayMode::Splat, degree, false, extent);
    Ok(viewer)
}

/// Our pinhole camera in the other renderer's terms: x right, y up, looking along -z, depth 0 to 1.
struct SameCamera<'a>(&'a Camera);

impl CameraTrait for SameCamera<'_> {
    fn view(&self) -> Mat4 {
        let columns = self.0.camera_from_world.to_matrix().as_mat4().to_cols_array();
        Mat4::from_scale(Vec3::new(1.0, -1.0, -1.0)) * Mat4::from_cols_array(&columns)
    }

    fn projection(&self, _aspect_ratio: f32) -> Mat4 {
        let (near, far) = (0.05f32, 100.0f32);
        let f = (self.0.intrinsics.focal_px.as_vec2() * 2.0 / SIZE as f32).to_array();
        Mat4::from_cols(
            Vec4::new(f[0], 0.0, 0.0, 0.0),
            Vec4::new(0.0, f[1], 0.0, 0.0),
            Vec4::new(0.0, 0.0, far / (near - far), -1.0),
            Vec4::new(0.0, 0.0, near * far / (near - far), 0.0),
        )
    }
}

fn read_texture(gpu: &GpuContext, texture: &wgpu::Texture) -> Result<Vec<[u8; 4]>, Box<dyn Error>> {
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("other renderer's picture"),
        size: u64::from(SIZE * SIZE * 4),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(SIZE * 4), rows_per_image: None };
    let to = wgpu::TexelCopyBufferInfo { buffer: &buffer, layout };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), to, texture.size());
    gpu.queue.submit([encoder.finish()]);
    Ok(read_back(gpu, &buffer, (SIZE * SIZE) as usize)?)
}

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort();
    times.get(times.len() / 2).map_or(f64::NAN, |t| t.as_secs_f64() * 1e3)
}
