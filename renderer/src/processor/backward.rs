//! Backward rasteriser: `raster_backward_blend.wgsl` and `raster_backward_project.wgsl` on the processor.

use std::array::from_fn;

use flyrig_gpu::CameraConstants;
use glam::{Mat2, Mat3, Mat4, Vec2, Vec3, Vec4};
use rayon::prelude::*;

use super::blend::{LOG2_CUT, TileLanes, exponents, is_opaque, rows_of};
use super::lanes::{LANES, Lanes, exp2, sum, vectorized};
use super::project::{Splat, TILE};
use super::rasterizer::{Drawn, ProcessorRasterizer};
use crate::raster_kernels::{MAX_ALPHA, OPAQUE};
use crate::{Carry, GaussianBuffers, GaussianGradients, ImageGradients, RenderTarget};

const ROWS: usize = TILE as usize;
/// Gaussians that one task carries to the world.
const CHUNK: usize = 1024;

/// Sums over pixels for one Gaussian. With e the exponent log2(alpha), s = dL/de of a pixel, (x, y) the pixel from the
/// splat's centre and w its blending weight: s, s x, s y, w dL/d(depth sum), s x x, s x y, s y y, w, w carried.
type PairSum = [f32; 11];

/// [`BackwardRasterizer`](crate::BackwardRasterizer) on the processor. Its arrays are used again.
#[derive(Debug, Default)]
pub(crate) struct ProcessorBackward {
    /// By position in the lists; of tiles that were blended.
    pair_sums: Vec<PairSum>,
    /// Pairs walked of each tile.
    walked: Vec<u32>,
    /// By Gaussian.
    sums: Vec<PairSum>,
    is_touched: Vec<bool>,
}

impl ProcessorBackward {
    /// Adds the derivatives of the image that `rasterizer` drew last. Arrays have been checked.
    pub(crate) fn add(
        &mut self,
        rasterizer: &ProcessorRasterizer,
        gaussians: &GaussianBuffers,
        target: &RenderTarget,
        (incoming, carry): (&ImageGradients, Carry),
        out: &GaussianGradients,
    ) {
        let ProcessorRasterizer { lists, latest: Some(drawn), .. } = rasterizer else { return };
        let (Some(color), Some(center_scale)) = (gaussians.color.slice(), gaussians.center_scale.slice()) else {
            return;
        };
        let (Some(drawn_color), Some(drawn_depth)) = (target.color.slice(), target.depth.slice()) else { return };
        let (Some(d_color), Some(d_depth)) = (incoming.color.slice(), incoming.depth_carry.slice()) else { return };
        let pixels = Pixels {
            size: drawn.size.map(|side| side as usize),
            color: &drawn_color,
            depth: drawn.settings.outputs.depth.then_some(&drawn_depth),
            d_color: &d_color,
            d_depth: &d_depth,
        };
        self.pair_sums.resize(lists.pairs.len(), [0.0; 11]);
        self.walked.clear();
        self.walked.resize(lists.starts.len().saturating_sub(1), 0);
        // The part of the sums that belongs to each row of tiles.
        let mut rest = self.pair_sums.as_mut_slice();
        let columns = lists.tiles[0] as usize;
        let mut bands = Vec::with_capacity(lists.tiles[1] as usize);
        for (row, walked) in self.walked.chunks_mut(columns.max(1)).enumerate() {
            let first = lists.starts[row * columns];
            let (part, others) = rest.split_at_mut((lists.starts[(row + 1) * columns] - first) as usize);
            bands.push((row, first as usize, part, walked));
            rest = others;
        }
        let within = |first: u32, count: u32, at: usize| (first as usize..(first + count) as usize).contains(&at);
        bands.into_par_iter().filter(|(row, ..)| within(drawn.first_tile[1], drawn.blended[1], *row)).for_each(
            |(row, first, part, walked)| {
                for (column, walked) in walked.iter_mut().enumerate() {
                    if !within(drawn.first_tile[0], drawn.blended[0], column) {
                        continue;
                    }
                    let Some(state) = pixels.state(column, row) else { continue };
                    let range = lists.range(row * columns + column);
                    *walked = vectorized(TileBackward {
                        state,
                        origin: [(column * LANES) as f32, (row * ROWS) as f32],
                        list: &lists.pairs[range.clone()],
                        splats: &lists.splats,
                        color: &color,
                        out: &mut part[range.start - first..range.end - first],
                    });
                }
            },
        );
        self.sums.clear();
        self.sums.resize(drawn.gaussians, [0.0; 11]);
        self.is_touched.clear();
        self.is_touched.resize(drawn.gaussians, false);
        for (tile, &walked) in self.walked.iter().enumerate().filter(|(_, walked)| **walked > 0) {
            let range = lists.range(tile);
            let range = range.start..range.start + walked as usize;
            for (&gaussian, more) in lists.pairs[range.clone()].iter().zip(&self.pair_sums[range]) {
                let (sums, is_touched) = (&mut self.sums[gaussian as usize], &mut self.is_touched[gaussian as usize]);
                sums.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                *is_touched = true;
            }
        }
        let (Some(mut center), Some(mut carried)) = (out.center.slice_mut(), out.carried.slice_mut()) else { return };
        let outs = center.par_chunks_mut(CHUNK).zip(carried.par_chunks_mut(2 * CHUNK));
        let ins = self.sums.par_chunks(CHUNK).zip(self.is_touched.par_chunks(CHUNK));
        outs.zip(ins).zip(center_scale.par_chunks(CHUNK)).for_each(
            |(((center, carried), (sums, is_touched)), center_scale)| {
                let gaussians = center.iter_mut().zip(carried.chunks_exact_mut(2)).zip(sums).zip(center_scale);
                for (((center, carried), sums), center_scale) in
                    gaussians.zip(is_touched).filter(|(_, is_touched)| **is_touched).map(|(one, _)| one)
                {
                    project_backward(drawn, sums, center_scale, carry, center, carried);
                }
            },
        );
    }
}

/// The images of one view.
struct Pixels<'a> {
    size: [usize; 2],
    color: &'a [[f32; 4]],
    depth: Option<&'a Vec<f32>>,
    d_color: &'a [[f32; 4]],
    d_depth: &'a [[f32; 4]],
}

/// Incoming derivatives of a tile's pixels. A pixel that cannot matter starts opaque.
struct State {
    transmittance: TileLanes,
    color: [TileLanes; 3],
    /// dL/d alpha of the pixel times the light that passes all.
    passing: TileLanes,
    /// dL/d depth / alpha, and the drawn depth.
    by_depth: TileLanes,
    mean_depth: TileLanes,
    carried: [TileLanes; 3],
    /// Loss by the colours that are still to be blended, were the loss linear. Depths are taken from the drawn depth: theirs
    /// add up to 0.
    behind: TileLanes,
}

impl Pixels<'_> {
    /// Incoming derivatives of a tile; None where no pixel matters.
    fn state(&self, column: usize, row: usize) -> Option<State> {
        const ZERO: TileLanes = [[0.0; LANES]; ROWS];
        let mut state = State {
            transmittance: ZERO,
            color: [ZERO; 3],
            passing: ZERO,
            by_depth: ZERO,
            mean_depth: ZERO,
            carried: [ZERO; 3],
            behind: ZERO,
        };
        let mut matters = false;
        for y in 0..ROWS.min(self.size[1] - row * ROWS) {
            for x in 0..LANES.min(self.size[0] - column * LANES) {
                let at = (row * ROWS + y) * self.size[0] + column * LANES + x;
                let (seen, d_color, mut d_depth) = (self.color[at], self.d_color[at], self.d_depth[at]);
                if self.depth.is_none() {
                    d_depth[0] = 0.0;
                }
                let (color, depth) = (Vec4::from(d_color), Vec4::from(d_depth));
                let is_zero = color == Vec4::ZERO && depth == Vec4::ZERO;
                if seen[3] > 0.0 && !is_zero && color.is_finite() && depth.is_finite() {
                    matters = true;
                    state.transmittance[y][x] = 1.0;
                    for c in 0..3 {
                        state.color[c][y][x] = d_color[c];
                        state.carried[c][y][x] = d_depth[1 + c];
                    }
                    state.passing[y][x] = d_color[3] * (1.0 - seen[3]);
                    state.behind[y][x] = color.truncate().dot(Vec4::from(seen).truncate());
                    if let Some(drawn) = self.depth {
                        state.by_depth[y][x] = d_depth[0] / seen[3].max(1e-6);
                        state.mean_depth[y][x] = drawn[at];
                    }
                }
            }
        }
        matters.then_some(state)
    }
}

/// Walks over a tile's list front to back again; what lies behind a splat is the finished pixel less what was blended so far.
/// Writes the sum of each pair and returns how many pairs were walked.
struct TileBackward<'a> {
    state: State,
    origin: [f32; 2],
    list: &'a [u32],
    splats: &'a [Splat],
    color: &'a [[f32; 4]],
    out: &'a mut [PairSum],
}

impl pulp::NullaryFnOnce for TileBackward<'_> {
    type Output = u32;

    #[inline(always)]
    fn call(self) -> u32 {
        let Self { mut state, origin, list, splats, color, out } = self;
        for (index, (&gaussian, out)) in list.iter().zip(out).enumerate() {
            let (splat, paint) = (&splats[gaussian as usize], &color[gaussian as usize]);
            let mut sums = [[0.0; LANES]; 11];
            for row in rows_of(splat, origin[1]) {
                state.add_row(splat, paint, origin, row, &mut sums);
            }
            *out = from_fn(|i| sum(&sums[i]));
            if index % LANES == LANES - 1 && is_opaque(&state.transmittance) {
                return index as u32 + 1;
            }
        }
        list.len() as u32
    }
}

impl State {
    /// Adds a splat's part of a row to its sums.
    #[inline(always)]
    fn add_row(&mut self, splat: &Splat, paint: &[f32; 4], origin: [f32; 2], row: usize, sums: &mut [Lanes; 11]) {
        let exponents = exponents(splat, origin, row);
        let (opaque, most) = (OPAQUE as f32, MAX_ALPHA as f32);
        let mut touched = 0u32;
        for lane in 0..LANES {
            touched |= u32::from(exponents[lane] >= LOG2_CUT) & u32::from(self.transmittance[row][lane] >= opaque);
        }
        if touched == 0 {
            return;
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
            let by_depth = self.by_depth[row][lane];
            let value = self.color[0][row][lane] * paint[0]
                + self.color[1][row][lane] * paint[1]
                + self.color[2][row][lane] * paint[2]
                + by_depth * (splat.depth - self.mean_depth[row][lane]);
            let behind = self.behind[row][lane] - weight * value;
            self.behind[row][lane] = behind;
            let by_this_alpha = transmittance * value + (self.passing[row][lane] - behind) / (1.0 - alpha);
            // dL/d exponent; at the clamp alpha does not follow it.
            let slope = by_this_alpha * alpha * std::f32::consts::LN_2;
            let slope = if unclamped < most { slope } else { 0.0 };
            sums[0][lane] += slope;
            sums[1][lane] += slope * dx;
            sums[2][lane] += slope * dy;
            sums[3][lane] += weight * by_depth;
            sums[4][lane] += slope * dx * dx;
            sums[5][lane] += slope * dx * dy;
            sums[6][lane] += slope * dy * dy;
            sums[7][lane] += weight;
            sums[8][lane] += weight * self.carried[0][row][lane];
            sums[9][lane] += weight * self.carried[1][row][lane];
            sums[10][lane] += weight * self.carried[2][row][lane];
            self.transmittance[row][lane] = transmittance * (1.0 - alpha);
        }
    }
}

/// Carries a Gaussian's sums through the filtered ellipse, the lens and the camera to the world.
fn project_backward(
    drawn: &Drawn,
    sums: &PairSum,
    center_scale: &[f32; 4],
    carry: Carry,
    center_out: &mut [f32; 4],
    carried_out: &mut [[f32; 4]],
) {
    let [slope, slope_x, slope_y, by_depth, xx_moment, xy_moment, yy_moment, weight, carried @ ..] = *sums;
    let camera = &drawn.camera;
    let [x, y, z, scale] = *center_scale;
    let p = camera.to_camera(Vec3::new(x, y, z));
    let inverse_z = 1.0 / p.z;
    let ideal = p.truncate() * inverse_z;
    let focal = Vec2::from(camera.focal_px) * inverse_z;
    // Columns of d pixel / d camera-space point.
    let [along_x, along_y, along_z] = camera.projection_jacobian(p);
    let row_x = Vec3::new(along_x.x, along_y.x, along_z.x) * scale;
    let row_y = Vec3::new(along_x.y, along_y.y, along_z.y) * scale;
    let (xx, xy, yy) = (row_x.dot(row_x), row_x.dot(row_y), row_y.dot(row_y));
    let det = row_x.cross(row_y).length_squared();
    let s = drawn.settings.filter_variance_px2;
    let filtered_det = det + s * (xx + yy) + s * s;
    // 1 / (2 ln 2): the conics are for exp2.
    let half_log2_e = 0.5 * std::f32::consts::LOG2_E;
    // Inverse covariances after and before the filter.
    let filtered_inverse = Mat2::from_cols_array(&[yy + s, -xy, -xy, xx + s]) * (1.0 / filtered_det);
    let plain_inverse = Mat2::from_cols_array(&[yy, -xy, -xy, xx]) * (1.0 / det);
    let d_pixel = filtered_inverse * Vec2::new(slope_x, slope_y) * (2.0 * half_log2_e);
    // dL/d covariance: through the conic, and through the opacity sqrt(det / filtered_det).
    let moments = Mat2::from_cols_array(&[xx_moment, xy_moment, xy_moment, yy_moment]);
    let d_covariance =
        (filtered_inverse * moments * filtered_inverse + plain_inverse * filtered_inverse * (s * slope)) * half_log2_e;
    // dL/d the columns of the projection's Jacobian, covariance = scale^2 J J^T.
    let twice = d_covariance * (2.0 * scale * scale);
    let d_along_z = twice * along_z;
    let d_along_x = twice * along_x - ideal.x * d_along_z;
    let d_along_y = twice * along_y - ideal.y * d_along_z;
    let d_lens = [d_along_x * focal, d_along_y * focal];
    let d_ideal =
        through_lens_jacobian(camera, ideal, d_lens) - Vec2::new(d_along_z.dot(along_x), d_along_z.dot(along_y));
    let d_z = by_depth - (d_along_x.dot(along_x) + d_along_y.dot(along_y) + ideal.dot(d_ideal)) * inverse_z;
    let in_camera = Vec3::new(
        d_pixel.dot(along_x) + d_ideal.x * inverse_z,
        d_pixel.dot(along_y) + d_ideal.y * inverse_z,
        d_pixel.dot(along_z) + d_z,
    );
    let rotation = Mat3::from_mat4(Mat4::from_cols_array_2d(&camera.camera_from_world));
    let world_from_camera = rotation.transpose();
    let in_world = (world_from_camera * in_camera).extend(weight);
    if in_world.is_finite() {
        *center_out = (Vec4::from(*center_out) + in_world).to_array();
    }
    let [first, second] = match carry {
        Carry::Sum => [Vec4::new(carried[0], carried[1], carried[2], 0.0), Vec4::ZERO],
        Carry::Lift => {
            // J^T C J with C = (xx, xy, yy) of the image, J = d pixel / d world.
            let du = world_from_camera * Vec3::new(along_x.x, along_y.x, along_z.x);
            let dv = world_from_camera * Vec3::new(along_x.y, along_y.y, along_z.y);
            let (u, v) = (carried[0] * du + carried[1] * dv, carried[1] * du + carried[2] * dv);
            let entry = |i: usize, j: usize| du[i] * u[j] + dv[i] * v[j];
            [
                Vec4::new(entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1)),
                Vec4::new(entry(1, 2), entry(2, 2), 0.0, 0.0),
            ]
        }
    };
    if let ([out_first, out_second], true) = (carried_out, first.is_finite() && second.is_finite()) {
        *out_first = (Vec4::from(*out_first) + first).to_array();
        *out_second = (Vec4::from(*out_second) + second).to_array();
    }
}

/// dL/d ideal through the lens's Jacobian, given dL/d Jacobian (columns as those of the Jacobian).
fn through_lens_jacobian(camera: &CameraConstants, ideal: Vec2, d: [Vec2; 2]) -> Vec2 {
    let Vec2 { x, y } = ideal;
    let r2 = ideal.length_squared();
    let [k1, k2, k3, k4, ..] = camera.coefficients;
    // A radial factor s(r): first = s'/r, second = (s'/r)'/r.
    let (first, second, p1, p2);
    if camera.lens == 0 {
        // s = above / below, polynomials of q = r^2: first = 2 ds/dq, second = 4 d2s/dq2.
        let [d1, d2, d3] = [camera.coefficients[5], camera.coefficients[6], camera.coefficients[7]];
        let below = 1.0 / (1.0 + r2 * (d1 + r2 * (d2 + r2 * d3)));
        let below_slope = d1 + r2 * (2.0 * d2 + r2 * 3.0 * d3);
        let s = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * below;
        let slope = (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - s * below_slope) * below;
        first = 2.0 * slope;
        second = 4.0 * (2.0 * k2 + 6.0 * k3 * r2 - 2.0 * slope * below_slope - s * (2.0 * d2 + 6.0 * d3 * r2)) * below;
        (p1, p2) = (camera.coefficients[3], camera.coefficients[4]);
    } else if r2 < 1e-4 {
        // Taylor: s = 1 + (k1 - 1/3) r^2 + O(r^4); the formulas below cancel here.
        first = 2.0 * (k1 - 1.0 / 3.0);
        (second, p1, p2) = (0.0, 0.0, 0.0);
    } else {
        let r = r2.sqrt();
        let theta = r.atan();
        let t2 = theta * theta;
        let n = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
        let dn = theta * (6.0 * k1 + t2 * (20.0 * k2 + t2 * (42.0 * k3 + t2 * 72.0 * k4)));
        let s = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r;
        let inverse = 1.0 / (1.0 + r2);
        first = (n * inverse - s) / r2;
        let bend = (dn - 2.0 * r * n) * inverse * inverse;
        second = (bend / r - 3.0 * first) / r2;
        (p1, p2) = (0.0, 0.0);
    }
    let u_xx = 3.0 * x * first + x * x * x * second + 6.0 * p2;
    let u_xy = y * first + x * x * y * second + 2.0 * p1;
    let u_yy = x * first + x * y * y * second + 2.0 * p2;
    let v_yy = 3.0 * y * first + y * y * y * second + 6.0 * p1;
    // v_xx = u_xy and v_xy = u_yy for all lenses.
    let off_diagonal = d[1].x + d[0].y;
    Vec2::new(d[0].x * u_xx + off_diagonal * u_xy + d[1].y * u_yy, d[0].x * u_xy + off_diagonal * u_yy + d[1].y * v_yy)
}
