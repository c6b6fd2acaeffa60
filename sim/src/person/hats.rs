//! Hats.

use std::f32::consts::{FRAC_PI_2, TAU};

use glam::{Vec2, Vec3};

use crate::clothes::lift::HeadLift;
use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::{Hat, Textile};
use crate::noise::{Noise, smoothstep};

/// Centre of the head seen from above, metres on the average body.
const MIDDLE_Z_M: f32 = 0.047;
/// Half axes of a hat at its rim.
const HALF_M: Vec2 = Vec2::new(0.0905, 0.1090);

/// Returns the height of a hat's rim in the direction of a point of the average head: lower at the back.
pub(crate) fn rim_height_m(p: Vec3) -> f32 {
    let around = p.x.abs().atan2(p.z - MIDDLE_Z_M);
    1.574 + 0.020 * around.cos()
}

/// Returns the cloth of a hat.
pub(crate) fn hat_cloth(hat: &Hat) -> Option<&Textile> {
    match hat {
        Hat::None => None,
        Hat::Beanie(cloth) | Hat::Cap(cloth) | Hat::Brimmed(cloth) => Some(cloth),
    }
}

/// Builds the hat, textured by u around from the front and v from the rim (0.1) to the apex (1); below 0.1 lie brims.
pub(crate) fn hat(hat: &Hat, body: &Sheet, noise: Noise) -> Sheet {
    const COLUMNS: u32 = 56;
    let lift = HeadLift::new(body);
    let mut sheet = Sheet::default();
    let Some(carrier) = lift.node(Vec3::new(0.0, 1.66, MIDDLE_Z_M)) else { return sheet };
    let placed = |average: Vec3, uv: Vec2| Node { uv, ..lift.node(average).unwrap_or(carrier) };
    let crown_m = lift.top_m();
    let (apex, square) = match hat {
        Hat::None => return sheet,
        Hat::Beanie(_) => (crown_m + 0.014, 0.62),
        Hat::Cap(_) => (crown_m + 0.008, 0.62),
        Hat::Brimmed(_) => (crown_m + 0.020, 0.36),
    };
    let crown = |t: f32, angle: f32| {
        let direction = Vec2::new(angle.sin(), angle.cos());
        let polar = t * FRAC_PI_2;
        let rim = 1.574 + 0.020 * angle.cos();
        let mut out = polar.cos().max(0.0).powf(square);
        let mut y = rim + (apex - rim) * polar.sin().powf(0.9);
        match hat {
            // The rim is turned up: twice the cloth.
            Hat::Beanie(_) => {
                out += 0.075 * smoothstep(0.27, 0.24, t)
                    + 0.03 * noise.sum(Vec3::new(direction.x * 2.0, t * 3.0, direction.y * 2.0), 2);
            }
            // A pinch along the top.
            Hat::Brimmed(_) => y -= 0.020 * smoothstep(0.55, 1.0, t) * smoothstep(0.6, 0.0, direction.x.abs()),
            Hat::Cap(_) | Hat::None => {}
        }
        Vec3::new(direction.x * HALF_M.x * out, y, MIDDLE_Z_M + direction.y * HALF_M.y * out)
    };
    sheet.add_grid(18, COLUMNS, |t, u| placed(crown(t, (u % 1.0) * TAU), Vec2::new(u, 0.1 + 0.9 * t)));
    match hat {
        Hat::Cap(_) => {
            // Upper and lower side of the visor.
            for side in [1.0f32, -1.0] {
                sheet.add_grid(6, 24, |t, u| {
                    let reach = if side > 0.0 { 1.0 - t } else { t };
                    let angle = (u - 0.5) * 2.2;
                    let edge = crown(0.02, angle);
                    let long = 0.078 * (angle * 1.25).cos().max(0.0).sqrt();
                    let droop = 0.016 * reach * reach + 0.030 * edge.x.powi(2) / HALF_M.x.powi(2) * reach;
                    let average = edge + Vec3::new(angle.sin() * 0.3, 0.0, 1.0) * long * reach
                        - Vec3::Y * (droop + 0.0015 * (1.0 - side));
                    placed(average, Vec2::new(0.5 * u, 0.08 * reach))
                });
            }
        }
        Hat::Brimmed(_) => {
            for side in [1.0f32, -1.0] {
                sheet.add_grid(6, COLUMNS, |t, u| {
                    let reach = if side > 0.0 { 1.0 - t } else { t };
                    let angle = (u % 1.0) * TAU;
                    let edge = crown(0.0, angle);
                    let out = Vec3::new(angle.sin(), 0.0, angle.cos());
                    let wave = 0.012 * (2.0 * angle).cos() * reach * reach;
                    let lower = 0.0015 * (1.0 - side);
                    placed(
                        edge + out * 0.068 * reach - Vec3::Y * (wave + 0.010 * reach + lower),
                        Vec2::new(u, 0.08 * reach),
                    )
                });
            }
        }
        Hat::Beanie(_) | Hat::None => {}
    }
    sheet
}
