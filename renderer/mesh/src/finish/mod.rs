//! From a fused surface to an even, smooth mesh of a number of triangles.

mod around;
mod collapse;
pub(crate) mod decimate;
mod quadric;
mod relax;
mod smooth;
pub(crate) mod untangle;

use crate::TriMesh;
use decimate::{DecimateError, Decimated, decimate};
use relax::relax;
use smooth::smooth;
use untangle::untangle;

/// Simplifies a fused surface to about `triangles`, makes them even, and averages their normals over two spacings of the points that were
/// fused, metres. The topology stays, and what would intersect itself is left as it was.
///
/// # Errors
/// As [`decimate`].
pub(crate) fn finish(fused: &TriMesh, triangles: usize, spacing_m: f32) -> Result<Decimated, DecimateError> {
    let mut simple = decimate(fused, triangles)?;
    let corners = simple.mesh.positions.clone();
    relax(&mut simple.mesh, fused);
    smooth(&mut simple.mesh, spacing_m);
    untangle(&mut simple.mesh, &corners);
    Ok(simple)
}
