//! Times anisotropic Gaussians beside isotropic ones of the same number on the built-in body, forward and backward, and prints the
//! error to the f64 reference beside the time.
//!
//! `cargo bench -p flyrig-renderer --bench anisotropic -- [COUNT...]`
//!
//! The row "planes" draws Gaussians of order 2 with normals and plane depths, and differentiates by them as well.
//!
//! With `scenes N` in place of counts: errors of the derivatives over N small random scenes, and for ever longer needles.

#[path = "../tests/support/mod.rs"]
mod support;

use std::error::Error;
use std::time::Instant;

use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_renderer::{
    AnisotropicBuffers, AnisotropicGradients, BackwardRasterizer, Carry, GaussianBuffers, GaussianGradients,
    HarmonicOrder, ImageGradients, Outputs, RasterSettings, Rasterizer, RenderTarget,
};
use flyrig_types::Camera;
use glam::{Quat, Vec3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use support::anisotropic::{ATTRIBUTES, Ellipsoids, backward, errors, harmonics, random_ellipsoids, upload};
use support::anisotropic_run::{Kernels, random_incoming, random_round, summary};
use support::body_scene::{body, camera};
use support::random_scene::{LENSES, random_camera};
use support::reference::{Picture, Scene, render, vec3};
use support::reference_backward::{Incoming, backward as isotropic_backward, touched, touched_by};

const RUNS: usize = 15;
const SIZE: u32 = 512;
const SETTINGS: RasterSettings = RasterSettings {
    near_m: 0.05,
    cull_backfacing: false,
    outputs: Outputs::COLOR,
    filter_variance_px2: 0.1,
    filter_keeps_opacity: false,
    area: None,
};

fn main() -> Result<(), Box<dyn Error>> {
    let device = GpuContext::new(&AdapterChoice::Best)?;
    let processor = device.on_processor();
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    if let [first, count] = arguments.as_slice()
        && first == "scenes"
    {
        return [&processor, &device].into_iter().try_for_each(|gpu| random_scenes(gpu, count.parse()?));
    }
    let counts = arguments.iter().map(|count| count.parse()).collect::<Result<Vec<usize>, _>>()?;
    let counts = if counts.is_empty() { vec![10_000, 41_000, 115_000] } else { counts };
    println!(
        "{} and {}; {SIZE}x{SIZE}, milliseconds an image, median of {RUNS} alternating runs; errors: mean of colour and alpha \
         over the body's pixels, and relative errors of the derivatives",
        device.adapter_name(),
        processor.adapter_name()
    );
    println!(
        "{:>9} {:>7} {:>9} {:>8} | {:>8} {:>6} | {:>8} {:>6} {:>9} | {:>8} | {}",
        "kernels",
        "count",
        "kind",
        "pairs",
        "forward",
        "ratio",
        "backward",
        "ratio",
        "/ forward",
        "image",
        ATTRIBUTES.join(" ")
    );
    for count in counts {
        compare(&[&device, &processor], count)?;
    }
    Ok(())
}

fn random_scenes(gpu: &GpuContext, count: usize) -> Result<(), Box<dyn Error>> {
    let mut rng = StdRng::seed_from_u64(2);
    let mut kernels = Kernels::new(gpu)?;
    let all = (0..count).map(|round| random_round(&mut rng, &mut kernels, round)).collect::<Result<Vec<_>, _>>()?;
    println!("{count} random scenes on {}", gpu.adapter_name());
    for (name, [median, high, worst]) in ATTRIBUTES.iter().zip(summary(&all)) {
        println!("{name:10} median {median:.1e}, 99 % {high:.1e}, worst {worst:.1e}");
    }
    for (long, thin) in [(0.03, 3e-3), (0.1, 3e-3), (0.3, 3e-3), (0.3, 3e-4)] {
        let view = random_camera(&mut rng, LENSES[1], SIZE, SIZE);
        let mut scene = random_ellipsoids(&mut rng, 300, HarmonicOrder::Two);
        scene.scale_opacity.fill([long, thin, thin, 0.7]);
        scene.clear_of_clamp(&view);
        let lists = touched_by(scene.splats(&view, &SETTINGS), (SIZE, SIZE));
        let mut incoming = random_incoming(&mut rng, (SIZE * SIZE) as usize);
        incoming.depth_carry.fill([0.0; 4]);
        incoming.only_clear(&lists.unclear);
        let slopes = backward(&scene, &view, &SETTINGS, SIZE, &lists, &incoming);
        let found = kernels.run(&scene, &[(&view, &incoming)], &SETTINGS)?;
        let errors = errors(&found, &slopes).map(|e| format!("{e:.0e}")).join(" ");
        println!("needles of {long} m by {thin} m, {SIZE}x{SIZE}: {errors}");
    }
    Ok(())
}

/// A scene, its reference image in f64, and reference derivatives for an incoming gradient.
struct Variant<G> {
    scene: G,
    picture: Picture,
    incoming: Incoming,
}

fn compare(contexts: &[&GpuContext], count: usize) -> Result<(), Box<dyn Error>> {
    let scene = body(count)?;
    let view = camera(&scene, SIZE, SIZE, 0.5);
    let size = (SIZE, SIZE);
    let mut rng = StdRng::seed_from_u64(1);
    let mut gradient = |unclear: &[bool]| {
        let mut incoming = random_incoming(&mut rng, (SIZE * SIZE) as usize);
        incoming.depth_carry.fill([0.0; 4]);
        incoming.only_clear(unclear);
        incoming
    };
    let lists = touched(&scene, &view, &SETTINGS, size);
    let incoming = gradient(&lists.unclear);
    let centers = isotropic_backward(&scene, &view, &SETTINGS, SIZE, &lists, &incoming).center;
    let isotropic = Variant { picture: render(&scene, &view, &SETTINGS, SIZE, SIZE), scene, incoming };
    let mut others = Vec::new();
    for order in HarmonicOrder::ALL {
        let mut scene = ellipsoids(&isotropic.scene, order);
        scene.clear_of_clamp(&view);
        let lists = touched_by(scene.splats(&view, &SETTINGS), size);
        let incoming = gradient(&lists.unclear);
        let slopes = backward(&scene, &view, &SETTINGS, SIZE, &lists, &incoming);
        let picture = scene.render(&view, &SETTINGS, SIZE, SIZE);
        others.push((Variant { scene, picture, incoming }, slopes));
    }
    for gpu in contexts {
        let mut rows = vec![Row::isotropic(gpu, &isotropic)?];
        for (variant, _) in &others {
            rows.push(Row::anisotropic(gpu, variant)?);
        }
        if let Some((variant, _)) = others.last() {
            rows.push(Row::anisotropic(gpu, variant)?.with_planes(gpu)?);
        }
        for run in 0..RUNS + 2 {
            for row in &mut rows {
                row.measure(gpu, &view, run >= 2)?;
            }
        }
        let [forward, backward] = [&rows[0].forwards, &rows[0].backwards].map(|times| median(times));
        for (i, row) in rows.iter().enumerate() {
            let found = row.errors(gpu)?;
            let (name, picture, errors) = match i.checked_sub(1).and_then(|i| others.get(i).or(others.last())) {
                Some((variant, slopes)) => {
                    let with_planes = row.settings.outputs.planes;
                    let name = if with_planes { "planes".to_owned() } else { format!("{:?}", variant.scene.order) };
                    (name, &variant.picture, errors(&found, slopes).to_vec())
                }
                None => {
                    let off: f64 = found[0].iter().zip(&centers).map(|(a, b)| (vec3(*a) - *b).length_squared()).sum();
                    let all: f64 = centers.iter().map(|c| c.length_squared()).sum();
                    ("isotropic".to_owned(), &isotropic.picture, vec![(off / all).sqrt()])
                }
            };
            let (ahead, back) = (median(&row.forwards), median(&row.backwards));
            println!(
                "{:>9} {count:>7} {name:>9} {:>8} | {ahead:8.3} {:6.2} | {back:8.3} {:6.2} {:9.2} | {:8.1e} | {}",
                if gpu.is_on_processor() { "processor" } else { "adapter" },
                row.rasterizer.stats(gpu)?.pairs,
                ahead / forward,
                back / backward,
                back / ahead,
                mean_error(&row.target.color.read(gpu)?, picture),
                errors.iter().map(|e| format!("{e:.0e}")).collect::<Vec<_>>().join(" ")
            );
        }
    }
    Ok(())
}

/// The body of flat ellipsoids that touch as many tiles as its isotropic Gaussians, with the colours of those.
fn ellipsoids(scene: &Scene, order: HarmonicOrder) -> Ellipsoids {
    let mut rng = StdRng::seed_from_u64(7);
    let constant = harmonics(glam::DVec3::X)[0] as f32;
    let mut out = Ellipsoids {
        center: scene.center_scale.iter().map(|c| [c[0], c[1], c[2], 0.0]).collect(),
        scale_opacity: Vec::new(),
        rotation: Vec::new(),
        harmonics: Vec::new(),
        order,
    };
    for ((center, normal), color) in scene.center_scale.iter().zip(&scene.normal).zip(&scene.color) {
        let s = center[3];
        out.scale_opacity.push([1.6 * s, 1.0 * s, 0.5 * s, color[3]]);
        let normal = Vec3::new(normal[0], normal[1], normal[2]).normalize_or(Vec3::Z);
        let turn = Quat::from_rotation_z(rng.random_range(0.0..std::f32::consts::TAU));
        out.rotation.push((Quat::from_rotation_arc(Vec3::Z, normal) * turn).to_array());
        for k in 0..order.coefficients() {
            let channel = |c: usize, rng: &mut StdRng| {
                if k == 0 { color[c] / constant } else { rng.random_range(-0.1..0.1) }
            };
            out.harmonics.push([channel(0, &mut rng), channel(1, &mut rng), channel(2, &mut rng), 0.0]);
        }
    }
    out
}

/// Gaussians on the device with their derivatives.
enum Buffers {
    Isotropic(GaussianBuffers, GaussianGradients),
    Anisotropic(AnisotropicBuffers, AnisotropicGradients),
}

/// One line of the table while it is measured.
struct Row {
    buffers: Buffers,
    settings: RasterSettings,
    rasterizer: Rasterizer,
    backward: BackwardRasterizer,
    target: RenderTarget,
    incoming: ImageGradients,
    forwards: Vec<f64>,
    backwards: Vec<f64>,
}

impl Row {
    fn isotropic(gpu: &GpuContext, variant: &Variant<Scene>) -> Result<Self, Box<dyn Error>> {
        let buffers = support::upload(gpu, &variant.scene)?;
        let gradients = GaussianGradients::zeroed(gpu, buffers.count())?;
        Self::new(gpu, Buffers::Isotropic(buffers, gradients), &variant.incoming)
    }

    fn anisotropic(gpu: &GpuContext, variant: &Variant<Ellipsoids>) -> Result<Self, Box<dyn Error>> {
        let buffers = upload(gpu, &variant.scene)?;
        let gradients = AnisotropicGradients::zeroed(gpu, buffers.count(), buffers.order())?;
        Self::new(gpu, Buffers::Anisotropic(buffers, gradients), &variant.incoming)
    }

    fn new(gpu: &GpuContext, buffers: Buffers, incoming: &Incoming) -> Result<Self, Box<dyn Error>> {
        let gradients = ImageGradients::zeroed(gpu, SIZE, SIZE)?;
        gradients.color.write(gpu, &incoming.color);
        Ok(Self {
            buffers,
            settings: SETTINGS,
            rasterizer: Rasterizer::new(gpu, 0)?,
            backward: BackwardRasterizer::new(gpu)?,
            target: RenderTarget::new(gpu, SIZE, SIZE)?,
            incoming: gradients,
            forwards: Vec::new(),
            backwards: Vec::new(),
        })
    }

    /// Adds the planes, with a gradient of 0: it costs as much as any other.
    fn with_planes(self, gpu: &GpuContext) -> Result<Self, Box<dyn Error>> {
        let settings = RasterSettings { outputs: Outputs::PLANES, ..SETTINGS };
        let (target, incoming) = (self.target.with_planes(gpu)?, self.incoming.with_planes(gpu)?);
        Ok(Self { settings, target, incoming, ..self })
    }

    /// Draws the image and takes its derivative. On a graphics processor several times in one submission, so that the wait
    /// does not count.
    fn measure(&mut self, gpu: &GpuContext, view: &Camera, counts: bool) -> Result<(), Box<dyn Error>> {
        let repeats = if gpu.is_software() || gpu.is_on_processor() { 1 } else { 10 };
        let begin = Instant::now();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for _ in 0..repeats {
            match &self.buffers {
                Buffers::Isotropic(g, _) => {
                    self.rasterizer.encode(gpu, &mut encoder, g, view, &self.settings, &self.target)?;
                }
                Buffers::Anisotropic(g, _) => {
                    self.rasterizer.encode(gpu, &mut encoder, g, view, &self.settings, &self.target)?;
                }
            }
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        let middle = Instant::now();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        for _ in 0..repeats {
            let (back, rasterizer, target) = (&mut self.backward, &self.rasterizer, &self.target);
            match &self.buffers {
                Buffers::Isotropic(g, out) => {
                    out.clear(&mut encoder);
                    back.encode(gpu, &mut encoder, rasterizer, g, target, (&self.incoming, Carry::Sum), out)?;
                }
                Buffers::Anisotropic(g, out) => {
                    out.clear(&mut encoder);
                    back.encode_anisotropic(gpu, &mut encoder, rasterizer, g, target, &self.incoming, out)?;
                }
            }
        }
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()?;
        if counts {
            let milliseconds = |time: std::time::Duration| time.as_secs_f64() * 1e3 / f64::from(repeats);
            self.forwards.push(milliseconds(middle - begin));
            self.backwards.push(milliseconds(middle.elapsed()));
        }
        Ok(())
    }

    /// The derivatives that were computed last.
    fn errors(&self, gpu: &GpuContext) -> Result<[Vec<[f32; 4]>; 4], Box<dyn Error>> {
        Ok(match &self.buffers {
            Buffers::Isotropic(_, out) => [out.center.read(gpu)?, vec![], vec![], vec![]],
            Buffers::Anisotropic(_, out) => {
                let [center, scale, rotation, harmonics] = out.attributes().map(|attribute| attribute.read(gpu));
                [center?, scale?, rotation?, harmonics?]
            }
        })
    }
}

/// Mean error of colour and alpha where either image shows the body.
fn mean_error(ours: &[[f32; 4]], reference: &Picture) -> f64 {
    let (mut sum, mut seen) = (0.0, 0usize);
    for (a, b) in ours.iter().zip(&reference.color) {
        if a[3] > 0.0 || b[3] > 0.0 {
            seen += 1;
            sum += a.iter().zip(b).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
        }
    }
    sum / seen.max(1) as f64
}

fn median(times: &[f64]) -> f64 {
    let mut times = times.to_vec();
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(f64::NAN)
}
