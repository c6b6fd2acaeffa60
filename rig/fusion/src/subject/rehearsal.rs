//! Changes of the Gaussians that a person is made of, and painting without tracking: what the learner compares versions with.

use std::sync::Arc;

use flyrig_avatar::Avatar;
use flyrig_gpu::GpuContext;
use flyrig_renderer::Rasterizer;
use flyrig_stream::EncodedTemplate;
use flyrig_types::Pose;
use glam::DVec3;

use super::{
    inputs::InputView,
    instants::Instants,
    memory::PersonMemory,
    painter::{PaintInputs, PaintTools},
    person::Subject,
};
use crate::{error::FusionError, health::stage_times::StageTimes};

impl Subject {
    /// Makes the person of an avatar that hangs on its surface's graph; an earlier version changes into it over `sets` updates. The
    /// template of the person stream is forgotten. Nothing happens to a person who is not learnt.
    pub(crate) fn become_avatar(
        &mut self,
        gpu: &GpuContext,
        avatar: &Arc<Avatar>,
        sets: u32,
    ) -> Result<(), FusionError> {
        let Some(base) = self.base.clone() else { return Ok(()) };
        let was_avatar = self.avatar().is_some();
        self.geometry.set_avatar(gpu, avatar, &base, sets)?;
        self.forget_stream();
        if !was_avatar {
            self.painter.correct(true);
        }
        Ok(())
    }

    /// Makes the person of the surface's own Gaussians again.
    pub(crate) fn return_to_surface(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        let Some(base) = self.base.clone().filter(|_| self.avatar().is_some()) else { return Ok(()) };
        self.geometry.drop_avatar(gpu, &base)?;
        self.forget_stream();
        self.painter.correct(false);
        Ok(())
    }

    /// Sets the template of the person stream, which was encoded elsewhere. One that poses alone drive stays.
    pub(crate) fn set_stream(&mut self, template: &Arc<EncodedTemplate>) {
        self.shape.stream.get_or_insert_with(|| Arc::clone(template));
    }

    /// Forgets the template of the person stream, unless poses alone drive it.
    fn forget_stream(&mut self) {
        self.shape.stream = self.shape.stream.take().filter(|stream| stream.template.has_colors());
    }

    /// Makes the person of what is known before the first image: an avatar, or the surface.
    pub(crate) fn return_to_start(&mut self, gpu: &GpuContext) -> Result<(), FusionError> {
        match self.start.as_ref().and_then(|start| start.avatar.clone()) {
            Some(avatar) if self.avatar().is_some_and(|known| Arc::ptr_eq(known, &avatar)) => Ok(()),
            Some(avatar) => self.become_avatar(gpu, &avatar, 1),
            None => self.return_to_surface(gpu),
        }
    }

    /// Forgets all colours that were seen; an avatar's are not corrected any more.
    pub(crate) fn forget_colors(&mut self, gpu: &GpuContext) {
        self.painter.reset();
        if self.avatar().is_some() {
            let corrections = &self.geometry.painted().color;
            corrections.write(gpu, &vec![[0.0; 4]; corrections.len()]);
        }
    }

    /// Shows the colours of a memory with the same number of Gaussians.
    pub(crate) fn show_colors(&mut self, gpu: &GpuContext, memory: &PersonMemory) -> Result<(), FusionError> {
        self.painter.resume(gpu, self.geometry.painted(), memory)
    }

    /// Takes pose and deformation as they were tracked before, and paints the person from views.
    pub(crate) fn paint_tracked(
        &mut self,
        gpu: &GpuContext,
        rasterizer: &mut Rasterizer,
        (pose, translations): (&Pose, &[DVec3]),
        views: &[InputView<'_>],
        stages: &mut StageTimes,
    ) -> Result<(), FusionError> {
        self.inputs.upload(gpu, views)?;
        let instants = Instants::new(pose, views);
        self.geometry.reserve(gpu, instants.poses().len())?;
        self.geometry.views_changed();
        self.geometry.resume(gpu, translations)?;
        self.geometry.skin(gpu, &self.shape.template.skeleton, &instants, &mut self.clock, stages)?;
        let inputs = PaintInputs { gpu, geometry: &self.geometry, instants: &instants, views, images: &self.inputs };
        self.painter.paint(inputs, &mut PaintTools { rasterizer, clock: &mut self.clock, stages })?;
        gpu.wait()?;
        self.clock.collect(stages);
        Ok(())
    }
}
