//! Rendering of an avatar.

use flyrig_body::Part;
use flyrig_gpu::{GpuContext, GpuError};
use flyrig_renderer::{AnisotropicBuffers, ViewPainter};
use flyrig_types::{Camera, Pose, RenderedView};
use glam::{DVec2, DVec3};

use crate::model::avatar::{Attachment, Avatar};
use crate::model::posing::{Bones, PosedAvatar};
use flyrig_fit::Element;

/// Posed avatar on the adapter, as seen from one camera.
#[derive(Debug)]
pub(crate) struct AvatarBuffers {
    pub gaussians: AnisotropicBuffers,
    scale_opacity: Vec<Element>,
}

impl AvatarBuffers {
    pub fn new(gpu: &GpuContext, avatar: &Avatar) -> Result<Self, GpuError> {
        let gaussians = AnisotropicBuffers::zeroed(gpu, avatar.gaussians(), avatar.parameters.order())?;
        Ok(Self { gaussians, scale_opacity: Vec::new() })
    }

    pub fn pose(&self, gpu: &GpuContext, posed: &PosedAvatar) {
        self.gaussians.center.write(gpu, &posed.center);
        self.gaussians.scale_opacity.write(gpu, &posed.scale_opacity);
        self.gaussians.rotation.write(gpu, &posed.rotation);
        self.gaussians.harmonics.write(gpu, &posed.harmonics);
    }

    /// Hides Gaussians that face away from a camera and returns their number.
    pub fn look(&mut self, gpu: &GpuContext, posed: &PosedAvatar, camera: &Camera) -> usize {
        let eye = camera.camera_from_world.inverse().translation.as_vec3();
        let hidden = posed.facing(eye, &mut self.scale_opacity);
        self.gaussians.scale_opacity.write(gpu, &self.scale_opacity);
        hidden
    }
}

/// Renderer of one avatar.
#[derive(Debug)]
pub struct AvatarScene {
    gpu: GpuContext,
    painter: ViewPainter,
    buffers: AvatarBuffers,
    posed: PosedAvatar,
    /// Number of back-facing Gaussians skipped in the last view.
    hidden: usize,
}

impl AvatarScene {
    /// Allocates buffers for an avatar.
    ///
    /// # Errors
    /// [`GpuError::TooLarge`].
    pub fn new(gpu: &GpuContext, avatar: &Avatar) -> Result<Self, GpuError> {
        Ok(Self {
            gpu: gpu.clone(),
            painter: ViewPainter::new(gpu, avatar.gaussians())?,
            buffers: AvatarBuffers::new(gpu, avatar)?,
            posed: PosedAvatar::default(),
            hidden: 0,
        })
    }

    /// Poses the avatar for the following views; see [`Avatar::pose`].
    pub fn pose(&mut self, avatar: &Avatar, bones: &Bones, translations: Option<&[DVec3]>) {
        avatar.pose(bones, translations, &mut self.posed);
        self.buffers.pose(&self.gpu, &self.posed);
    }

    /// Poses the avatar by a pose alone, with its mean shape.
    pub fn drive(&mut self, avatar: &Avatar, pose: &Pose) {
        self.pose(avatar, &Bones::new(&avatar.template.skeleton, pose), None);
    }

    /// Renders the avatar from a camera at its image size, straight alpha.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn draw(&mut self, camera: &Camera) -> Result<RenderedView, GpuError> {
        self.hidden = self.buffers.look(&self.gpu, &self.posed, camera);
        self.painter.draw(&self.buffers.gaussians, camera)
    }

    /// Returns the box `[x0, y0, x1, y1]` (ends excluded, pixels) around the centres of some parts' Gaussians in a
    /// camera's image, with a margin of `margin_px`, within the image; `None` where they are outside of it.
    #[must_use]
    pub fn part_box(&self, avatar: &Avatar, parts: &[Part], camera: &Camera, margin_px: f64) -> Option<[u32; 4]> {
        let body = &avatar.template;
        let is_part = |attachment: &Attachment| {
            let corner = body.triangles[attachment.triangle as usize][0];
            body.parts.get(corner as usize).is_some_and(|part| parts.contains(part))
        };
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for (attachment, center) in avatar.attachments.iter().zip(&self.posed.center) {
            if !is_part(attachment) {
                continue;
            }
            let [x, y, z, _] = center.map(f64::from);
            if let Some(pixel) = camera.project(DVec3::new(x, y, z)) {
                (low, high) = (low.min(pixel), high.max(pixel));
            }
        }
        let size = DVec2::new(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
        let low = (low - margin_px).floor().max(DVec2::ZERO);
        let high = (high + 1.0 + margin_px).ceil().min(size);
        low.cmplt(high).all().then_some([low.x as u32, low.y as u32, high.x as u32, high.y as u32])
    }

    /// Returns the number of back-facing Gaussians skipped in the last view.
    #[must_use]
    pub fn hidden(&self) -> usize {
        self.hidden
    }
}

#[cfg(test)]
mod tests {
    use flyrig_types::{Intrinsics, Isometry};

    use super::*;
    use crate::model::avatar::tests::small;

    #[test]
    fn boxes_are_around_the_part_and_within_the_image() {
        let avatar = small(4000, 7);
        let gpu = flyrig_gpu::testing::device().on_processor();
        let mut scene = AvatarScene::new(&gpu, &avatar).unwrap();
        let pose = avatar.template.skeleton.rest_pose();
        scene.drive(&avatar, &pose);
        // The body at rest has y up and looks along z.
        let camera_at = |eye: DVec3| Camera {
            id: "view".into(),
            intrinsics: Intrinsics::pinhole(200, 300, 300.0),
            camera_from_world: Isometry::look_at(eye, DVec3::new(eye.x, eye.y, 0.0), DVec3::Y),
            time_offset_nanos: 0,
            color: Default::default(),
        };
        let camera = camera_at(DVec3::new(0.0, 0.9, 3.5));
        let area = |parts: &[Part]| scene.part_box(&avatar, parts, &camera, 2.0).unwrap();
        let ([_, head_top, _, head_end], [_, feet_top, _, _]) =
            (area(&[Part::Head]), area(&[Part::LeftFoot, Part::RightFoot]));
        let [left, top, right, bottom] = area(&Part::ALL);
        assert!(head_top == top && head_end < feet_top && head_end - head_top < (bottom - top) / 3);
        assert!(left < right && right <= 200 && bottom <= 300);
        // It stands behind the camera, or no part is asked for.
        let turned = Camera {
            camera_from_world: Isometry::look_at(DVec3::new(0.0, 0.9, 3.5), DVec3::new(0.0, 0.9, 9.0), DVec3::Y),
            ..camera.clone()
        };
        assert_eq!(scene.part_box(&avatar, &Part::ALL, &turned, 2.0), None);
        assert_eq!(scene.part_box(&avatar, &[], &camera, 2.0), None);
    }
}
