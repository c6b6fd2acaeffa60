//! Whole frames through direct appearance and the networks.
#![allow(clippy::unwrap_used)] // helpers of tests

use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, ShapeParams, SurfaceGaussians, build_graph, default_template, sample_surface,
};
use flyrig_gpu::{AdapterChoice, GpuContext, StorageBuffer};
use flyrig_renderer::{
    AppearanceSettings, DirectAppearance, GaussianBuffers, Observations, Outputs, RasterSettings, Rasterizer,
    RenderTarget, ViewInput, rgba8_from_target,
};
use flyrig_stfa::{BodyGraph, Crops, LearnedAppearance, NetworkSize, Parameters, ViewImage, frame_inputs};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

const SIZE: [u32; 2] = [96, 128];
const GAUSSIANS: usize = 5000;

struct Stage {
    gpu: GpuContext,
    surface: SurfaceGaussians,
    graph: DeformationGraph,
    buffers: GaussianBuffers,
    rasterizer: Rasterizer,
    appearance: DirectAppearance,
}

impl Stage {
    fn new() -> Self {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, GAUSSIANS, 1).unwrap();
        let graph = build_graph(&template, &surface, 300, DEFAULT_SIGMA2_M2).unwrap();
        let buffers = GaussianBuffers::zeroed(&gpu, GAUSSIANS).unwrap();
        let quad = |v: glam::Vec3, w: f32| v.extend(w).to_array();
        let centers: Vec<_> = surface.positions.iter().zip(&surface.scale_m).map(|(p, s)| quad(*p, *s)).collect();
        buffers.center_scale.write(&gpu, &centers);
        buffers.normal.write(&gpu, &surface.normals.iter().map(|n| quad(*n, 0.0)).collect::<Vec<_>>());
        buffers.canonical.write(&gpu, &surface.positions.iter().map(|p| quad(*p, 1.0)).collect::<Vec<_>>());
        let rasterizer = Rasterizer::new(&gpu, GAUSSIANS).unwrap();
        let mut appearance = DirectAppearance::new(&gpu, &surface, &graph, 3).unwrap();
        appearance.keep_observations(&gpu).unwrap();
        Self { gpu, surface, graph, buffers, rasterizer, appearance }
    }

    fn body(&self) -> BodyGraph {
        BodyGraph::new(&self.surface, &self.graph).unwrap()
    }

    fn camera(azimuth: f64) -> Camera {
        let middle = DVec3::new(0.0, 0.85, 0.0);
        let [width, height] = SIZE;
        Camera {
            time_offset_nanos: 0,
            color: Default::default(),
            id: format!("{azimuth}").as_str().into(),
            intrinsics: Intrinsics {
                width,
                height,
                focal_px: DVec2::splat(180.0),
                center_px: DVec2::new(f64::from(width) * 0.5 - 0.5, f64::from(height) * 0.5 - 0.5),
                lens: Lens::RadialTangential { radial: [0.0; 3], tangential: [0.0; 2] },
            },
            camera_from_world: Isometry::look_at(
                middle + DVec3::new(azimuth.sin(), 0.1, azimuth.cos()) * 3.0,
                middle,
                DVec3::Y,
            ),
        }
    }

    fn draw(&mut self, camera: &Camera) -> RenderTarget {
        let target = RenderTarget::new(&self.gpu, SIZE[0], SIZE[1]).unwrap();
        let settings = RasterSettings { outputs: Outputs::ALL, ..RasterSettings::default() };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.rasterizer.encode(&self.gpu, &mut encoder, &self.buffers, camera, &settings, &target).unwrap();
        self.gpu.queue.submit([encoder.finish()]);
        target
    }

    /// Cloth with a pattern that moves with `time`, as the camera sees it.
    fn picture(&mut self, camera: &Camera, time: f32) -> Vec<u8> {
        let pattern = |p: &glam::Vec3| {
            [p.x, p.y, p.z].map(|v| 0.45 + 0.4 * (25.0 * v + time).sin()).into_iter().chain([1.0]).collect::<Vec<_>>()
        };
        let colors: Vec<[f32; 4]> = self.surface.positions.iter().map(|p| pattern(p).try_into().unwrap()).collect();
        self.buffers.color.write(&self.gpu, &colors);
        let target = self.draw(camera);
        rgba8_from_target(&target.color.read(&self.gpu).unwrap())
    }

    /// Runs direct appearance and returns its colours and observations.
    fn update(
        &mut self,
        cameras: &[Camera],
        pictures: &[Vec<u8>],
        settings: &AppearanceSettings,
    ) -> (Vec<[f32; 4]>, Observations) {
        let targets: Vec<RenderTarget> = cameras.iter().map(|camera| self.draw(camera)).collect();
        let images: Vec<_> =
            pictures.iter().map(|rgba| StorageBuffer::from_bytes(&self.gpu, "image", rgba).unwrap()).collect();
        let views: Vec<ViewInput<'_>> = cameras
            .iter()
            .zip(&images)
            .zip(&targets)
            .map(|((camera, picture), target)| ViewInput {
                camera,
                picture,
                canonical: &target.canonical,
                rendered: &target.color,
                gaussians: None,
            })
            .collect();
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.appearance.update(&self.gpu, &mut encoder, &self.buffers, &views, settings).unwrap();
        self.gpu.queue.submit([encoder.finish()]);
        let observed = self.appearance.observations(&self.gpu, cameras.len()).unwrap();
        (self.buffers.color.read(&self.gpu).unwrap(), observed)
    }
}

fn views(pictures: &[Vec<u8>]) -> Vec<ViewImage<'_>> {
    pictures.iter().map(|rgba| ViewImage { width: SIZE[0], height: SIZE[1], rgba }).collect()
}

#[test]
fn untrained_networks_paint_direct_appearance_over_time() {
    let mut stage = Stage::new();
    for (space, time) in [(true, true), (true, false), (false, false)] {
        let settings = AppearanceSettings { space, time, ..AppearanceSettings::default() };
        stage.appearance.reset();
        let mut learned = LearnedAppearance::new(&Parameters::untrained(NetworkSize::SMALL, 1), stage.body());
        for frame in 0..3 {
            let cameras = [0.0, 2.1, 4.2].map(|a| Stage::camera(a + 0.5 * f64::from(frame)));
            // The last frame misses a camera.
            let cameras = &cameras[..if frame == 2 { 2 } else { 3 }];
            let pictures: Vec<_> = cameras.iter().map(|camera| stage.picture(camera, frame as f32)).collect();
            let (direct, observed) = stage.update(cameras, &pictures, &settings);
            let ours = learned.paint(&observed, &views(&pictures), &settings).unwrap();
            let worst =
                ours.as_flattened().iter().zip(direct.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 2e-3, "space {space}, time {time}, frame {frame}: off by {worst}");
        }
        assert_eq!(learned.counts.poisoned, 0);
    }
}

#[test]
fn observations_tell_which_view_saw_what() {
    let mut stage = Stage::new();
    let settings = AppearanceSettings { time: false, ..AppearanceSettings::default() };
    let cameras = [0.0, 2.1].map(Stage::camera);
    let pictures: Vec<_> = cameras.iter().map(|camera| stage.picture(camera, 0.0)).collect();
    let (_, observed) = stage.update(&cameras, &pictures, &settings);
    let mut seen = 0;
    for (gaussian, quality) in observed.quality.iter().enumerate() {
        let mut sum = 0.0;
        for (view, camera) in observed.views.iter().zip(&cameras) {
            let [x, y, weight, nearness] = view[gaussian];
            sum += weight;
            if weight > 0.0 {
                seen += 1;
                let pixel = camera.project(stage.surface.positions[gaussian].as_dvec3()).unwrap();
                assert!((pixel - DVec2::new(x.into(), y.into())).length() < 0.01, "Gaussian {gaussian}");
                assert!((0.0..=1.0).contains(&nearness) && nearness <= quality[1] + 1e-6);
            }
        }
        assert!((sum - quality[0]).abs() < 1e-5, "Gaussian {gaussian}: {sum} against {}", quality[0]);
    }
    assert!(seen > GAUSSIANS / 2, "{seen} looks");
}

#[test]
fn poison_never_reaches_the_colours() {
    let mut stage = Stage::new();
    let settings = AppearanceSettings::default();
    let cameras = [0.0, 2.1].map(Stage::camera);
    let pictures: Vec<_> = cameras.iter().map(|camera| stage.picture(camera, 0.0)).collect();
    let (_, observed) = stage.update(&cameras, &pictures, &settings);
    let mut parameters = Parameters::untrained(NetworkSize::SMALL, 1);
    let mut learned = LearnedAppearance::new(&parameters, stage.body());
    let finite = |colors: &[[f32; 4]]| colors.as_flattened().iter().all(|v| (0.0..=1.0).contains(v));

    let mut bad = observed.clone();
    for (i, view) in bad.views[0].iter_mut().enumerate() {
        view[i % 4] = [f32::NAN, f32::INFINITY, -1e30][i % 3];
    }
    bad.seen[7] = [f32::NAN; 4];
    bad.quality[8] = [f32::INFINITY; 2];
    bad.node_color[3] = [f32::NAN; 4];
    bad.node_seen[5] = [f32::NEG_INFINITY; 4];
    assert!(finite(&learned.paint(&bad, &views(&pictures), &settings).unwrap()));
    // The memory has kept nothing of it: the next good frame is as without.
    learned.reset();
    let after = learned.paint(&observed, &views(&pictures), &settings).unwrap();
    let fresh =
        LearnedAppearance::new(&parameters, stage.body()).paint(&observed, &views(&pictures), &settings).unwrap();
    assert_eq!(after, fresh);

    // A black image, an image without a person, no image at all.
    let black: Vec<u8> = pictures[0].chunks_exact(4).flat_map(|p| [0, 0, 0, p[3]]).collect();
    let nobody = vec![0; pictures[0].len()];
    for given in [vec![black, pictures[1].clone()], vec![nobody.clone(), nobody]] {
        let (_, observed) = stage.update(&cameras, &given, &settings);
        assert!(finite(&learned.paint(&observed, &views(&given), &settings).unwrap()));
    }
    let (_, blind) = stage.update(&[], &[], &settings);
    assert!(finite(&learned.paint(&blind, &[], &settings).unwrap()));

    // Views that do not belong to the observations are refused.
    let error = learned.paint(&observed, &views(&pictures[..1]), &settings).unwrap_err().to_string();
    assert!(error.contains("2 views, expected 1"), "{error}");
    parameters = Parameters::untrained(NetworkSize::SMALL, 2);
    assert!(parameters.is_finite() && parameters.count() > 10_000);
}

#[test]
fn some_gaussians_are_gathered_as_all_are() {
    let mut stage = Stage::new();
    let settings = AppearanceSettings::default();
    let cameras = [0.0, 2.1, 4.2].map(Stage::camera);
    let pictures: Vec<_> = cameras.iter().map(|camera| stage.picture(camera, 0.0)).collect();
    let (_, observed) = stage.update(&cameras, &pictures, &settings);
    let crops = Crops::cut(&views(&pictures)).unwrap();
    let body = stage.body();
    let all = frame_inputs(&body, &observed, &crops, &settings, None).unwrap();
    let which = [17, 3, 4999];
    let some = frame_inputs(&body, &observed, &crops, &settings, Some(&which)).unwrap();
    for (row, &gaussian) in which.iter().enumerate() {
        let bits = |state: &[f32]| state.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&some.state[row]), bits(&all.state[gaussian as usize]));
        assert_eq!(some.taps.row(row), all.taps.row(gaussian as usize));
    }
    assert_eq!(some.nodes, all.nodes);
    let error = frame_inputs(&body, &observed, &crops, &settings, Some(&[5000])).unwrap_err().to_string();
    assert!(error.contains("Gaussian 5000 of 5000"), "{error}");
}
