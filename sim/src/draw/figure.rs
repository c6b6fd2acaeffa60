//! GPU buffers of a person.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use wgpu::util::DeviceExt;
use wgpu::{BindGroup, BindGroupLayout, Buffer, BufferUsages, RenderPass, TextureView};

use crate::draw::gpu_parts::{bind, upload_textures};
use crate::person::actor::ActorShape;
use crate::person::assembly::Person;

/// Surface of a person around an instant.
#[derive(Debug, Clone)]
pub(crate) struct Figured {
    /// Shape at each key.
    pub keys: Vec<ActorShape>,
    /// Per vertex: unoccluded fraction of the surroundings, in 0..=1.
    pub openness: Vec<f32>,
}

#[derive(Debug)]
pub(crate) struct Figure {
    points: StorageBuffer<[f32; 8]>,
    /// Fraction of each lamp's light that furniture lets through.
    shares: StorageBuffer<[f32; 4]>,
    points_bind: BindGroup,
    paint: Buffer,
    truth: Buffer,
    indices: Buffer,
    index_count: u32,
    vertex_count: usize,
    pub textures: TextureView,
}

impl Figure {
    /// Uploads a person; `main` marks the one whose truth is rendered.
    pub(crate) fn new(
        gpu: &GpuContext,
        layout: &BindGroupLayout,
        person: &Person,
        main: bool,
    ) -> Result<Self, GpuError> {
        let buffer = |label, contents: &[u8], usage| {
            let label = Some(label);
            gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label, contents, usage })
        };
        let clothed = &person.clothed;
        let vertex_count = clothed.positions.len();
        let part = |part| if main { part as u8 + 1 } else { 0 };
        let paint: Vec<[f32; 4]> = (clothed.uvs.iter().zip(&person.layer_and_openness).zip(&clothed.parts))
            .map(|((uv, &(layer, _)), &of)| [uv.x, uv.y, layer as f32, f32::from(part(of))])
            .collect();
        let truth: Vec<[f32; 4]> = person.carriers.iter().map(|p| p.extend(0.0).to_array()).collect();
        let points = StorageBuffer::zeroed(gpu, "points of a person", vertex_count)?;
        let shares = StorageBuffer::from_slice(gpu, "shade on a person", &vec![[1.0; 4]; vertex_count])?;
        Ok(Self {
            points_bind: bind(gpu, layout, &[points.raw().as_entire_binding(), shares.raw().as_entire_binding()]),
            points,
            shares,
            paint: buffer("paint of a person", bytemuck::cast_slice(&paint), BufferUsages::VERTEX),
            truth: buffer("truth of a person", bytemuck::cast_slice(&truth), BufferUsages::VERTEX),
            indices: buffer("triangles of a person", bytemuck::cast_slice(&clothed.triangles), BufferUsages::INDEX),
            index_count: clothed.triangles.len() as u32 * 3,
            vertex_count,
            textures: upload_textures(gpu, "clothes and skin of a person", &person.textures),
        })
    }

    /// Uploads the person's shapes at the keys of a moment.
    pub(crate) fn pose(
        &mut self,
        gpu: &GpuContext,
        layout: &BindGroupLayout,
        figured: &Figured,
    ) -> Result<(), GpuError> {
        let needed = self.vertex_count * figured.keys.len();
        if self.points.len() < needed {
            self.points = StorageBuffer::zeroed(gpu, "points of a person", needed)?;
            let buffers = [self.points.raw().as_entire_binding(), self.shares.raw().as_entire_binding()];
            self.points_bind = bind(gpu, layout, &buffers);
        }
        let mut points = Vec::with_capacity(needed);
        for ActorShape { positions, normals, .. } in &figured.keys {
            for ((p, n), open) in positions.iter().zip(normals).zip(&figured.openness) {
                points.push([p.x, p.y, p.z, *open, n.x, n.y, n.z, 0.0]);
            }
        }
        self.points.write(gpu, &points);
        Ok(())
    }

    /// Returns points and shares as resources of a kernel, and the number of points.
    pub(crate) fn buffers(&self) -> ([wgpu::BindingResource<'_>; 2], u32) {
        ([self.points.raw().as_entire_binding(), self.shares.raw().as_entire_binding()], self.vertex_count as u32)
    }

    /// Draws `instances`; the caller has set the pipeline and all groups except the points.
    pub(crate) fn draw(&self, pass: &mut RenderPass<'_>, instances: std::ops::Range<u32>) {
        pass.set_bind_group(1, &self.points_bind, &[]);
        pass.set_vertex_buffer(0, self.paint.slice(..));
        pass.set_vertex_buffer(1, self.truth.slice(..));
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        pass.draw_indexed(0..self.index_count, 0, instances);
    }
}
