//! Free length of cloth, metres: that of the pendulum that a point of a garment forms; 0 where it is fixed.

use crate::clothes::cuts::{is_arm, opening_m};
use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::{Bottom, Fabric, Outer, TopKind};
use crate::noise::{lerp, smoothstep};
use crate::person::look::PersonLook;
use crate::person::regions::along_arm;

/// Sets the free lengths of a sheet's points.
pub(crate) fn hang_free(sheet: &mut Sheet, free_m: impl Fn(&Node) -> f32) {
    for node in &mut sheet.nodes {
        node.free_m = free_m(node);
    }
}

/// Returns the stiffness of a cloth relative to that of a plain weave.
pub(crate) fn stiffness(fabric: Fabric) -> f32 {
    match fabric {
        Fabric::Jersey => 0.9,
        Fabric::Weave => 1.0,
        Fabric::Knit => 1.3,
        Fabric::Denim => 2.0,
        Fabric::Leather => 2.4,
    }
}

/// Returns the free length of hems and wide short sleeves of the outermost top that is not tucked in.
pub(crate) fn free_top(look: &PersonLook, node: &Node) -> f32 {
    let (top, p) = (&look.top, node.average);
    // A close fit does not swing.
    let loose = smoothstep(0.007, 0.013, top.offset_m);
    let thick = matches!(top.kind, TopKind::Jumper | TopKind::Turtleneck | TopKind::Hoodie);
    if is_arm(node.part) {
        let (along, _) = along_arm(p);
        let wide = if top.sleeve_m < 0.25 { 0.030 } else { 0.012 };
        return wide * loose * smoothstep(0.05, top.sleeve_m.max(0.06), along);
    }
    if top.tucked || look.outer.is_some() {
        return 0.0;
    }
    let long = if thick { 0.022 } else { 0.055 };
    long * loose * smoothstep(1.10, top.hem_m, p.y)
}

/// Returns the free length of an open jacket's fronts and its hem; the upper part of a coat is held by its tails.
pub(crate) fn free_outer(outer: &Outer, node: &Node) -> f32 {
    let p = node.average;
    if outer.hem_m < 0.7 || is_arm(node.part) {
        return 0.0;
    }
    let down = smoothstep(1.28, outer.hem_m, p.y);
    let front =
        if outer.open_m > 0.0 && p.z > 0.0 { smoothstep(0.13, 0.0, p.x.abs() - opening_m(outer, p.y)) } else { 0.0 };
    0.025 * smoothstep(1.0, outer.hem_m, p.y) + 0.13 * front * down
}

/// Returns the free length of wide trouser legs and shorts.
pub(crate) fn free_bottom(look: &PersonLook, node: &Node) -> f32 {
    if look.outer.is_some_and(|outer| outer.hem_m < 0.7) {
        // Under a coat.
        return 0.0;
    }
    let (hem_m, wide_m) = match look.bottom {
        Bottom::Trousers { hem_m, wide_m, .. } => (hem_m, wide_m),
        Bottom::Overalls { hem_m, .. } => (hem_m, 0.012),
        Bottom::Skirt { .. } => return 0.0,
    };
    1.9 * wide_m * smoothstep(lerp(hem_m, 0.85, 0.65), hem_m, node.average.y)
}
