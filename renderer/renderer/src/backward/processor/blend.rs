//! Derivative of a tile's blending: `backward/blend.wgsl` on the processor.

#![allow(clippy::needless_range_loop)] // one index for several lanes is what compilers turn into vectors

use glam::Vec4;

use crate::backward::processor::planes::PlaneSum;
use crate::backward::processor::project::PairSum;
use crate::raster::kernels::{MAX_ALPHA, OPAQUE};
use crate::raster::processor::blend::{LOG2_CUT, TileLanes, exponents, is_opaque, rows_of};
use crate::raster::processor::lanes::{LANES, Lanes, exp2, sums as sums_of_lanes};
use crate::raster::processor::planes::Plane;
use crate::raster::processor::project::{ProjectedSplat, TILE};

pub(super) const ROWS: usize = TILE as usize;

/// Images and incoming derivatives of one view.
pub(super) struct Pixels<'a> {
    pub size: [usize; 2],
    pub color: &'a [[f32; 4]],
    pub depth: Option<&'a Vec<f32>>,
    pub d_color: &'a [[f32; 4]],
    pub d_depth: &'a [[f32; 4]],
    /// Drawn planes and dL/d planes.
    pub planes: Option<[&'a [[f32; 4]]; 2]>,
    /// Whether dL/d colour is carried to the Gaussians in place of the last three numbers of `d_depth`.
    pub carries_color: bool,
}

/// Number of [`State::planes`] of a view with derivatives by its planes.
pub(super) const PLANE_INPUTS: usize = 5;

/// Incoming derivatives of a tile's pixels. A pixel without influence starts opaque.
pub(super) struct State<const PLANES: usize> {
    transmittance: TileLanes,
    color: [TileLanes; 3],
    /// dL/d alpha of the pixel times its final transmittance.
    passing: TileLanes,
    /// dL/d depth / alpha; `mean_depth` is the rendered depth.
    by_depth: TileLanes,
    mean_depth: TileLanes,
    carried: [TileLanes; 3],
    /// Linearised loss of the colours that are still to be blended. Depths are relative to the rendered depth, so that
    /// theirs sum to 0.
    behind: TileLanes,
    /// dL/d normal sums, dL/d sum of plane depths, and the mean of the plane depths.
    planes: [TileLanes; PLANES],
}

impl Pixels<'_> {
    /// Returns whether the pixels have derivatives by colour alone, which are those that are carried.
    pub fn only_colors(&self) -> bool {
        self.carries_color && self.depth.is_none()
    }

    /// Returns the incoming derivatives of a tile; `None` where no pixel has any.
    pub fn state<const PLANES: usize>(&self, column: usize, row: usize) -> Option<State<PLANES>> {
        const ZERO: TileLanes = [[0.0; LANES]; ROWS];
        let mut state = State {
            transmittance: ZERO,
            color: [ZERO; 3],
            passing: ZERO,
            by_depth: ZERO,
            mean_depth: ZERO,
            carried: [ZERO; 3],
            behind: ZERO,
            planes: [ZERO; PLANES],
        };
        let mut matters = false;
        for y in 0..ROWS.min(self.size[1] - row * ROWS) {
            for x in 0..LANES.min(self.size[0] - column * LANES) {
                let at = (row * ROWS + y) * self.size[0] + column * LANES + x;
                let (seen, d_color, mut d_depth) = (self.color[at], self.d_color[at], self.d_depth[at]);
                if self.depth.is_none() {
                    d_depth[0] = 0.0;
                }
                if self.carries_color {
                    d_depth[1..].copy_from_slice(&d_color[..3]);
                }
                let (color, depth) = (Vec4::from(d_color), Vec4::from(d_depth));
                let [drawn, plane] = match self.planes {
                    Some(planes) if PLANES > 0 => planes.map(|image| Vec4::from(image[at])),
                    _ => [Vec4::ZERO; 2],
                };
                let is_zero = color == Vec4::ZERO && depth == Vec4::ZERO && plane == Vec4::ZERO;
                if seen[3] > 0.0 && !is_zero && color.is_finite() && depth.is_finite() && plane.is_finite() {
                    matters = true;
                    state.transmittance[y][x] = 1.0;
                    for c in 0..3 {
                        state.color[c][y][x] = d_color[c];
                        state.carried[c][y][x] = d_depth[1 + c];
                    }
                    state.passing[y][x] = d_color[3] * (1.0 - seen[3]);
                    state.behind[y][x] = color.truncate().dot(Vec4::from(seen).truncate());
                    if let Some(rendered) = self.depth {
                        state.by_depth[y][x] = d_depth[0] / seen[3].max(1e-6);
                        state.mean_depth[y][x] = rendered[at];
                    }
                    if PLANES > 0 {
                        // Depths count relative to their mean: the rest is dL/d alpha.
                        let mean = drawn.w / seen[3].max(1e-6);
                        state.passing[y][x] = (d_color[3] + plane.w * mean) * (1.0 - seen[3]);
                        state.behind[y][x] += plane.truncate().dot(drawn.truncate());
                        let inputs = [plane.x, plane.y, plane.z, plane.w, mean];
                        state.planes.iter_mut().zip(inputs).for_each(|(lanes, input)| lanes[y][x] = input);
                    }
                }
            }
        }
        matters.then_some(state)
    }
}

/// Derivative of a tile's blending. The list is walked front to back again; the light from behind a splat is the
/// finished pixel less what was blended so far. Writes the sum of each pair and returns the number of pairs walked.
///
/// With `ONLY_COLORS`, the pixels' derivatives are those of colours, coverage and planes, and the carried ones those of colours.
/// `PLANES` is [`PLANE_INPUTS`] where they are those of planes as well, otherwise 0.
pub(super) struct TileBackward<'a, const ONLY_COLORS: bool, const PLANES: usize> {
    pub state: State<PLANES>,
    pub origin: [f32; 2],
    pub list: &'a [u32],
    pub splats: &'a [ProjectedSplat],
    pub color: &'a [[f32; 4]],
    pub planes: &'a [Plane],
    pub out: &'a mut [PairSum],
    pub plane_out: &'a mut [PlaneSum],
}

impl<const ONLY_COLORS: bool, const PLANES: usize> pulp::NullaryFnOnce for TileBackward<'_, ONLY_COLORS, PLANES> {
    type Output = u32;

    #[inline(always)]
    fn call(self) -> u32 {
        let Self { mut state, origin, list, splats, color, planes, out, plane_out } = self;
        for (index, (&gaussian, out)) in list.iter().zip(out).enumerate() {
            let (splat, paint) = (&splats[gaussian as usize], &color[gaussian as usize]);
            let plane = if PLANES > 0 { planes[gaussian as usize] } else { Plane::default() };
            let (mut moments, mut values) = ([[0.0; LANES]; LANES], [[0.0; LANES]; 3]);
            let mut plane_moments = [[0.0; LANES]; LANES];
            for row in rows_of(splat, origin[1]) {
                if PLANES > 0 {
                    let inverse_ratios = plane.inverse_ratios(splat, origin, row);
                    let extra = state.plane_values(splat, &plane, &inverse_ratios, row);
                    let weights =
                        state.add_row::<ONLY_COLORS>(splat, paint, &extra, origin, row, (&mut moments, &mut values));
                    state.add_plane_row((splat, &plane), &inverse_ratios, &weights, origin, row, &mut plane_moments);
                } else {
                    const NONE: Lanes = [0.0; LANES];
                    state.add_row::<ONLY_COLORS>(splat, paint, &NONE, origin, row, (&mut moments, &mut values));
                }
            }
            if PLANES > 0 {
                plane_out[index] = sums_of_lanes(&plane_moments);
            }
            let moments = sums_of_lanes(&moments);
            let [a, b, c] = values;
            let [red, green, blue, ..] = sums_of_lanes(&[a, b, c, a, a, b, c, a]);
            let [slope, slope_x, slope_y, by_depth, xx, xy, yy, weight] = moments;
            *out = [slope, slope_x, slope_y, by_depth, xx, xy, yy, weight, red, green, blue];
            if index % LANES == LANES - 1 && is_opaque(&state.transmittance) {
                return index as u32 + 1;
            }
        }
        list.len() as u32
    }
}

impl<const PLANES: usize> State<PLANES> {
    /// Adds a splat's contribution in a row to its sums and returns its weights. `extra` is the value of its plane.
    #[inline(always)]
    fn add_row<const ONLY_COLORS: bool>(
        &mut self,
        splat: &ProjectedSplat,
        paint: &[f32; 4],
        extra: &Lanes,
        origin: [f32; 2],
        row: usize,
        (moments, values): (&mut [Lanes; LANES], &mut [Lanes; 3]),
    ) -> Lanes {
        let exponents = exponents(splat, origin, row);
        let (opaque, most) = (OPAQUE as f32, MAX_ALPHA as f32);
        let mut touched = 0u32;
        let mut weights = [0.0; LANES];
        for lane in 0..LANES {
            touched |= u32::from(exponents[lane] >= LOG2_CUT) & u32::from(self.transmittance[row][lane] >= opaque);
        }
        if touched == 0 {
            return weights;
        }
        let dy = origin[1] + row as f32 - splat.pixel.y;
        for lane in 0..LANES {
            let dx = origin[0] + lane as f32 - splat.pixel.x;
            let transmittance = self.transmittance[row][lane];
            let is_touched = (exponents[lane] >= LOG2_CUT) & (transmittance >= opaque);
            let unclamped = exp2(exponents[lane]);
            let clamped = if unclamped < most { unclamped } else { most };
            let alpha = if is_touched { clamped } else { 0.0 };
            let weight = alpha * transmittance;
            let color = [0, 1, 2].map(|c| self.color[c][row][lane]);
            let mut value = color[0] * paint[0] + color[1] * paint[1] + color[2] * paint[2];
            if !ONLY_COLORS {
                let by_depth = self.by_depth[row][lane];
                value += by_depth * (splat.depth - self.mean_depth[row][lane]);
                moments[3][lane] += weight * by_depth;
            }
            if PLANES > 0 {
                value += extra[lane];
                weights[lane] = weight;
            }
            let behind = self.behind[row][lane] - weight * value;
            self.behind[row][lane] = behind;
            let by_this_alpha = transmittance * value + (self.passing[row][lane] - behind) / (1.0 - alpha);
            // dL/d exponent; at the clamp alpha does not follow it.
            let slope = by_this_alpha * alpha * std::f32::consts::LN_2;
            let slope = if unclamped < most { slope } else { 0.0 };
            moments[0][lane] += slope;
            moments[1][lane] += slope * dx;
            moments[2][lane] += slope * dy;
            moments[4][lane] += slope * dx * dx;
            moments[5][lane] += slope * dx * dy;
            moments[6][lane] += slope * dy * dy;
            moments[7][lane] += weight;
            for (c, values) in values.iter_mut().enumerate() {
                values[lane] += weight * if ONLY_COLORS { color[c] } else { self.carried[c][row][lane] };
            }
            self.transmittance[row][lane] = transmittance * (1.0 - alpha);
        }
        weights
    }

    /// Returns the inputs of a row's pixels, as in [`Self::planes`]; zeros where there are none.
    #[inline(always)]
    fn plane_inputs(&self, row: usize) -> [Lanes; PLANE_INPUTS] {
        let mut inputs = [[0.0; LANES]; PLANE_INPUTS];
        inputs.iter_mut().zip(&self.planes).for_each(|(input, lanes)| *input = lanes[row]);
        inputs
    }

    /// Computes the change of the linearised loss per weight of a plane at the pixels of a row.
    #[inline(always)]
    fn plane_values(&self, splat: &ProjectedSplat, plane: &Plane, inverse_ratios: &Lanes, row: usize) -> Lanes {
        let [nx, ny, nz, by_depth, mean] = self.plane_inputs(row);
        let [x, y, z] = plane.normal;
        let mut values = [0.0; LANES];
        for lane in 0..LANES {
            let depth = splat.depth / plane.limit(inverse_ratios[lane]);
            values[lane] = nx[lane] * x + ny[lane] * y + nz[lane] * z + by_depth[lane] * (depth - mean[lane]);
        }
        values
    }

    /// Adds a plane's contribution in a row to its sums ([`PlaneSum`]).
    #[inline(always)]
    fn add_plane_row(
        &self,
        (splat, plane): (&ProjectedSplat, &Plane),
        inverse_ratios: &Lanes,
        weights: &Lanes,
        origin: [f32; 2],
        row: usize,
        sums: &mut [Lanes; LANES],
    ) {
        let [nx, ny, nz, by_depth, _] = self.plane_inputs(row);
        let dy = origin[1] + row as f32 - splat.pixel.y;
        for lane in 0..LANES {
            let dx = origin[0] + lane as f32 - splat.pixel.x;
            let (weight, inverse_ratio) = (weights[lane], inverse_ratios[lane]);
            let ratio = 1.0 / plane.limit(inverse_ratio);
            let is_near = inverse_ratio >= plane.most;
            let is_inside = (inverse_ratio > plane.least) & (inverse_ratio < plane.most);
            let by_ratio = weight * by_depth[lane] * splat.depth;
            // dL/dt, and dL/d reach where t is limited.
            let by_inverse = if is_inside { -by_ratio * ratio * ratio } else { 0.0 };
            let limited = if is_near { -by_ratio } else { by_ratio };
            sums[0][lane] += weight * nx[lane];
            sums[1][lane] += weight * ny[lane];
            sums[2][lane] += weight * nz[lane];
            sums[3][lane] += weight * by_depth[lane] * ratio;
            sums[4][lane] += by_inverse;
            sums[5][lane] += by_inverse * dx;
            sums[6][lane] += by_inverse * dy;
            sums[7][lane] += if is_inside { 0.0 } else { limited };
        }
    }
}
