//! Textures, bind group layouts and pipelines in terms of wgpu.

use flyrig_gpu::GpuContext;
use wgpu::{
    BindGroup, BindGroupLayout, BindGroupLayoutEntry, BindingResource, BindingType, BufferBindingType, Color,
    CommandEncoder, CompareFunction, ComputePipeline, LoadOp, Operations, RenderPass, RenderPassColorAttachment,
    RenderPassDepthStencilAttachment, RenderPipeline, SamplerBindingType, ShaderModule, ShaderStages, StoreOp, Texture,
    TextureDescriptor, TextureDimension, TextureFormat, TextureSampleType, TextureUsages, TextureView,
    TextureViewDimension, VertexAttribute, VertexBufferLayout, VertexFormat, VertexStepMode,
};

use crate::texture::{TextureImage, linear_from_srgb};

/// Format of rendered light.
pub(crate) const LIGHT: TextureFormat = TextureFormat::Rgba16Float;
/// Format of textures: square roots of linear colour, which Mesa's software adapter filters faster than sRGB.
const PAINT: TextureFormat = TextureFormat::Rgba8Unorm;
/// Format of depth images.
pub(crate) const DEPTH: TextureFormat = TextureFormat::Depth32Float;
/// Format of truth images.
pub(crate) const TRUTH: TextureFormat = TextureFormat::Rgba32Float;
/// Samples per pixel.
pub(crate) const SAMPLES: u32 = 4;

/// Kind of a binding, in the order of a group's bindings.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Slot {
    /// Storage buffer with a dynamic offset.
    Constants,
    Read,
    Write,
    Textures,
    DepthMaps,
    ManySamples,
    ManyDepths,
    Smooth,
    Compare,
}

pub(crate) fn layout(gpu: &GpuContext, label: &str, slots: &[Slot]) -> BindGroupLayout {
    let texture =
        |sample_type, view_dimension, multisampled| BindingType::Texture { sample_type, view_dimension, multisampled };
    let buffer = |read_only, has_dynamic_offset| BindingType::Buffer {
        ty: BufferBindingType::Storage { read_only },
        has_dynamic_offset,
        min_binding_size: None,
    };
    let entries: Vec<_> = (0..)
        .zip(slots)
        .map(|(binding, slot)| BindGroupLayoutEntry {
            binding,
            visibility: match slot {
                Slot::Write => ShaderStages::COMPUTE,
                _ => ShaderStages::VERTEX_FRAGMENT | ShaderStages::COMPUTE,
            },
            ty: match slot {
                Slot::Constants => buffer(true, true),
                Slot::Read => buffer(true, false),
                Slot::Write => buffer(false, false),
                Slot::Textures => {
                    texture(TextureSampleType::Float { filterable: true }, TextureViewDimension::D2Array, false)
                }
                Slot::DepthMaps => texture(TextureSampleType::Depth, TextureViewDimension::D2Array, false),
                Slot::ManySamples => {
                    texture(TextureSampleType::Float { filterable: false }, TextureViewDimension::D2, true)
                }
                Slot::ManyDepths => texture(TextureSampleType::Depth, TextureViewDimension::D2, true),
                Slot::Smooth => BindingType::Sampler(SamplerBindingType::Filtering),
                Slot::Compare => BindingType::Sampler(SamplerBindingType::Comparison),
            },
            count: None,
        })
        .collect();
    gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries })
}

/// Creates a bind group of resources at bindings 0, 1, 2, ...
pub(crate) fn bind(gpu: &GpuContext, layout: &BindGroupLayout, resources: &[BindingResource<'_>]) -> BindGroup {
    let entries: Vec<_> = (0..)
        .zip(resources)
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() })
        .collect();
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

pub(crate) fn view_of(texture: &Texture) -> TextureView {
    texture.create_view(&Default::default())
}

pub(crate) fn array_view(texture: &Texture) -> TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(TextureViewDimension::D2Array),
        ..Default::default()
    })
}

/// Returns a view of one layer of an array, as a render target.
pub(crate) fn layer_view(texture: &Texture, layer: u32) -> TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(TextureViewDimension::D2),
        base_array_layer: layer,
        array_layer_count: Some(1),
        ..Default::default()
    })
}

pub(crate) fn target(
    gpu: &GpuContext,
    label: &str,
    [width, height, layers]: [u32; 3],
    sample_count: u32,
    format: TextureFormat,
    usage: TextureUsages,
) -> Texture {
    gpu.device.create_texture(&TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: layers },
        mip_level_count: 1,
        sample_count,
        dimension: TextureDimension::D2,
        format,
        usage: usage | TextureUsages::RENDER_ATTACHMENT,
        view_formats: &[],
    })
}

/// Uploads textures of equal size as an array with mip levels.
pub(crate) fn upload_textures(gpu: &GpuContext, label: &str, pictures: &[TextureImage]) -> TextureView {
    let roots: Vec<u8> = (0..=255).map(|v| (linear_from_srgb(v as f32 / 255.0).sqrt() * 255.0).round() as u8).collect();
    let side = pictures.first().map_or(1, |picture| picture.side) as u32;
    let array = gpu.device.create_texture(&TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width: side, height: side, depth_or_array_layers: pictures.len().max(1) as u32 },
        mip_level_count: side.ilog2() + 1,
        sample_count: 1,
        dimension: TextureDimension::D2,
        format: PAINT,
        usage: TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST,
        view_formats: &[],
    });
    for (layer, picture) in (0..).zip(pictures) {
        let mut picture = picture.clone();
        for mip in 0..array.mip_level_count() {
            let side = (side >> mip).max(1);
            let root = |byte: u8| roots[usize::from(byte)];
            let texels: Vec<[u8; 4]> =
                picture.pixels.iter().map(|&[r, g, b, a]| [root(r), root(g), root(b), a]).collect();
            gpu.queue.write_texture(
                wgpu::TexelCopyTextureInfo {
                    texture: &array,
                    mip_level: mip,
                    origin: wgpu::Origin3d { x: 0, y: 0, z: layer },
                    aspect: wgpu::TextureAspect::All,
                },
                bytemuck::cast_slice(&texels),
                wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(side * 4), rows_per_image: Some(side) },
                wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 1 },
            );
            picture = picture.halved();
        }
    }
    array_view(&array)
}

/// Parts of a render pipeline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PipelineParts<'a> {
    pub module: &'a ShaderModule,
    pub layouts: &'a [&'a BindGroupLayout],
    pub vertex: &'a str,
    pub fragment: Option<&'a str>,
    /// Vertex attributes, and whether they share one buffer.
    pub attributes: &'a [VertexFormat],
    pub interleaved: bool,
    pub targets: &'a [TextureFormat],
    pub samples: u32,
}

pub(crate) fn pipeline(gpu: &GpuContext, drawn: PipelineParts<'_>) -> RenderPipeline {
    let mut offset = 0;
    let attributes: Vec<VertexAttribute> = (0..)
        .zip(drawn.attributes)
        .map(|(shader_location, &format)| {
            let at = if drawn.interleaved { offset } else { 0 };
            offset += format.size();
            VertexAttribute { format, offset: at, shader_location }
        })
        .collect();
    let stride = |attributes: &[VertexAttribute]| attributes.iter().map(|a| a.format.size()).sum();
    let per_buffer = if drawn.interleaved { attributes.len().max(1) } else { 1 };
    let buffers: Vec<_> = attributes
        .chunks(per_buffer)
        .map(|attributes| {
            let step_mode = VertexStepMode::Vertex;
            Some(VertexBufferLayout { array_stride: stride(attributes), step_mode, attributes })
        })
        .collect();
    let targets: Vec<_> = drawn.targets.iter().map(|&format| Some(format.into())).collect();
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(drawn.vertex),
        layout: Some(&pipeline_layout(gpu, drawn.layouts)),
        vertex: wgpu::VertexState {
            module: drawn.module,
            entry_point: Some(drawn.vertex),
            compilation_options: Default::default(),
            buffers: &buffers,
        },
        // Hems, hair and leaves are seen from inside too.
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            // The layers of a plate are drawn over the same depth.
            depth_compare: Some(CompareFunction::LessEqual),
            stencil: Default::default(),
            bias: Default::default(),
        }),
        multisample: wgpu::MultisampleState { count: drawn.samples, ..Default::default() },
        fragment: drawn.fragment.map(|entry| wgpu::FragmentState {
            module: drawn.module,
            entry_point: Some(entry),
            compilation_options: Default::default(),
            targets: &targets,
        }),
        multiview_mask: None,
        cache: None,
    })
}

pub(crate) fn compute(
    gpu: &GpuContext,
    module: &ShaderModule,
    layouts: &[&BindGroupLayout],
    entry: &str,
) -> ComputePipeline {
    gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(entry),
        layout: Some(&pipeline_layout(gpu, layouts)),
        module,
        entry_point: Some(entry),
        compilation_options: Default::default(),
        cache: None,
    })
}

fn pipeline_layout(gpu: &GpuContext, layouts: &[&BindGroupLayout]) -> wgpu::PipelineLayout {
    let layouts: Vec<_> = layouts.iter().map(|&layout| Some(layout)).collect();
    gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: None,
        bind_group_layouts: &layouts,
        immediate_size: 0,
    })
}

/// Begins a render pass that clears `targets` and loads depth as given.
pub(crate) fn begin_pass<'a>(
    encoder: &'a mut CommandEncoder,
    targets: &[&TextureView],
    depth: &TextureView,
    depth_load: LoadOp<f32>,
) -> RenderPass<'a> {
    let colors: Vec<_> = targets
        .iter()
        .map(|&view| {
            let ops = Operations { load: LoadOp::Clear(Color::TRANSPARENT), store: StoreOp::Store };
            Some(RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
        })
        .collect();
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: None,
        color_attachments: &colors,
        depth_stencil_attachment: Some(RenderPassDepthStencilAttachment {
            view: depth,
            depth_ops: Some(Operations { load: depth_load, store: StoreOp::Store }),
            stencil_ops: None,
        }),
        ..Default::default()
    })
}
