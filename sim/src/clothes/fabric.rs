//! Colours of cloth: threads, prints, wear.

use glam::{Vec2, Vec3};

use crate::clothes::glyphs::word_at;
use crate::clothes::wardrobe::{Fabric, Print, SrgbColor, Textile};
use crate::noise::{Noise, smoothstep};
use crate::texture::{mix3, scale3};

/// Position of a point on a piece of cloth.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ClothPoint {
    /// Across and down, metres.
    pub at: Vec2,
    /// Position in space, metres, for noise.
    pub space: Vec3,
    /// Height along the garment, 0 at the upper end, 1 at the lower.
    pub fall: f32,
    /// On the chest: offset from the centre of a motif, x to the reader's right, y up, metres.
    pub chest: Option<Vec2>,
}

/// Returns 1 in the first `share` of each period.
fn band(at: f32, period: f32, share: f32) -> f32 {
    let phase = (at / period).rem_euclid(1.0);
    smoothstep(0.0, 0.04, phase) * smoothstep(share + 0.04, share, phase)
}

/// Returns the colour of a cloth, without seams.
pub(crate) fn cloth_colour(cloth: &Textile, noise: Noise, point: ClothPoint) -> SrgbColor {
    let Vec2 { x: across, y: down } = point.at;
    let [ground, print, accent] = cloth.colours;
    let size = cloth.scale;
    let blend = |on: f32| mix3(ground, print, on);
    let colour = match cloth.print {
        Print::Plain => ground,
        Print::Stripes => blend(band(down, 0.058 * size, 0.42)),
        Print::Pinstripes => blend(band(across, 0.022 * size, 0.12) * 0.8),
        Print::Checks => {
            let (a, b) = (band(down, 0.050 * size, 0.5), band(across, 0.0489 * size, 0.5));
            blend(0.48 * (a + b))
        }
        Print::Plaid => {
            let lines = |at: f32| (band(at, 0.11 * size, 0.42), band(at + 0.028 * size, 0.11 * size, 0.05));
            let ((wide_a, thin_a), (wide_b, thin_b)) = (lines(down), lines(across));
            mix3(blend(0.42 * (wide_a + wide_b)), accent, (0.7 * (thin_a + thin_b)).min(0.9))
        }
        Print::Dots => {
            let row = (down / (0.034 * size)).floor();
            let cell = Vec2::new(
                (across / (0.040 * size) + 0.5 * row.rem_euclid(2.0)).rem_euclid(1.0),
                (down / (0.034 * size)).rem_euclid(1.0),
            );
            blend(smoothstep(0.30, 0.25, (cell - 0.5).length()))
        }
        Print::Camouflage => camouflage(ground, noise, point.space / size),
        Print::Gradient => blend(smoothstep(0.1, 0.9, point.fall)),
        Print::Text(which) => {
            let on = point.chest.map_or(0.0, |at| word_at(which, 0.20, at.x, at.y));
            blend(on)
        }
        Print::Logo(which) => blend(point.chest.map_or(0.0, |at| mark(which, at))),
    };
    let p = point.space;
    let wear = 0.03 * noise.sum(p * 9.0, 2);
    match cloth.fabric {
        Fabric::Jersey => scale3(colour, 1.0 + 0.03 * noise.sum(p * 60.0, 2) + wear),
        Fabric::Weave => {
            let threads = 0.035 * ((across * 1400.0).sin() + (down * 1400.0).sin());
            scale3(colour, 1.0 + threads * 0.5 + 0.02 * noise.sum(p * 80.0, 2) + wear)
        }
        Fabric::Knit => {
            // Columns of stitches, and ribs wide enough to be seen from afar.
            let rib = (across * 520.0).sin();
            let stitch = (down * 900.0 + 1.5 * rib).sin();
            scale3(colour, 1.0 + 0.07 * rib + 0.04 * stitch + 0.05 * noise.sum(p * 70.0, 2) + wear)
        }
        Fabric::Denim => {
            let twill = 0.05 * ((across + down) * 1700.0).sin() + 0.05 * noise.at(p * 420.0);
            let blotch = (0.16 + 0.22 * noise.sum(p * 14.0, 3)).clamp(0.0, 1.0);
            let faded = mix3(colour, [0.52, 0.60, 0.72], blotch * (0.4 + colour[2]));
            scale3(faded, 1.0 + twill)
        }
        Fabric::Leather => {
            let grain = noise.sum(p * 160.0, 2);
            let crease = smoothstep(0.10, 0.0, noise.sum(p * 16.0, 3).abs());
            scale3(colour, 1.0 + 0.10 * grain + 0.16 * crease)
        }
    }
}

/// Returns the gloss of a cloth, in 0..=1.
pub(crate) fn gloss(fabric: Fabric) -> f32 {
    match fabric {
        Fabric::Leather => 0.55,
        Fabric::Weave => 0.05,
        Fabric::Jersey | Fabric::Knit | Fabric::Denim => 0.0,
    }
}

/// Returns the colour of patches in four shades of the ground's hue.
fn camouflage(ground: SrgbColor, noise: Noise, p: Vec3) -> SrgbColor {
    let field = |stretch: Vec3, frequency: f32| noise.sum(p * stretch * frequency, 3);
    let green = mix3(ground, [0.36, 0.38, 0.24], 0.65);
    let mut colour = mix3(green, [0.68, 0.62, 0.46], 0.75);
    if field(Vec3::new(1.0, 1.7, 1.0), 11.0) > 0.02 {
        colour = green;
    }
    if field(Vec3::new(1.3, 1.0, 1.6), 9.0) > 0.16 {
        colour = scale3(mix3(green, [0.32, 0.24, 0.16], 0.7), 0.85);
    }
    if field(Vec3::new(1.0, 2.0, 1.3), 13.0) > 0.27 {
        colour = scale3(green, 0.36);
    }
    colour
}

/// Returns the coverage of one of six marks at an offset from its centre, metres.
fn mark(which: u8, at: Vec2) -> f32 {
    let r = at.length();
    let angle = at.y.atan2(at.x);
    let ring = smoothstep(0.0055, 0.0040, (r - 0.062).abs());
    match which % 6 {
        0 => {
            let ridge = 0.034 - 1.35 * (at.x.abs() - 0.004).max(0.0) + 0.35 * (at.x - 0.018).clamp(0.0, 0.02);
            let inside = smoothstep(-0.032, -0.029, at.y) * smoothstep(0.052, 0.050, r);
            let mountain = smoothstep(0.0, 0.002, ridge - at.y) * inside;
            let snow = smoothstep(0.016, 0.018, at.y - 0.006 * (at.x * 260.0).sin());
            ring.max(mountain * (1.0 - 0.8 * snow))
        }
        // A star.
        1 => smoothstep(0.002, 0.0, r - 0.034 - 0.024 * (5.0 * (angle - std::f32::consts::FRAC_PI_2)).cos()),
        // A band across the chest.
        2 => smoothstep(0.030, 0.028, at.y.abs()),
        // A sun over waves.
        3 => {
            let sun = smoothstep(0.040, 0.038, r) * smoothstep(-0.004, -0.002, at.y);
            let wave = smoothstep(0.0035, 0.002, ((at.y + 0.006 + 0.003 * (at.x * 150.0).sin()) % 0.014).abs());
            sun.max(wave * smoothstep(0.0, -0.002, at.y + 0.004) * smoothstep(0.052, 0.050, r))
        }
        // A heart.
        4 => {
            let (x, y) = (at.x / 0.05, at.y / 0.05 + 0.1);
            let heart = (x * x + y * y - 0.7).powi(3) - x * x * y * y * y;
            smoothstep(0.02, 0.0, heart)
        }
        // Three triangles.
        _ => {
            let third = (angle / std::f32::consts::TAU * 3.0).rem_euclid(1.0) - 0.5;
            ring.max(smoothstep(0.002, 0.0, r * (0.9 + 2.2 * third.abs()) - 0.046))
        }
    }
}
