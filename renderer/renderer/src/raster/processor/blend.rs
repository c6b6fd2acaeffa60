//! Blending of a tile: `raster/blend.wgsl` on the processor.

use crate::raster::kernels::{MAX_ALPHA, OPAQUE};
use crate::raster::processor::lanes::{LANES, Lanes, exp2};
use crate::raster::processor::planes::Plane;
use crate::raster::processor::project::{ProjectedSplat, TILE};
use crate::raster::settings::Outputs;

const ROWS: usize = TILE as usize;
/// Number of splats between checks whether every pixel is opaque.
const OPAQUE_EVERY: usize = 8;

/// One number per pixel of a tile, row by row.
pub(crate) type TileLanes = [Lanes; ROWS];

/// Number of sums of a plane: three of the normal, then the depth.
pub(crate) const PLANE_SUMS: usize = 4;

/// Accumulators of a tile: sums of weight times value; `coverage` is the sum of the weights. `PLANES` is [`PLANE_SUMS`] where
/// planes are drawn, otherwise 0.
#[derive(Debug, Clone)]
pub(crate) struct BlendedTile<const PLANES: usize> {
    pub transmittance: TileLanes,
    pub coverage: TileLanes,
    pub color: [TileLanes; 3],
    pub depth: TileLanes,
    pub canonical: [TileLanes; 3],
    pub planes: [TileLanes; PLANES],
}

impl<const PLANES: usize> BlendedTile<PLANES> {
    fn new() -> Self {
        const ZERO: TileLanes = [[0.0; LANES]; ROWS];
        Self {
            transmittance: [[1.0; LANES]; ROWS],
            coverage: ZERO,
            color: [ZERO; 3],
            depth: ZERO,
            canonical: [ZERO; 3],
            planes: [ZERO; PLANES],
        }
    }
}

/// Front-to-back blending of a tile's list. Without `PLANES`, nothing of planes is compiled.
pub(crate) struct BlendTile<'a, const PLANES: usize> {
    /// First pixel of the tile.
    pub origin: [f32; 2],
    /// Indices of Gaussians, nearest first.
    pub list: &'a [u32],
    pub splats: &'a [ProjectedSplat],
    pub color: &'a [[f32; 4]],
    pub canonical: &'a [[f32; 4]],
    pub planes: &'a [Plane],
    pub outputs: Outputs,
}

impl<const PLANES: usize> pulp::NullaryFnOnce for BlendTile<'_, PLANES> {
    type Output = BlendedTile<PLANES>;

    #[inline(always)]
    fn call(self) -> BlendedTile<PLANES> {
        let mut tile = BlendedTile::new();
        for (index, &gaussian) in self.list.iter().enumerate() {
            let splat = &self.splats[gaussian as usize];
            for row in rows_of(splat, self.origin[1]) {
                let Some(weight) = weigh(splat, self.origin, row, &mut tile.transmittance[row]) else { continue };
                add(&mut tile.coverage[row], &weight, 1.0);
                if self.outputs.color {
                    let color = &self.color[gaussian as usize];
                    for (sum, value) in tile.color.iter_mut().zip(color) {
                        add(&mut sum[row], &weight, *value);
                    }
                }
                if self.outputs.depth {
                    add(&mut tile.depth[row], &weight, splat.depth);
                }
                if self.outputs.canonical {
                    let position = &self.canonical[gaussian as usize];
                    for (sum, value) in tile.canonical.iter_mut().zip(position) {
                        add(&mut sum[row], &weight, *value);
                    }
                }
                if PLANES > 0 {
                    let plane = &self.planes[gaussian as usize];
                    let [x, y, z] = plane.normal.map(|value| [value; LANES]);
                    let values = [x, y, z, plane.depths(splat, self.origin, row)];
                    for (sum, values) in tile.planes.iter_mut().zip(&values) {
                        add_each(&mut sum[row], &weight, values);
                    }
                }
            }
            if index % OPAQUE_EVERY == OPAQUE_EVERY - 1 && is_opaque(&tile.transmittance) {
                break;
            }
        }
        tile
    }
}

/// Returns the rows in which the splat is visible, of a tile that begins at pixel row `top`.
#[inline(always)]
pub(crate) fn rows_of(splat: &ProjectedSplat, top: f32) -> std::ops::Range<usize> {
    // `as` saturates: rows above the tile become 0.
    let first = (splat.pixel.y - splat.reach_y - top).ceil() as usize;
    let end = (splat.pixel.y + splat.reach_y - top + 1.0).floor() as usize;
    first..end.min(ROWS)
}

/// Computes log2(alpha) of a splat at the pixels of a row.
#[inline(always)]
pub(crate) fn exponents(splat: &ProjectedSplat, origin: [f32; 2], row: usize) -> Lanes {
    let dy = origin[1] + row as f32 - splat.pixel.y;
    let [a, b, c] = splat.conic;
    let mut exponents = [0.0; LANES];
    for (lane, exponent) in exponents.iter_mut().enumerate() {
        let dx = origin[0] + lane as f32 - splat.pixel.x;
        *exponent = splat.log2_opacity - a * dx * dx - dy * (b * dx + c * dy);
    }
    exponents
}

/// Returns the weights of a splat at the pixels of a row and reduces their transmittance; `None` where it touches no
/// pixel.
#[inline(always)]
fn weigh(splat: &ProjectedSplat, origin: [f32; 2], row: usize, transmittance: &mut Lanes) -> Option<Lanes> {
    let exponents = exponents(splat, origin, row);
    let (cut, opaque, most) = (LOG2_CUT, OPAQUE as f32, MAX_ALPHA as f32);
    let mut touched = 0u32;
    for lane in 0..LANES {
        touched |= u32::from(exponents[lane] >= cut) & u32::from(transmittance[lane] >= opaque);
    }
    if touched == 0 {
        return None;
    }
    let mut weight = [0.0; LANES];
    for lane in 0..LANES {
        let is_touched = (exponents[lane] >= cut) & (transmittance[lane] >= opaque);
        let power = exp2(exponents[lane]);
        let power = if power < most { power } else { most };
        let alpha = if is_touched { power } else { 0.0 };
        weight[lane] = alpha * transmittance[lane];
        transmittance[lane] *= 1.0 - alpha;
    }
    Some(weight)
}

/// log2 of the alpha below which a splat does not touch a pixel.
pub(crate) const LOG2_CUT: f32 = -7.994_353_4;

#[inline(always)]
fn add(sum: &mut Lanes, weight: &Lanes, value: f32) {
    for lane in 0..LANES {
        sum[lane] += weight[lane] * value;
    }
}

#[inline(always)]
fn add_each(sum: &mut Lanes, weight: &Lanes, values: &Lanes) {
    for lane in 0..LANES {
        sum[lane] += weight[lane] * values[lane];
    }
}

/// Returns whether every pixel of a tile is finished.
#[inline(always)]
pub(crate) fn is_opaque(transmittance: &TileLanes) -> bool {
    let mut open = 0u32;
    for row in transmittance {
        for lane in row {
            open |= u32::from(*lane >= OPAQUE as f32);
        }
    }
    open == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cut_is_that_of_the_other_kernels() {
        assert!((f64::from(LOG2_CUT) - crate::raster::kernels::CUT.log2()).abs() < 1e-6);
    }
}
