//! Cuts of garments: signed distances on the average body, metres, positive inside the cloth.

use flyrig_body::Part;

use crate::clothes::sheet::Node;
use crate::clothes::wardrobe::{Bottom, Outer, ShoeKind, Top, TopKind};
use crate::noise::{lerp, smoothstep};
use crate::person::look::PersonLook;
use crate::person::regions::{along_arm, below_neckline};

/// Value far outside any cloth.
const OUTSIDE_M: f32 = -0.05;
/// Upper edge of trousers and skirts, metres above the sole: over a tucked-in top, or under a loose one.
const HIGH_WAIST_M: f32 = 0.985;
const WAIST_M: f32 = 0.925;
/// Upper edge of a boot's shaft.
pub(crate) const BOOT_M: f32 = 0.20;
/// Where the hanging part of skirts and coats begins.
pub(crate) const COAT_SEAM_M: f32 = 0.90;
/// Height above a hem that becomes visible when it swings.
const SWING_M: f32 = 0.24;
/// Radius of a jacket's neck opening.
const OUTER_NECK_M: f32 = 0.094;

pub(crate) fn is_arm(part: Part) -> bool {
    matches!(part, Part::LeftArm | Part::RightArm)
}

pub(crate) fn is_hand(part: Part) -> bool {
    matches!(part, Part::LeftHand | Part::RightHand)
}

pub(crate) fn waist_m(look: &PersonLook) -> f32 {
    if look.top.tucked { HIGH_WAIST_M } else { WAIST_M }
}

/// Cuts the cloth at `hem_m` on the trunk and at `sleeve_m` along the arm.
fn within_hem_and_sleeve(node: &Node, inside: f32, hem_m: f32, sleeve_m: f32) -> f32 {
    let p = node.average;
    let inside = inside.min(p.y - hem_m);
    if !(is_arm(node.part) || p.x.abs() > 0.20 && p.y > 0.95) {
        return inside;
    }
    let (along, _) = along_arm(p);
    if p.y < hem_m + 0.1 || along > 0.1 { sleeve_m - along } else { inside.min(sleeve_m - along) }
}

pub(crate) fn inside_top(top: &Top, node: &Node) -> f32 {
    let p = node.average;
    if is_hand(node.part) {
        return OUTSIDE_M;
    }
    let neck = if top.kind == TopKind::Turtleneck {
        // Up the neck, below the jaw.
        1.447 - p.y - 0.6 * (p.z - 0.03)
    } else if p.y > 1.42 {
        return OUTSIDE_M;
    } else {
        below_neckline(p, top.v_neck_m, top.neck_m)
    };
    within_hem_and_sleeve(node, neck, top.hem_m, top.sleeve_m)
}

pub(crate) fn inside_outer(outer: &Outer, node: &Node) -> f32 {
    let p = node.average;
    if p.y > 1.42 || is_hand(node.part) {
        return OUTSIDE_M;
    }
    let mut inside = below_neckline(p, if outer.open_m > 0.0 { 0.0 } else { 0.05 }, OUTER_NECK_M);
    if p.z > 0.0 && !is_arm(node.part) {
        inside = inside.min(p.x.abs() - opening_m(outer, p.y));
    }
    // A coat goes on as its tails.
    let hem_m = if outer.hem_m < 0.7 { COAT_SEAM_M - 0.025 } else { outer.hem_m };
    within_hem_and_sleeve(node, inside, hem_m, 0.468)
}

/// Returns half the width of a jacket's opening at a height.
pub(crate) fn opening_m(outer: &Outer, y: f32) -> f32 {
    if outer.open_m > 0.0 { outer.open_m * lerp(1.0, 0.62, smoothstep(0.9, 1.3, y)) } else { OUTSIDE_M }
}

/// Returns the cut of trousers and overalls; skirts are built separately.
pub(crate) fn inside_bottom(look: &PersonLook, node: &Node) -> f32 {
    if is_arm(node.part) || is_hand(node.part) {
        return OUTSIDE_M;
    }
    let p = node.average;
    match look.bottom {
        Bottom::Trousers { hem_m, .. } => (waist_m(look) - p.y).min(p.y - hem_m),
        Bottom::Overalls { hem_m, .. } => {
            let bib =
                if p.z > 0.02 { (0.118 - p.x.abs()).min(1.225 - p.y) } else { (0.105 - p.x.abs()).min(1.10 - p.y) };
            (waist_m(look) - p.y).max(bib).min(p.y - hem_m)
        }
        Bottom::Skirt { .. } => OUTSIDE_M,
    }
}

pub(crate) fn inside_boot(look: &PersonLook, node: &Node) -> f32 {
    if look.shoes.kind == ShoeKind::Boots && !is_hand(node.part) {
        (BOOT_M - node.average.y).min(node.average.y - 0.05)
    } else {
        OUTSIDE_M
    }
}

/// Returns the region below a skirt, or behind the tails of a coat.
pub(crate) fn under_hanging(look: &PersonLook, node: &Node) -> f32 {
    let p = node.average;
    if is_arm(node.part) || is_hand(node.part) {
        return OUTSIDE_M;
    }
    if let Bottom::Skirt { hem_m, .. } = look.bottom {
        return (waist_m(look) - p.y).min(p.y - hem_m - SWING_M);
    }
    OUTSIDE_M
}

/// Returns the region inside the sides and the back of a coat's tails, which no camera sees.
pub(crate) fn under_tails(look: &PersonLook, node: &Node) -> f32 {
    match look.outer {
        Some(outer) if outer.hem_m < 0.7 && !is_arm(node.part) && !is_hand(node.part) => {
            let p = node.average;
            let behind = if outer.open_m > 0.0 { 0.02 - p.z } else { 1.0 };
            (COAT_SEAM_M - p.y).min(p.y - outer.hem_m - SWING_M).min(behind)
        }
        _ => OUTSIDE_M,
    }
}
