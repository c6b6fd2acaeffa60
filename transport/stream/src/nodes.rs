//! Coding of the node translations of the deformation graph, in whole steps: each is predicted from neighbours coded before it.

use alloc::{vec, vec::Vec};

use crate::{
    integers::{MOST, ResidualModel},
    planes::Influences,
    range_coder::BitCoder,
    tree::CHANNELS,
};

/// Largest number of nodes that a node is predicted from.
const NEAREST: usize = 3;
/// Weight of a unit normal in distances, metres: front and back of a thin part move separately.
const NORMAL_M: f32 = 0.1;
/// Least squared distance between two nodes, square metres.
const LEAST_SQUARED: f32 = 1e-8;
/// Fractional bits of a share.
const SHARE_BITS: u32 = 16;
/// Weight of a node's own channels relative to those of its neighbours in the expected size of a difference.
const OWN: u32 = 4;

/// Nodes that a node is predicted from, with their shares in steps of `2^-SHARE_BITS`; nodes without a share are unused.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Prediction {
    node: [u32; NEAREST],
    share: [i32; NEAREST],
}

/// Chooses the nodes that each node is predicted from: the nearest of those before it that move a Gaussian together with it, and so are
/// joined to it by the surface, weighted by inverse squared distances (Shepard 1968); where there is none, the node before it. `places`
/// (metres) and `normals` have one element per node, `influences` one per Gaussian.
///
/// The result is the same on every computer: it only takes operations that IEEE 754 rounds correctly.
pub(crate) fn predictions(places: &[[f32; 3]], normals: &[[f32; 3]], influences: &[Influences]) -> Vec<Prediction> {
    let squared = |a: usize, b: usize| {
        let apart = |v: &[[f32; 3]]| (0..3).map(|k| (v[a][k] - v[b][k]) * (v[a][k] - v[b][k])).sum::<f32>();
        (apart(places) + NORMAL_M * NORMAL_M * apart(normals)).max(LEAST_SQUARED)
    };
    let mut nearest = vec![[(f32::INFINITY, 0); NEAREST]; places.len()];
    let mut last = [-1; 4];
    for on in influences {
        if core::mem::replace(&mut last, on.index) == on.index {
            continue;
        }
        for (a, b) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
            if on.weight[a] > 0 && on.weight[b] > 0 && on.index[a] != on.index[b] {
                let (before, node) = (on.index[a].min(on.index[b]), on.index[a].max(on.index[b]) as usize);
                insert(&mut nearest[node], (squared(before as usize, node), before as u32));
            }
        }
    }
    let predict = |(node, near): (usize, [(f32, u32); NEAREST])| {
        let sum: f32 = near.iter().map(|(squared, _)| 1.0 / squared).sum();
        if sum > 0.0 {
            let share = near.map(|(squared, _)| ((1 << SHARE_BITS) as f32 / (squared * sum) + 0.5) as i32);
            Prediction { node: near.map(|(_, node)| node), share }
        } else if node > 0 {
            Prediction { node: [node as u32 - 1; NEAREST], share: [1 << SHARE_BITS, 0, 0] }
        } else {
            Prediction::default()
        }
    };
    nearest.into_iter().enumerate().map(predict).collect()
}

/// Inserts a squared distance and a node among the nearest, unless it is one of them.
fn insert(nearest: &mut [(f32, u32); NEAREST], new: (f32, u32)) {
    if nearest.contains(&new) {
        return;
    }
    let mut new = new;
    for known in nearest {
        if new < *known {
            core::mem::swap(known, &mut new);
        }
    }
}

/// Codes the translations of all nodes, steps of -[`MOST`]..=[`MOST`].
pub(crate) fn code_nodes<C: BitCoder>(coder: &mut C, predictions: &[Prediction], levels: &mut [[i32; CHANNELS]]) {
    let mut model = ResidualModel::default();
    // Magnitudes of the differences from the predictions, and their sum over the channels.
    let mut differences = vec![0u32; levels.len()];
    for (node, prediction) in predictions.iter().enumerate() {
        let known = || prediction.node.iter().zip(prediction.share).filter(|(_, share)| *share > 0);
        let around: u32 = known().map(|(&other, _)| differences[other as usize]).sum();
        let count = (CHANNELS * known().count()) as u32;
        let predicted: [i32; CHANNELS] = core::array::from_fn(|c| {
            let shares = known().map(|(&other, share)| i64::from(share) * i64::from(levels[other as usize][c]));
            ((shares.sum::<i64>() + (1 << (SHARE_BITS - 1))) >> SHARE_BITS) as i32
        });
        let mut own = 0;
        for ((level, predicted), channels) in levels[node].iter_mut().zip(predicted).zip(0..) {
            let expected = 4 * (OWN + around + OWN * own) / (1 + count + OWN * channels);
            let difference = model.code(coder, *level - predicted, expected);
            *level = (predicted + difference).clamp(-MOST, MOST);
            own += difference.unsigned_abs();
        }
        differences[node] = own;
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::range_coder::{RangeDecoder, RangeEncoder};

    /// Returns nodes on a sheet, row by row, and Gaussians that hang on four neighbours each.
    fn sheet(side: usize) -> (Vec<[f32; 3]>, Vec<[f32; 3]>, Vec<Influences>) {
        let place = |i: usize| [0.03 * (i % side) as f32, 0.03 * (i / side) as f32, 0.001 * (i * i % 7) as f32];
        let corners = |i: usize| [i, i + 1, i + side, i + side + 1].map(|i| i as u32);
        let cells = (0..side * (side - 1)).filter(|i| i % side + 1 < side);
        let influences = cells.map(|i| Influences::new(corners(i), [0.4, 0.3, 0.2, 0.1])).collect();
        ((0..side * side).map(place).collect(), std::vec![[0.0, 0.0, 1.0]; side * side], influences)
    }

    fn bytes_of(predictions: &[Prediction], levels: &[[i32; 3]]) -> Vec<u8> {
        let mut coded = levels.to_vec();
        let mut encoder = RangeEncoder::new(Vec::new());
        code_nodes(&mut encoder, predictions, &mut coded);
        assert_eq!(coded, levels);
        let bytes = encoder.finish();
        let mut found = std::vec![[7; 3]; levels.len()];
        code_nodes(&mut RangeDecoder::new(&bytes), predictions, &mut found);
        assert_eq!(found, levels);
        bytes
    }

    /// Returns the nearest of the nodes before one that share a Gaussian with it, by brute force in f64, with their shares.
    fn reference(node: usize, places: &[[f32; 3]], normals: &[[f32; 3]], influences: &[Influences]) -> Vec<(u32, f64)> {
        let hangs = |on: &Influences, node: usize| (0..4).any(|k| on.weight[k] > 0 && on.index[k] == node as i32);
        let apart = |v: &[[f32; 3]], other: usize| -> f64 {
            (0..3).map(|k| (f64::from(v[node][k]) - f64::from(v[other][k])).powi(2)).sum()
        };
        let mut near: Vec<(f64, u32)> = (0..node)
            .filter(|&other| influences.iter().any(|on| hangs(on, node) && hangs(on, other)))
            .map(|other| (apart(places, other) + 0.01 * apart(normals, other), other as u32))
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.truncate(NEAREST);
        let sum: f64 = near.iter().map(|(squared, _)| 1.0 / squared).sum();
        near.iter().map(|(squared, other)| (*other, 1.0 / (squared * sum))).collect()
    }

    #[test]
    fn nodes_are_predicted_from_the_nearest_that_the_surface_joins_to_them() {
        let mut random = StdRng::seed_from_u64(21);
        for round in 0..5 {
            let count = 60;
            let places: Vec<[f32; 3]> = (0..count).map(|_| random.random()).collect();
            let normals: Vec<[f32; 3]> = (0..count).map(|_| random.random()).collect();
            let influences: Vec<Influences> = (0..count * round)
                .map(|_| Influences::new([0; 4].map(|_| random.random_range(0..count as u32)), random.random()))
                .collect();
            for (node, found) in predictions(&places, &normals, &influences).iter().enumerate() {
                let expected = reference(node, &places, &normals, &influences);
                let used: Vec<(u32, i32)> =
                    found.node.into_iter().zip(found.share).filter(|(_, share)| *share > 0).collect();
                if expected.is_empty() {
                    let before = node.checked_sub(1).map(|before| (before as u32, 1 << SHARE_BITS));
                    assert_eq!(used, before.into_iter().collect::<Vec<_>>());
                    continue;
                }
                assert_eq!(used.len(), expected.len(), "{round} {node}");
                for ((other, share), (wanted, of_one)) in used.iter().zip(&expected) {
                    assert_eq!(other, wanted, "{round} {node}");
                    assert!((f64::from(*share) / 65_536.0 - of_one).abs() < 2e-5, "{round} {node}: {share} {of_one}");
                }
            }
        }
    }

    #[test]
    fn translations_come_back_and_smooth_ones_are_cheap() {
        let side = 40;
        let (places, normals, influences) = sheet(side);
        let predictions = predictions(&places, &normals, &influences);
        let mut random = StdRng::seed_from_u64(22);
        let smooth: Vec<[i32; 3]> =
            places.iter().map(|&[x, y, _]| [x + 0.5 * y, y, 1.0 - x].map(|v: f32| (200.0 * v.sin()) as i32)).collect();
        let random: Vec<[i32; 3]> = smooth.iter().map(|_| [0; 3].map(|_| random.random_range(-200..=200))).collect();
        let extreme: Vec<[i32; 3]> = (0..smooth.len()).map(|i| [[MOST, -MOST, 0], [-MOST, MOST, 1]][i % 2]).collect();
        let [still, smooth, random, _] =
            [&std::vec![[0; 3]; smooth.len()], &smooth, &random, &extreme].map(|levels| bytes_of(&predictions, levels));
        // Entropy of the random ones: 8.6 bits each.
        let uniform = (side * side * 3) as f64 * 401f64.log2() / 8.0;
        assert!(still.len() < 20 && (random.len() as f64) < 1.2 * uniform, "{} {}", still.len(), random.len());
        assert!(2 * smooth.len() < random.len(), "{} {}", smooth.len(), random.len());
    }

    #[test]
    fn nodes_without_neighbours_or_places_are_coded() {
        for count in [0, 1, 2, 50] {
            let places = std::vec![[0.0; 3]; count];
            let on_all = Influences { index: [0, 0, count.saturating_sub(1) as i32, 0], weight: [0, 100, 155, 0] };
            let influences: &[Influences] = if count > 0 { &[on_all] } else { &[] };
            for places in [places.clone(), std::vec![[f32::MAX; 3]; count]] {
                let predictions = predictions(&places, &places, influences);
                let levels: Vec<[i32; 3]> = (0..count as i32).map(|i| [i, -5 * i, 1000 - i]).collect();
                bytes_of(&predictions, &levels);
            }
        }
    }
}
