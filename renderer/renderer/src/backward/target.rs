//! Gaussians that receive derivatives.

use crate::anisotropic::buffers::{AnisotropicBuffers, AnisotropicGradients};
use crate::anisotropic::order::HarmonicOrder;
use crate::backward::error::BackwardError;
use crate::backward::gradients::{Carry, GaussianGradients};
use crate::buffers::GaussianBuffers;
use crate::raster::settings::Latest;

/// Gaussians to which derivatives are carried, and the buffers that accumulate them.
#[derive(Clone, Copy)]
pub(crate) enum GradientTarget<'a> {
    Isotropic { gaussians: &'a GaussianBuffers, carry: Carry, out: &'a GaussianGradients },
    Anisotropic { gaussians: &'a AnisotropicBuffers, out: &'a AnisotropicGradients },
}

impl GradientTarget<'_> {
    /// Returns the harmonic order of the colours; `None` for isotropic Gaussians.
    pub(crate) fn order(&self) -> Option<HarmonicOrder> {
        match self {
            Self::Isotropic { .. } => None,
            Self::Anisotropic { gaussians, .. } => Some(gaussians.order()),
        }
    }

    pub(crate) fn check(&self, latest: &Latest) -> Result<(), BackwardError> {
        let (count, room) = match self {
            Self::Isotropic { gaussians, out, .. } => (gaussians.count(), out.center.len().min(out.carried.len() / 2)),
            Self::Anisotropic { gaussians, out } => {
                let rows = out.center.len().min(out.scale_opacity.len()).min(out.rotation.len());
                (gaussians.count(), rows.min(out.harmonics.len() / gaussians.order().coefficients()))
            }
        };
        check("the Gaussians", count, latest.gaussians)?;
        check("dL/d Gaussians", room, latest.gaussians)
    }
}

pub(crate) fn check(what: &'static str, found: usize, needed: usize) -> Result<(), BackwardError> {
    if found >= needed { Ok(()) } else { Err(BackwardError::Buffer { what, found, needed }) }
}
