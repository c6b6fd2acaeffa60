//! Patches of a reference image and their tracking in another image.

use glam::{DVec2, DVec3};

use super::image::WatchedImage;

/// Half the side of a patch, and its side, pixels.
const HALF: usize = 7;
const SIDE: usize = 2 * HALF + 1;
/// Levels of the pyramid, each half the size of the previous one.
const LEVELS: usize = 3;
/// Cells of the image, across and down, and the most patches per cell.
const CELLS: (usize, usize) = (12, 8);
const A_CELL: usize = 2;
/// Least contrast of a patch: the smaller eigenvalue of its mean squared gradients, grey levels of 255 per pixel.
const LEAST_GRADIENT: f32 = 1.5;
/// Steps of the descent, and the step that ends it, pixels.
const STEPS: usize = 12;
const SMALL_STEP: f32 = 0.01;
/// Farthest a patch is tracked from its expected position, pixels.
const FAR: f64 = 8.0;
/// Least correlation of a tracked patch.
const LEAST_CORRELATION: f32 = 0.8;
/// Largest shift that is searched, pixels of the coarsest level.
const FAR_SHIFT: isize = 14;

type Gray = Vec<f32>;

/// Level of a pyramid.
#[derive(Debug, Clone)]
pub(super) struct Level {
    width: usize,
    height: usize,
    gray: Gray,
}

/// Image pyramid, finest level first.
#[derive(Debug, Clone)]
pub(super) struct Pyramid(Vec<Level>);

impl Pyramid {
    /// Reduces an image by an integer factor and builds its pyramid; `None` if it is too small or its length does not
    /// match its size.
    pub fn new(image: &WatchedImage<'_>, factor: usize) -> Option<Self> {
        let (width, height) = (image.width / factor, image.height / factor);
        let length = image.width.checked_mul(image.height)?.checked_mul(image.channels)?;
        let least = (SIDE + 2) << (LEVELS - 1);
        if image.bytes.len() != length || ![1, 3].contains(&image.channels) || width.min(height) < least {
            return None;
        }
        let share = 1.0 / (factor * factor * image.channels) as f32;
        let mut gray = vec![0.0f32; width * height];
        let mut sums = vec![0u32; width];
        for (y, row) in gray.chunks_exact_mut(width).enumerate() {
            sums.fill(0);
            for line in image.bytes.chunks_exact(image.width * image.channels).skip(y * factor).take(factor) {
                for (sum, pixels) in sums.iter_mut().zip(line.chunks_exact(factor * image.channels)) {
                    *sum += pixels.iter().map(|byte| u32::from(*byte)).sum::<u32>();
                }
            }
            row.iter_mut().zip(&sums).for_each(|(to, sum)| *to = *sum as f32 * share);
        }
        let mut levels = vec![Level { width, height, gray }.smoothed()];
        while levels.len() < LEVELS {
            let half = levels.last().map(Level::halved)?;
            levels.push(half);
        }
        Some(Self(levels))
    }
}

impl Level {
    /// Smooths each pixel with its neighbours (1 2 1 across and down): noise falls to 3/8, corners stay.
    fn smoothed(self) -> Self {
        let (width, height) = (self.width, self.height);
        let pass = |from: &Gray, step: usize, index: &dyn Fn(usize) -> (usize, usize)| -> Gray {
            let value = |i: usize| {
                let (at, side) = index(i);
                let (before, after) = (if at > 0 { i - step } else { i }, if at + 1 < side { i + step } else { i });
                0.5 * from[i] + 0.25 * (from[before] + from[after])
            };
            (0..from.len()).map(value).collect()
        };
        let across = pass(&self.gray, 1, &|i| (i % width, width));
        let gray = pass(&across, width, &|i| (i / width, height));
        Self { width, height, gray }
    }

    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let at = |x: usize, y: usize| self.gray[y * self.width + x];
        let pixel = |i: usize| {
            let (x, y) = (2 * (i % width), 2 * (i / width));
            0.25 * (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1))
        };
        Self { width, height, gray: (0..width * height).map(pixel).collect() }
    }

    /// Samples the brightness around a subpixel position, row by row; `None` where a part lies outside.
    fn raw_patch(&self, x: f32, y: f32) -> Option<Gray> {
        let reach = HALF as f32;
        let inside =
            x >= reach && y >= reach && x + reach < (self.width - 1) as f32 && y + reach < (self.height - 1) as f32;
        if !inside {
            return None;
        }
        let (x0, y0) = (x as usize, y as usize);
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let mut values = Vec::with_capacity(SIDE * SIDE);
        for row in 0..SIDE {
            let at = (y0 + row - HALF) * self.width + x0 - HALF;
            let (above, below) = (&self.gray[at..=at + SIDE], &self.gray[at + self.width..=at + self.width + SIDE]);
            for column in 0..SIDE {
                let top = above[column] + fx * (above[column + 1] - above[column]);
                let bottom = below[column] + fx * (below[column + 1] - below[column]);
                values.push(top + fy * (bottom - top));
            }
        }
        Some(values)
    }

    /// Samples a patch, normalised to mean 0 and length 1; `None` at the edge and without contrast.
    fn patch(&self, x: f32, y: f32) -> Option<Gray> {
        normalised(self.raw_patch(x, y)?)
    }
}

fn normalised(mut values: Gray) -> Option<Gray> {
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    values.iter_mut().for_each(|value| *value -= mean);
    let length = values.iter().map(|value| value * value).sum::<f32>().sqrt();
    if length.is_nan() || length < 1e-3 * values.len() as f32 {
        return None;
    }
    values.iter_mut().for_each(|value| *value /= length);
    Some(values)
}

/// Reference patch at one level.
#[derive(Debug, Clone)]
struct Template {
    values: Gray,
    by_x: Gray,
    by_y: Gray,
    /// Inverse of the summed products of the derivatives: xx, xy, yy.
    inverse: [f32; 3],
}

impl Template {
    fn new(level: &Level, x: f32, y: f32) -> Option<Self> {
        let values = level.patch(x, y)?;
        let raw = |dx: f32, dy: f32| level.raw_patch(x + dx, y + dy);
        // Derivatives of the normalised patch, up to its length.
        let mean = raw(0.0, 0.0)?;
        let middle = mean.iter().sum::<f32>() / mean.len() as f32;
        let length = mean.iter().map(|value| (value - middle).powi(2)).sum::<f32>().sqrt();
        let slope = |plus: Gray, minus: Gray| -> Gray {
            let mut by: Gray = plus.iter().zip(&minus).map(|(a, b)| 0.5 * (a - b) / length).collect();
            let mean = by.iter().sum::<f32>() / by.len() as f32;
            by.iter_mut().for_each(|value| *value -= mean);
            by
        };
        let by_x = slope(raw(1.0, 0.0)?, raw(-1.0, 0.0)?);
        let by_y = slope(raw(0.0, 1.0)?, raw(0.0, -1.0)?);
        let dot = |a: &Gray, b: &Gray| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        let (xx, xy, yy) = (dot(&by_x, &by_x), dot(&by_x, &by_y), dot(&by_y, &by_y));
        let det = xx * yy - xy * xy;
        (det > 1e-9).then(|| Self { values, by_x, by_y, inverse: [yy / det, -xy / det, xx / det] })
    }
}

/// Corner of the reference.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    /// Pixel of the finest level.
    pub at: DVec2,
    /// Direction of that pixel, camera axes.
    pub ray: DVec3,
    templates: Vec<Template>,
}

/// Chooses corners all over the image; `ray` gives the direction of a pixel of the finest level.
pub(super) fn choose(pyramid: &Pyramid, ray: &dyn Fn(DVec2) -> Option<DVec3>) -> Vec<Patch> {
    let Some(level) = pyramid.0.first() else { return Vec::new() };
    let (w, h) = (level.width, level.height);
    // The smaller eigenvalue of the squared gradients over a small window, on every second pixel.
    let reach = HALF + 2;
    let strength = |x: usize, y: usize| {
        let (mut xx, mut xy, mut yy) = (0.0f32, 0.0f32, 0.0f32);
        for v in y - 3..=y + 3 {
            for u in x - 3..=x + 3 {
                let gx = 0.5 * (level.gray[v * w + u + 1] - level.gray[v * w + u - 1]);
                let gy = 0.5 * (level.gray[(v + 1) * w + u] - level.gray[(v - 1) * w + u]);
                (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
            }
        }
        let (half, difference) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        (half - (difference * difference + xy * xy).sqrt()) / 49.0
    };
    let mut patches = Vec::new();
    for cell_y in 0..CELLS.1 {
        for cell_x in 0..CELLS.0 {
            let range = |cell: usize, cells: usize, side: usize| {
                (cell * side / cells).max(reach)..((cell + 1) * side / cells).min(side - reach)
            };
            let mut corners = Vec::new();
            for y in range(cell_y, CELLS.1, h).step_by(2) {
                for x in range(cell_x, CELLS.0, w).step_by(2) {
                    let strength = strength(x, y);
                    if strength > LEAST_GRADIENT {
                        corners.push((strength, x, y));
                    }
                }
            }
            corners.sort_by(|a, b| b.0.total_cmp(&a.0));
            let mut chosen: Vec<(usize, usize)> = Vec::new();
            for (_, x, y) in corners {
                let is_apart = |(a, b): &(usize, usize)| a.abs_diff(x).max(b.abs_diff(y)) > HALF;
                if chosen.len() < A_CELL && chosen.iter().all(is_apart) {
                    chosen.push((x, y));
                }
            }
            patches.extend(chosen.into_iter().filter_map(|(x, y)| patch(pyramid, x as f32, y as f32, ray)));
        }
    }
    patches
}

fn patch(pyramid: &Pyramid, x: f32, y: f32, ray: &dyn Fn(DVec2) -> Option<DVec3>) -> Option<Patch> {
    let mut templates = vec![Template::new(pyramid.0.first()?, x, y)?];
    for (k, level) in pyramid.0.iter().enumerate().skip(1) {
        let (x, y) = reduced(x, y, k);
        // At the edge, coarse levels are left out.
        match Template::new(level, x, y) {
            Some(template) => templates.push(template),
            None => break,
        }
    }
    let at = DVec2::new(f64::from(x), f64::from(y));
    Some(Patch { at, ray: ray(at)?, templates })
}

/// Returns the position in level `k` of a pixel of the finest one: pixel centres lie at integers in both.
fn reduced(x: f32, y: f32, k: usize) -> (f32, f32) {
    let factor = (1 << k) as f32;
    let place = |at: f32| (at + 0.5) / factor - 0.5;
    (place(x), place(y))
}

/// Tracks patches near their positions shifted by `expected`; pixels of the finest level, or `None`.
pub(super) fn track(pyramid: &Pyramid, patches: &[Patch], expected: &[DVec2]) -> Vec<Option<DVec2>> {
    let one = |(patch, expected): (&Patch, &DVec2)| {
        let mut shift = [expected.x as f32, expected.y as f32];
        for (k, (template, level)) in patch.templates.iter().zip(&pyramid.0).enumerate().take(2).rev() {
            let factor = (1 << k) as f32;
            let (x, y) = reduced(patch.at.x as f32, patch.at.y as f32, k);
            let (found, correlation) = descend(template, level, x, y, [shift[0] / factor, shift[1] / factor])?;
            if k == 0 && correlation < LEAST_CORRELATION {
                return None;
            }
            shift = [found[0] * factor, found[1] * factor];
        }
        let found = DVec2::new(f64::from(shift[0]), f64::from(shift[1]));
        (found.distance(*expected) < FAR).then_some(patch.at + found)
    };
    patches.iter().zip(expected).map(one).collect()
}

/// Aligns a patch with its template by gradient descent; returns the shift and the correlation.
fn descend(template: &Template, level: &Level, x: f32, y: f32, mut shift: [f32; 2]) -> Option<([f32; 2], f32)> {
    for _ in 0..STEPS {
        let values = level.patch(x + shift[0], y + shift[1])?;
        let (mut along_x, mut along_y) = (0.0f32, 0.0f32);
        for (i, value) in values.iter().enumerate() {
            let off = value - template.values[i];
            along_x += template.by_x[i] * off;
            along_y += template.by_y[i] * off;
        }
        let [xx, xy, yy] = template.inverse;
        let step = [xx * along_x + xy * along_y, xy * along_x + yy * along_y];
        let length = step[0].hypot(step[1]);
        if !length.is_finite() {
            return None;
        }
        // Farther than a patch's half, the gradients say nothing.
        let limited = (2.0 / length.max(2.0)).min(1.0);
        shift = [shift[0] - step[0] * limited, shift[1] - step[1] * limited];
        if length < SMALL_STEP {
            break;
        }
    }
    let values = level.patch(x + shift[0], y + shift[1])?;
    let correlation = values.iter().zip(&template.values).map(|(a, b)| a * b).sum();
    Some((shift, correlation))
}

/// Finds the shift at which most patches of the coarsest level match, in pixels of the finest level.
pub(super) fn coarse_shift(pyramid: &Pyramid, patches: &[Patch]) -> Option<DVec2> {
    let (k, level) = pyramid.0.iter().enumerate().next_back()?;
    let score = |dx: isize, dy: isize| -> f32 {
        let of = |patch: &Patch| {
            let (x, y) = reduced(patch.at.x as f32, patch.at.y as f32, k);
            let values = level.patch(x + dx as f32, y + dy as f32)?;
            let template = patch.templates.get(k)?;
            let correlation: f32 = values.iter().zip(&template.values).map(|(a, b)| a * b).sum();
            Some(correlation.max(0.0).powi(2))
        };
        patches.iter().filter_map(of).sum()
    };
    let shifts = (-FAR_SHIFT..=FAR_SHIFT).flat_map(|dy| (-FAR_SHIFT..=FAR_SHIFT).map(move |dx| (dx, dy)));
    let (_, (dx, dy)) = shifts.map(|shift| (score(shift.0, shift.1), shift)).max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(DVec2::new(dx as f64, dy as f64) * f64::from(1 << k))
}
