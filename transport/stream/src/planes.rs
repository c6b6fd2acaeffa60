//! Attributes of a template's Gaussians, each coded as its difference from the previous Gaussian.

use crate::{integers::NumberModel, range_coder::BitCoder};

/// Quantisation levels of a coordinate, an axis of a normal and a scale.
pub(crate) const POSITION_LEVELS: f32 = 65_535.0;
pub(crate) const NORMAL_LEVELS: f32 = 1023.0;
pub(crate) const SCALE_LEVELS: f32 = 1023.0;
/// Sum of the weights of a Gaussian.
pub(crate) const WEIGHT_SUM: i32 = 255;

/// Quantised Gaussian of the template.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Quantised {
    pub position: [i32; 3],
    pub normal: [i32; 2],
    pub scale: i32,
    pub joints: Influences,
    pub nodes: Influences,
}

/// Four influences by increasing index, whose weights add up to [`WEIGHT_SUM`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Influences {
    pub index: [i32; 4],
    pub weight: [i32; 4],
}

impl Influences {
    /// Quantises indices and weights, which must be finite and not negative; influences without weight take the index of the heaviest.
    pub fn new(index: [u32; 4], weight: [f32; 4]) -> Self {
        let sum: f32 = weight.iter().sum();
        let share = |w: f32| if sum > 0.0 { w / sum * WEIGHT_SUM as f32 } else { 0.0 };
        let mut pairs: [(i32, i32); 4] = core::array::from_fn(|k| (index[k] as i32, (share(weight[k]) + 0.5) as i32));
        pairs.sort_by_key(|&(_, w)| -w);
        pairs[0].1 = WEIGHT_SUM - pairs[1..].iter().map(|&(_, w)| w).sum::<i32>();
        for k in 1..4 {
            if pairs[k].1 == 0 {
                pairs[k].0 = pairs[0].0;
            }
        }
        pairs.sort();
        Self { index: pairs.map(|(i, _)| i), weight: pairs.map(|(_, w)| w) }
    }

    /// Returns the influences, those with a weight first.
    pub fn heavy_first(&self) -> Self {
        let mut found = Self::default();
        let order = (0..4).filter(|k| self.weight[*k] > 0).chain((0..4).filter(|k| self.weight[*k] <= 0));
        for (to, from) in order.enumerate() {
            (found.index[to], found.weight[to]) = (self.index[from], self.weight[from]);
        }
        found
    }

    /// Returns indices and weights, as fractions, of the influences that have a weight; those must come first.
    pub fn shares(&self) -> impl Iterator<Item = (usize, f32)> {
        let pairs = self.index.into_iter().zip(self.weight).take_while(|(_, weight)| *weight > 0);
        pairs.map(|(index, weight)| (index as usize, weight as f32 * (1.0 / WEIGHT_SUM as f32)))
    }
}

/// Returns the sum of the squared distances between the nodes of a Gaussian that have a weight, square metres; those must come first.
#[inline]
pub(crate) fn spread(on: &Influences, place: impl Fn(usize) -> [f32; 3]) -> f32 {
    // From the first of n nodes at distances d: n times the sum of |d|^2, less |sum of d|^2.
    let first = place(on.index[0] as usize);
    let (mut sum, mut squares, mut count) = ([0.0; 3], 0.0, 1.0);
    for (node, _) in on.shares().skip(1) {
        let other = place(node);
        for k in 0..3 {
            let apart = other[k] - first[k];
            sum[k] += apart;
            squares += apart * apart;
        }
        count += 1.0;
    }
    count * squares - sum.iter().map(|v| v * v).sum::<f32>()
}

/// Probabilities of all attributes.
#[derive(Debug, Default)]
pub(crate) struct GaussianModel {
    position: [NumberModel; 3],
    normal: [NumberModel; 2],
    scale: NumberModel,
    joints: InfluenceModel,
    nodes: InfluenceModel,
}

#[derive(Debug, Default)]
struct InfluenceModel {
    index: [NumberModel; 4],
    weight: [NumberModel; 3],
}

impl GaussianModel {
    /// Codes a Gaussian by its difference from the one before. Decoded values are arbitrary; the caller checks them.
    pub fn code(
        &mut self,
        coder: &mut impl BitCoder,
        before: &Quantised,
        gaussian: &Quantised,
        has_nodes: bool,
    ) -> Quantised {
        let mut found = *gaussian;
        let mut code = |model: &mut NumberModel, value: i32, before: i32| {
            before.saturating_add(model.code_signed(coder, value.saturating_sub(before)))
        };
        for k in 0..3 {
            found.position[k] = code(&mut self.position[k], gaussian.position[k], before.position[k]);
        }
        for k in 0..2 {
            found.normal[k] = code(&mut self.normal[k], gaussian.normal[k], before.normal[k]);
        }
        found.scale = code(&mut self.scale, gaussian.scale, before.scale);
        found.joints = self.joints.code(coder, &before.joints, &gaussian.joints);
        if has_nodes {
            found.nodes = self.nodes.code(coder, &before.nodes, &gaussian.nodes);
        }
        found
    }
}

impl InfluenceModel {
    fn code(&mut self, coder: &mut impl BitCoder, before: &Influences, influences: &Influences) -> Influences {
        let mut found = Influences::default();
        for k in 0..4 {
            let step = influences.index[k].saturating_sub(before.index[k]);
            found.index[k] = before.index[k].saturating_add(self.index[k].code_signed(coder, step));
        }
        let mut left = WEIGHT_SUM;
        for k in 0..3 {
            let step = influences.weight[k].saturating_sub(before.weight[k]);
            found.weight[k] = before.weight[k].saturating_add(self.weight[k].code_signed(coder, step));
            left = left.saturating_sub(found.weight[k]);
        }
        found.weight[3] = left;
        found
    }
}

/// Maps a unit normal to the octahedron, each axis in 0..=[`NORMAL_LEVELS`].
pub(crate) fn octahedral(normal: [f32; 3]) -> [i32; 2] {
    let sum = normal.iter().map(|v| v.abs()).sum::<f32>().max(1e-12);
    let [x, y, z] = normal.map(|v| v / sum);
    let sign = |v: f32| if v >= 0.0 { 1.0 } else { -1.0 };
    let folded = if z >= 0.0 { [x, y] } else { [(1.0 - y.abs()) * sign(x), (1.0 - x.abs()) * sign(y)] };
    folded.map(|v| ((0.5 * v + 0.5) * NORMAL_LEVELS + 0.5) as i32)
}

/// Returns the unit normal of a point on the octahedron.
pub(crate) fn normal_of(octahedral: [i32; 2]) -> [f32; 3] {
    let [x, y] = octahedral.map(|v| v as f32 / NORMAL_LEVELS * 2.0 - 1.0);
    let z = 1.0 - x.abs() - y.abs();
    let below = (-z).max(0.0);
    let inwards = |v: f32| if v >= 0.0 { v - below } else { v + below };
    let normal = [inwards(x), inwards(y), z];
    let length = libm::sqrtf(normal.iter().map(|v| v * v).sum::<f32>()).max(1e-12);
    normal.map(|v| v / length)
}

#[cfg(test)]
mod tests {
    use alloc::vec::Vec;

    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::range_coder::{RangeDecoder, RangeEncoder};

    #[test]
    fn normals_come_back_to_a_quarter_of_a_degree() {
        let mut random = StdRng::seed_from_u64(6);
        for _ in 0..20_000 {
            let v: [f32; 3] = [0; 3].map(|_| random.random_range(-1.0f32..1.0));
            let length = v.iter().map(|v| v * v).sum::<f32>().sqrt();
            let normal = v.map(|v| v / length);
            let back = normal_of(octahedral(normal));
            let dot: f32 = normal.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!(dot > 0.25f32.to_radians().cos(), "{normal:?} {back:?}");
        }
        // Axes and a normal of no length.
        for normal in [[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0; 3]] {
            assert!(normal_of(octahedral(normal)).iter().all(|v| v.is_finite()), "{normal:?}");
        }
    }

    #[test]
    fn gaussians_come_back() {
        let mut random = StdRng::seed_from_u64(7);
        let gaussians: Vec<Quantised> = (0..500)
            .map(|_| Quantised {
                position: [0; 3].map(|_| random.random_range(0..65_536)),
                normal: [0; 2].map(|_| random.random_range(0..1024)),
                scale: random.random_range(0..1024),
                joints: Influences::new([0; 4].map(|_| random.random_range(0..50)), random.random()),
                nodes: Influences::new([0; 4].map(|_| random.random_range(0..2000)), [0.0, 1.0, 0.0, 0.0]),
            })
            .collect();
        let mut encoder = RangeEncoder::new(Vec::new());
        let mut model = GaussianModel::default();
        let mut before = Quantised::default();
        for gaussian in &gaussians {
            model.code(&mut encoder, &before, gaussian, true);
            before = *gaussian;
        }
        let bytes = encoder.finish();
        let mut decoder = RangeDecoder::new(&bytes);
        let mut model = GaussianModel::default();
        let mut before = Quantised::default();
        for gaussian in &gaussians {
            before = model.code(&mut decoder, &before, &Quantised::default(), true);
            assert_eq!(before, *gaussian);
            assert_eq!(before.nodes.weight.iter().sum::<i32>(), WEIGHT_SUM);
        }
    }
}
