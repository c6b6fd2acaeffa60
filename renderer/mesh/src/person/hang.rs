//! Nodes that move the vertices of a mesh, from the Gaussians beside them.

use flyrig_avatar::{Hanging, PosedAvatar};
use flyrig_body::PointGrid;
use glam::Vec3;
use rayon::prelude::*;

/// Gaussians whose nodes a vertex takes, and nodes that it keeps.
const NEAREST: usize = 4;
const NODES: usize = 4;
/// First search radius, metres, and its growth until Gaussians are found.
const RADIUS_M: f32 = 0.012;
const GROWTH: f32 = 2.0;
const WIDEST_M: f32 = 0.4;
/// Least cosine between the normals of a vertex and of its Gaussians: the far side of a hand moves with other nodes.
const SAME_SIDE: f32 = 0.2;

/// Returns the nodes of each vertex: those of the nearest Gaussians on the same side, weighted by their inverse distance.
pub(super) fn hang((positions, normals): (&[Vec3], &[Vec3]), of: &Hanging, posed: &PosedAvatar) -> Hanging {
    let centers: Vec<Vec3> = posed.center.iter().map(|center| Vec3::from_slice(&center[..3])).collect();
    let facing: Vec<Vec3> = posed.normals().collect();
    let grid = PointGrid::new(&centers, RADIUS_M);
    let row = |(position, normal): (&Vec3, &Vec3)| {
        let mut radius = RADIUS_M;
        let mut near = Vec::new();
        while near.is_empty() && radius < WIDEST_M && position.is_finite() {
            grid.within(*position, radius, |i, squared| {
                if facing[i].dot(*normal) >= SAME_SIDE {
                    near.push((squared, i));
                }
            });
            radius *= GROWTH;
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(NEAREST);
        blend(of, &near)
    };
    let rows: Vec<([u32; NODES], [f32; NODES])> =
        positions.par_iter().zip(normals).with_min_len(256).map(row).collect();
    let (gaussian_nodes, gaussian_weights) = rows.into_iter().unzip();
    Hanging { nodes: of.nodes.clone(), gaussian_nodes, gaussian_weights, mean: of.mean.clone() }
}

/// Blends the nodes of Gaussians, given by squared distance and index: the strongest ones, with weights of sum 1; no weights without a
/// Gaussian.
fn blend(of: &Hanging, near: &[(f32, usize)]) -> ([u32; NODES], [f32; NODES]) {
    const NEAR_M: f32 = 1e-3;
    let mut sums: Vec<(u32, f32)> = Vec::with_capacity(NEAREST * NODES);
    for (squared, i) in near {
        let share = 1.0 / (squared.sqrt() + NEAR_M);
        for (node, weight) in of.gaussian_nodes[*i].iter().zip(of.gaussian_weights[*i]) {
            match sums.iter_mut().find(|(known, _)| known == node) {
                Some((_, sum)) => *sum += share * weight,
                None => sums.push((*node, share * weight)),
            }
        }
    }
    sums.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    sums.truncate(NODES);
    let total: f32 = sums.iter().map(|(_, weight)| weight).sum();
    let (mut nodes, mut weights) = ([0; NODES], [0.0; NODES]);
    for (slot, (node, weight)) in sums.iter().enumerate().filter(|_| total > 0.0) {
        (nodes[slot], weights[slot]) = (*node, weight / total);
    }
    (nodes, weights)
}
