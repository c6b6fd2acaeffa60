//! Colours of garments: cloth with seams, buttons and pockets, shoes and hair.

use glam::{Vec2, Vec3};

use crate::clothes::fabric::{ClothPoint, cloth_colour};
use crate::clothes::wardrobe::{Bottom, Fabric, Outer, ShoeKind, SrgbColor, Textile, Top, TopKind};
use crate::noise::{Noise, smoothstep};
use crate::person::look::PersonLook;
use crate::person::regions::{along_arm, around_arm, on_sleeve};
use crate::texture::{mix3, scale3};

/// Returns a seam's line, 1 on it.
fn line(distance: f32, half_m: f32) -> f32 {
    smoothstep(half_m + 0.0006, half_m, distance.abs())
}

/// Returns the colour of seams: darker than the cloth, orange on denim.
fn stitch(cloth: &Textile) -> SrgbColor {
    if cloth.fabric == Fabric::Denim { [0.72, 0.55, 0.30] } else { scale3(cloth.colours[0], 0.55) }
}

/// Returns the cloth of the upper body at a point of the average body.
fn upper_cloth(cloth: &Textile, noise: Noise, p: Vec3, hem_m: f32) -> SrgbColor {
    let arm = on_sleeve(p);
    // Across, down. Sleeves have their own piece of cloth.
    let at = if arm {
        Vec2::new(around_arm(p) * 0.0509, along_arm(p).0)
    } else {
        Vec2::new((p.x / 0.16).atan2(p.z / 0.11) * 0.14, -p.y)
    };
    let fall = if arm { along_arm(p).0 / 0.6 } else { (1.36 - p.y) / (1.36 - hem_m) };
    // The reader's right is the wearer's left, +x.
    let chest = (!arm && p.z > 0.0).then(|| Vec2::new(p.x, p.y - 1.235));
    cloth_colour(cloth, noise, ClothPoint { at, space: p, fall, chest })
}

/// Returns the colour of the top at a point of the average body, `inside` metres from the cloth's edge.
pub(crate) fn top_colour(top: &Top, noise: Noise, p: Vec3, inside: f32) -> SrgbColor {
    let mut colour = upper_cloth(&top.cloth, noise, p, top.hem_m);
    let ground = top.cloth.colours[0];
    let dark = stitch(&top.cloth);
    if top.kind == TopKind::Shirt {
        // Button placket, buttons, breast pocket, cuffs.
        if p.z > 0.0 && !on_sleeve(p) {
            colour = mix3(colour, dark, 0.6 * line(p.x.abs() - 0.016, 0.0010));
            let button = Vec2::new(p.x, (p.y / 0.075).fract() * 0.075 - 0.037).length();
            colour = mix3(colour, [0.94, 0.93, 0.90], smoothstep(0.0056, 0.0046, button));
            let pocket = Vec2::new((p.x - 0.075).abs() - 0.038, (p.y - 1.215).abs() - 0.043);
            colour = mix3(colour, dark, 0.55 * line(pocket.x.max(pocket.y), 0.0010));
        }
        return mix3(colour, dark, 0.5 * line(inside - 0.022, 0.0010));
    }
    // Ribbing at neck, cuffs and hem.
    let rib_m = if matches!(top.kind, TopKind::Jumper | TopKind::Hoodie) { 0.034 } else { 0.016 };
    let rib = smoothstep(rib_m, rib_m - 0.002, inside);
    colour = mix3(colour, scale3(ground, 0.84), rib * 0.9);
    colour = scale3(colour, 1.0 - 0.35 * smoothstep(0.0016, 0.0004, (inside - rib_m).abs()));
    if top.kind == TopKind::Hoodie && p.z > 0.0 && !on_sleeve(p) {
        // Pouch and cords.
        let slant = 0.10 - 0.35 * (p.y - 0.90).max(0.0);
        let pouch = Vec2::new(p.x.abs() - slant, (p.y - 0.965).abs() - 0.075);
        colour = mix3(colour, dark, 0.7 * line(pouch.x.max(pouch.y), 0.0016));
        let cord = line(p.x.abs() - 0.030, 0.0026) * smoothstep(1.235, 1.245, p.y);
        colour = mix3(colour, [0.90, 0.89, 0.86], cord);
    }
    colour
}

/// Returns the colour of a jacket or a coat's upper part.
pub(crate) fn outer_colour(outer: &Outer, noise: Noise, p: Vec3, inside: f32) -> SrgbColor {
    let mut colour = upper_cloth(&outer.cloth, noise, p, outer.hem_m);
    let dark = stitch(&outer.cloth);
    if p.z > 0.0 && !on_sleeve(p) {
        if outer.open_m <= 0.0 {
            // Zip.
            colour = mix3(colour, scale3(dark, 0.7), smoothstep(0.007, 0.006, p.x.abs()));
            colour = mix3(colour, [0.72, 0.71, 0.68], smoothstep(0.0030, 0.0022, p.x.abs()));
        }
        let pocket = Vec2::new((p.x.abs() - 0.115).abs() - 0.036, (p.y - 0.90).abs() - 0.012);
        colour = mix3(colour, dark, 0.8 * line(pocket.x.max(pocket.y), 0.0014));
    }
    if p.z < 0.0 && !on_sleeve(p) {
        colour = mix3(colour, dark, 0.5 * line(p.y - 1.27, 0.0010) + 0.4 * line(p.x, 0.0010));
    }
    mix3(colour, dark, 0.6 * line(inside - 0.012, 0.0009))
}

/// Returns the colour of the trousers at a point of the average body, `inside` metres from the cloth's edge.
pub(crate) fn bottom_colour(look: &PersonLook, noise: Noise, p: Vec3, inside: f32) -> SrgbColor {
    let (cloth, hem_m, bib) = match &look.bottom {
        Bottom::Trousers { cloth, hem_m, .. } => (cloth, *hem_m, false),
        Bottom::Overalls { cloth, hem_m } => (cloth, *hem_m, true),
        Bottom::Skirt { cloth, hem_m, .. } => (cloth, *hem_m, false),
    };
    let side_x = if p.y > 0.47 { 0.142 } else { 0.150 + (0.47 - p.y) * 0.08 };
    let around = (p.x.abs() - side_x).atan2(p.z - 0.03);
    let at = Vec2::new(around * 0.07 * p.x.signum(), -p.y);
    let fall = (0.95 - p.y) / (0.95 - hem_m);
    let mut colour = cloth_colour(cloth, noise, ClothPoint { at, space: p, fall, chest: None });
    let out = p.x.abs() - side_x;
    if cloth.fabric == Fabric::Denim {
        let worn = smoothstep(0.30, 0.0, (p.y - 0.58).abs()) * smoothstep(0.02, 0.09, p.z);
        colour = mix3(colour, [0.52, 0.60, 0.72], 0.38 * worn);
    } else if hem_m < 0.1 {
        // A pressed crease down the front.
        colour = scale3(colour, 1.0 + 0.10 * smoothstep(0.006, 0.0, out.abs()) * smoothstep(0.0, 0.05, p.z));
    }
    // Side seam, pockets, fly, hem.
    let seam = line(p.z - 0.004, 0.0013) * f32::from(out > 0.0);
    let pocket = line((p.y - 0.845) - (p.x.abs() - 0.12) * -1.1, 0.0014)
        * f32::from(p.z > 0.02 && p.y > 0.77 && p.x.abs() > 0.07);
    let fly = line(p.x - 0.012, 0.0013) * f32::from(!bib && p.z > 0.05 && p.y > 0.84);
    let hem = line(p.y - hem_m - 0.023, 0.0012);
    let back = Vec2::new((p.x.abs() - 0.085).abs() - 0.048, (p.y - 0.86).abs() - 0.055);
    let back_pocket = line(back.x.max(back.y), 0.0014) * f32::from(p.z < -0.02);
    let mut lines = seam.max(pocket).max(fly).max(hem).max(back_pocket);
    if bib {
        let patch = Vec2::new(p.x.abs() - 0.060, (p.y - 1.13).abs() - 0.055);
        lines = lines.max(line(patch.x.max(patch.y), 0.0014) * f32::from(p.z > 0.05)).max(line(inside - 0.008, 0.0010));
        lines = lines.max(line(p.y - 0.985, 0.0016));
        let button = Vec2::new(p.x.abs() - 0.083, p.y - 1.215).length();
        colour = mix3(colour, [0.78, 0.68, 0.42], smoothstep(0.013, 0.011, button) * f32::from(p.z > 0.03));
    } else if look.top.tucked {
        // A belt.
        let belt = smoothstep(0.944, 0.946, p.y) * smoothstep(0.981, 0.979, p.y);
        colour = mix3(colour, [0.17, 0.12, 0.09], belt);
        let buckle = (p.x.abs() - 0.020).max((p.y - 0.9625).abs() - 0.020);
        colour = mix3(colour, [0.76, 0.72, 0.62], line(buckle, 0.0035) * f32::from(p.z > 0.0));
        lines *= 1.0 - belt;
    }
    mix3(colour, stitch(cloth), 0.75 * lines)
}

/// Returns the colour of a skirt or a coat's tails, which are `high_m` high; `uv` runs around from the front and down.
pub(crate) fn hanging_colour(cloth: &Textile, noise: Noise, uv: Vec2, high_m: f32, waistband: bool) -> SrgbColor {
    let turn = uv.x * std::f32::consts::TAU;
    let at = Vec2::new(uv.x * 1.12, uv.y * high_m);
    let space = Vec3::new(turn.sin() * 0.18, -at.y, turn.cos() * 0.18);
    let fall = 0.35 + 0.65 * uv.y;
    let colour = cloth_colour(cloth, noise, ClothPoint { at, space, fall, chest: None });
    let dark = stitch(cloth);
    let hem = line((1.0 - uv.y) * high_m - 0.020, 0.0013);
    let band = if waistband { smoothstep(0.034, 0.032, at.y) } else { 0.0 };
    let colour = mix3(colour, scale3(colour, 0.72), band);
    mix3(colour, dark, 0.6 * hem)
}

/// Returns the colour of a hat.
pub(crate) fn hat_colour(cloth: &Textile, noise: Noise, uv: Vec2) -> SrgbColor {
    let turn = uv.x * std::f32::consts::TAU;
    let at = Vec2::new(uv.x * 0.60, (1.0 - uv.y) * 0.16);
    let space = Vec3::new(turn.sin() * 0.1, uv.y * 0.16, turn.cos() * 0.1);
    let colour = cloth_colour(cloth, noise, ClothPoint { at, space, fall: 1.0 - uv.y, chest: None });
    // Panels of a cap, the band of a brimmed hat and of a beanie.
    let (panel, band) = match cloth.fabric {
        Fabric::Knit => (0.0, smoothstep(0.345, 0.335, uv.y) * 0.25),
        _ => (line((uv.x * 6.0).fract() - 0.5, 0.012) * smoothstep(0.1, 0.12, uv.y), 0.0),
    };
    mix3(colour, scale3(colour, 0.6), panel.max(band))
}

/// Returns the colour of hair.
pub(crate) fn hair_colour(look: &PersonLook, noise: Noise, p: Vec3) -> SrgbColor {
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

/// Returns the colour of a shoe's upper; `uv` runs around (0 at the outer side, 0.25 on top) and from heel to toe.
pub(crate) fn upper_colour(look: &PersonLook, noise: Noise, uv: Vec2) -> SrgbColor {
    let [main, accent] = look.shoes.colours;
    let side = (uv.x - 0.25).abs();
    let top = smoothstep(0.115, 0.10, side);
    let mut colour = main;
    let toe = smoothstep(0.80, 0.815, uv.y);
    let heel = smoothstep(0.17, 0.155, uv.y);
    let trainers = look.shoes.kind == ShoeKind::Trainers;
    colour = mix3(colour, scale3(main, if trainers { 0.82 } else { 0.92 }), toe.max(heel));
    if trainers {
        // Two slanted bands on each side.
        let slant = uv.y - 0.9 * (side - 0.18);
        let bands = smoothstep(0.022, 0.016, (slant - 0.46).abs()).max(smoothstep(0.022, 0.016, (slant - 0.54).abs()));
        colour = mix3(colour, accent, bands * smoothstep(0.125, 0.135, side) * smoothstep(0.27, 0.25, side));
    } else {
        // The seam of the toe cap.
        colour = mix3(colour, scale3(main, 0.5), line(uv.y - 0.78, 0.004));
    }
    // Tongue and laces.
    if (0.40..0.74).contains(&uv.y) {
        colour = mix3(colour, scale3(main, 0.7), top * smoothstep(0.06, 0.05, side));
        let lace = smoothstep(0.30, 0.18, ((uv.y * 26.0).rem_euclid(1.0) - 0.5).abs());
        let laces = if trainers { [0.92, 0.91, 0.88] } else { scale3(main, 0.5) };
        colour = mix3(colour, laces, lace * smoothstep(0.075, 0.065, side));
    }
    scale3(colour, 1.0 + 0.03 * noise.sum(Vec3::new(uv.x * 80.0, uv.y * 120.0, 5.0), 2))
}

/// Returns the colour of a shoe's sole.
pub(crate) fn sole_colour(look: &PersonLook, noise: Noise, uv: Vec2) -> SrgbColor {
    let base = match look.shoes.kind {
        ShoeKind::Trainers if look.shoes.colours[0][0] > 0.8 => [0.80, 0.79, 0.76],
        ShoeKind::Trainers => [0.88, 0.87, 0.84],
        ShoeKind::Leather | ShoeKind::Boots => [0.16, 0.13, 0.11],
    };
    scale3(base, 1.0 + 0.04 * noise.sum(Vec3::new(uv.x * 40.0, uv.y * 60.0, 9.0), 2))
}
