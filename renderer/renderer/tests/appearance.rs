//! Direct appearance against the f64 reference and against common sense.
#![allow(clippy::unwrap_used)] // helpers of tests

mod appearance_support;

use appearance_support::{
    reference::{self, MID_GREY},
    scene::{self, Frame, Person, View},
};
use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_renderer::{
    AppearanceError, AppearanceSettings, DiffusionHierarchy, DirectAppearance, GaussianBuffers, Outputs,
    RasterSettings, Rasterizer, RenderTarget, linear_from_srgb,
};
use glam::{DVec3, DVec4};

const BACKGROUND: [u8; 3] = [255, 0, 255];

struct Rig {
    gpu: GpuContext,
    person: Person,
    buffers: GaussianBuffers,
    appearance: DirectAppearance,
}

impl Rig {
    fn new(gpu: &GpuContext, gaussians: usize, nodes: usize) -> Self {
        let gpu = gpu.clone();
        let person = scene::person(gaussians, nodes);
        let buffers = GaussianBuffers::zeroed(&gpu, gaussians).unwrap();
        buffers.canonical.write(&gpu, &person.canonical);
        let appearance = DirectAppearance::new(&gpu, &person.surface, &person.graph, 3).unwrap();
        Self { gpu, person, buffers, appearance }
    }

    fn update(&mut self, frame: &Frame, views: &[View], settings: &AppearanceSettings) -> Vec<[f32; 4]> {
        self.try_update(frame, views, settings).unwrap()
    }

    fn try_update(
        &mut self,
        frame: &Frame,
        views: &[View],
        settings: &AppearanceSettings,
    ) -> Result<Vec<[f32; 4]>, AppearanceError> {
        self.buffers.center_scale.write(&self.gpu, &frame.center_scale);
        self.buffers.normal.write(&self.gpu, &frame.normal);
        let maps = scene::upload(&self.gpu, views).unwrap();
        let inputs = scene::inputs(views, &maps);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.appearance.update(&self.gpu, &mut encoder, &self.buffers, &inputs, settings)?;
        self.gpu.queue.submit([encoder.finish()]);
        Ok(self.buffers.color.read(&self.gpu)?)
    }

    fn reference(
        &self,
        frame: &Frame,
        views: &[View],
        settings: &AppearanceSettings,
        state: &mut reference::State,
    ) -> Vec<DVec3> {
        let levels = DiffusionHierarchy::new(&self.person.graph).unwrap().levels;
        reference::update(&self.person, &levels, frame, views, settings, state)
    }
}

fn ablations() -> [AppearanceSettings; 4] {
    [(true, true), (true, false), (false, true), (false, false)].map(|(space, time)| AppearanceSettings {
        space,
        time,
        ..Default::default()
    })
}

fn views(frame: &Frame, size: u32) -> Vec<View> {
    scene::ring(size).iter().map(|camera| scene::view(frame, camera, BACKGROUND, scene::pattern)).collect()
}

/// Largest difference of a colour channel, and its mean over the Gaussians.
fn difference(ours: &[[f32; 4]], reference: &[DVec3]) -> (f64, f64) {
    assert_eq!(ours.len(), reference.len());
    let one = |(a, b): (&[f32; 4], &DVec3)| {
        assert!(a.iter().all(|x| x.is_finite()), "{a:?}");
        assert_eq!(a[3].to_bits(), 1f32.to_bits(), "opacity");
        (DVec4::from_array(a.map(f64::from)).truncate() - *b).abs().max_element()
    };
    let each: Vec<f64> = ours.iter().zip(reference).map(one).collect();
    (each.iter().copied().fold(0.0, f64::max), each.iter().sum::<f64>() / each.len() as f64)
}

/// f32 positions at 2.5 m and pixels at 100 leave about 1e-5 of a pixel; neighbouring texels differ by up to 1.
const TOLERANCE: f64 = 5e-4;
/// The baseline gives the rim its full say, where a sample holds as little as 1% of believed texels: the pixel's
/// rounding counts a hundredfold there. The mean must not notice.
const BASELINE_TOLERANCE: f64 = 5e-3;
const MEAN_TOLERANCE: f64 = 3e-5;

#[test]
fn agrees_with_the_reference_over_time_in_every_setting() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 4000, 150);
        let frames: Vec<_> = [0.0, 0.6, 1.2, 1.5].map(|turn| scene::frame(&rig.person, turn)).into();
        let pictures: Vec<_> = frames.iter().map(|frame| views(frame, 96)).collect();
        for settings in ablations() {
            rig.appearance.reset();
            let mut state = reference::State { memory: vec![DVec4::ZERO; 4000], last: None };
            // Cameras come and go.
            for (frame, seen) in [(0, 0..3), (1, 1..3), (2, 0..0), (3, 2..3)] {
                let (frame, views) = (&frames[frame], &pictures[frame][seen]);
                let ours = rig.update(frame, views, &settings);
                let expected = rig.reference(frame, views, &settings, &mut state);
                let (worst, mean) = difference(&ours, &expected);
                println!("{settings:?} {} views: max {worst:.2e}, mean {mean:.2e}", views.len());
                assert!(mean < MEAN_TOLERANCE, "{settings:?}: mean {mean}");
                assert!(worst < if settings.space { TOLERANCE } else { BASELINE_TOLERANCE }, "{settings:?}: {worst}");
            }
        }
    });
}

#[test]
fn corrections_agree_with_the_reference_and_are_nothing_where_nobody_looks() {
    on_both(|gpu| {
        let frames: Vec<_> = {
            let person = scene::person(4000, 150);
            [0.0, 0.6, 1.2].map(|turn| scene::frame(&person, turn)).into()
        };
        let pictures: Vec<_> = frames.iter().map(|frame| views(frame, 96)).collect();
        for settings in ablations().map(|settings| AppearanceSettings { corrects: true, ..settings }) {
            let mut rig = Rig::new(gpu, 4000, 150);
            let mut state = reference::State { memory: vec![DVec4::ZERO; 4000], last: None };
            let nothing = rig.update(&frames[0], &[], &settings);
            assert!(nothing.iter().all(|color| color[..3].iter().all(|value| value.abs() <= 0.0)), "{settings:?}");
            for (frame, seen) in [(0, 0..3), (1, 1..3), (2, 0..0), (2, 2..3)] {
                let (frame, views) = (&frames[frame], &pictures[frame][seen]);
                let ours = rig.update(frame, views, &settings);
                let expected = rig.reference(frame, views, &settings, &mut state);
                let (worst, mean) = difference(&ours, &expected);
                println!("{settings:?} {} views: max {worst:.2e}, mean {mean:.2e}", views.len());
                let most = if settings.space { TOLERANCE } else { BASELINE_TOLERANCE };
                assert!(mean < MEAN_TOLERANCE && worst < most, "{settings:?}: {worst}, mean {mean}");
            }
            assert!(ours_of(&rig).iter().any(|color| color[..3].iter().any(|c| *c < -0.01)), "some are negative");
        }
    });
}

fn ours_of(rig: &Rig) -> Vec<[f32; 4]> {
    rig.buffers.color.read(&rig.gpu).unwrap()
}

#[test]
fn the_same_input_gives_the_same_bytes() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 4000, 150);
        let frame = scene::frame(&rig.person, 0.3);
        let views = views(&frame, 64);
        let settings = AppearanceSettings::default();
        let mut run = || {
            rig.appearance.reset();
            rig.update(&frame, &views, &settings);
            rig.update(&frame, &views[1..], &settings)
        };
        let (first, second) = (run(), run());
        assert_eq!(bits(&first), bits(&second));
    });
}

fn bits(colors: &[[f32; 4]]) -> Vec<u32> {
    colors.as_flattened().iter().map(|c| c.to_bits()).collect()
}

#[test]
fn what_nobody_sees_is_grey_then_remembered_until_reset() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 2000, 80);
        let frame = scene::frame(&rig.person, 0.3);
        let seen = views(&frame, 64);
        // No view, an empty mask, and a camera that looks away.
        let mut masked = seen.clone();
        masked.iter_mut().for_each(|view| view.rgba.chunks_exact_mut(4).for_each(|p| p[3] = 0));
        let mut behind = seen.clone();
        for view in &mut behind {
            let eye = view.camera.position();
            view.camera.camera_from_world = flyrig_types::Isometry::look_at(eye, eye * 2.0, DVec3::Y);
        }
        let grey = [MID_GREY as f32; 3];
        // These views were not drawn with the last colours.
        for settings in ablations().map(|settings| AppearanceSettings { sharpness: 0.0, ..settings }) {
            rig.appearance.reset();
            for blind in [&[][..], &masked, &behind] {
                for color in rig.update(&frame, blind, &settings) {
                    assert!(color[..3].iter().zip(grey).all(|(a, b)| (a - b).abs() < 1e-6), "{settings:?} {color:?}");
                }
            }
            for _ in 0..40 {
                rig.update(&frame, &seen, &settings);
            }
            let known = rig.update(&frame, &seen, &settings);
            let blind = rig.update(&frame, &[], &settings);
            let again = rig.update(&frame, &masked, &settings);
            let same = |a: &[[f32; 4]], b: &[[f32; 4]]| {
                let near = |a: &[f32; 4], b: &[f32; 4]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 0.02);
                a.iter().zip(b).filter(|(a, b)| near(a, b)).count() as f64 / a.len() as f64
            };
            assert_eq!(bits(&blind), bits(&again), "zero weight leaves the memory as it was");
            if settings.time {
                // The ball hides some of the belly and the head's top is grazed by all; the rest was seen.
                assert!(same(&known, &blind) > 0.6, "{settings:?} {}", same(&known, &blind));
            } else {
                assert!(same(&known, &blind) < 0.1, "{settings:?}");
            }
            rig.appearance.reset();
            let forgotten = rig.update(&frame, &[], &settings);
            assert!(forgotten.iter().all(|c| (c[0] - grey[0]).abs() < 1e-6), "{settings:?}");
        }
    });
}

#[test]
fn poison_never_reaches_the_memory() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 2000, 80);
        let clean = scene::frame(&rig.person, 0.3);
        let views = views(&clean, 64);
        let mut poisoned = clean.clone();
        let poison = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38, 0.0];
        for i in 0..500 {
            let value = poison[i % poison.len()];
            if i % 2 == 0 { poisoned.center_scale[i] = [value; 4] } else { poisoned.normal[i] = [value; 4] }
        }
        let mut bad_views = views.clone();
        for view in &mut bad_views {
            view.canonical.iter_mut().step_by(3).enumerate().for_each(|(i, c)| *c = [poison[i % poison.len()]; 4]);
            view.rendered.iter_mut().step_by(2).enumerate().for_each(|(i, c)| *c = [poison[i % poison.len()]; 4]);
        }
        bad_views[0].camera.camera_from_world.translation.x = f64::NAN;
        for settings in ablations() {
            rig.appearance.reset();
            let known = rig.update(&clean, &views, &settings);
            for (frame, views) in [(&poisoned, &views), (&clean, &bad_views), (&poisoned, &bad_views)] {
                let colors = rig.update(frame, views, &settings);
                assert!(colors.as_flattened().iter().all(|c| c.is_finite() && (0.0..=1.0).contains(c)), "{settings:?}");
            }
            let colors = rig.update(&clean, &views, &settings);
            assert!(colors.as_flattened().iter().all(|c| c.is_finite()), "{settings:?}");
            if !settings.time {
                assert_eq!(bits(&colors), bits(&known), "nothing stays");
            }
        }
    });
}

#[test]
fn what_is_painted_draws_the_image_again() {
    on_both(|gpu| {
        let gaussians = 6000;
        let mut rig = Rig::new(gpu, gaussians, 300);
        let mut frame = scene::frame(&rig.person, 0.3);
        // As wide as they are apart.
        frame.center_scale.iter_mut().for_each(|c| c[3] = 0.012);
        let mut rasterizer = Rasterizer::new(&rig.gpu, gaussians).unwrap();
        let target = RenderTarget::new(&rig.gpu, 128, 128).unwrap();
        let mut error_after = |sharpness: f32, frames: usize| {
            let settings = AppearanceSettings { sharpness, ..Default::default() };
            let mut views = views(&frame, 128);
            rig.appearance.reset();
            let mut errors = (0.0, 0.0);
            for _ in 0..frames {
                rig.update(&frame, &views, &settings);
                errors = (0.0, 0.0);
                for view in &mut views {
                    let mut encoder = rig.gpu.device.create_command_encoder(&Default::default());
                    let color = RasterSettings { outputs: Outputs::COLOR, ..Default::default() };
                    rasterizer.encode(&rig.gpu, &mut encoder, &rig.buffers, &view.camera, &color, &target).unwrap();
                    rig.gpu.queue.submit([encoder.finish()]);
                    view.rendered = target.color.read(&rig.gpu).unwrap();
                    for (rendered, wanted) in view.rendered.iter().zip(view.rgba.chunks_exact(4)) {
                        if wanted[3] == 255 && rendered[3] > 0.9 {
                            let off =
                                |c: usize| rendered[c] / rendered[3] - linear_from_srgb(f32::from(wanted[c]) / 255.0);
                            errors.0 += (0..3).map(|c| off(c) * off(c)).sum::<f32>();
                            errors.1 += 3.0;
                        }
                    }
                }
            }
            (errors.0 / errors.1).sqrt()
        };
        let [plain, once, sharp] = [(0.0, 12), (0.8, 1), (0.8, 12)].map(|(share, frames)| error_after(share, frames));
        println!("RMS of the rendered images, linear light: plain {plain:.4}, sharpened {sharp:.4}");
        assert!((once - plain).abs() < 0.02 * plain, "nothing is known in the first frame: {once}, {plain}");
        assert!(sharp < 0.8 * plain, "{sharp} {plain}");
    });
}

#[test]
fn neither_background_nor_ball_paints_the_body() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 4000, 150);
        let frame = scene::frame(&rig.person, 0.0);
        // Green body, blue ball in front of it, magenta behind it.
        let paint = |p: DVec3| if p.z > 0.3 { [0, 0, 200] } else { [0, 200, 0] };
        let views: Vec<_> =
            scene::ring(96).iter().map(|camera| scene::view(&frame, camera, BACKGROUND, paint)).collect();
        let settings = AppearanceSettings { time: false, ..Default::default() };
        let colors = rig.update(&frame, &views, &settings);
        let green = linear_from_srgb(200.0 / 255.0);
        let mut bled = 0;
        for color in &colors[..rig.person.body_count] {
            // The rim's texels are half background: mask coverage 128 of 255 is hardly believed.
            assert!(color[0] < 0.02, "background: {color:?}");
            bled += usize::from(color[2] > 0.02 || color[1] < green - 0.05);
        }
        // Between the ball's outline and the belly a texel may hold either.
        assert!(bled < rig.person.body_count / 100, "{bled}");
        // The baseline projects whatever is in front.
        let baseline = AppearanceSettings { space: false, ..settings };
        let colors = rig.update(&frame, &views, &baseline);
        assert!(colors[..rig.person.body_count].iter().any(|color| color[2] > 0.1));
    });
}

#[test]
fn an_unseen_part_takes_the_mean_and_an_unseen_back_its_surroundings() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 4000, 150);
        // From behind, the ball is hidden by the body.
        let frame = scene::frame(&rig.person, 0.0);
        let camera = scene::camera("behind", std::f64::consts::PI, 96, flyrig_types::Lens::PINHOLE);
        let paint = |p: DVec3| if p.y > 1.0 { [200, 0, 0] } else { [0, 200, 0] };
        let views = [scene::view(&frame, &camera, BACKGROUND, paint)];
        let settings = AppearanceSettings { time: false, ..Default::default() };
        let colors = rig.update(&frame, &views, &settings);
        let bright = linear_from_srgb(200.0 / 255.0);
        let ball = &colors[rig.person.body_count..];
        for color in ball {
            assert!((color[0] + color[1] - bright).abs() < 0.02 && color[2] < 0.02, "{color:?}");
            assert!(color[0] > 0.3 * bright && color[1] > 0.3 * bright, "about half of each: {color:?}");
            assert!(color.iter().zip(ball[0]).all(|(a, b)| (a - b).abs() < 1e-5), "one colour: {color:?}");
        }
        // The unseen front: red above, green below.
        for (color, p) in colors.iter().zip(&rig.person.surface.positions).take(rig.person.body_count) {
            if p.z > 0.1 && (p.y - 1.0).abs() > 0.3 {
                let (wanted, other) = if p.y > 1.0 { (color[0], color[1]) } else { (color[1], color[0]) };
                assert!(wanted > 0.7 * bright && other < 0.3 * bright, "{p} {color:?}");
            }
        }
    });
}

#[test]
fn the_cascade_is_close_to_the_exact_diffusion() {
    on_both(|gpu| {
        let rig = Rig::new(gpu, 4000, 600);
        let frame = scene::frame(&rig.person, 0.3);
        let camera = scene::camera("one", 0.0, 96, flyrig_types::Lens::PINHOLE);
        let views = [scene::view(&frame, &camera, BACKGROUND, scene::pattern)];
        let levels = DiffusionHierarchy::new(&rig.person.graph).unwrap().levels;
        let settings = AppearanceSettings::default();
        let exact = reference::exact_diffusion(&rig.person, &levels, &frame, &views, &settings);
        let ours = reference::cascade_diffusion(&rig.person, &levels, &frame, &views, &settings);
        let body = rig.person.body_count;
        let errors: Vec<f64> = ours.iter().zip(&exact).take(body).map(|(a, b)| (*a - *b).abs().max_element()).collect();
        let mean = errors.iter().sum::<f64>() / body as f64;
        println!("cascade against exact: mean {mean:.4}, max {:.4}", errors.iter().copied().fold(0.0, f64::max));
        assert!(mean < 0.03, "{mean}");
    });
}

#[test]
fn refusals_name_the_view_and_the_mend() {
    on_both(|gpu| {
        let mut rig = Rig::new(gpu, 900, 40);
        let frame = scene::frame(&rig.person, 0.0);
        let views = views(&frame, 16);
        let settings = AppearanceSettings::default();
        let mut short = views.clone();
        short[1].rgba.pop();
        let message = rig.try_update(&frame, &short, &settings).unwrap_err().to_string();
        assert_eq!(message, "camera radial: the image has 255 pixels, its 16x16 image needs 256");
        let mut other = views.clone();
        other[2].canonical.pop();
        let message = rig.try_update(&frame, &other, &settings).unwrap_err().to_string();
        assert!(message.contains("camera fisheye: the canonical map has 255 pixels"), "{message}");
        let mut no_drawing = views.clone();
        no_drawing[0].rendered.clear();
        let message = rig.try_update(&frame, &no_drawing, &settings).unwrap_err().to_string();
        assert!(message.contains("the rendered image has 0 pixels"), "{message}");
        let four = [&views[..], &views[..1]].concat();
        let message = rig.try_update(&frame, &four, &settings).unwrap_err().to_string();
        assert!(message.contains("made for 3 views but is given 4"), "{message}");
        for bad in [f32::NAN, -1.0, f32::INFINITY, 0.0] {
            let settings = AppearanceSettings { memory_weight_max: bad, ..settings };
            let message = rig.try_update(&frame, &views, &settings).unwrap_err().to_string();
            assert!(message.contains("memory_weight_max is"), "{message}");
        }
        for bad in [f32::NAN, -0.1, 0.96, 1e9] {
            let settings = AppearanceSettings { sharpness: bad, ..settings };
            let message = rig.try_update(&frame, &views, &settings).unwrap_err().to_string();
            assert!(message.contains("sharpness is"), "{message}");
        }
        let mut graph = rig.person.graph.clone();
        graph.gaussian_weights[3] = [f32::NAN; 4];
        let error = DirectAppearance::new(&rig.gpu, &rig.person.surface, &graph, 1).unwrap_err().to_string();
        assert!(error.contains("Gaussian 3 has node weights"), "{error}");
        rig.buffers = GaussianBuffers::zeroed(&rig.gpu, 5).unwrap();
        let message = rig.try_update(&frame, &views, &settings).unwrap_err().to_string();
        assert!(message.contains("made for 900 Gaussians but is given 5"), "{message}");
    });
}
