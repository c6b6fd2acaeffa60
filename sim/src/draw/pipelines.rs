//! Bind group layouts and pipelines of the rasteriser.

use flyrig_gpu::GpuContext;
use wgpu::{BindGroupLayout, ComputePipeline, RenderPipeline, VertexFormat};

use crate::draw::constants::shader_sources;
use crate::draw::gpu_parts::{LIGHT, PipelineParts, SAMPLES, Slot, TRUTH, compute, layout, pipeline};

/// Bind group layouts, one per kind of pass.
#[derive(Debug)]
pub(crate) struct Layouts {
    pub constants: BindGroupLayout,
    pub points: BindGroupLayout,
    pub shade: BindGroupLayout,
    pub person: BindGroupLayout,
    pub room: BindGroupLayout,
    pub plate: BindGroupLayout,
    pub picture: BindGroupLayout,
}

/// Pipelines, one per pass.
#[derive(Debug)]
pub(crate) struct Pipelines {
    pub person_shadow: RenderPipeline,
    pub person_lit: RenderPipeline,
    pub person_truth: RenderPipeline,
    pub room_shadow: RenderPipeline,
    pub room_layer: RenderPipeline,
    pub room_depth: RenderPipeline,
    pub shade: ComputePipeline,
    pub plate: ComputePipeline,
    pub picture: ComputePipeline,
}

impl Layouts {
    pub(crate) fn new(gpu: &GpuContext) -> Self {
        Self {
            constants: layout(gpu, "constants", &[Slot::Constants, Slot::Constants]),
            points: layout(gpu, "points", &[Slot::Read, Slot::Read]),
            shade: layout(gpu, "shade", &[Slot::Read, Slot::Write, Slot::DepthMaps, Slot::Compare]),
            person: layout(gpu, "surface of a person", &[Slot::Textures, Slot::Smooth, Slot::DepthMaps, Slot::Compare]),
            room: layout(gpu, "surface of the room", &[Slot::Textures, Slot::Smooth, Slot::DepthMaps, Slot::Compare]),
            plate: layout(gpu, "plate", &[Slot::ManySamples, Slot::Write]),
            picture: layout(
                gpu,
                "image",
                &[
                    Slot::ManySamples,
                    Slot::ManyDepths,
                    Slot::Read,
                    Slot::Read,
                    Slot::DepthMaps,
                    Slot::Compare,
                    Slot::Write,
                    Slot::Write,
                ],
            ),
        }
    }
}

impl Pipelines {
    pub(crate) fn new(gpu: &GpuContext, layouts: &Layouts, lamps: usize) -> Self {
        let [people, shade, room, plate, picture] = shader_sources(lamps).map(|(label, source)| {
            gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(label),
                source: wgpu::ShaderSource::Wgsl(source.into()),
            })
        });
        let Layouts { constants, points, person, room: room_layout, .. } = layouts;
        let figure = |vertex, fragment, layouts, targets, samples| {
            let attributes = &[VertexFormat::Float32x4, VertexFormat::Float32x4];
            let drawn = PipelineParts {
                module: &people,
                layouts,
                vertex,
                fragment,
                attributes,
                interleaved: false,
                targets,
                samples,
            };
            pipeline(gpu, drawn)
        };
        let standing = |vertex, fragment, layouts, targets, samples| {
            let attributes = &[
                VertexFormat::Float32x3,
                VertexFormat::Float32x3,
                VertexFormat::Float32x4,
                VertexFormat::Float32x4,
                VertexFormat::Float32x2,
            ];
            let drawn = PipelineParts {
                module: &room,
                layouts,
                vertex,
                fragment,
                attributes,
                interleaved: true,
                targets,
                samples,
            };
            pipeline(gpu, drawn)
        };
        Self {
            person_shadow: figure("vs_shadow", None, &[constants, points], &[], 1),
            person_lit: figure("vs_lit", Some("fs_lit"), &[constants, points, person], &[LIGHT], SAMPLES),
            person_truth: figure("vs_truth", Some("fs_truth"), &[constants, points, person], &[TRUTH, TRUTH], 1),
            room_shadow: standing("vs_room_shadow", None, &[constants], &[], 1),
            room_layer: standing("vs_room", Some("fs_layer"), &[constants, room_layout], &[LIGHT], SAMPLES),
            room_depth: standing("vs_room", None, &[constants], &[], 1),
            shade: compute(gpu, &shade, &[constants, &layouts.shade], "shade"),
            plate: compute(gpu, &plate, &[constants, &layouts.plate], "keep"),
            picture: compute(gpu, &picture, &[constants, &layouts.picture], "compose"),
        }
    }
}
