//! Even spacing by removal of points: weighted sample elimination (C. Yuksel, "Sample Elimination for
//! Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015).

use std::collections::BinaryHeap;
use std::collections::binary_heap::PeekMut;

use glam::Vec3;
use rayon::prelude::*;

use crate::point_grid::PointGrid;

/// Parameters of the paper's weight function (1 - d / 2 r_max)^ALPHA, with distances below
/// 2 r_min = 2 r_max (1 - (N / M)^GAMMA) BETA taken as 2 r_min.
const ALPHA: i32 = 8;
const BETA: f32 = 0.65;
const GAMMA: f32 = 1.5;

/// Selects `keep` of the points that lie evenly on a surface of `area` square metres; returns their indices, ascending. Points
/// whose normals oppose each other lie on different sheets and do not repel each other.
pub(crate) fn eliminate(points: &[Vec3], normals: &[Vec3], keep: usize, area: f64) -> Vec<usize> {
    if keep >= points.len() {
        return (0..points.len()).collect();
    }
    // Radius of the densest packing of `keep` discs.
    let r_max = (area / (2.0 * 3.0f64.sqrt() * keep as f64)).sqrt() as f32;
    let r_min = r_max * (1.0 - (keep as f32 / points.len() as f32).powf(GAMMA)) * BETA;
    let weight = |distance: f32| (1.0 - distance.max(2.0 * r_min) / (2.0 * r_max)).max(0.0).powi(ALPHA);

    let grid = PointGrid::new(points, 2.0 * r_max);
    let neighbors: Vec<Vec<(u32, f32)>> = points
        .par_iter()
        .enumerate()
        .map(|(i, &point)| {
            let mut list = Vec::new();
            grid.within(point, 2.0 * r_max, |j, squared| {
                if j != i && normals[i].dot(normals[j]) > 0.0 {
                    list.push((j as u32, weight(squared.sqrt())));
                }
            });
            list
        })
        .collect();
    let mut weights: Vec<f32> = neighbors.iter().map(|list| list.iter().map(|(_, w)| w).sum()).collect();
    let mut heap: BinaryHeap<u64> = weights.iter().enumerate().map(|(index, weight)| entry(*weight, index)).collect();
    let mut alive = vec![true; points.len()];
    let mut left = points.len();
    while left > keep {
        let Some(mut highest) = heap.peek_mut() else { break };
        let index = (u32::MAX - *highest as u32) as usize;
        // Weights only fall: an outdated entry is too high and sinks to its place.
        let now = entry(weights[index], index);
        if *highest > now {
            *highest = now;
            continue;
        }
        PeekMut::pop(highest);
        alive[index] = false;
        left -= 1;
        for &(neighbor, w) in &neighbors[index] {
            weights[neighbor as usize] -= w;
        }
    }
    (0..points.len()).filter(|&i| alive[i]).collect()
}

/// Returns the entry of a point in the heap, the highest first: its weight, then the lower index. One number is compared
/// and moved in a fraction of the time of two.
fn entry(weight: f32, index: usize) -> u64 {
    let bits = weight.to_bits();
    let ordered = if bits >> 31 == 0 { bits | 1 << 31 } else { !bits };
    u64::from(ordered) << 32 | u64::from(u32::MAX - index as u32)
}
