//! Alpha and foreground colour of the pixels along a mask's outline.
//!
//! A pixel on the outline shows alpha F + (1 - alpha) B, in linear light. The background B is the plate, brought to the
//! exposure and the shadow of the surely empty pixels nearby, or else their colour; the foreground F comes from the nearest
//! pixels well inside the mask. Where F and B are alike, alpha stays that of the mask.

use flyrig_types::{Image, Mask};
use rayon::prelude::*;

use crate::error::TrackError;
use crate::image::grid::Grid;
use crate::image::light::{byte, linear_of_bytes, step};
use crate::image::pixels::Rgb;
use crate::masks::background::Background;
use crate::masks::background_light::BackgroundLight;
use crate::masks::edge_color::{EdgeColor, Matte};
use crate::masks::seen_background::SeenBackground;

/// Half width of the band around the outline in which alpha is solved for, pixels.
const BAND_PX: f32 = 3.4;
/// Least depth of a pixel of a thin part that counts as surely inside, pixels.
const THIN_PX: f32 = 1.9;
/// Width of the surroundings of the mask that show the background, pixels.
const MARGIN_PX: usize = 14;
/// Half side of the square in which the background's exposure is compared with the plate's, pixels.
const LOCAL_PX: usize = 7;
/// Offsets from the nearest sure pixel at which colours are sampled, pixels.
const TRIED: [(i64, i64); 9] = [(0, 0), (-2, 0), (2, 0), (0, -2), (0, 2), (-2, -2), (2, -2), (-2, 2), (2, 2)];
/// Standard deviation of a pixel's colour, sRGB steps.
const NOISE: f32 = 3.0;
/// Contrast of foreground and background at which the solved alpha gets half the weight, standard deviations.
const HALF_BELIEVED: f32 = 4.0;
/// Weight of the unexplained part of a pixel in the doubt about its alpha.
const REMAINDER: f32 = 60.0;
/// Weight of differences in colour beside those in brightness.
const CHROMA: f32 = 0.8;
/// Largest half width of a blurred outline, pixels.
const BLUR_PX: f32 = 1.7;
/// Range of the share of its light that a shadow leaves to the background, and the margin by which a mixture must explain a
/// pixel beyond the mask better than a shadow does, squared standard deviations.
const SHADOWS: std::ops::RangeInclusive<f32> = 0.15..=1.05;
const BETTER_THAN_SHADOW: f32 = 4.0;
/// Largest depth of a mask pixel that is solved for because it looks like the background, pixels, and the evidence below
/// which it does.
const DEEP_PX: f32 = 24.0;
const LOOKS_EMPTY: f32 = 0.4;

/// Solves for coverage and foreground colour along the outline of a mask. Without a background, or where it has another
/// size, the colours around the mask are used. `seen` is the background as the mask estimation measured it in this
/// image; without it, the background is measured here.
///
/// ```
/// use flyrig_tracker::matte;
/// use flyrig_types::{Image, Mask, PixelFormat};
///
/// // A dark square before a light wall, and a mask that is two pixels too wide.
/// let dark = |at: usize| (20..44).contains(&(at % 64)) && (20..44).contains(&(at / 64));
/// let wide = |at: usize| (18..46).contains(&(at % 64)) && (18..46).contains(&(at / 64));
/// let bytes: Vec<u8> = (0..64 * 64).flat_map(|at| if dark(at) { [20, 30, 60] } else { [200, 190, 170] }).collect();
/// let image = Image::new(64, 64, PixelFormat::Rgb8, bytes)?;
/// let mask = Mask::new(64, 64, (0..64 * 64).map(|at| 255 * u8::from(wide(at))).collect())?;
///
/// let solved = matte(&image, &mask, None, None)?;
/// // Without a plate the mask keeps half its weight where it disagrees with the colours.
/// let (before, after) = (mask.coverage()[32 * 64 + 18], solved.mask.coverage()[32 * 64 + 18]);
/// assert!(before == 255 && after < 160, "the wall beside the square is covered less: {after}");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// Kind `Image` when the format cannot be read or the mask is of another size.
pub fn matte(
    image: &Image,
    mask: &Mask,
    background: Option<&Background>,
    seen: Option<&SeenBackground>,
) -> Result<Matte, TrackError> {
    let picture = Rgb::new(image)?;
    if (mask.width() as usize, mask.height() as usize) != (picture.width, picture.height) {
        return Err(TrackError::new(
            crate::error::TrackErrorKind::Image,
            format!(
                "the mask is {}x{} but the image {}x{}",
                mask.width(),
                mask.height(),
                picture.width,
                picture.height
            ),
        ));
    }
    let unmasked = |at: usize| mask.coverage()[at] == 0;
    let light = background.and_then(|background| match seen {
        Some(seen) => background.light_again(&picture, seen),
        None => background.light(&picture, &unmasked),
    });
    let Some(band) = Band::new(&picture, mask, light.as_ref(), seen) else {
        return Ok(Matte { mask: mask.clone(), colors: Vec::new() });
    };
    let mut matte = band.solve(mask);
    if let Some(BackgroundLight::Screen(key, screen)) = &light {
        key.despill(&picture, screen, &mut matte);
    }
    Ok(matte)
}

/// Surroundings of a mask's outline.
struct Band<'a> {
    picture: &'a Rgb<'a>,
    x0: usize,
    y0: usize,
    width: usize,
    height: usize,
    /// Linear light of the pixels.
    light: Vec<[f32; 3]>,
    /// Distance of pixels in the mask to the nearest one outside, and of pixels outside to the mask; 0 on the other side.
    inner: Grid,
    outer: Grid,
    /// Nearest pixel that surely shows the foreground alone, and the nearest that shows the background alone.
    nearest_inside: Vec<u32>,
    nearest_outside: Vec<u32>,
    /// Pixels of the mask that look like the background.
    empty: Vec<bool>,
    /// Linear light of the background where it is known.
    behind: Vec<Option<[f32; 3]>>,
}

/// Marks a missing pixel.
const NONE: u32 = u32::MAX;
/// Pixels per parallel task.
const PIXELS_A_TASK: usize = 8192;

impl<'a> Band<'a> {
    /// Measures the surroundings of a mask; `None` for an empty mask.
    fn new(
        picture: &'a Rgb<'a>,
        mask: &Mask,
        light: Option<&BackgroundLight<'_>>,
        seen: Option<&SeenBackground>,
    ) -> Option<Self> {
        let inside = |x: usize, y: usize| mask.coverage()[y * picture.width + x] >= 128;
        let [x0, y0, x1, y1] = mask.bounding_box()?.map(|v| v as usize);
        let (x0, y0) = (x0.saturating_sub(MARGIN_PX), y0.saturating_sub(MARGIN_PX));
        let (x1, y1) = ((x1 + MARGIN_PX).min(picture.width), (y1 + MARGIN_PX).min(picture.height));
        let (width, height) = (x1 - x0, y1 - y0);
        let mut set = Grid::new(width, height, 0.0);
        for (at, value) in set.values.iter_mut().enumerate() {
            *value = f32::from(inside(x0 + at % width, y0 + at / width));
        }
        let mut unset = set.clone();
        unset.values.iter_mut().for_each(|value| *value = 1.0 - *value);
        let (outer, inner) = rayon::join(|| set.distance_to_set(), || unset.distance_to_set());
        let own_light: Vec<[f32; 3]> = (0..width * height)
            .into_par_iter()
            .with_min_len(PIXELS_A_TASK)
            .map(|at| linear_of_bytes(picture.pixel(x0 + at % width, y0 + at / width)))
            .collect();
        let mut band = Self {
            picture,
            x0,
            y0,
            width,
            height,
            light: own_light,
            inner,
            outer,
            nearest_inside: Vec::new(),
            nearest_outside: Vec::new(),
            empty: vec![false; width * height],
            behind: vec![None; width * height],
        };
        let pixels = (0..width * height).into_par_iter().with_min_len(PIXELS_A_TASK);
        let mut sure_inside: Vec<bool> = pixels.map(|at| band.is_sure_inside(at)).collect();
        let mut sure_outside: Vec<bool> = band.outer.values.iter().map(|d| *d > BAND_PX).collect();
        if let Some(light) = light {
            let bounds = [x0, y0, x1, y1];
            let evidence = match seen {
                Some(seen) => seen.evidence_in(light, picture, bounds),
                None => light.evidence(picture, bounds),
            };
            if let Some(evidence) = evidence {
                sure_outside.iter_mut().zip(&evidence.values).for_each(|(sure, value)| *sure &= *value < 0.5);
                for (at, value) in evidence.box_mean(1).values.iter().enumerate() {
                    let depth = band.inner.values[at];
                    band.empty[at] = depth > 0.0 && depth <= DEEP_PX && *value < LOOKS_EMPTY;
                    sure_inside[at] &= !band.empty[at] && *value > 0.5;
                }
                band.behind = band.local_background(light, &sure_outside);
            }
        }
        (band.nearest_inside, band.nearest_outside) =
            rayon::join(|| nearest(&sure_inside, width, height), || nearest(&sure_outside, width, height));
        Some(band)
    }

    /// Whether a pixel shows the foreground alone: deep in the mask, or in the middle of a thin part.
    fn is_sure_inside(&self, at: usize) -> bool {
        let depth = self.inner.values[at];
        if depth > BAND_PX {
            return true;
        }
        if depth < THIN_PX {
            return false;
        }
        let (x, y) = (at % self.width, at / self.width);
        let near = |v: usize, side: usize| v.saturating_sub(2)..(v + 3).min(side);
        near(y, self.height).all(|v| near(x, self.width).all(|u| self.inner.values[v * self.width + u] <= depth))
    }

    /// Returns the background's light, scaled to the exposure and shadow of the sure background nearby.
    fn local_background(&self, background: &BackgroundLight<'_>, sure: &[bool]) -> Vec<Option<[f32; 3]>> {
        let behind: Vec<Option<[f32; 3]>> = (0..self.light.len()).map(|at| background.at(self.pixel(at))).collect();
        let mean = |value: &(dyn Fn(usize, [f32; 3]) -> f32 + Sync)| {
            let of = |at: usize| behind[at].filter(|_| sure[at]).map_or(0.0, |light| value(at, light));
            Grid { width: self.width, height: self.height, values: (0..sure.len()).map(of).collect() }
                .box_mean(LOCAL_PX)
        };
        let ratio = |k: usize| {
            let (mut now, plate) =
                rayon::join(|| mean(&|at, _| self.light[at][k]), || mean(&|_, light: [f32; 3]| light[k]));
            // Without sure background nearby the plate is used unscaled.
            now.values.iter_mut().zip(&plate.values).for_each(|(now, plate)| *now = (*now + 2e-3) / (plate + 2e-3));
            now
        };
        let (red, (green, blue)) = rayon::join(|| ratio(0), || rayon::join(|| ratio(1), || ratio(2)));
        let ratios = [red, green, blue];
        let scaled = |(at, light): (usize, &Option<[f32; 3]>)| {
            light.map(|light| std::array::from_fn(|k| light[k] * ratios[k].values[at].clamp(0.3, 2.0)))
        };
        behind.iter().enumerate().map(scaled).collect()
    }

    /// Returns the index in the image of a pixel of the band.
    fn pixel(&self, at: usize) -> usize {
        (self.y0 + at / self.width) * self.picture.width + self.x0 + at % self.width
    }

    /// Whether coverage is solved for at a pixel.
    fn is_open(&self, at: usize) -> bool {
        self.inner.values[at].max(self.outer.values[at]) <= BAND_PX || self.empty[at]
    }

    /// Solves for the coverage and colours of all open pixels.
    fn solve(&self, mask: &Mask) -> Matte {
        let mut coverage = mask.coverage().to_vec();
        let pixels = (0..self.light.len()).into_par_iter().with_min_len(PIXELS_A_TASK);
        let mixtures: Vec<Option<Mixed>> =
            pixels.map(|at| self.is_open(at).then(|| self.unmix(at)).flatten()).collect();
        let mut alphas = Grid::new(self.width, self.height, 0.0);
        for (at, mixed) in mixtures.iter().enumerate() {
            // Soft slopes of the mask end with the band.
            let beyond = f32::from(self.inner.values[at] > 0.0);
            let geometric = f32::from(coverage[self.pixel(at)]) / 255.0;
            alphas.values[at] = match mixed {
                Some(mixed) => geometric + mixed.belief * (mixed.alpha - geometric),
                None if self.is_open(at) => geometric,
                None => beyond,
            };
        }
        sharpen(&mut alphas);
        let mut colors = Vec::new();
        for (at, mixed) in mixtures.iter().enumerate() {
            let (pixel, alpha) = (self.pixel(at), alphas.values[at]);
            coverage[pixel] = (alpha * 255.0).round() as u8;
            let Some(mixed) = mixed.as_ref().filter(|_| coverage[pixel] > 0 && coverage[pixel] < 255) else { continue };
            let rgb = self.foreground(at, alpha, mixed);
            if rgb != self.picture.pixel(pixel % self.picture.width, pixel / self.picture.width) {
                colors.push(EdgeColor { pixel: pixel as u32, rgb });
            }
        }
        Matte { mask: Mask::new(mask.width(), mask.height(), coverage).unwrap_or_else(|_| mask.clone()), colors }
    }

    /// Returns the foreground colour of a pixel with the given coverage.
    fn foreground(&self, at: usize, alpha: f32, mixed: &Mixed) -> [u8; 3] {
        // Low coverage hardly constrains the colour.
        let solved = (1.5 * alpha - 0.25).clamp(0.0, 1.0);
        std::array::from_fn(|k| {
            let seen = self.light[at][k];
            let clean = (seen - (1.0 - alpha) * mixed.background[k]) / alpha.max(0.1);
            let color = mixed.foreground[k] + solved * (clean.clamp(0.0, 1.0) - mixed.foreground[k]);
            byte(seen + mixed.belief * (color - seen))
        })
    }

    /// Returns the best explanation of a pixel as a mixture of a foreground and a background nearby.
    fn unmix(&self, at: usize) -> Option<Mixed> {
        let seen = self.light[at];
        let mut best: Option<(f32, Mixed)> = None;
        let mut try_pair = |foreground: [f32; 3], background: [f32; 3], known: bool| {
            let mean = |c: [f32; 3]| (c[0] + c[1] + c[2]) / 3.0;
            let noise = NOISE * step(0.5 * (mean(foreground) + mean(background)).max(4e-3));
            let across = weighted(std::array::from_fn(|k| foreground[k] - background[k]));
            let off = weighted(std::array::from_fn(|k| seen[k] - background[k]));
            let contrast2 = dot(across, across);
            let raw = dot(off, across) / contrast2.max(1e-9);
            let alpha = raw.clamp(0.0, 1.0);
            let left: [f32; 3] = std::array::from_fn(|k| off[k] - alpha * across[k]);
            let remainder2 = dot(left, left) / (noise * noise);
            let contrast = contrast2 / (noise * noise);
            let doubt = HALF_BELIEVED * HALF_BELIEVED + REMAINDER * remainder2;
            let mut belief = contrast / (contrast + doubt);
            if !known {
                belief *= 0.5;
            }
            if belief.is_finite() && best.as_ref().is_none_or(|(least, _)| remainder2 < *least) {
                best = Some((remainder2, Mixed { alpha, foreground, background, belief }));
            }
        };
        let foregrounds = self.samples(&self.nearest_inside, at, &self.inner);
        match self.behind[at] {
            Some(behind) => foregrounds.for_each(|foreground| try_pair(foreground, behind, true)),
            None => {
                let backgrounds: Vec<[f32; 3]> = self.samples(&self.nearest_outside, at, &self.outer).collect();
                for foreground in foregrounds {
                    backgrounds.iter().for_each(|background| try_pair(foreground, *background, false));
                }
            }
        }
        let (remainder2, mixed) = best?;
        // A shadow in front of dark clothes looks like a mixture.
        let is_shadow = self.outer.values[at] > 1.0
            && self.behind[at]
                .is_some_and(|behind| self.shadow_remainder2(at, behind) < remainder2 + BETTER_THAN_SHADOW);
        Some(if is_shadow { Mixed { belief: 0.0, ..mixed } } else { mixed })
    }

    /// Returns the squared residual of a pixel explained as background in shadow, in squared standard deviations; infinite
    /// where the pixel is too dark for a shadow, or brighter than the background.
    fn shadow_remainder2(&self, at: usize, behind: [f32; 3]) -> f32 {
        let (seen, behind) = (self.light[at], weighted(behind));
        let noise = NOISE * step((seen.iter().sum::<f32>() / 3.0).max(4e-3));
        let seen = weighted(seen);
        let share = dot(seen, behind) / dot(behind, behind).max(1e-9);
        let left: [f32; 3] = std::array::from_fn(|k| seen[k] - share * behind[k]);
        if SHADOWS.contains(&share) { dot(left, left) / (noise * noise) } else { f32::INFINITY }
    }

    /// Samples colours around the nearest sure pixel, each the mean of 3x3 pixels.
    fn samples<'b>(
        &'b self,
        nearest: &[u32],
        at: usize,
        depth: &'b Grid,
    ) -> impl Iterator<Item = [f32; 3]> + use<'b, 'a> {
        let sure = nearest[at];
        let (x, y) = (i64::from(sure) % self.width as i64, i64::from(sure) / self.width as i64);
        let least = if sure == NONE { f32::INFINITY } else { depth.values[sure as usize].min(BAND_PX) };
        let steps = if sure == NONE { &[][..] } else { &TRIED[..] };
        steps.iter().filter_map(move |(dx, dy)| self.mean_around(x + dx, y + dy, depth, least))
    }

    /// Returns the mean light of the 3x3 pixels around one that are no nearer to the outline than `least`.
    fn mean_around(&self, x: i64, y: i64, depth: &Grid, least: f32) -> Option<[f32; 3]> {
        let (width, height) = (self.width as i64, self.height as i64);
        if x < 0 || y < 0 || x >= width || y >= height || depth.values[(y * width + x) as usize] < least {
            return None;
        }
        let (mut sum, mut count) = ([0.0; 3], 0.0);
        for v in (y - 1).max(0)..(y + 2).min(height) {
            for u in (x - 1).max(0)..(x + 2).min(width) {
                let at = (v * width + u) as usize;
                if depth.values[at] >= least {
                    (0..3).for_each(|k| sum[k] += self.light[at][k]);
                    count += 1.0;
                }
            }
        }
        Some(sum.map(|s| s / count))
    }
}

/// Sets alpha to 0 or 1 beyond the blur of a lens around the solved outline: there, a mixture is a shade of the foreground
/// or a shadow on the background.
fn sharpen(alphas: &mut Grid) {
    let mut unset = alphas.clone();
    unset.values.iter_mut().for_each(|alpha| *alpha = 1.0 - *alpha);
    let (outer, inner) = rayon::join(|| alphas.distance_to_set(), || unset.distance_to_set());
    for (at, alpha) in alphas.values.iter_mut().enumerate() {
        if inner.values[at] > BLUR_PX {
            *alpha = 1.0;
        } else if outer.values[at] > BLUR_PX {
            *alpha = 0.0;
        }
    }
}

/// Pixel as a mixture.
struct Mixed {
    alpha: f32,
    foreground: [f32; 3],
    background: [f32; 3],
    /// Weight of the mixture against the mask's own coverage, 0..=1.
    belief: f32,
}

/// Returns weighted brightness and two colour differences; the latter count less, since cameras and codecs blur them over
/// the outline.
fn weighted([red, green, blue]: [f32; 3]) -> [f32; 3] {
    let light = 0.3 * red + 0.59 * green + 0.11 * blue;
    [1.7 * light, CHROMA * (red - light), CHROMA * (blue - light)]
}

fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the index of the nearest set pixel for each pixel, by the chamfer distance; [`NONE`] when none is set.
fn nearest(set: &[bool], width: usize, height: usize) -> Vec<u32> {
    const SIDE: u64 = 3 << 32;
    const DIAGONAL: u64 = 4 << 32;
    // Distance in the upper bits, index in the lower: the smaller number is nearer.
    const FAR: u64 = (1 << 62) | NONE as u64;
    let start = |(at, set): (usize, &bool)| if *set { at as u64 } else { FAR };
    let mut labels: Vec<u64> = set.iter().enumerate().map(start).collect();
    let across = |row: &mut [u64], before: &[u64]| {
        row.iter_mut().zip(before).for_each(|(at, before)| *at = (*at).min(before + SIDE));
        row.iter_mut().skip(1).zip(before).for_each(|(at, before)| *at = (*at).min(before + DIAGONAL));
        row.iter_mut().zip(before.iter().skip(1)).for_each(|(at, before)| *at = (*at).min(before + DIAGONAL));
    };
    let along = |last: u64, at: &mut u64| {
        *at = (*at).min(last + SIDE);
        *at
    };
    for y in 0..height {
        let (above, rest) = labels.split_at_mut(y * width);
        across(&mut rest[..width], &above[above.len().saturating_sub(width)..]);
        rest[..width].iter_mut().fold(FAR, along);
    }
    for y in (0..height).rev() {
        let (rest, below) = labels.split_at_mut((y + 1) * width);
        across(&mut rest[y * width..], &below[..width.min(below.len())]);
        rest[y * width..].iter_mut().rev().fold(FAR, along);
    }
    labels.into_iter().map(|at| at as u32).collect()
}

#[cfg(test)]
mod tests {
    use flyrig_types::PixelFormat;

    use super::*;
    use crate::masks::gate::BodyGate;
    use crate::testing::small_camera;

    const SIDE: usize = 64;
    const SHIRT: [f32; 3] = [0.05, 0.08, 0.35];

    fn wall(x: usize, y: usize) -> [f32; 3] {
        [0.4 + 0.003 * x as f32, 0.35, 0.3 + 0.003 * y as f32]
    }

    /// Coverage of a tilted half plane with a soft edge: its place is known to a fraction of a pixel.
    fn truth(x: usize, y: usize) -> f32 {
        (32.3 - x as f32 + 0.3 * y as f32 - 8.0).clamp(-0.5, 0.5) + 0.5
    }

    fn picture(paint: impl Fn(usize, usize) -> [f32; 3]) -> Image {
        let bytes: Vec<u8> = (0..SIDE * SIDE).flat_map(|at| paint(at % SIDE, at / SIDE).map(byte)).collect();
        Image::new(SIDE as u32, SIDE as u32, PixelFormat::Rgb8, bytes).unwrap()
    }

    fn over(alpha: f32, front: [f32; 3], back: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|k| alpha * front[k] + (1.0 - alpha) * back[k])
    }

    fn mask(coverage: impl Fn(usize, usize) -> u8) -> Mask {
        let coverage = (0..SIDE * SIDE).map(|at| coverage(at % SIDE, at / SIDE)).collect();
        Mask::new(SIDE as u32, SIDE as u32, coverage).unwrap()
    }

    /// The true outline, a pixel and a half too far out.
    fn rough() -> Mask {
        mask(|x, y| if truth(x.saturating_sub(1), y) + truth(x.saturating_sub(2), y) >= 1.0 { 255 } else { 0 })
    }

    fn background(plate: &Image) -> Background {
        Background::from_plate(&small_camera("a", plate.width() as usize), plate).unwrap()
    }

    /// Mean error of alpha within two pixels of the true outline, away from the borders.
    fn error(mask: &Mask) -> f32 {
        let (mut sum, mut count) = (0.0, 0.0);
        for y in 6..SIDE - 6 {
            for x in 2..SIDE - 2 {
                if (truth(x - 2, y) - truth(x + 2, y)).abs() > 1e-6 {
                    sum += (f32::from(mask.coverage()[y * SIDE + x]) / 255.0 - truth(x, y)).abs();
                    count += 1.0;
                }
            }
        }
        sum / count
    }

    #[test]
    fn alpha_and_colour_of_a_known_mixture_are_found() {
        let now = picture(|x, y| over(truth(x, y), SHIRT, wall(x, y).map(|c| c * 0.9)));
        let plate = picture(wall);
        let solved = matte(&now, &rough(), Some(&background(&plate)), None).unwrap();
        assert!(error(&rough()) > 0.2 && error(&solved.mask) < 0.03, "{} {}", error(&rough()), error(&solved.mask));
        let half = |color: &&EdgeColor| (96..200).contains(&solved.mask.coverage()[color.pixel as usize]);
        let mixed: Vec<&EdgeColor> = solved.colors.iter().filter(half).collect();
        assert!(mixed.len() > 20, "{} pixels", mixed.len());
        for EdgeColor { pixel, rgb } in mixed {
            let off = (0..3).map(|k| i32::from(rgb[k]).abs_diff(i32::from(byte(SHIRT[k])))).max().unwrap();
            assert!(off <= 14, "pixel {pixel}: {rgb:?}");
        }
    }

    #[test]
    fn what_the_mask_has_measured_gives_the_same_matte() {
        let now = picture(|x, y| over(truth(x, y), SHIRT, wall(x, y).map(|c| c * 0.9)));
        let known = background(&picture(wall));
        let mask = rough();
        let mut body = Grid::new(mask.width() as usize, mask.height() as usize, 0.0);
        body.values.iter_mut().zip(mask.coverage()).for_each(|(value, alpha)| *value = f32::from(*alpha >= 128));
        let seen = known.seen(&Rgb::new(&now).unwrap(), &BodyGate::of_grid(&body, 40.0)).unwrap();
        let (anew, again) =
            (matte(&now, &mask, Some(&known), None).unwrap(), matte(&now, &mask, Some(&known), Some(&seen)).unwrap());
        let differences = anew.mask.coverage().iter().zip(again.mask.coverage()).map(|(a, b)| a.abs_diff(*b));
        assert!(differences.max() < Some(4) && anew != matte(&now, &mask, None, None).unwrap());
        // Measured before a screen, or in an image of another size: the colours around stand in.
        let screen = Background::from_key(&small_camera("a", 64), "green".parse().unwrap());
        let without = matte(&now, &mask, None, None).unwrap();
        assert_eq!(matte(&now, &mask, Some(&screen), Some(&seen)).unwrap(), without);
    }

    #[test]
    fn without_a_plate_the_colours_around_stand_in() {
        let now = picture(|x, y| over(truth(x, y), SHIRT, wall(x, y)));
        let solved = matte(&now, &rough(), None, None).unwrap();
        assert!(error(&solved.mask) < 0.7 * error(&rough()), "{} {}", error(&rough()), error(&solved.mask));
    }

    #[test]
    fn the_nearest_pixel_is_as_near_as_any() {
        let (width, height) = (19, 13);
        let set: Vec<bool> = (0..width * height).map(|i| (i * 7919) % 29 == 4).collect();
        let distance = |a: usize, b: usize| {
            let (dx, dy) = ((a % width).abs_diff(b % width), (a / width).abs_diff(b / width));
            3 * dx.max(dy) + dx.min(dy)
        };
        for (at, label) in nearest(&set, width, height).into_iter().enumerate() {
            let least = (0..set.len()).filter(|&other| set[other]).map(|other| distance(at, other)).min();
            assert!(set[label as usize] && Some(distance(at, label as usize)) == least, "{at}: {label}");
        }
        assert!(nearest(&[false; 12], 4, 3).iter().all(|label| *label == NONE));
    }

    #[test]
    fn alike_colours_keep_the_masks_alpha() {
        let now = picture(wall);
        let rough = rough();
        let solved = matte(&now, &rough, Some(&background(&now)), None).unwrap();
        let changed = rough.coverage().iter().zip(solved.mask.coverage()).filter(|(a, b)| a.abs_diff(**b) > 64).count();
        assert!(changed < 20, "{changed} pixels changed");
    }

    #[test]
    fn empty_full_and_black_images_and_other_sizes_do_no_harm() {
        let black = picture(|_, _| [0.0; 3]);
        let plate = background(&black);
        for coverage in [0, 255] {
            let mask = mask(|_, _| coverage);
            assert_eq!(matte(&black, &mask, Some(&plate), None).unwrap(), Matte { mask, colors: Vec::new() });
        }
        // A mask that touches three borders, and one of a single pixel.
        matte(&black, &rough(), None, None).unwrap();
        matte(&black, &mask(|x, y| if (x, y) == (0, 63) { 255 } else { 0 }), Some(&plate), None).unwrap();
        let small = Image::new(8, 8, PixelFormat::Rgb8, vec![0; 192]).unwrap();
        assert!(matte(&small, &rough(), None, None).is_err());
        assert!(
            matte(&black, &rough(), Some(&background(&small)), None).is_ok(),
            "a plate of another size is not used"
        );
    }
}
