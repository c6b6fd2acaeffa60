//! Linear blend skinning of surface Gaussians on the device or the processor.

use flyrig_gpu::{ComputeKernel, GpuContext, GpuError, StorageBuffer, dispatch_1d};
use flyrig_types::Pose;
use glam::{DMat4, Mat4, Vec3, Vec4};
use rayon::prelude::*;

use crate::{BodyError, Skeleton, SurfaceGaussians};

const WGSL: &str = include_str!("skin.wgsl");
/// Default of the kernel's `WORKGROUP_SIZE`.
const WORKGROUP_SIZE: u32 = 64;

/// Skinning of surface Gaussians in device memory: world = LBS(x + t_x), FlyHuman section 3.1. Constant data is uploaded once; a
/// frame uploads 48 bytes per joint.
#[derive(Debug)]
pub struct GpuSkinner {
    /// Compiled kernel; `None` on the processor.
    kernel: Option<ComputeKernel>,
    count: usize,
    joint_rows: StorageBuffer<[f32; 4]>,
    rest: StorageBuffer<[f32; 4]>,
    rest_normal: StorageBuffer<[f32; 4]>,
    skin_joints: StorageBuffer<[u32; 2]>,
    skin_weights: StorageBuffer<[f32; 4]>,
    no_displacement: StorageBuffer<[f32; 4]>,
}

impl GpuSkinner {
    /// Uploads these Gaussians, for poses of a skeleton with as many joints as this one.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, gaussians: &SurfaceGaussians, skeleton: &Skeleton) -> Result<Self, GpuError> {
        let rest: Vec<[f32; 4]> =
            gaussians.positions.iter().zip(&gaussians.scale_m).map(|(p, &scale)| [p.x, p.y, p.z, scale]).collect();
        let normals: Vec<[f32; 4]> =
            gaussians.normals.iter().zip(&gaussians.depth_m).map(|(n, &depth)| [n.x, n.y, n.z, depth]).collect();
        let pack = |a: u16, b: u16| u32::from(a) | u32::from(b) << 16;
        let joints: Vec<[u32; 2]> =
            gaussians.skin.iter().map(|s| [pack(s.joints[0], s.joints[1]), pack(s.joints[2], s.joints[3])]).collect();
        let weights: Vec<[f32; 4]> = gaussians.skin.iter().map(|s| s.weights).collect();
        Ok(Self {
            kernel: (!gpu.is_on_processor()).then(|| ComputeKernel::new(gpu, "skinning", &[WGSL], "skin")),
            count: gaussians.len(),
            joint_rows: StorageBuffer::zeroed(gpu, "joint matrices", skeleton.joints().len() * 3)?,
            rest: StorageBuffer::from_slice(gpu, "Gaussian rest positions", &rest)?,
            rest_normal: StorageBuffer::from_slice(gpu, "Gaussian rest normals", &normals)?,
            skin_joints: StorageBuffer::from_slice(gpu, "Gaussian joints", &joints)?,
            skin_weights: StorageBuffer::from_slice(gpu, "Gaussian skin weights", &weights)?,
            no_displacement: StorageBuffer::zeroed(gpu, "no displacement", 1)?,
        })
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn count(&self) -> usize {
        self.count
    }

    /// Records the kernel, which writes world position and scale to `center_scale`, world normal and
    /// [`SurfaceGaussians::depth_m`] to `normal`, one element per Gaussian. `displacement` holds t_x, canonical metres; its w is the
    /// relative growth of a Gaussian and of its depth below the surface ([`crate::displacement`]). Elements that are not finite
    /// count as zero. The pose is uploaded among the encoder's commands: one encoder may take several poses.
    ///
    /// # Errors
    /// [`BodyError::Pose`] when the pose does not fit or is not finite, [`BodyError::Buffer`] when a buffer is too
    /// short; nothing is recorded then.
    #[allow(clippy::too_many_arguments)]
    pub fn encode(
        &self,
        gpu: &GpuContext,
        encoder: &mut wgpu::CommandEncoder,
        skeleton: &Skeleton,
        pose: &Pose,
        displacement: Option<&StorageBuffer<[f32; 4]>>,
        center_scale: &StorageBuffer<[f32; 4]>,
        normal: &StorageBuffer<[f32; 4]>,
    ) -> Result<(), BodyError> {
        skeleton.check_pose(pose)?;
        let check = |what, buffer: &StorageBuffer<[f32; 4]>| match buffer.len() < self.count {
            true => Err(BodyError::Buffer { what, found: buffer.len(), needed: self.count }),
            false => Ok(()),
        };
        check("centres", center_scale)?;
        check("normals", normal)?;
        if let Some(displacement) = displacement {
            check("displacements", displacement)?;
        }
        let rows = skeleton.joints().len() * 3;
        if rows != self.joint_rows.len() {
            let (found, expected) = (rows / 3, self.joint_rows.len() / 3);
            return Err(BodyError::Pose(format!("a skeleton of {found} joints where the skinner has {expected}")));
        }
        let matrices = skeleton.world_from_canonical(pose);
        if self.count == 0 {
            return Ok(());
        }
        let Some(kernel) = &self.kernel else {
            self.skin(&matrices, displacement.unwrap_or(&self.no_displacement), center_scale, normal);
            return Ok(());
        };
        let joint_rows: Vec<[f32; 4]> =
            matrices.iter().flat_map(|matrix| [0, 1, 2].map(|row| matrix.row(row).as_vec4().to_array())).collect();
        self.joint_rows.encode_write(gpu, encoder, &joint_rows);
        let buffers = [
            self.joint_rows.raw(),
            self.rest.raw(),
            self.rest_normal.raw(),
            self.skin_joints.raw(),
            self.skin_weights.raw(),
            displacement.unwrap_or(&self.no_displacement).raw(),
            center_scale.raw(),
            normal.raw(),
        ];
        let bindings = kernel.bind(gpu, &buffers.map(wgpu::Buffer::as_entire_binding));
        let (x, y) = dispatch_1d(self.count as u32, WORKGROUP_SIZE);
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("skinning"), ..Default::default() });
        pass.set_pipeline(&kernel.pipeline);
        pass.set_bind_group(0, &bindings, &[]);
        gpu.count_dispatch();
        pass.dispatch_workgroups(x, y, 1);
        Ok(())
    }

    /// Runs the kernel on the processor.
    fn skin(
        &self,
        world_from_canonical: &[DMat4],
        displacement: &StorageBuffer<[f32; 4]>,
        center_scale: &StorageBuffer<[f32; 4]>,
        normal: &StorageBuffer<[f32; 4]>,
    ) {
        let joints: Vec<Mat4> = world_from_canonical.iter().map(DMat4::as_mat4).collect();
        let (Some(rest), Some(rest_normal)) = (self.rest.slice(), self.rest_normal.slice()) else { return };
        let (Some(skin_joints), Some(weights)) = (self.skin_joints.slice(), self.skin_weights.slice()) else { return };
        let (Some(displacement), Some(mut center_scale), Some(mut normal)) =
            (displacement.slice(), center_scale.slice_mut(), normal.slice_mut())
        else {
            return;
        };
        let outs = center_scale.par_iter_mut().zip(normal.par_iter_mut()).take(self.count);
        outs.enumerate().with_min_len(4096).for_each(|(i, (center_scale, normal))| {
            let mut matrix = Mat4::ZERO;
            let mut total = 0.0;
            for (k, &weight) in weights[i].iter().enumerate() {
                let joint = (skin_joints[i][k / 2] >> (16 * (k % 2))) & 0xffff;
                if let Some(joint) = joints.get(joint as usize).filter(|_| weight > 0.0) {
                    matrix += *joint * weight;
                    total += weight;
                }
            }
            let matrix = if total > 0.0 { matrix * (1.0 / total) } else { Mat4::IDENTITY };
            let [x, y, z, scale] = rest[i];
            let by = displacement.get(i).map_or(Vec4::ZERO, |by| Vec4::from(*by));
            let by = if by.truncate().is_finite() { by } else { Vec4::ZERO };
            let growth = if by.w.is_finite() { 1.0 + by.w.max(0.0) } else { 1.0 };
            let point = Vec3::new(x, y, z) + by.truncate();
            let world = matrix.x_axis * point.x + matrix.y_axis * point.y + matrix.z_axis * point.z + matrix.w_axis;
            *center_scale = [world.x, world.y, world.z, growth * scale];
            let turned = matrix.transform_vector3(Vec4::from(rest_normal[i]).truncate());
            let length_squared = turned.length_squared();
            let unit = if length_squared > 1e-20 { turned / length_squared.sqrt() } else { Vec3::ZERO };
            *normal = unit.extend(growth * rest_normal[i][3]).to_array();
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shader_is_valid() {
        let module = naga::front::wgsl::parse_str(WGSL).unwrap();
        let flags = naga::valid::ValidationFlags::all();
        naga::valid::Validator::new(flags, naga::valid::Capabilities::default()).validate(&module).unwrap();
    }
}
