//! Gaussians on a person's surface, and the graph that deforms them.

use std::borrow::Cow;

use flyrig_body::{
    BodyError, DEFAULT_SIGMA2_M2, DeformationGraph, SurfaceGaussians, Template, build_graph, sample_surface,
};

use crate::settings::body::BodySettings;

/// Seed of the surface sampling: equal templates give equal Gaussians in every run.
const SURFACE_SEED: u64 = 1;

/// Surface of a person, and the graph that deforms it.
#[derive(Debug)]
pub(crate) struct GraphedSurface {
    pub surface: SurfaceGaussians,
    pub graph: DeformationGraph,
}

impl GraphedSurface {
    /// Returns the Gaussians as they are drawn: inset where they are deformed.
    pub fn drawn(&self, is_deformed: bool) -> Cow<'_, SurfaceGaussians> {
        if is_deformed { Cow::Owned(self.surface.inset()) } else { Cow::Borrowed(&self.surface) }
    }
}

/// Samples the Gaussians of a session's person on the surface of its template.
///
/// # Errors
/// [`BodyError`] for a template that is not valid.
pub fn person_gaussians(template: &Template, body: &BodySettings) -> Result<SurfaceGaussians, BodyError> {
    sample_surface(template, body.gaussians, SURFACE_SEED)
}

/// Samples the Gaussians of a session's person and builds the graph that deforms them. Gaussians that are deformed are drawn
/// [inset](SurfaceGaussians::inset).
///
/// # Errors
/// [`BodyError`] for a template that is not valid.
///
/// # Example
/// ```
/// use flyrig_fusion::{BodySettings, body::{ShapeParams, default_template}, person_surface};
///
/// let template = default_template(&ShapeParams::default())?;
/// let (surface, graph) = person_surface(&template, &BodySettings::with_gaussians(2000))?;
/// assert_eq!(surface.positions.len(), 2000);
/// assert_eq!(graph.gaussian_nodes.len(), 2000, "each Gaussian follows four nodes");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn person_surface(
    template: &Template,
    body: &BodySettings,
) -> Result<(SurfaceGaussians, DeformationGraph), BodyError> {
    let surface = person_gaussians(template, body)?;
    let graph = build_graph(template, &surface, body.nodes, DEFAULT_SIGMA2_M2)?;
    Ok((surface, graph))
}
