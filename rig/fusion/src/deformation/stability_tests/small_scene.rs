//! Person of tens of Gaussians before three small cameras, and the deformation that is tested.

use flyrig_body::{
    DEFAULT_SIGMA2_M2, DeformationGraph, GpuSkinner, ShapeParams, SurfaceGaussians, Template, build_graph,
    default_template, sample_surface, skin_normal_f64, skin_point_f64,
};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{GaussianBuffers, RasterSettings, srgb_from_linear};
use flyrig_tracker::DeformReport;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Pose};
use glam::{DMat4, DQuat, DVec3, Vec3};

use super::super::{
    DeformOptions, Deformation,
    scene::{TrackedPerson, TrackedView},
};
use super::reference::{self, blend, sorted_splats_at};

/// Person and cameras.
pub struct SmallScene {
    pub template: Template,
    pub surface: SurfaceGaussians,
    pub graph: DeformationGraph,
    /// Linear colour and opacity of every Gaussian.
    pub colors: Vec<[f32; 4]>,
    pub cameras: Vec<Camera>,
}

/// Images of one frame, each with its own pose.
pub struct SceneShot {
    pub poses: Vec<Pose>,
    /// sRGB bytes with coverage.
    pub rgba: Vec<Vec<u8>>,
}

impl SmallScene {
    pub fn new(gaussians: usize, nodes: usize, side: u32) -> Self {
        let template = default_template(&ShapeParams::default()).unwrap();
        let surface = sample_surface(&template, gaussians, 1).unwrap();
        let graph = build_graph(&template, &surface, nodes, DEFAULT_SIGMA2_M2).unwrap();
        let shade = |i: usize, k: usize| 0.15 + 0.7 * (((i * 37 + k * 71) % 101) as f32 / 101.0);
        let colors = (0..surface.len()).map(|i| [shade(i, 0), shade(i, 1), shade(i, 2), 1.0]).collect();
        let cameras = [0.1, 2.2, 4.4].into_iter().map(|azimuth| camera(azimuth, side)).collect();
        Self { template, surface, graph, colors, cameras }
    }

    /// Returns the pose in a frame: the person turns once in 150 frames and swings its limbs.
    pub fn pose(&self, frame: f64) -> Pose {
        let mut pose = self.template.skeleton.rest_pose();
        for (joint, rotation) in pose.joint_rotations.iter_mut().enumerate().skip(1) {
            let phase = frame * 0.13 + joint as f64;
            let turn = DVec3::new(phase.sin(), (0.7 * phase).cos(), (1.3 * phase).sin()) * 0.08;
            *rotation = (*rotation * DQuat::from_scaled_axis(turn)).normalize();
        }
        let turn = DQuat::from_rotation_y(frame * std::f64::consts::TAU / 150.0);
        pose.joint_rotations[0] = (turn * pose.joint_rotations[0]).normalize();
        pose.root_translation += DVec3::new((frame * 0.05).sin(), 0.0, (frame * 0.07).cos()) * 0.1;
        pose
    }

    /// Returns the displacement of the clothes from the skin, canonical metres: up to 3 cm, swinging once in 40 frames.
    pub fn cloth(x: Vec3, frame: f64) -> DVec3 {
        let x = x.as_dvec3() * 7.0;
        let size = 0.01 + 0.005 * (frame * std::f64::consts::TAU / 40.0).sin();
        size * DVec3::new(x.y.sin() + x.z.cos(), (x.x + x.z).sin(), x.y.cos() + (x.x * 1.3).sin())
    }

    /// Returns the scene as the reference draws it, and the world centres of the Gaussians of `rest` displaced by `by`.
    pub fn posed(
        &self,
        rest: &SurfaceGaussians,
        bones: &[DMat4],
        by: impl Fn(usize) -> DVec3,
    ) -> (reference::Scene, Vec<DVec3>) {
        let place = |i: usize| skin_point_f64(bones, &rest.skin[i], rest.positions[i].as_dvec3() + by(i));
        let centers: Vec<DVec3> = (0..rest.len()).map(place).collect();
        let normal = |i: usize| skin_normal_f64(bones, &rest.skin[i], rest.normals[i].as_dvec3());
        let scene = reference::Scene {
            center_scale: (0..rest.len()).map(|i| centers[i].as_vec3().extend(rest.scale_m[i]).to_array()).collect(),
            normal: (0..rest.len()).map(|i| normal(i).as_vec3().extend(0.0).to_array()).collect(),
            color: self.colors.clone(),
            canonical: vec![[0.0; 4]; rest.len()],
        };
        (scene, centers)
    }

    /// Renders the cameras' images of a frame: each exposes a quarter of a frame after the one before it.
    pub fn shot(&self, frame: f64) -> SceneShot {
        let rest = self.surface.inset();
        let mut shot = SceneShot { poses: Vec::new(), rgba: Vec::new() };
        for (k, camera) in self.cameras.iter().enumerate() {
            let pose = self.pose(frame + 0.25 * k as f64);
            let bones = self.template.skeleton.world_from_canonical(&pose);
            let (scene, centers) = self.posed(&rest, &bones, |i| Self::cloth(self.surface.positions[i], frame));
            let splats = sorted_splats_at(&scene, camera, &RasterSettings::default(), &centers);
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let byte = |value: f64| (value * 255.0).round().clamp(0.0, 255.0) as u8;
            let pixel = |c: &[f64; 4]| {
                let straight = [0, 1, 2].map(|k| c[k] / c[3].max(1e-9));
                let srgb = straight.map(|v| byte(srgb_from_linear(v as f32).into()));
                [srgb[0], srgb[1], srgb[2], byte(c[3])]
            };
            shot.rgba.push(blend(&scene, &splats, width, height).color.iter().flat_map(pixel).collect());
            shot.poses.push(pose);
        }
        shot
    }

    /// Returns a shot as inputs of the deformation.
    pub fn views<'a>(&'a self, shot: &'a SceneShot, images: &'a [StorageBuffer<u32>]) -> Vec<TrackedView<'a>> {
        let cameras = self.cameras.iter().zip(&shot.rgba).zip(images).enumerate();
        let view = |(instant, ((camera, rgba), words)): (usize, ((&'a Camera, &'a Vec<u8>), _))| TrackedView {
            camera,
            size: [camera.intrinsics.width, camera.intrinsics.height],
            rgba,
            words,
            with_unknown: false,
            instant,
        };
        cameras.map(view).collect()
    }
}

/// Returns a camera that looks at the middle of the body from 3 m away.
fn camera(azimuth: f64, side: u32) -> Camera {
    let middle = DVec3::new(0.0, 0.9, 0.0);
    let eye = middle + DVec3::new(azimuth.sin(), 0.15, azimuth.cos()) * 3.0;
    let lens = Lens::RadialTangential { radial: [-0.05, 0.01, 0.0], tangential: [0.0005, -0.0005] };
    let intrinsics = Intrinsics { lens, ..Intrinsics::pinhole(side, side, 1.2 * f64::from(side)) };
    Camera::new(format!("{azimuth}"), intrinsics, Isometry::look_at(eye, middle, DVec3::Y))
}

/// Deformation as a session runs it.
pub struct TestedDeformation {
    gpu: GpuContext,
    pub deformation: Deformation,
    gaussians: GaussianBuffers,
    skinner: GpuSkinner,
}

impl TestedDeformation {
    pub fn new(gpu: &GpuContext, scene: &SmallScene, options: DeformOptions) -> Self {
        let gaussians = GaussianBuffers::zeroed(gpu, scene.surface.len()).unwrap();
        gaussians.color.write(gpu, &scene.colors);
        Self {
            gpu: gpu.clone(),
            deformation: Deformation::new(gpu, &scene.template, &scene.surface, (&scene.graph, None), options, 0.01)
                .unwrap(),
            gaussians,
            skinner: GpuSkinner::new(gpu, &scene.surface.inset(), &scene.template.skeleton).unwrap(),
        }
    }

    /// Solves one frame; `None` without anything to compare with.
    pub fn track(&mut self, scene: &SmallScene, shot: &SceneShot) -> Option<DeformReport> {
        let instants: Vec<&Pose> = shot.poses.iter().collect();
        let lent = TrackedPerson {
            gpu: &self.gpu,
            skeleton: &scene.template.skeleton,
            poses: &instants,
            colors: &self.gaussians.color,
        };
        let image = |rgba: &Vec<u8>| StorageBuffer::from_bytes(&self.gpu, "image", rgba).unwrap();
        let images: Vec<_> = shot.rgba.iter().map(image).collect();
        self.deformation.track(lent, &scene.views(shot, &images)).unwrap();
        self.deformation.report().cloned()
    }

    /// Returns world centres and scales of all Gaussians in a pose.
    pub fn centers(&self, scene: &SmallScene, pose: &Pose) -> Vec<[f32; 4]> {
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let (centers, normals): (&StorageBuffer<_>, _) = (&self.gaussians.center_scale, &self.gaussians.normal);
        let displacement = Some(self.deformation.displacement());
        let skeleton = &scene.template.skeleton;
        self.skinner.encode(&self.gpu, &mut encoder, skeleton, pose, displacement, centers, normals).unwrap();
        self.gpu.queue.submit([encoder.finish()]);
        centers.read(&self.gpu).unwrap()
    }
}
