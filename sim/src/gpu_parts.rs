//! Textures, plates and pipelines in wgpu's words.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use wgpu::{
    BindGroup, BindingResource, CompareFunction, RenderPipeline, Texture, TextureDescriptor, TextureDimension,
    TextureFormat, TextureUsages, TextureView, VertexAttribute, VertexBufferLayout, VertexFormat, VertexStepMode,
};

use crate::person::Person;
use crate::room::Plate;

/// Of colours that are blended and filtered.
pub(crate) const COLOR: TextureFormat = TextureFormat::Rgba8UnormSrgb;
/// Of depth pictures.
pub(crate) const DEPTH: TextureFormat = TextureFormat::Depth32Float;

/// Bind group 0 of a pipeline with derived layout, resources at bindings 0, 1, 2, ...
pub(crate) fn bind(gpu: &GpuContext, pipeline: &RenderPipeline, resources: &[BindingResource<'_>]) -> BindGroup {
    let entries: Vec<_> = (0..)
        .zip(resources)
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() })
        .collect();
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    })
}

pub(crate) fn view_of(texture: &Texture) -> TextureView {
    texture.create_view(&Default::default())
}

pub(crate) fn texture(
    gpu: &GpuContext,
    label: &str,
    [width, height, layers]: [u32; 3],
    mips: u32,
    format: TextureFormat,
    usage: TextureUsages,
) -> Texture {
    gpu.device.create_texture(&TextureDescriptor {
        label: Some(label),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: layers },
        mip_level_count: mips,
        sample_count: 1,
        dimension: TextureDimension::D2,
        format,
        usage,
        view_formats: &[],
    })
}

pub(crate) fn upload_textures(gpu: &GpuContext, person: &Person) -> TextureView {
    let side = person.textures.first().map_or(1, |texture| texture.side) as u32;
    let mips = side.ilog2() + 1;
    let usage = TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST;
    let array = texture(gpu, "person textures", [side, side, person.textures.len() as u32], mips, COLOR, usage);
    for (layer, image) in (0..).zip(&person.textures) {
        let mut image = image.clone();
        for mip in 0..mips {
            write_layer(gpu, &array, layer, mip, [side >> mip, side >> mip], &image.pixels);
            image = image.halved();
        }
    }
    array.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        ..Default::default()
    })
}

pub(crate) fn upload_plate(
    gpu: &GpuContext,
    plate: &Plate,
    [width, height]: [u32; 2],
) -> Result<(TextureView, StorageBuffer<[f32; 2]>), GpuError> {
    let usage = TextureUsages::TEXTURE_BINDING | TextureUsages::COPY_DST;
    let image = texture(gpu, "plate", [width, height, 1], 1, COLOR, usage);
    write_layer(gpu, &image, 0, 0, [width, height], &plate.rgba);
    Ok((view_of(&image), StorageBuffer::from_slice(gpu, "floor positions", &plate.floor)?))
}

pub(crate) fn write_layer(
    gpu: &GpuContext,
    texture: &Texture,
    layer: u32,
    mip: u32,
    [width, height]: [u32; 2],
    rgba: &[[u8; 4]],
) {
    let (width, height) = (width.max(1), height.max(1));
    gpu.queue.write_texture(
        wgpu::TexelCopyTextureInfo {
            texture,
            mip_level: mip,
            origin: wgpu::Origin3d { x: 0, y: 0, z: layer },
            aspect: wgpu::TextureAspect::All,
        },
        bytemuck::cast_slice(rgba),
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(width * 4), rows_per_image: Some(height) },
        wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
    );
}

pub(crate) fn pipeline(
    gpu: &GpuContext,
    module: &wgpu::ShaderModule,
    vertex: &str,
    fragment: Option<&str>,
    formats: &[TextureFormat],
) -> RenderPipeline {
    let attribute = |format, shader_location| [VertexAttribute { format, offset: 0, shader_location }];
    let attributes = [
        attribute(VertexFormat::Float32x3, 0),
        attribute(VertexFormat::Float32x3, 1),
        attribute(VertexFormat::Float32x4, 2),
        attribute(VertexFormat::Float32x4, 3),
    ];
    let buffers = attributes.each_ref().map(|attributes| {
        Some(VertexBufferLayout {
            array_stride: attributes[0].format.size(),
            step_mode: VertexStepMode::Vertex,
            attributes,
        })
    });
    let targets: Vec<_> = formats.iter().map(|&format| Some(format.into())).collect();
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(vertex),
        layout: None,
        vertex: wgpu::VertexState {
            module,
            entry_point: Some(vertex),
            compilation_options: Default::default(),
            buffers: &buffers,
        },
        // Hems and hair are seen from inside too.
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            depth_compare: Some(CompareFunction::Less),
            stencil: Default::default(),
            bias: Default::default(),
        }),
        multisample: Default::default(),
        fragment: fragment.map(|entry| wgpu::FragmentState {
            module,
            entry_point: Some(entry),
            compilation_options: Default::default(),
            targets: &targets,
        }),
        multiview_mask: None,
        cache: None,
    })
}
