//! Gaussians of an avatar as a tracked person: posed on the deformation's nodes, their colours corrected by the images.

use std::sync::Arc;

use flyrig_avatar::{Avatar, Bones, PosedAvatar};
use flyrig_body::{DeformationGraph, Skeleton, SurfaceGaussians};
use flyrig_gpu::{GpuContext, StorageBuffer};
use flyrig_renderer::{AnisotropicBuffers, Corrected, GaussianBuffers, Recolor};
use flyrig_types::Pose;
use glam::{DVec3, Vec3};
use wgpu::CommandEncoder;

use super::avatar_stream::linear;
use crate::error::FusionError;

/// Avatar on the device, at each instant of a frame set.
#[derive(Debug)]
pub(super) struct AvatarFigure {
    source: Arc<Avatar>,
    /// The avatar, hung on the session's graph.
    hung: Arc<Avatar>,
    /// Avatar between the version before and this one, and the updates until it is this one.
    between: Option<(Avatar, u32)>,
    canonical: Vec<[f32; 4]>,
    posed: PosedAvatar,
    recolor: Recolor,
    instants: Vec<Instant>,
    /// Colour that each Gaussian of the surface shows under the mean light of the take, linear RGB.
    look: StorageBuffer<[f32; 4]>,
    /// Gaussians at the frame set's time with the corrections as colours: what the images paint.
    painted: GaussianBuffers,
}

/// Avatar at one instant.
#[derive(Debug)]
struct Instant {
    drawn: AnisotropicBuffers,
    /// Constant harmonics under the room's light, without correction.
    constant: StorageBuffer<[f32; 4]>,
}

impl AvatarFigure {
    /// Hangs an avatar on the graph of its [`Avatar::attached_surface`]. `gaussians` are those at the frame set's time.
    pub fn new(
        gpu: &GpuContext,
        source: &Arc<Avatar>,
        (surface, graph): (&SurfaceGaussians, &DeformationGraph),
        gaussians: &GaussianBuffers,
    ) -> Result<Self, FusionError> {
        let looks: Vec<[f32; 4]> = source.surface_colors(surface).into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect();
        gaussians.color.write(gpu, &looks);
        let hung = source.shared_on(graph);
        let canonical: Vec<[f32; 4]> = hung.centers().iter().map(|p| p.extend(1.0).to_array()).collect();
        gaussians.canonical.write(gpu, &canonical);
        let corrections = StorageBuffer::zeroed(gpu, "colour corrections", canonical.len())?;
        let GaussianBuffers { center_scale, normal, canonical: positions, .. } = gaussians;
        Ok(Self {
            recolor: Recolor::new(gpu, hung.parameters.order()),
            painted: GaussianBuffers {
                center_scale: center_scale.clone(),
                normal: normal.clone(),
                color: corrections,
                canonical: positions.clone(),
            },
            source: Arc::clone(source),
            hung,
            between: None,
            canonical,
            posed: PosedAvatar::default(),
            look: StorageBuffer::from_slice(gpu, "looks of the surface", &looks)?,
            instants: Vec::new(),
        })
    }

    /// Returns the avatar as it was given.
    pub fn source(&self) -> &Arc<Avatar> {
        &self.source
    }

    /// Changes to another version of the avatar, of the same surface and graph, over `sets` updates. The colours that the deformation
    /// compares, and the light, change at once.
    pub fn change_to(
        &mut self,
        gpu: &GpuContext,
        source: &Arc<Avatar>,
        (surface, graph): (&SurfaceGaussians, &DeformationGraph),
        gaussians: &GaussianBuffers,
        sets: u32,
    ) {
        let looks: Vec<[f32; 4]> = source.surface_colors(surface).into_iter().map(|[r, g, b]| [r, g, b, 1.0]).collect();
        self.look.write(gpu, &looks);
        let hung = source.shared_on(graph);
        self.canonical = hung.centers().iter().map(|p| p.extend(1.0).to_array()).collect();
        gaussians.canonical.write(gpu, &self.canonical);
        for surface in self.instants.iter().filter_map(|instant| instant.drawn.surface.as_ref()) {
            surface.canonical.write(gpu, &self.canonical);
        }
        let before = match self.between.take() {
            Some((avatar, _)) => avatar.parameters,
            None => self.hung.parameters.clone(),
        };
        self.between = (sets > 1).then(|| (Avatar { parameters: before, ..(*hung).clone() }, sets));
        self.hung = hung;
        self.source = Arc::clone(source);
    }

    /// Goes on with a change of version by one update.
    fn go_on(&mut self) {
        let Some((avatar, left)) = &mut self.between else { return };
        avatar.parameters.approach(&self.hung.parameters, 1.0 / *left as f32);
        *left -= 1;
        if *left == 0 {
            self.between = None;
        }
    }

    /// Returns the avatar, hung on the session's graph; while a change of version goes on, the new one.
    pub fn hung(&self) -> &Avatar {
        &self.hung
    }

    /// Returns the avatar that is drawn.
    fn shown(&self) -> &Avatar {
        self.between.as_ref().map_or(&self.hung, |(avatar, _)| avatar)
    }

    /// Reads back the linear RGB, 0..=1, and opacity 1 of each Gaussian as it was drawn last, without the terms of the view.
    pub fn shown_colors(&self, gpu: &GpuContext) -> Result<Vec<[f32; 4]>, FusionError> {
        let Some(Instant { drawn, .. }) = self.instants.first() else { return Ok(Vec::new()) };
        let harmonics = drawn.harmonics.read(gpu)?;
        let constants = harmonics.iter().step_by(self.hung.parameters.order().coefficients());
        let shown = |constant: &[f32; 4]| {
            let [r, g, b] = linear(*constant);
            [r, g, b, 1.0]
        };
        Ok(constants.map(shown).collect())
    }

    /// Returns the mean translations of the graph's nodes, canonical metres.
    pub fn mean(&self) -> &[DVec3] {
        self.hung.hanging.as_ref().map_or(&[], |hanging| &hanging.mean)
    }

    /// Returns the colours of the surface without corrections. Corrections follow the images wherever the surface slides; colours
    /// that stay hold it.
    pub fn looks(&self) -> &StorageBuffer<[f32; 4]> {
        &self.look
    }

    /// Returns the Gaussians at the frame set's time with the corrections as colours.
    pub fn painted(&self) -> &GaussianBuffers {
        &self.painted
    }

    /// Returns the Gaussians at an instant of the last update; `None` before it.
    pub fn drawn(&self, instant: usize) -> Option<&AnisotropicBuffers> {
        self.instants.get(instant).map(|instant| &instant.drawn)
    }

    /// Poses the avatar at an instant, with the last corrections. Centres and normals go to `gaussians` as well.
    pub fn pose(
        &mut self,
        gpu: &GpuContext,
        encoder: &mut CommandEncoder,
        instant: usize,
        (skeleton, pose): (&Skeleton, &Pose),
        translations: Option<&[DVec3]>,
        gaussians: &GaussianBuffers,
    ) -> Result<(), FusionError> {
        let count = self.canonical.len();
        while self.instants.len() <= instant {
            let drawn = AnisotropicBuffers::zeroed(gpu, count, self.hung.parameters.order())?.with_surface(gpu)?;
            if let Some(surface) = &drawn.surface {
                surface.canonical.write(gpu, &self.canonical);
            }
            let constant = StorageBuffer::zeroed(gpu, "constant harmonics", count)?;
            self.instants.push(Instant { drawn, constant });
        }
        if instant == 0 {
            self.go_on();
        }
        let mut posed = std::mem::take(&mut self.posed);
        self.shown().pose(&Bones::new(skeleton, pose), translations, &mut posed);
        self.posed = posed;
        let PosedAvatar { center, scale_opacity, rotation, harmonics, .. } = &self.posed;
        let Instant { drawn, constant } = &self.instants[instant];
        let normals: Vec<[f32; 4]> = self.posed.normals().map(|normal| normal.extend(0.0).to_array()).collect();
        let isotropic = |(center, scales): (&[f32; 4], &[f32; 4])| {
            let [a, b, c, _] = *scales;
            Vec3::from_slice(center).extend((a * b * c).cbrt()).to_array()
        };
        let centers: Vec<[f32; 4]> = center.iter().zip(scale_opacity).map(isotropic).collect();
        gaussians.center_scale.write(gpu, &centers);
        gaussians.normal.write(gpu, &normals);
        drawn.center.write(gpu, center);
        drawn.scale_opacity.write(gpu, scale_opacity);
        drawn.rotation.write(gpu, rotation);
        drawn.harmonics.write(gpu, harmonics);
        if let Some(surface) = &drawn.surface {
            surface.normal.write(gpu, &normals);
        }
        let coefficients = self.hung.parameters.order().coefficients();
        let constants: Vec<[f32; 4]> = harmonics.iter().step_by(coefficients).copied().collect();
        constant.write(gpu, &constants);
        self.recolor(gpu, encoder, instant, gaussians);
        Ok(())
    }

    /// Adds the corrections to the colours at an instant.
    pub fn recolor(&self, gpu: &GpuContext, encoder: &mut CommandEncoder, instant: usize, gaussians: &GaussianBuffers) {
        let Some(Instant { drawn, constant }) = self.instants.get(instant) else { return };
        let corrected =
            Corrected { constant, correction: &self.painted.color, look: &self.look, color: &gaussians.color };
        self.recolor.encode(gpu, encoder, drawn, corrected);
    }
}
