//! Spatial order: neighbours in space are neighbours in the list.

use alloc::vec::Vec;

/// Weight of a unit normal relative to positions, metres: front and back of a thin part are separate.
const NORMAL_M: f32 = 0.1;

/// Orders points so that each node of a [`crate::tree::HaarTree`] over the list is compact: splits at the median along the longest extent,
/// down to single points. Returns the points' indices.
pub(crate) fn spatial_order(points: &[[f32; 3]], normals: Option<&[[f32; 3]]>) -> Vec<u32> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    let mut parts = alloc::vec![&mut order[..]];
    let at = |i: u32, axis: usize| match normals {
        Some(normals) if axis >= 3 => NORMAL_M * normals[i as usize][axis - 3],
        _ => points[i as usize][axis],
    };
    let axes = if normals.is_some() { 6 } else { 3 };
    while let Some(part) = parts.pop() {
        if part.len() < 3 {
            continue;
        }
        let extent = |axis: usize| {
            let bounds = part.iter().map(|&i| at(i, axis));
            let (low, high) = bounds.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            high - low
        };
        let longest = (0..axes).max_by(|&a, &b| extent(a).total_cmp(&extent(b))).unwrap_or(0);
        let half = part.len() - part.len() / 2;
        part.select_nth_unstable_by(half, |&a, &b| at(a, longest).total_cmp(&at(b, longest)).then(a.cmp(&b)));
        let (first, second) = part.split_at_mut(half);
        parts.extend([first, second]);
    }
    order
}
