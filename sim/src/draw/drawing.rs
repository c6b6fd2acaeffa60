//! Rendering of one instant: shadow maps, plates, people in front of them, truth at pixel centres. All images of an
//! instant are rendered in one submission and read back together.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer, read_back};
use glam::Vec2;
use wgpu::util::DeviceExt;
use wgpu::{
    BindGroup, BindingResource, Buffer, BufferUsages, CompareFunction, LoadOp, Sampler, Texture, TextureUsages,
};

use crate::camera::optics::SubFrame;
use crate::draw::constants::{Blocks, LightBlock, ViewHead};
use crate::draw::figure::Figure;
use crate::draw::gpu_parts::{
    DEPTH, LIGHT, SAMPLES, TRUTH, array_view, begin_pass, bind, target, upload_textures, view_of,
};
use crate::draw::moment::{ImageRequest, Moment, RawImage, Step, Truth, steps};
use crate::draw::pipelines::{Layouts, Pipelines};
use crate::draw::plates::Plates;
use crate::person::actor::ActorShape;
use crate::person::assembly::Person;
use crate::room::scene::Scene;

/// Sides of the shadow maps of people and of the room, pixels.
const PEOPLE_MAP_PX: u32 = 512;
const ROOM_MAP_PX: u32 = 2048;

/// Renderer of a scene with all of its GPU resources.
#[derive(Debug)]
pub(crate) struct Drawing {
    pub(super) gpu: GpuContext,
    pub(super) size: [u32; 2],
    pub(super) scene: Scene,
    glows: bool,
    pub(super) layouts: Layouts,
    pub(super) pipelines: Pipelines,
    pub(super) people: Vec<(Figure, BindGroup)>,
    pub(super) room_vertices: Buffer,
    pub(super) room_indices: Buffer,
    pub(super) room_bind: BindGroup,
    pub(super) people_maps: Texture,
    pub(super) room_maps: Texture,
    pub(super) compare: Sampler,
    pub(super) samples: Texture,
    pub(super) depth: Texture,
    truth_depth: Texture,
    canonical_depth: Texture,
    normal_part: Texture,
    pub(super) pixels: Buffer,
    sums: Vec<Buffer>,
    plates: Plates,
    moment: Moment,
    /// Whether furniture may shade the people of the previous moment and of this one.
    pub(super) shaded: [bool; 2],
}

/// Offsets of a pass's constants: view and light.
pub(crate) type Offsets = [u32; 2];

impl Drawing {
    pub(crate) fn new(gpu: &GpuContext, size: [u32; 2], scene: Scene, people: &[&Person]) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let layouts = Layouts::new(gpu);
        let pipelines = Pipelines::new(gpu, &layouts, scene.lamps.len());
        let [width, height] = size;
        let bound = TextureUsages::TEXTURE_BINDING;
        let lamps = scene.lamps.len().max(1) as u32;
        let people_maps = target(gpu, "people to lamps", [PEOPLE_MAP_PX, PEOPLE_MAP_PX, lamps], 1, DEPTH, bound);
        let room_maps = target(gpu, "room to lamps", [ROOM_MAP_PX, ROOM_MAP_PX, lamps], 1, DEPTH, bound);
        let compare = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            compare: Some(CompareFunction::LessEqual),
            ..Default::default()
        });
        let smooth = |address_mode| {
            device.create_sampler(&wgpu::SamplerDescriptor {
                address_mode_u: address_mode,
                address_mode_v: address_mode,
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                mipmap_filter: wgpu::MipmapFilterMode::Linear,
                // Anisotropic filters take Mesa's software adapter a minute to compile.
                ..Default::default()
            })
        };
        let cloth_sampler = smooth(wgpu::AddressMode::ClampToEdge);
        let room_sampler = smooth(wgpu::AddressMode::Repeat);
        let room_textures = upload_textures(gpu, "surfaces of the room", &scene.textures);
        let mut figures = Vec::with_capacity(people.len());
        for (index, person) in people.iter().enumerate() {
            let figure = Figure::new(gpu, &layouts.points, person, index == 0)?;
            let group = bind(
                gpu,
                &layouts.person,
                &[
                    BindingResource::TextureView(&figure.textures),
                    BindingResource::Sampler(&cloth_sampler),
                    BindingResource::TextureView(&array_view(&people_maps)),
                    BindingResource::Sampler(&compare),
                ],
            );
            figures.push((figure, group));
        }
        let room_bind = bind(
            gpu,
            &layouts.room,
            &[
                BindingResource::TextureView(&room_textures),
                BindingResource::Sampler(&room_sampler),
                BindingResource::TextureView(&array_view(&room_maps)),
                BindingResource::Sampler(&compare),
            ],
        );
        let buffer = |label, contents: &[u8], usage| {
            let label = Some(label);
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label, contents, usage })
        };
        let full = [width, height, 1];
        let read = TextureUsages::COPY_SRC;
        let glows = scene.glows();
        let layers = 1 + scene.lamps.len() + usize::from(glows);
        let pixels = StorageBuffer::<[u32; 2]>::zeroed(gpu, "simulated image", width as usize * height as usize)?;
        let drawing = Self {
            gpu: gpu.clone(),
            size,
            glows,
            pipelines,
            people: figures,
            room_vertices: buffer("room", bytemuck::cast_slice(&scene.mesh.vertices), BufferUsages::VERTEX),
            room_indices: buffer(
                "triangles of the room",
                bytemuck::cast_slice(&scene.mesh.triangles),
                BufferUsages::INDEX,
            ),
            room_bind,
            people_maps,
            room_maps,
            compare,
            samples: target(gpu, "light samples", full, SAMPLES, LIGHT, bound),
            depth: target(gpu, "sample depth", full, SAMPLES, DEPTH, TextureUsages::COPY_DST),
            truth_depth: target(gpu, "truth depth", full, 1, DEPTH, TextureUsages::COPY_DST),
            canonical_depth: target(gpu, "canonical and depth", full, 1, TRUTH, read),
            normal_part: target(gpu, "normal and part", full, 1, TRUTH, read),
            pixels: pixels.raw().clone(),
            sums: Vec::new(),
            plates: Plates::new(size, layers),
            moment: Moment {
                first_secs: 0.0,
                keys_a_second: 0.0,
                people: Vec::new(),
                ball: (crate::room::lamps::STAGE, 1.0),
                bounds: Vec::new(),
                capsules: Vec::new(),
            },
            scene,
            layouts,
            shaded: [false; 2],
        };
        drawing.draw_room_maps();
        Ok(drawing)
    }

    /// Sets the people around an instant, for all cameras of that instant.
    pub(crate) fn set_moment(&mut self, moment: Moment) -> Result<(), GpuError> {
        for ((figure, _), figured) in self.people.iter_mut().zip(&moment.people) {
            figure.pose(&self.gpu, &self.layouts.points, figured)?;
        }
        let (center, radius) = moment.ball;
        let mesh = &self.scene.mesh;
        let shaded = self.scene.lamps.iter().any(|lamp| mesh.may_hide(lamp.place, center, radius));
        self.shaded = [self.shaded[1], shaded];
        self.moment = moment;
        // They are on the adapter now; what is left is their number.
        for figured in &mut self.moment.people {
            figured.keys.iter_mut().for_each(|key| *key = ActorShape::default());
            figured.openness = Vec::new();
        }
        Ok(())
    }

    /// Renders images of one instant.
    pub(crate) fn pictures(&mut self, takes: &[ImageRequest]) -> Result<Vec<RawImage>, GpuError> {
        let steps = steps(takes);
        self.plates.next_round();
        let mut blocks = Blocks::default();
        let light = self.light_offset(&mut blocks);
        let mut planned = Vec::with_capacity(steps.len());
        for step in &steps {
            let take = &takes[step.take];
            let focus_m = take.optics.focus_m;
            let (plate, fresh) = self.plates.find(&self.gpu, &take.camera, focus_m, step.frame.lens_point)?;
            let mut layers = Vec::new();
            if fresh {
                for layer in 0..self.layer_count() {
                    let mut head = ViewHead::new(&take.camera, focus_m, step.frame);
                    head.moment[3] = layer as f32;
                    layers.push([self.view_offset(&mut blocks, head, &[]), light]);
                }
            }
            let view = self.view_offset(&mut blocks, self.head(take, step), &self.rows(take, step.frame));
            planned.push((plate, layers, [view, light]));
        }
        let constants = self.upload(&blocks);
        let needs_sums = |take: usize| steps.iter().filter(|step| step.take == take).count() > 1;
        let sums: Vec<Buffer> =
            (0..takes.len()).map(|take| self.sums_of(take, needs_sums(take))).collect::<Result<_, _>>()?;

        let bytes = u64::from(self.size[0]) * u64::from(self.size[1]) * 8;
        let staging = self.gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("simulated images"),
            size: bytes * takes.len() as u64,
            usage: BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let mut shadows_at = None;
        for (step, (plate, layers, offsets)) in steps.iter().zip(&planned) {
            let people = takes[step.take].people;
            if people && shadows_at != Some(step.secs) {
                self.shade_people(&mut encoder, &constants, *offsets);
                shadows_at = Some(step.secs);
            }
            self.bake(&mut encoder, &constants, plate, layers);
            self.draw_people(&mut encoder, &constants, plate, *offsets, people);
            self.compose(&mut encoder, &constants, plate, *offsets, &sums[step.take]);
            if step.last {
                encoder.copy_buffer_to_buffer(&self.pixels, 0, &staging, bytes * step.take as u64, bytes);
            }
        }
        self.gpu.queue.submit([encoder.finish()]);
        let pixels = self.size[0] as usize * self.size[1] as usize;
        let all: Vec<[u16; 4]> = read_back(&self.gpu, &staging, pixels * takes.len())?;
        Ok(all.chunks_exact(pixels).map(<[_]>::to_vec).collect())
    }

    /// Renders the truth of one image: at the middle of its exposure through the middle of the lens, each row at its
    /// own time.
    pub(crate) fn truth(&mut self, take: &ImageRequest) -> Result<Truth, GpuError> {
        let frame = SubFrame { secs: 0.0, lens_point: Vec2::ZERO };
        let step = Step { secs: 0.0, take: 0, frame, first: true, last: true };
        let mut blocks = Blocks::default();
        let light = self.light_offset(&mut blocks);
        let view = self.view_offset(&mut blocks, self.head(take, &step), &[]);
        let constants = self.upload(&blocks);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let centre = match self.plates.centre_depth(&take.camera) {
            Some(depth) => depth,
            None => {
                let [width, height] = self.size;
                let usage = TextureUsages::COPY_SRC;
                let depth = target(&self.gpu, "depth at centres", [width, height, 1], 1, DEPTH, usage);
                let mut pass = begin_pass(&mut encoder, &[], &view_of(&depth), LoadOp::Clear(1.0));
                pass.set_pipeline(&self.pipelines.room_depth);
                pass.set_bind_group(0, &constants, &[view, light]);
                self.draw_room(&mut pass, 0, 0..1);
                drop(pass);
                self.plates.keep_centre_depth(&take.camera, &depth);
                depth
            }
        };
        encoder.copy_texture_to_texture(
            centre.as_image_copy(),
            self.truth_depth.as_image_copy(),
            self.truth_depth.size(),
        );
        let targets = [&view_of(&self.canonical_depth), &view_of(&self.normal_part)];
        {
            let mut pass = begin_pass(&mut encoder, &targets, &view_of(&self.truth_depth), LoadOp::Load);
            pass.set_pipeline(&self.pipelines.person_truth);
            pass.set_bind_group(0, &constants, &[view, light]);
            for (figure, surface) in &self.people {
                pass.set_bind_group(2, surface, &[]);
                figure.draw(&mut pass, 0..1);
            }
        }
        self.gpu.queue.submit([encoder.finish()]);
        Ok(Truth {
            canonical_depth: self.read_truth(&self.canonical_depth)?,
            normal_part: self.read_truth(&self.normal_part)?,
        })
    }

    fn layer_count(&self) -> usize {
        1 + self.scene.lamps.len() + usize::from(self.glows)
    }

    fn head(&self, take: &ImageRequest, step: &Step) -> ViewHead {
        let mut head = ViewHead::new(&take.camera, take.optics.focus_m, step.frame);
        let rows = f64::from(self.size[1]);
        head.moment[1] = (take.optics.readout_ms * 1e-3 / (rows - 1.0)) as f32;
        head.moment[2] = (0.5 * (rows - 1.0)) as f32;
        let keys = self.moment.people.first().map_or(1, |figured| figured.keys.len());
        head.keys = [self.moment.first_secs as f32, self.moment.keys_a_second as f32, keys as f32, 0.0];
        let share = 1.0 / take.optics.sub_frames().len() as f32;
        let flag = |on: bool| f32::from(u8::from(on));
        head.sum = [share, flag(step.first), flag(step.last), flag(take.people)];
        head
    }

    /// Returns each lamp's level and the ambient light at the time of each row.
    fn rows(&self, take: &ImageRequest, frame: SubFrame) -> Vec<[f32; 8]> {
        let rows = f64::from(self.size[1]);
        let row_secs = take.optics.readout_ms * 1e-3 / (rows - 1.0);
        let middle = take.nanos as f64 * 1e-9 + frame.secs;
        (0..self.size[1])
            .map(|row| {
                let secs = middle + (f64::from(row) - 0.5 * (rows - 1.0)) * row_secs;
                let mut levels = [0.0; 4];
                let mut around = self.scene.steady;
                for (to, lamp) in levels.iter_mut().zip(&self.scene.lamps) {
                    *to = lamp.level(secs);
                    around += lamp.bounce * *to;
                }
                let [a, b, c, d] = levels;
                [a, b, c, d, around.x, around.y, around.z, 0.0]
            })
            .collect()
    }

    pub(super) fn view_offset(&self, blocks: &mut Blocks, head: ViewHead, rows: &[[f32; 8]]) -> u32 {
        let mut rows = rows.to_vec();
        rows.resize(self.size[1] as usize, [0.0; 8]);
        blocks.push(&[bytemuck::bytes_of(&head), bytemuck::cast_slice(&rows)])
    }

    pub(super) fn light_offset(&self, blocks: &mut Blocks) -> u32 {
        let light = LightBlock::new(&self.scene, self.glows, &self.moment);
        blocks.push(&[bytemuck::bytes_of(&light)])
    }

    /// Uploads the blocks and binds them as group 0.
    pub(super) fn upload(&self, blocks: &Blocks) -> BindGroup {
        let buffer = self.gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("constants of a batch"),
            contents: &blocks.bytes,
            // A storage buffer: Mesa's software adapter leaks with uniform ones, see ARCHITECTURE.md.
            usage: BufferUsages::STORAGE,
        });
        let view_bytes = size_of::<ViewHead>() + 32 * self.size[1] as usize;
        let block = |bytes: usize| {
            let size = std::num::NonZeroU64::new(bytes as u64);
            BindingResource::Buffer(wgpu::BufferBinding { buffer: &buffer, offset: 0, size })
        };
        bind(&self.gpu, &self.layouts.constants, &[block(view_bytes), block(size_of::<LightBlock>())])
    }

    fn sums_of(&mut self, take: usize, needed: bool) -> Result<Buffer, GpuError> {
        while self.sums.len() <= take {
            self.sums.push(StorageBuffer::<[f32; 4]>::zeroed(&self.gpu, "no sums", 1)?.raw().clone());
        }
        let pixels = self.size[0] as usize * self.size[1] as usize;
        if needed && self.sums[take].size() < pixels as u64 * 16 {
            let sums = StorageBuffer::<[f32; 4]>::zeroed(&self.gpu, "sums of sub-frames", pixels)?;
            self.sums[take] = sums.raw().clone();
        }
        Ok(self.sums[take].clone())
    }

    /// Reads the pixels of a texture back, without row padding.
    fn read_truth(&self, texture: &Texture) -> Result<Vec<[f32; 4]>, GpuError> {
        let [width, height] = self.size;
        let row = width as usize * 16;
        let padded = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT as usize);
        let bytes = padded * height as usize;
        let copy = self.gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("truth copy"),
            size: bytes as u64,
            usage: BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let layout =
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(padded as u32), rows_per_image: None };
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo { buffer: &copy, layout },
            texture.size(),
        );
        self.gpu.queue.submit([encoder.finish()]);
        let raw: Vec<u8> = read_back(&self.gpu, &copy, bytes)?;
        Ok(raw
            .chunks_exact(padded)
            .flat_map(|line| bytemuck::pod_collect_to_vec::<u8, [f32; 4]>(&line[..row]))
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use flyrig_gpu::AdapterChoice;
    use flyrig_types::{Camera, CameraId, Intrinsics, Isometry, Lens};
    use glam::{DVec2, DVec3};

    use glam::Vec3;

    use super::*;
    use crate::camera::optics::OpticsConfig;
    use crate::room::scene_mesh::{Coat, SceneMesh};
    use crate::room::surfaces::Surface;
    use crate::texture::TextureImage;

    /// Compares the centre of light of a glowing square in the dark with the f64 camera model's, for each lens model
    /// and each corner of the image.
    #[test]
    fn furniture_lands_where_each_lens_puts_it() {
        let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();
        let lenses = [
            (1.3, Lens::PINHOLE),
            (1.1, Lens::RadialTangential { radial: [-0.25, 0.06, -0.004], tangential: [0.004, -0.003] }),
            (1.0, Lens::Rational { radial: [0.5, 0.1, 0.01, 0.8, 0.2, 0.02], tangential: [0.002, -0.001] }),
            (0.6, Lens::Fisheye { coefficients: [0.05, -0.01, 0.004, -0.001] }),
        ];
        for (focal_heights, lens) in lenses {
            let intrinsics = Intrinsics {
                width: 200,
                height: 160,
                focal_px: DVec2::splat(160.0 * focal_heights),
                center_px: DVec2::new(101.0, 78.0),
                lens,
            };
            let camera = Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: CameraId::from("00".to_owned()),
                intrinsics,
                camera_from_world: Isometry::look_at(DVec3::new(0.3, -3.0, 1.5), DVec3::new(0.0, 0.0, 1.0), DVec3::Z),
            };
            for pixel in
                [DVec2::new(30.0, 25.0), DVec2::new(172.0, 30.0), DVec2::new(96.0, 80.0), DVec2::new(170.0, 130.0)]
            {
                let corner = camera.position() + camera.ray(pixel).unwrap() * 2.5;
                let (u, v) = (DVec3::new(0.30, 0.10, 0.0), DVec3::new(0.0, 0.0, 0.22));
                let mut mesh = SceneMesh::new(0.05);
                let glow = Coat::new(Surface::Plain, Vec3::ONE).glowing(1.0, 1);
                mesh.quad((corner - u * 0.5 - v * 0.5).as_vec3(), u.as_vec3(), v.as_vec3(), glow);
                let scene = Scene {
                    mesh,
                    textures: vec![TextureImage { side: 1, pixels: vec![[255; 4]] }],
                    lamps: Vec::new(),
                    steady: Vec3::ZERO,
                    sky: Vec3::ZERO,
                    ground: Vec3::ZERO,
                };
                let mut drawing = Drawing::new(&gpu, [200, 160], scene, &[]).unwrap();
                let take =
                    ImageRequest { nanos: 0, camera: camera.clone(), optics: OpticsConfig::default(), people: false };
                let raw = drawing.pictures(&[take]).unwrap().remove(0);
                let (mut sum, mut light) = (DVec2::ZERO, 0.0);
                for (i, pixel) in raw.iter().enumerate() {
                    let here = f64::from(crate::camera::sensor::linear_of_half(pixel[1]));
                    sum += DVec2::new((i % 200) as f64, (i / 200) as f64) * here;
                    light += here;
                }
                let (mut expected, mut area) = (DVec2::ZERO, 0.0);
                const STEPS: usize = 200;
                for i in 0..STEPS * STEPS {
                    let t = DVec2::new((i % STEPS) as f64 + 0.5, (i / STEPS) as f64 + 0.5) / STEPS as f64 - 0.5;
                    let at = |t: DVec2| camera.project(corner + u * t.x + v * t.y).unwrap();
                    let step = 0.5 / STEPS as f64;
                    let (dx, dy) = (
                        at(t + DVec2::X * step) - at(t - DVec2::X * step),
                        at(t + DVec2::Y * step) - at(t - DVec2::Y * step),
                    );
                    let here = dx.perp_dot(dy).abs();
                    expected += at(t) * here;
                    area += here;
                }
                let off = (sum / light - expected / area).length();
                println!("{lens:?} at {pixel}: {off:.4} px off, {light:.1} of {area:.1} pixels");
                assert!(off < 0.1, "{lens:?} at {pixel}: {off} px");
                assert!((light / area - 1.0).abs() < 0.02, "{light} of {area}");
            }
        }
    }
}
