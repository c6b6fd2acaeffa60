//! Distance of each pixel from the person's outlines: of the mask, and where a near part hides a far one.

/// Step of depth between neighbouring pixels that counts as an outline, metres: beyond what a steep surface shows.
const STEP_M: f32 = 0.04;
/// Length of a diagonal step, pixels.
const DIAGONAL: f32 = std::f32::consts::SQRT_2;

/// Returns the distance of each pixel's centre from the nearest pixel that is outside of the mask, shows no mesh, or lies at a step
/// of depth; pixels, along straight and diagonal steps (up to 8 % longer than a straight line). `alpha` is the mask, 0..=255; above
/// half is inside.
pub(super) fn edge_distances(alpha: impl Fn(usize) -> u8, depth: &[f32], width: usize) -> Vec<f32> {
    let height = depth.len() / width.max(1);
    let is_outside = |i: usize| alpha(i) < 128 || !depth[i].is_finite();
    let steps = |i: usize, j: usize| (depth[i] - depth[j]).abs() > STEP_M;
    let mut away = vec![f32::MAX; depth.len()];
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let is_step = (x > 0 && steps(i, i - 1))
                || (x + 1 < width && steps(i, i + 1))
                || (y > 0 && steps(i, i - width))
                || (y + 1 < height && steps(i, i + width));
            if is_outside(i) || is_step {
                away[i] = 0.0;
            }
        }
    }
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let mut least = away[i];
            if x > 0 {
                least = least.min(away[i - 1] + 1.0);
            }
            if y > 0 {
                least = least.min(away[i - width] + 1.0);
                if x > 0 {
                    least = least.min(away[i - width - 1] + DIAGONAL);
                }
                if x + 1 < width {
                    least = least.min(away[i - width + 1] + DIAGONAL);
                }
            }
            away[i] = least;
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let i = y * width + x;
            let mut least = away[i];
            if x + 1 < width {
                least = least.min(away[i + 1] + 1.0);
            }
            if y + 1 < height {
                least = least.min(away[i + width] + 1.0);
                if x + 1 < width {
                    least = least.min(away[i + width + 1] + DIAGONAL);
                }
                if x > 0 {
                    least = least.min(away[i + width - 1] + DIAGONAL);
                }
            }
            away[i] = least;
        }
    }
    away
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with a search through all pixels, in f64.
    #[test]
    fn distances_are_those_to_the_nearest_outline() {
        let (width, height) = (40usize, 30usize);
        // A disc of mask; inside it a near square, a step of 0.2 m.
        let alpha = |i: usize| {
            let (x, y) = ((i % width) as f64, (i / width) as f64);
            if (x - 19.0).hypot(y - 15.0) < 13.5 { 200 } else { 90 }
        };
        let is_near = |x: usize, y: usize| (20..28).contains(&x) && (10..18).contains(&y);
        let mut depth: Vec<f32> =
            (0..width * height).map(|i| if is_near(i % width, i / width) { 1.8 } else { 2.0 }).collect();
        depth[15 * width + 10] = f32::INFINITY;
        let found = edge_distances(alpha, &depth, width);
        let is_seed = |x: usize, y: usize| {
            let step = |u: usize, v: usize| {
                let (a, b) = (depth[y * width + x], depth[v * width + u]);
                !(f64::from(a) - f64::from(b)).abs().le(&0.04)
            };
            alpha(y * width + x) < 128
                || !depth[y * width + x].is_finite()
                || (x > 0 && step(x - 1, y))
                || (x + 1 < width && step(x + 1, y))
                || (y > 0 && step(x, y - 1))
                || (y + 1 < height && step(x, y + 1))
        };
        let seeds: Vec<(usize, usize)> =
            (0..width * height).map(|i| (i % width, i / width)).filter(|(x, y)| is_seed(*x, *y)).collect();
        for (i, found) in found.iter().enumerate() {
            let to = |(x, y): &(usize, usize)| (*x as f64 - (i % width) as f64).hypot(*y as f64 - (i / width) as f64);
            let expected = seeds.iter().map(to).fold(f64::INFINITY, f64::min);
            let found = f64::from(*found);
            assert!(found >= expected - 1e-5 && found <= 1.083 * expected + 1e-5, "{i}: {found} {expected}");
        }
        assert!(edge_distances(|_| 255, &[], 0).is_empty());
        assert!(edge_distances(|_| 255, &[1.0; 6], 3).iter().all(|away| *away > 1e6), "no outline");
        assert!(edge_distances(|_| 255, &[f32::NAN; 6], 3).iter().all(|away| *away <= 0.0));
    }
}
