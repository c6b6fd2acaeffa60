//! Passes of the rasteriser: shadow maps, plates, people, and the sum of sub-frames.

use bytemuck::Zeroable;
use wgpu::{BindGroup, BindingResource, Buffer, CommandEncoder, ComputePipeline, LoadOp};

use crate::draw::constants::{Blocks, ViewHead};
use crate::draw::drawing::{Drawing, Offsets};
use crate::draw::gpu_parts::{array_view, begin_pass, bind, layer_view, view_of};
use crate::draw::plates::RoomPlate;

impl Drawing {
    pub(super) fn draw_room_maps(&self) {
        let mut blocks = Blocks::default();
        let light = self.light_offset(&mut blocks);
        let view = self.view_offset(&mut blocks, ViewHead::zeroed(), &[]);
        let constants = self.upload(&blocks);
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        for lamp in 0..self.scene.lamps.len() as u32 {
            let mut pass = begin_pass(&mut encoder, &[], &layer_view(&self.room_maps, lamp), LoadOp::Clear(1.0));
            pass.set_pipeline(&self.pipelines.room_shadow);
            pass.set_bind_group(0, &constants, &[view, light]);
            self.draw_room(&mut pass, self.scene.mesh.first_caster, lamp..lamp + 1);
        }
        self.gpu.queue.submit([encoder.finish()]);
    }

    /// Renders the shadow maps of people at a time, and the furniture's shade on them.
    pub(super) fn shade_people(&self, encoder: &mut CommandEncoder, constants: &BindGroup, offsets: Offsets) {
        let shaded = if self.shaded == [false; 2] { &[][..] } else { &self.people };
        for (figure, _) in shaded {
            let ([points, shares], count) = figure.buffers();
            let group = [
                points,
                shares,
                BindingResource::TextureView(&array_view(&self.room_maps)),
                BindingResource::Sampler(&self.compare),
            ];
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.pipelines.shade);
            pass.set_bind_group(0, constants, &offsets);
            pass.set_bind_group(1, &bind(&self.gpu, &self.layouts.shade, &group), &[]);
            pass.dispatch_workgroups(count.div_ceil(64), 1, 1);
        }
        for lamp in 0..self.scene.lamps.len() as u32 {
            let mut pass = begin_pass(encoder, &[], &layer_view(&self.people_maps, lamp), LoadOp::Clear(1.0));
            pass.set_pipeline(&self.pipelines.person_shadow);
            pass.set_bind_group(0, constants, &offsets);
            for (figure, _) in &self.people {
                figure.draw(&mut pass, lamp..lamp + 1);
            }
        }
    }

    pub(super) fn bake(
        &self,
        encoder: &mut CommandEncoder,
        constants: &BindGroup,
        plate: &RoomPlate,
        layers: &[Offsets],
    ) {
        let (samples, depth) = (view_of(&self.samples), view_of(&plate.depth));
        let group = [BindingResource::TextureView(&samples), plate.layers.as_entire_binding()];
        for (layer, offsets) in layers.iter().enumerate() {
            let load = if layer == 0 { LoadOp::Clear(1.0) } else { LoadOp::Load };
            {
                let mut pass = begin_pass(encoder, &[&samples], &depth, load);
                pass.set_pipeline(&self.pipelines.room_layer);
                pass.set_bind_group(0, constants, offsets);
                pass.set_bind_group(1, &self.room_bind, &[]);
                self.draw_room(&mut pass, 0, 0..1);
            }
            let group = bind(&self.gpu, &self.layouts.plate, &group);
            self.dispatch(encoder, &self.pipelines.plate, constants, *offsets, &group);
        }
    }

    pub(super) fn draw_people(
        &self,
        encoder: &mut CommandEncoder,
        constants: &BindGroup,
        plate: &RoomPlate,
        offsets: Offsets,
        people: bool,
    ) {
        encoder.copy_texture_to_texture(plate.depth.as_image_copy(), self.depth.as_image_copy(), self.depth.size());
        let mut pass = begin_pass(encoder, &[&view_of(&self.samples)], &view_of(&self.depth), LoadOp::Load);
        if !people {
            return;
        }
        pass.set_pipeline(&self.pipelines.person_lit);
        pass.set_bind_group(0, constants, &offsets);
        for (figure, surface) in &self.people {
            pass.set_bind_group(2, surface, &[]);
            figure.draw(&mut pass, 0..1);
        }
    }

    pub(super) fn compose(
        &self,
        encoder: &mut CommandEncoder,
        constants: &BindGroup,
        plate: &RoomPlate,
        offsets: Offsets,
        sums: &Buffer,
    ) {
        let group = bind(
            &self.gpu,
            &self.layouts.picture,
            &[
                BindingResource::TextureView(&view_of(&self.samples)),
                BindingResource::TextureView(&view_of(&plate.depth)),
                plate.layers.as_entire_binding(),
                plate.directions.as_entire_binding(),
                BindingResource::TextureView(&array_view(&self.people_maps)),
                BindingResource::Sampler(&self.compare),
                sums.as_entire_binding(),
                self.pixels.as_entire_binding(),
            ],
        );
        self.dispatch(encoder, &self.pipelines.picture, constants, offsets, &group);
    }

    /// Runs a kernel over all pixels.
    pub(super) fn dispatch(
        &self,
        encoder: &mut CommandEncoder,
        pipeline: &ComputePipeline,
        constants: &BindGroup,
        offsets: Offsets,
        group: &BindGroup,
    ) {
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, constants, &offsets);
        pass.set_bind_group(1, group, &[]);
        pass.dispatch_workgroups(self.size[0].div_ceil(8), self.size[1].div_ceil(8), 1);
    }

    pub(super) fn draw_room(
        &self,
        pass: &mut wgpu::RenderPass<'_>,
        first_triangle: usize,
        instances: std::ops::Range<u32>,
    ) {
        let range = first_triangle as u32 * 3..self.scene.mesh.triangles.len() as u32 * 3;
        if range.is_empty() {
            return;
        }
        pass.set_vertex_buffer(0, self.room_vertices.slice(..));
        pass.set_index_buffer(self.room_indices.slice(..), wgpu::IndexFormat::Uint32);
        pass.draw_indexed(range, 0, instances);
    }
}
