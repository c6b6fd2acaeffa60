//! The raster pipeline: shadow map, anti-aliased picture, truth at pixel centres.

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, read_back};
use flyrig_types::{Camera, Lens};
use glam::{Mat4, Vec2, Vec3};
use wgpu::util::DeviceExt;
use wgpu::{
    BindGroup, BindingResource, Buffer, BufferUsages, Color, CommandEncoder, CompareFunction, LoadOp, Operations,
    RenderPassColorAttachment, RenderPassDepthStencilAttachment, RenderPipeline, StoreOp, Texture, TextureFormat,
    TextureUsages, TextureView,
};

use crate::gpu_parts::{COLOR, DEPTH, bind, pipeline, texture, upload_plate, upload_textures, view_of};
use crate::person::Person;
use crate::room::Plate;

/// Colour samples a pixel side.
pub(crate) const SUPERSAMPLES: u32 = 2;
const SHADOW_PX: u32 = 1024;
/// Half the side of the lit box around the person, metres.
const SHADOW_HALF_M: f32 = 1.35;
const NEAR_M: f32 = 0.1;

/// WGSL of the drawing passes and of the composition.
pub(crate) fn shader_sources() -> [(&'static str, String); 2] {
    let constants = format!("const NEAR_M: f32 = {NEAR_M:?};\nconst SUPERSAMPLES: u32 = {SUPERSAMPLES}u;\n");
    let view = include_str!("view.wgsl");
    [
        ("simulated person", [&constants, view, include_str!("person.wgsl")].concat()),
        ("simulated picture", [&constants, view, include_str!("compose.wgsl")].concat()),
    ]
}

/// Layout of `struct View` in view.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct View {
    camera_from_world: [[f32; 4]; 4],
    light_from_world: [[f32; 4]; 4],
    focal_px: [f32; 2],
    center_px: [f32; 2],
    size_px: [f32; 2],
    padding: [f32; 2],
    lens: [f32; 4],
    fisheye: [f32; 4],
    to_light: [f32; 4],
    key: [f32; 4],
    sky: [f32; 4],
    ground: [f32; 4],
    feet: [[f32; 4]; 2],
}

/// One instant of the person in the world.
pub(crate) struct Posed {
    pub positions: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    /// Middle of the body, metres.
    pub center: Vec3,
    /// x, y of each foot, metres, and its closeness to the floor, 0..=1.
    pub feet: [Vec3; 2],
}

/// Truth at pixel centres.
pub(crate) struct Truth {
    /// Canonical position and camera-space z.
    pub canonical_depth: Vec<[f32; 4]>,
    /// Part index plus one, 0 on the background.
    pub part: Vec<u32>,
}

/// Everything on the GPU.
#[derive(Debug)]
pub(crate) struct Drawing {
    gpu: GpuContext,
    size: [u32; 2],
    view: Buffer,
    positions: Buffer,
    normals: Buffer,
    paint: Buffer,
    truth: Buffer,
    indices: Buffer,
    index_count: u32,
    shadow_pipeline: RenderPipeline,
    color_pipeline: RenderPipeline,
    truth_pipeline: RenderPipeline,
    shadow_bind: BindGroup,
    color_bind: BindGroup,
    truth_bind: BindGroup,
    compose_binds: Vec<BindGroup>,
    compose: ComputeKernel,
    shadow_map: TextureView,
    samples: TextureView,
    sample_depth: TextureView,
    canonical_depth: Texture,
    part: Texture,
    truth_depth: TextureView,
    pixels: StorageBuffer<u32>,
    light: (Mat4, [[f32; 4]; 2]),
}

impl Drawing {
    pub(crate) fn new(gpu: &GpuContext, person: &Person, size: [u32; 2], plates: &[Plate]) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let buffer = |label, content: &[u8], usage| {
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some(label),
                contents: content,
                usage,
            })
        };
        let clothed = &person.clothed;
        let paint: Vec<[f32; 4]> = clothed
            .uvs
            .iter()
            .zip(&person.layer_and_openness)
            .map(|(uv, &(layer, open))| [uv.x, uv.y, layer as f32, open])
            .collect();
        let truth: Vec<[f32; 4]> = person
            .carriers
            .iter()
            .zip(&clothed.parts)
            .map(|(p, &part)| p.extend(f32::from(part as u8)).to_array())
            .collect();
        let moving = BufferUsages::VERTEX | BufferUsages::COPY_DST;
        let still: Vec<u8> = bytemuck::cast_slice(&clothed.positions).to_vec();
        let [person_source, compose_source] = shader_sources();
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(person_source.0),
            source: wgpu::ShaderSource::Wgsl(person_source.1.into()),
        });
        let pipeline = |entry, fragment, formats: &[TextureFormat]| pipeline(gpu, &module, entry, fragment, formats);
        let shadow_pipeline = pipeline("vs_shadow", None, &[]);
        let color_pipeline = pipeline("vs_person", Some("fs_color"), &[COLOR]);
        let truth_formats = [TextureFormat::Rgba32Float, TextureFormat::R32Uint];
        let truth_pipeline = pipeline("vs_person", Some("fs_truth"), &truth_formats);
        let compose = ComputeKernel::new(gpu, compose_source.0, &[&compose_source.1], "compose");

        let [width, height] = size;
        let target = |label, width, height, format, usage| {
            texture(gpu, label, [width, height, 1], 1, format, TextureUsages::RENDER_ATTACHMENT | usage)
        };
        let bound = TextureUsages::TEXTURE_BINDING;
        let (wide, tall) = (width * SUPERSAMPLES, height * SUPERSAMPLES);
        let shadow_map = view_of(&target("shadow map", SHADOW_PX, SHADOW_PX, DEPTH, bound));
        let samples = view_of(&target("colour samples", wide, tall, COLOR, bound));
        let sample_depth = view_of(&target("sample depth", wide, tall, DEPTH, TextureUsages::empty()));
        let truth_depth = view_of(&target("truth depth", width, height, DEPTH, TextureUsages::empty()));
        let copied = TextureUsages::COPY_SRC;
        let canonical_depth = target("canonical and depth", width, height, truth_formats[0], copied);
        let part = target("parts", width, height, truth_formats[1], copied);
        // A storage buffer: Mesa's software adapter leaks with uniform ones, see ARCHITECTURE.md.
        let view = buffer("view", bytemuck::bytes_of(&View::zeroed()), BufferUsages::STORAGE | BufferUsages::COPY_DST);
        let textures = upload_textures(gpu, person);
        let smooth = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..Default::default()
        });
        let compare = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            compare: Some(CompareFunction::LessEqual),
            ..Default::default()
        });
        let uniform = view.as_entire_binding();
        let shadow_bind = bind(gpu, &shadow_pipeline, std::slice::from_ref(&uniform));
        let truth_bind = bind(gpu, &truth_pipeline, std::slice::from_ref(&uniform));
        let color_bind = bind(
            gpu,
            &color_pipeline,
            &[
                uniform.clone(),
                BindingResource::TextureView(&textures),
                BindingResource::Sampler(&smooth),
                BindingResource::TextureView(&shadow_map),
                BindingResource::Sampler(&compare),
            ],
        );
        let pixels = StorageBuffer::zeroed(gpu, "simulated picture", width as usize * height as usize)?;
        let mut compose_binds = Vec::with_capacity(plates.len());
        for plate in plates {
            let (plate_view, floor) = upload_plate(gpu, plate, size)?;
            compose_binds.push(compose.bind(
                gpu,
                &[
                    uniform.clone(),
                    BindingResource::TextureView(&samples),
                    BindingResource::TextureView(&plate_view),
                    floor.raw().as_entire_binding(),
                    BindingResource::TextureView(&shadow_map),
                    BindingResource::Sampler(&compare),
                    pixels.raw().as_entire_binding(),
                ],
            ));
        }
        Ok(Self {
            gpu: gpu.clone(),
            size,
            positions: buffer("person positions", &still, moving),
            normals: buffer("person normals", &still, moving),
            paint: buffer("person paint", bytemuck::cast_slice(&paint), BufferUsages::VERTEX),
            truth: buffer("person truth", bytemuck::cast_slice(&truth), BufferUsages::VERTEX),
            indices: buffer("person triangles", bytemuck::cast_slice(&clothed.triangles), BufferUsages::INDEX),
            index_count: clothed.triangles.len() as u32 * 3,
            view,
            shadow_pipeline,
            color_pipeline,
            truth_pipeline,
            shadow_bind,
            color_bind,
            truth_bind,
            compose_binds,
            compose,
            shadow_map,
            samples,
            sample_depth,
            canonical_depth,
            part,
            truth_depth,
            pixels,
            light: (Mat4::IDENTITY, [[0.0; 4]; 2]),
        })
    }

    /// Puts the person at an instant and draws its shadow map; serves all cameras of that instant.
    pub(crate) fn set_person(&mut self, posed: &Posed) {
        let queue = &self.gpu.queue;
        queue.write_buffer(&self.positions, 0, bytemuck::cast_slice(&posed.positions));
        queue.write_buffer(&self.normals, 0, bytemuck::cast_slice(&posed.normals));
        let eye = posed.center + to_light() * 4.0;
        let light_from_view = Mat4::from_cols_array(&[
            1.0 / SHADOW_HALF_M,
            0.0,
            0.0,
            0.0,
            0.0,
            1.0 / SHADOW_HALF_M,
            0.0,
            0.0,
            0.0,
            0.0,
            1.0 / 8.0,
            0.0,
            0.0,
            0.0,
            0.0,
            1.0,
        ]);
        let forward = -to_light();
        let right = forward.cross(Vec3::Z).normalize_or(Vec3::X);
        let up = right.cross(forward);
        let axes = glam::Mat3::from_cols(right, up, forward).transpose();
        let view_from_world = Mat4::from_mat3(axes) * Mat4::from_translation(-eye);
        let feet = posed.feet.map(|foot| foot.extend(0.0).to_array());
        self.light = (light_from_view * view_from_world, feet);
        let view = View { light_from_world: self.light.0.to_cols_array_2d(), ..View::zeroed() };
        queue.write_buffer(&self.view, 0, bytemuck::bytes_of(&view));
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.draw(&mut encoder, &self.shadow_pipeline, &self.shadow_bind, &[], &self.shadow_map);
        queue.submit([encoder.finish()]);
    }

    /// Picture of one camera: sRGB and the person's coverage.
    pub(crate) fn picture(&self, camera: &Camera, slot: usize) -> Result<Vec<[u8; 4]>, GpuError> {
        self.set_view(camera);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.draw(&mut encoder, &self.color_pipeline, &self.color_bind, &[&self.samples], &self.sample_depth);
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.compose.pipeline);
            pass.set_bind_group(0, self.compose_binds.get(slot), &[]);
            pass.dispatch_workgroups(self.size[0].div_ceil(8), self.size[1].div_ceil(8), 1);
        }
        self.gpu.queue.submit([encoder.finish()]);
        let pixels = self.pixels.read(&self.gpu)?;
        Ok(pixels.into_iter().map(u32::to_le_bytes).collect())
    }

    /// Truth of one camera.
    pub(crate) fn truth(&self, camera: &Camera) -> Result<Truth, GpuError> {
        self.set_view(camera);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let targets = [&view_of(&self.canonical_depth), &view_of(&self.part)];
        self.draw(&mut encoder, &self.truth_pipeline, &self.truth_bind, &targets, &self.truth_depth);
        self.gpu.queue.submit([encoder.finish()]);
        Ok(Truth { canonical_depth: self.read_texture(&self.canonical_depth)?, part: self.read_texture(&self.part)? })
    }

    fn set_view(&self, camera: &Camera) {
        let i = &camera.intrinsics;
        let valid = i.lens.valid_radius() as f32;
        let (lens, fisheye) = match i.lens {
            Lens::RadialTangential { radial: [k1, k2, _], .. } => ([k1 as f32, k2 as f32, valid, 0.0], [0.0; 4]),
            Lens::Fisheye { coefficients } => ([0.0, 0.0, valid, 1.0], coefficients.map(|k| k as f32)),
        };
        let view = View {
            camera_from_world: camera.camera_from_world.to_matrix().as_mat4().to_cols_array_2d(),
            light_from_world: self.light.0.to_cols_array_2d(),
            focal_px: i.focal_px.as_vec2().to_array(),
            center_px: i.center_px.as_vec2().to_array(),
            size_px: Vec2::new(i.width as f32, i.height as f32).to_array(),
            padding: [0.0; 2],
            lens,
            fisheye,
            to_light: to_light().extend(0.0).to_array(),
            key: [0.86, 0.82, 0.76, 0.0],
            sky: [0.42, 0.44, 0.47, 0.0],
            ground: [0.20, 0.175, 0.15, 0.0],
            feet: self.light.1,
        };
        self.gpu.queue.write_buffer(&self.view, 0, bytemuck::bytes_of(&view));
    }

    fn draw(
        &self,
        encoder: &mut CommandEncoder,
        pipeline: &RenderPipeline,
        group: &BindGroup,
        targets: &[&TextureView],
        depth: &TextureView,
    ) {
        let colors: Vec<_> = targets
            .iter()
            .map(|&view| {
                let ops = Operations { load: LoadOp::Clear(Color::TRANSPARENT), store: StoreOp::Store };
                Some(RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
            })
            .collect();
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: None,
            color_attachments: &colors,
            depth_stencil_attachment: Some(RenderPassDepthStencilAttachment {
                view: depth,
                depth_ops: Some(Operations { load: LoadOp::Clear(1.0), store: StoreOp::Store }),
                stencil_ops: None,
            }),
            ..Default::default()
        });
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, group, &[]);
        for (slot, buffer) in (0..).zip([&self.positions, &self.normals, &self.paint, &self.truth]) {
            pass.set_vertex_buffer(slot, buffer.slice(..));
        }
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        pass.draw_indexed(0..self.index_count, 0, 0..1);
    }

    /// Pixels of a texture without row padding; `T` is one texel.
    fn read_texture<T: Pod>(&self, texture: &Texture) -> Result<Vec<T>, GpuError> {
        let [width, height] = self.size;
        let row = width as usize * size_of::<T>();
        let padded = row.next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT as usize);
        let bytes = padded * height as usize;
        let copy = self.gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("truth copy"),
            size: bytes as u64,
            usage: BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &copy,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(padded as u32),
                    rows_per_image: None,
                },
            },
            texture.size(),
        );
        self.gpu.queue.submit([encoder.finish()]);
        let raw: Vec<u8> = read_back(&self.gpu, &copy, bytes)?;
        Ok(raw.chunks_exact(padded).flat_map(|line| bytemuck::pod_collect_to_vec::<u8, T>(&line[..row])).collect())
    }
}

/// Unit vector from the person to the key light: high, in front and to the left of camera 0's view.
fn to_light() -> Vec3 {
    Vec3::new(-0.50, -0.62, 0.95).normalize()
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_shaders_are_valid() {
        for (name, source) in super::shader_sources() {
            assert!(!source.contains("var<uniform>"), "{name}: leaks on Mesa's software adapter");
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&source)));
            let mut validator =
                naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
            let info = validator.validate(&module).unwrap_or_else(|e| panic!("{name}: {e:?}"));
            let _ = info;
            if let Some((_, view)) = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some("View"))
                && let naga::TypeInner::Struct { span, .. } = view.inner
            {
                assert_eq!(span as usize, size_of::<super::View>(), "{name}: struct View");
            }
        }
    }
}
