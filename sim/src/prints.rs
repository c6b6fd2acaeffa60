//! Colours of cloth, shoes and hair.

use glam::{Vec2, Vec3};

use crate::look::{Look, Print, Srgb};
use crate::noise::{Noise, smoothstep};
use crate::regions::{along_arm, around_arm, below_neckline, on_sleeve};
use crate::texture::{mix3, scale3};

/// Colour of the top at a point of the average body, `inside` metres from the cloth's edge.
pub(crate) fn top_colour(look: &Look, noise: Noise, p: Vec3, inside: f32) -> Srgb {
    let arm = on_sleeve(p);
    // Cloth coordinates: across, down. Sleeves have their own piece of cloth.
    let (across, down) =
        if arm { (around_arm(p) * 0.0509, along_arm(p).0) } else { ((p.x / 0.16).atan2(p.z / 0.11) * 0.14, -p.y) };
    let [ground, print] = look.top;
    let blend = |on: f32| mix3(ground, print, on);
    let band = |at: f32, period: f32, share: f32| {
        let phase = (at / period).rem_euclid(1.0);
        smoothstep(0.0, 0.04, phase) * smoothstep(share + 0.04, share, phase)
    };
    let mut colour = match look.print {
        Print::Plain => ground,
        Print::Stripes => blend(band(down, 0.058, 0.42)),
        Print::Checks => {
            let (a, b) = (band(down, 0.075, 0.5), band(across, 0.0733, 0.5));
            let fine = band(down, 0.075, 0.06).max(band(across, 0.0733, 0.06));
            mix3(blend(0.48 * (a + b)), [0.95, 0.93, 0.88], fine * 0.5)
        }
        Print::Dots => {
            let row = (down / 0.034).floor();
            let cell =
                Vec2::new((across / 0.040 + 0.5 * row.rem_euclid(2.0)).rem_euclid(1.0), (down / 0.034).rem_euclid(1.0));
            blend(smoothstep(0.30, 0.25, (cell - 0.5).length()))
        }
    };
    if look.logo && !arm && p.z > 0.0 {
        colour = mix3(
            colour,
            if look.print == Print::Plain { print } else { [0.96, 0.95, 0.92] },
            logo(Vec2::new(p.x, p.y - 1.235)),
        );
    }
    // Ribbing at neck, cuffs and hem.
    let rib_m = if look.knit { 0.030 } else { 0.014 };
    let rib = smoothstep(rib_m, rib_m - 0.002, inside);
    let near_neck = below_neckline(p, look.v_neck_m) < rib_m + 0.005;
    let rib_colour = if look.print == Print::Plain || !near_neck { scale3(ground, 0.86) } else { scale3(print, 0.95) };
    colour = mix3(colour, rib_colour, rib * 0.9);
    colour = scale3(colour, 1.0 - 0.35 * smoothstep(0.0016, 0.0004, (inside - rib_m).abs()));
    // Yarn, wear, and the seam of the sleeve.
    let knit = if look.knit { 0.05 * (down * 900.0).sin() * (across * 900.0).sin() } else { 0.0 };
    scale3(colour, 1.0 + knit + 0.035 * noise.sum(p * 60.0, 2) + 0.03 * noise.sum(p * 9.0, 2))
}

/// A mark on the chest: a ring around a mountain. Returns its coverage at an offset from its centre.
fn logo(at: Vec2) -> f32 {
    let r = at.length();
    let ring = smoothstep(0.0055, 0.0040, (r - 0.062).abs());
    let ridge = 0.034 - 1.35 * (at.x.abs() - 0.004).max(0.0) + 0.35 * (at.x - 0.018).clamp(0.0, 0.02);
    let mountain =
        smoothstep(0.0, 0.002, ridge - at.y) * smoothstep(-0.032, -0.029, at.y) * smoothstep(0.052, 0.050, r);
    let snow = smoothstep(0.016, 0.018, at.y - 0.006 * (at.x * 260.0).sin());
    ring.max(mountain * (1.0 - 0.8 * snow))
}

/// Colour of the trousers.
pub(crate) fn bottom_colour(look: &Look, noise: Noise, p: Vec3) -> Srgb {
    let mut colour = look.bottom;
    let side_x = if p.y > 0.47 { 0.142 } else { 0.150 + (0.47 - p.y) * 0.08 };
    let out = p.x.abs() - side_x;
    if look.denim {
        let twill = 0.06 * noise.at(Vec3::new(p.x * 700.0, (p.y + p.x + p.z) * 260.0, p.z * 700.0));
        let worn = smoothstep(0.30, 0.0, (p.y - 0.58).abs()) * smoothstep(0.02, 0.09, p.z);
        let blotch = 0.10 * noise.sum(p * 14.0, 3);
        colour = mix3(colour, [0.52, 0.60, 0.72], (0.38 * worn + blotch).clamp(0.0, 1.0));
        colour = scale3(colour, 1.0 + twill);
    } else {
        colour = scale3(colour, 1.0 + 0.03 * noise.sum(p * 80.0, 2) + 0.04 * noise.sum(p * 8.0, 2));
        // A pressed crease down the front.
        colour = scale3(
            colour,
            1.0 + 0.10 * smoothstep(0.006, 0.0, (p.x.abs() - side_x).abs()) * smoothstep(0.0, 0.05, p.z),
        );
    }
    // Side seam, pocket, fly, hem.
    let stitch = if look.denim { [0.72, 0.55, 0.30] } else { scale3(look.bottom, 0.6) };
    let seam = smoothstep(0.0022, 0.0010, (p.z - 0.004).abs()) * f32::from(out > 0.0);
    let pocket = smoothstep(0.0024, 0.0012, ((p.y - 0.845) - (p.x.abs() - 0.12) * -1.1).abs())
        * f32::from(p.z > 0.02 && p.y > 0.77 && p.x.abs() > 0.07);
    let fly = smoothstep(0.0022, 0.0010, (p.x - 0.012).abs()) * f32::from(p.z > 0.05 && p.y > 0.84);
    let hem = smoothstep(0.0022, 0.0010, (p.y - 0.085).abs());
    let back_pocket = {
        let q = Vec2::new((p.x.abs() - 0.085).abs() - 0.048, (p.y - 0.86).abs() - 0.055);
        smoothstep(0.0024, 0.0012, q.x.max(q.y).abs()) * f32::from(p.z < -0.02)
    };
    mix3(colour, stitch, 0.75 * seam.max(pocket).max(fly).max(hem).max(back_pocket))
}

/// Colour of hair.
pub(crate) fn hair_colour(look: &Look, noise: Noise, p: Vec3) -> Srgb {
    let around = p.x.atan2(p.z - 0.04);
    let top = smoothstep(1.60, 1.65, p.y);
    let side = noise.sum(Vec3::new(around * 46.0, p.y * 14.0, 1.0), 3);
    let crown = noise.sum(Vec3::new(p.x * 520.0, p.z * 40.0, 2.0), 3);
    let strand = side + (crown - side) * top;
    let depth = 0.80 + 0.20 * smoothstep(1.44, 1.60, p.y);
    let light = 1.0 + 0.42 * strand + 0.15 * noise.sum(p * 18.0, 2);
    let sheen = mix3(look.hair, [0.80, 0.72, 0.62], 0.10 * smoothstep(0.3, 0.9, strand));
    scale3(sheen, light * depth * 1.15)
}

/// Colour of a shoe's upper; `uv` runs around (0 at the outer side, 0.25 on top) and from heel to toe.
pub(crate) fn upper_colour(look: &Look, noise: Noise, uv: Vec2) -> Srgb {
    let [main, accent] = look.shoe;
    let top = smoothstep(0.115, 0.10, (uv.x - 0.25).abs());
    let mut colour = main;
    let toe = smoothstep(0.80, 0.815, uv.y);
    let heel = smoothstep(0.17, 0.155, uv.y);
    colour = mix3(colour, scale3(main, 0.82), toe.max(heel));
    // Two slanted bands on each side.
    let side = (uv.x - 0.25).abs();
    let slant = uv.y - 0.9 * (side - 0.18);
    let bands = smoothstep(0.022, 0.016, (slant - 0.46).abs()).max(smoothstep(0.022, 0.016, (slant - 0.54).abs()));
    colour = mix3(colour, accent, bands * smoothstep(0.125, 0.135, side) * smoothstep(0.27, 0.25, side));
    // Tongue and laces.
    if (0.40..0.74).contains(&uv.y) {
        colour = mix3(colour, scale3(main, 0.7), top * smoothstep(0.06, 0.05, side));
        let lace = smoothstep(0.30, 0.18, ((uv.y * 26.0).rem_euclid(1.0) - 0.5).abs());
        colour = mix3(colour, [0.92, 0.91, 0.88], lace * smoothstep(0.075, 0.065, side));
    }
    scale3(colour, 1.0 + 0.03 * noise.sum(Vec3::new(uv.x * 80.0, uv.y * 120.0, 5.0), 2))
}

/// Colour of a shoe's sole.
pub(crate) fn sole_colour(look: &Look, noise: Noise, uv: Vec2) -> Srgb {
    let base = if look.shoe[0][0] > 0.8 { [0.80, 0.79, 0.76] } else { [0.88, 0.87, 0.84] };
    scale3(base, 1.0 + 0.04 * noise.sum(Vec3::new(uv.x * 40.0, uv.y * 60.0, 9.0), 2))
}
