//! Plain slow f64 reference of the backward pass. The blending is differentiated from back to front, the projection
//! by differences: both other ways than the shaders'.
#![allow(dead_code)]

use flyrig_renderer::RasterSettings;
use flyrig_types::Camera;
use glam::{DVec2, DVec3};

use super::reference::{Scene, Splat, footprint, sorted_splats, splat_at, vec3};

const CUT: f64 = 1.0 / 255.0;
const MAX_ALPHA: f64 = 0.99;
const OPAQUE: f64 = 1e-4;

/// dL/d the images, element for element as in `ImageGradients`.
#[derive(Debug, Clone)]
pub struct Incoming<T = f32> {
    pub color: Vec<[T; 4]>,
    pub depth_carry: Vec<[T; 4]>,
}

/// dL/d centres, blending weights in pixels with a gradient, carried sums.
#[derive(Debug, Clone)]
pub struct Outgoing {
    pub center: Vec<DVec3>,
    pub weight: Vec<f64>,
    pub carried: Vec<[f64; 3]>,
}

/// A scene's splats and which of them touch each pixel, nearest first.
pub struct Touched {
    pub splats: Vec<Splat>,
    pub lists: Vec<Vec<usize>>,
    /// Pixels where rounding may decide what touches, what comes first, or what is clamped.
    pub unclear: Vec<bool>,
}

/// Alpha of a splat in a pixel, before the clamp.
pub fn unclamped_alpha(s: &Splat, x: f64, y: f64) -> f64 {
    let d = DVec2::new(x, y) - s.pixel;
    s.opacity * (-0.5 * (s.xx * d.x * d.x + 2.0 * s.xy * d.x * d.y + s.yy * d.y * d.y)).exp()
}

/// Pixels that each splat touches.
pub fn touched(scene: &Scene, camera: &Camera, settings: &RasterSettings, size: (u32, u32)) -> Touched {
    touched_by(sorted_splats(scene, camera, settings), size)
}

/// Finds the pixels that each splat touches; splats are sorted by depth.
pub fn touched_by(splats: Vec<Splat>, (width, height): (u32, u32)) -> Touched {
    let pixels = width as usize * height as usize;
    let mut lists: Vec<Vec<usize>> = vec![Vec::new(); pixels];
    let mut unclear = vec![false; pixels];
    let mut transmittance = vec![1.0; pixels];
    let near = |value: f64, limit: f64, share: f64| (value / limit - 1.0).abs() < share;
    for (k, s) in splats.iter().enumerate() {
        let ([x0, x1], [y0, y1]) = footprint(s, width, height);
        for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
            let at = y * width as usize + x;
            let alpha = unclamped_alpha(s, x as f64, y as f64);
            if transmittance[at] < OPAQUE {
                continue;
            }
            unclear[at] |= near(alpha, CUT, 2e-3) || near(alpha, MAX_ALPHA, 1e-3);
            if alpha < CUT {
                continue;
            }
            if let Some(&before) = lists[at].last() {
                let gap = s.depth - splats[before].depth;
                unclear[at] |= gap > 0.0 && gap < 1e-5 * s.depth;
            }
            transmittance[at] *= 1.0 - alpha.min(MAX_ALPHA);
            unclear[at] |= near(transmittance[at], OPAQUE, 1e-2);
            lists[at].push(k);
        }
    }
    Touched { splats, lists, unclear }
}

/// Colour and alpha, then depth and carried numbers of a pixel; none where all are zero or one is not finite.
fn pixel<T: Copy + Into<f64>>(incoming: &Incoming<T>, at: usize) -> Option<([f64; 4], [f64; 4])> {
    let (color, depth_carry) = (incoming.color[at].map(Into::into), incoming.depth_carry[at].map(Into::into));
    let all = || color.iter().chain(&depth_carry);
    (all().any(|&v| v != 0.0) && all().all(|v| v.is_finite())).then_some((color, depth_carry))
}

fn rgb(color: [f64; 4]) -> DVec3 {
    DVec3::new(color[0], color[1], color[2])
}

/// Colours of the splats.
fn colors_of(scene: &Scene, splats: &[Splat]) -> Vec<DVec3> {
    splats.iter().map(|s| vec3(scene.color[s.index])).collect()
}

/// The loss that is linear in the images with `incoming` as its derivative, with the lists of `touched` kept while
/// `splats` may have moved.
pub fn linear_loss(scene: &Scene, touched: &Touched, splats: &[Splat], incoming: &Incoming, width: u32) -> f64 {
    linear_loss_of(&colors_of(scene, splats), touched, splats, incoming, width)
}

/// [`linear_loss`] with a colour for each splat.
pub fn linear_loss_of(colors: &[DVec3], touched: &Touched, splats: &[Splat], incoming: &Incoming, width: u32) -> f64 {
    let mut loss = 0.0;
    for (at, list) in touched.lists.iter().enumerate() {
        let Some((by_color, by_depth)) = pixel(incoming, at).filter(|_| !list.is_empty()) else { continue };
        let (x, y) = ((at % width as usize) as f64, (at / width as usize) as f64);
        let (mut transmittance, mut color, mut depth) = (1.0, DVec3::ZERO, 0.0);
        for &k in list {
            let s = &splats[k];
            let alpha = unclamped_alpha(s, x, y).min(MAX_ALPHA);
            color += alpha * transmittance * colors[k];
            depth += alpha * transmittance * s.depth;
            transmittance *= 1.0 - alpha;
        }
        let alpha = 1.0 - transmittance;
        loss += rgb(by_color).dot(color) + by_color[3] * alpha + by_depth[0] * depth / alpha;
    }
    loss
}

/// Derivatives with respect to one splat's numbers, and what its pixels carried to it.
#[derive(Clone, Copy, Default)]
pub struct SplatGradient {
    pub color: DVec3,
    pub weight: f64,
    pub carried: [f64; 3],
    pixel: DVec2,
    depth: f64,
    opacity: f64,
    xx: f64,
    xy: f64,
    yy: f64,
}

impl SplatGradient {
    /// Change of the loss when the splat becomes another, were the loss linear in the splat's numbers.
    pub fn change(&self, from: &Splat, to: &Splat) -> f64 {
        self.pixel.dot(to.pixel - from.pixel)
            + self.depth * (to.depth - from.depth)
            + self.opacity * (to.opacity - from.opacity)
            + self.xx * (to.xx - from.xx)
            + self.xy * (to.xy - from.xy)
            + self.yy * (to.yy - from.yy)
    }
}

/// Derivatives with respect to the splats, each with its colour.
pub fn splat_gradients<T: Copy + Into<f64>>(
    colors: &[DVec3],
    width: u32,
    touched: &Touched,
    incoming: &Incoming<T>,
) -> Vec<SplatGradient> {
    let splats = &touched.splats;
    let mut gradients = vec![SplatGradient::default(); splats.len()];
    for (at, list) in touched.lists.iter().enumerate() {
        let Some((by_color, depth_carry)) = pixel(incoming, at).filter(|_| !list.is_empty()) else { continue };
        let (x, y) = ((at % width as usize) as f64, (at / width as usize) as f64);
        let mut before = vec![1.0];
        let mut depth_sum = 0.0;
        for &k in list {
            let alpha = unclamped_alpha(&splats[k], x, y).min(MAX_ALPHA);
            let transmittance = before[before.len() - 1];
            depth_sum += alpha * transmittance * splats[k].depth;
            before.push(transmittance * (1.0 - alpha));
        }
        let coverage = 1.0 - before[list.len()];
        let by_depth = depth_carry[0] / coverage;
        let by_alpha = by_color[3] - by_depth * depth_sum / coverage;
        // Value of all that lies behind, per light that reaches it.
        let mut behind = 0.0;
        for (place, &k) in list.iter().enumerate().rev() {
            let s = &splats[k];
            let unclamped = unclamped_alpha(s, x, y);
            let alpha = unclamped.min(MAX_ALPHA);
            let value = rgb(by_color).dot(colors[k]) + by_depth * s.depth + by_alpha;
            let weight = alpha * before[place];
            let g = &mut gradients[k];
            g.color += weight * rgb(by_color);
            g.weight += weight;
            for (sum, carry) in g.carried.iter_mut().zip(&depth_carry[1..]) {
                *sum += weight * carry;
            }
            g.depth += weight * by_depth;
            if unclamped < MAX_ALPHA {
                let by_this = before[place] * (value - behind);
                let d = DVec2::new(x, y) - s.pixel;
                g.opacity += by_this * alpha / s.opacity;
                let by_r2 = -0.5 * alpha * by_this;
                g.xx += by_r2 * d.x * d.x;
                g.xy += by_r2 * 2.0 * d.x * d.y;
                g.yy += by_r2 * d.y * d.y;
                g.pixel -= by_r2 * 2.0 * DVec2::new(s.xx * d.x + s.xy * d.y, s.xy * d.x + s.yy * d.y);
            }
            behind = alpha * value + (1.0 - alpha) * behind;
        }
    }
    gradients
}

/// The backward pass.
pub fn backward<T: Copy + Into<f64>>(
    scene: &Scene,
    camera: &Camera,
    settings: &RasterSettings,
    width: u32,
    touched: &Touched,
    incoming: &Incoming<T>,
) -> Outgoing {
    let count = scene.center_scale.len();
    let mut out =
        Outgoing { center: vec![DVec3::ZERO; count], weight: vec![0.0; count], carried: vec![[0.0; 3]; count] };
    let splats = &touched.splats;
    let gradients = splat_gradients(&colors_of(scene, splats), width, touched, incoming);
    for (s, g) in splats.iter().zip(&gradients) {
        (out.weight[s.index], out.carried[s.index]) = (g.weight, g.carried);
        // Culling is a jump, and not to be differentiated.
        let smooth = RasterSettings { cull_backfacing: false, ..*settings };
        let value = |center: DVec3| splat_at(scene, camera, &smooth, s.index, center).map(|moved| g.change(s, &moved));
        // Fourth order; the reference's own Jacobian is good to 1e-10. A splat that may vanish on the way gets
        // shorter steps.
        let slope = |axis: DVec3| {
            let pair = |h: f64| Some((value(s.center + axis * h)? - value(s.center - axis * h)?) / (2.0 * h));
            let at = |h: f64| Some((4.0 * pair(0.5 * h)? - pair(h)?) / 3.0);
            [1e-3, 1e-4, 1e-5].iter().find_map(|h| at(h * s.depth)).unwrap_or(0.0)
        };
        out.center[s.index] = DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z));
    }
    out
}

/// Entries xx, xy, xz, yy, yz, zz of `J^T C J`, with C = (xx, xy, yy) of the image and J = d pixel / d centre of a
/// splat by differences.
pub fn lift(
    scene: &Scene,
    camera: &Camera,
    settings: &RasterSettings,
    splat: &Splat,
    [xx, xy, yy]: [f64; 3],
) -> [f64; 6] {
    let smooth = RasterSettings { cull_backfacing: false, ..*settings };
    let h = 1e-5 * splat.depth;
    let column = |axis: DVec3| {
        let at = |h: f64| splat_at(scene, camera, &smooth, splat.index, splat.center + axis * h).map(|s| s.pixel);
        Some((at(h)? - at(-h)?) / (2.0 * h))
    };
    let columns = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| column(axis).unwrap_or(DVec2::ZERO));
    [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|(i, j)| {
        let (a, b) = (columns[i], columns[j]);
        xx * a.x * b.x + xy * (a.x * b.y + a.y * b.x) + yy * a.y * b.y
    })
}
