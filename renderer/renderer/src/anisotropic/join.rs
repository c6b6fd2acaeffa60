//! Gaussians of several people, of one or of both kinds, in one set of anisotropic buffers, so that people hide each other.

use bytemuck::{Pod, Zeroable};
use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use glam::Vec4;
use wgpu::{CommandEncoder, ComputePassDescriptor};

use crate::SH_DEGREE_0;
use crate::anisotropic::buffers::{AnisotropicBuffers, Gaussians};
use crate::anisotropic::order::HarmonicOrder;
use crate::schema::GaussianElement;
use crate::sort::scan::run_at;

pub(crate) const WGSL: &str = include_str!("join.wgsl");

/// `struct Copy` of join.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Copy {
    count: u32,
    first: u32,
    from: u32,
    to: u32,
    factor: f32,
}

/// Joins people of both kinds into anisotropic Gaussians. Gaussians without a surface face every camera.
#[derive(Debug)]
pub struct GaussianJoin {
    /// Kernels `spread` and `scales`; `None` on the processor.
    kernels: Option<[ComputeKernel; 2]>,
    copy: StorageBuffer<Copy>,
    joined: Option<AnisotropicBuffers>,
}

impl GaussianJoin {
    /// Compiles the kernels.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext) -> Result<Self, GpuError> {
        let compile = |entry| ComputeKernel::new(gpu, entry, &[WGSL], entry);
        Ok(Self {
            kernels: (!gpu.is_on_processor()).then(|| ["spread", "scales"].map(compile)),
            copy: StorageBuffer::zeroed(gpu, "copy of Gaussians", 1)?,
            joined: None,
        })
    }

    /// Returns the people joined last; `None` before.
    #[must_use]
    pub fn joined(&self) -> Option<&AnisotropicBuffers> {
        self.joined.as_ref()
    }

    /// Records the joining of people, one after the other, and returns the buffers.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`] for more Gaussians than a buffer holds.
    pub fn encode(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        people: &[Gaussians<'_>],
    ) -> Result<&AnisotropicBuffers, GpuError> {
        let count: usize = people.iter().map(Gaussians::count).sum();
        let order = people.iter().filter_map(Gaussians::order).max_by_key(|order| order.coefficients());
        let order = order.unwrap_or(HarmonicOrder::Zero);
        let fits = |known: &AnisotropicBuffers| known.count() == count && known.order() == order;
        let joined = match self.joined.take().filter(fits) {
            Some(joined) => joined,
            None => AnisotropicBuffers::zeroed(gpu, count, order)?.with_surface(gpu)?,
        };
        let mut first = 0;
        for person in people {
            match *person {
                Gaussians::Isotropic(person) => {
                    person.center_scale.encode_copy(encoder, &joined.center, first);
                    let turns =
                        StorageBuffer::from_slice(gpu, "rotations", &vec![[0.0, 0.0, 0.0, 1.0]; person.count()])?;
                    turns.encode_copy(encoder, &joined.rotation, first);
                    let copy = Copy { count: person.count() as u32, first: first as u32, from: 1, to: 1, factor: 1.0 };
                    self.scales(gpu, encoder, copy, [&person.center_scale, &person.color, &joined.scale_opacity]);
                    let factor = 1.0 / SH_DEGREE_0;
                    let copy = Copy { to: order.coefficients() as u32, factor, ..copy };
                    self.spread(gpu, encoder, copy, [&person.color, &joined.harmonics]);
                }
                Gaussians::Anisotropic(person) => {
                    person.center.encode_copy(encoder, &joined.center, first);
                    person.scale_opacity.encode_copy(encoder, &joined.scale_opacity, first);
                    person.rotation.encode_copy(encoder, &joined.rotation, first);
                    let [from, to] = [person.order(), order].map(|order| order.coefficients() as u32);
                    let copy = Copy { count: person.count() as u32, first: first as u32, from, to, factor: 1.0 };
                    self.spread(gpu, encoder, copy, [&person.harmonics, &joined.harmonics]);
                }
            }
            if let (Some((normal, canonical)), Some(surface)) = (person.surface(), &joined.surface) {
                normal.encode_copy(encoder, &surface.normal, first);
                canonical.encode_copy(encoder, &surface.canonical, first);
            } else if let Some(surface) = &joined.surface {
                // A normal of length 0 faces away from nothing.
                let none = StorageBuffer::zeroed(gpu, "no normals", person.count())?;
                none.encode_copy(encoder, &surface.normal, first);
            }
            first += person.count();
        }
        Ok(self.joined.insert(joined))
    }

    /// Records kernel `spread` from the first buffer to the second.
    fn spread(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        copy: Copy,
        [source, out]: [&StorageBuffer<GaussianElement>; 2],
    ) {
        let Some([kernel, _]) = &self.kernels else {
            let (Some(source), Some(mut out)) = (source.slice(), out.slice_mut()) else { return };
            let (from, to) = (copy.from as usize, copy.to as usize);
            let rows = out.chunks_mut(to).skip(copy.first as usize).zip(source.chunks(from));
            rows.take(copy.count as usize).for_each(|(out, source)| {
                for (k, out) in out.iter_mut().enumerate() {
                    let row = source.get(k).map_or(Vec4::ZERO, |row| Vec4::from(*row) * copy.factor);
                    *out = row.truncate().extend(0.0).to_array();
                }
            });
            return;
        };
        self.copy.encode_write(gpu, encoder, &[copy]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("spread"), ..Default::default() });
        let resources = [(0, self.copy.raw()), (1, source.raw()), (2, out.raw())];
        let resources = resources.map(|(binding, buffer)| (binding, buffer.as_entire_binding()));
        run_at(gpu, &mut pass, kernel, &resources, dispatch_1d(copy.count * copy.to, 64));
    }

    /// Records kernel `scales` from centres with scales and colours with opacities to scales with opacities.
    fn scales(
        &self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        copy: Copy,
        [source, color, out]: [&StorageBuffer<GaussianElement>; 3],
    ) {
        let Some([_, kernel]) = &self.kernels else {
            let (Some(source), Some(color), Some(mut out)) = (source.slice(), color.slice(), out.slice_mut()) else {
                return;
            };
            for (out, (source, color)) in out.iter_mut().skip(copy.first as usize).zip(source.iter().zip(&*color)) {
                let [.., scale] = *source;
                *out = [scale, scale, scale, color[3]];
            }
            return;
        };
        self.copy.encode_write(gpu, encoder, &[copy]);
        let mut pass =
            encoder.begin_compute_pass(&ComputePassDescriptor { label: Some("scales"), ..Default::default() });
        let resources = [(0, self.copy.raw()), (1, source.raw()), (2, out.raw()), (3, color.raw())];
        let resources = resources.map(|(binding, buffer)| (binding, buffer.as_entire_binding()));
        run_at(gpu, &mut pass, kernel, &resources, dispatch_1d(copy.count, 64));
    }
}
