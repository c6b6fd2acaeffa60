//! Paint of skin and face in coordinates of the average body.

use glam::{Vec2, Vec3};

use crate::clothes::wardrobe::{HairCut, ShoeKind, SrgbColor};
use crate::noise::{Noise, smoothstep};
use crate::person::features::LIPS_Y;
use crate::person::look::PersonLook;
use crate::person::regions::{EYE, above_hairline};
use crate::texture::{mix3, scale3};

/// Returns the colour of the skin at a point of the average body.
pub(crate) fn skin_colour(look: &PersonLook, noise: Noise, p: Vec3) -> SrgbColor {
    let blotch = noise.sum(p * 22.0, 3);
    let pores = noise.at(p * 420.0);
    let mut colour = scale3(look.skin, 1.0 + 0.035 * blotch + 0.018 * pores);
    let red = |colour: SrgbColor, by: f32| {
        [colour[0] * (1.0 + 0.10 * by), colour[1] * (1.0 - 0.13 * by), colour[2] * (1.0 - 0.12 * by)]
    };
    // Knuckles and fingertips.
    colour = red(colour, 0.5 * smoothstep(0.40, 0.50, p.x.abs()) * smoothstep(0.12, 0.22, p.z));
    let spots = smoothstep(0.52, 0.75, noise.at(p * 190.0)) * smoothstep(-0.2, 0.3, noise.at(p * 25.0 + 5.0));
    colour = mix3(colour, scale3(look.skin, 0.70), 0.4 * look.freckles * spots);
    if p.y < look.shoes.sock_m && look.shoes.kind != ShoeKind::Boots {
        let rib = 1.0 + 0.05 * ((p.x + p.z) * 900.0).sin();
        return scale3(look.shoes.sock, rib * (1.0 - 0.15 * smoothstep(0.020, 0.018, look.shoes.sock_m - p.y)));
    }
    if p.y < 1.42 {
        return colour;
    }
    let x = p.x.abs();
    let front = smoothstep(0.085, 0.105, p.z);
    // Cheeks and nose.
    let cheek = Vec2::new(x - 0.040, p.y - 1.516).length();
    colour = red(
        colour,
        front
            * (0.45 * smoothstep(0.030, 0.006, cheek)
                + 0.35 * smoothstep(0.018, 0.004, Vec2::new(x, p.y - 1.520).length())),
    );
    // Darker around the eyes.
    let to_eye = Vec2::new((x - 0.030) * 0.75, p.y - 1.553).length();
    colour = scale3(colour, 1.0 - 0.12 * front * smoothstep(0.021, 0.008, to_eye));
    // Lash line and the socket behind the eyeball.
    let lid = EYE.0.distance(Vec3::new(x, p.y, p.z)) / EYE.1;
    colour = mix3(colour, [0.10, 0.06, 0.05], if p.z > 0.1 { smoothstep(1.17, 1.09, lid) * 0.85 } else { 0.0 });
    // Nostrils.
    let nostril = Vec2::new(x - 0.0085, (p.y - 1.5095) * 1.3).length();
    colour =
        mix3(colour, scale3(look.skin, 0.25), front * smoothstep(0.0052, 0.0028, nostril) * f32::from(p.z < 0.152));
    colour = lips(look, colour, p, front);
    colour = stubble(look, noise, colour, p);
    brows(look, noise, colour, p, front)
}

fn lips(look: &PersonLook, colour: SrgbColor, p: Vec3, front: f32) -> SrgbColor {
    let face = look.features;
    let x = p.x.abs() / 0.0240;
    if x > 1.15 {
        return colour;
    }
    let bow = 0.0105 * (1.0 - x.powi(2)).max(0.0).sqrt() - 0.0018 * smoothstep(0.35, 0.0, x);
    let fall = 0.0118 * (1.0 - x.powi(2)).max(0.0).powf(0.6);
    // The line bends up at the corners of a friendly mouth.
    let above = p.y - LIPS_Y - 0.0015 * (0.4 + face.smile).clamp(-0.6, 1.6) * x * x;
    let inside = if above > 0.0 { bow - above } else { fall + above };
    let lip = if look.female { [0.70, 0.26, 0.28] } else { [0.68, 0.38, 0.34] };
    let lip = mix3(scale3(look.skin, 0.82), scale3(lip, 0.55 + 0.5 * look.skin[0]), 0.35 + 0.5 * look.lips);
    let coloured = mix3(colour, lip, front * smoothstep(-0.0008, 0.0012, inside));
    // The line between the lips, and the mouth behind it.
    let line = smoothstep(0.0016, 0.0005, above.abs()) * smoothstep(1.08, 0.9, x);
    let behind = smoothstep(0.132, 0.126, p.z) * f32::from(x < 1.0 && above.abs() < 0.02);
    mix3(coloured, scale3(lip, 0.30), front * (0.75 * line).max(behind))
}

fn stubble(look: &PersonLook, noise: Noise, colour: SrgbColor, p: Vec3) -> SrgbColor {
    if look.stubble <= 0.0 {
        return colour;
    }
    let jaw = smoothstep(1.512, 1.490, p.y - 0.35 * (0.12 - p.z).max(0.0))
        * smoothstep(1.425, 1.450, p.y)
        * smoothstep(0.02, 0.06, p.z);
    let grain = 0.65 + 0.35 * noise.at(p * 600.0);
    mix3(colour, scale3(look.hair, 0.8), look.stubble * 0.42 * jaw * grain)
}

fn brows(look: &PersonLook, noise: Noise, colour: SrgbColor, p: Vec3, front: f32) -> SrgbColor {
    let t = (p.x.abs() - 0.011) / 0.038;
    let mut colour = colour;
    if (0.0..1.0).contains(&t) && (1.55..1.61).contains(&p.y) {
        let face = look.features;
        let inner = 1.5672 + 0.0020 * face.brows_open.clamp(-0.8, 1.3);
        let rise = (1.5732 - inner) + 0.0026 * face.brows_arched;
        let arch =
            inner + rise * (t * 2.2).min(1.0) - (0.0075 + 0.0025 * face.brows_arched) * (t - 0.60).max(0.0) / 0.40;
        let thick = if look.female { 0.0026 } else { 0.0038 } * (1.0 + 0.35 * face.brows_thick);
        let thick = thick * (1.0 - 0.65 * t.powi(2)) * smoothstep(0.0, 0.12, t);
        let hairs = 0.75 + 0.25 * noise.at(Vec3::new(p.x * 900.0 + p.y * 500.0, p.y * 200.0, 0.0));
        let on = smoothstep(thick, thick * 0.45, (p.y - arch).abs());
        colour = mix3(colour, scale3(look.hair, 0.75), front * on * hairs * 0.92);
    }
    // Scalp under the hair.
    let scalp = smoothstep(-0.004, 0.008, above_hairline(p, look.recede_m));
    let under = match look.cut {
        HairCut::Bald => 0.12 + 0.3 * look.stubble,
        HairCut::Crop => 0.8,
        _ => 0.95,
    };
    mix3(colour, scale3(look.hair, 0.85), scalp * under)
}

/// Returns the colour of an eyeball; `at` is the offset from the pupil in eyeball radii, x to the image's right.
pub(crate) fn eye_colour(look: &PersonLook, at: Vec2) -> SrgbColor {
    let r = at.length();
    let white = mix3([0.90, 0.88, 0.86], [0.72, 0.58, 0.55], smoothstep(0.55, 1.0, r));
    let ring = (at.y.atan2(at.x) * 17.0).sin() * 0.08;
    let iris = scale3(look.iris, 1.0 + ring + 0.25 * smoothstep(0.2, 0.4, r));
    let mut colour = mix3(iris, white, smoothstep(0.44, 0.49, r));
    colour = mix3(colour, [0.07, 0.05, 0.05], smoothstep(0.06, 0.0, (r - 0.445).abs()) * 0.7);
    colour = mix3([0.02, 0.02, 0.02], colour, smoothstep(0.17, 0.21, r));
    mix3(colour, [1.0, 1.0, 1.0], smoothstep(0.13, 0.08, (at - Vec2::new(0.16, -0.20)).length()))
}
