//! Mapping of Gaussians to the texels of the atlas that colour them (LoGAvatar Eq. 14), and a first atlas from the
//! Gaussians' colours.

use flyrig_renderer::HarmonicOrder;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

use crate::error::AvatarError;
use flyrig_fit::Element;

/// Layout of the surface in the atlas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AtlasLayout {
    /// Texture coordinates of the body.
    #[default]
    Uv,
    /// Front and back views: two charts, split at the mean depth.
    FrontBack,
}

/// Border of the charts of front and back, texels.
const BORDER: f32 = 2.0;

/// Bilinear sample: four texels and their weights.
type Taps = [(u32, f32); 4];

/// Positions of the Gaussians in an atlas.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AtlasMap {
    /// Number of square charts.
    pub charts: usize,
    /// Texels along a side.
    pub side: usize,
    /// Bilinear sample of each Gaussian.
    pub taps: Vec<Taps>,
}

impl AtlasMap {
    /// Maps Gaussians at canonical `places` with texture coordinates `uvs`.
    pub fn new(layout: AtlasLayout, places: &[Vec3], uvs: &[Vec2], side: usize) -> Result<Self, AvatarError> {
        let side = side.max(1);
        let (charts, points) = match layout {
            AtlasLayout::Uv => {
                let first = uvs.first().copied().unwrap_or_default();
                if uvs.len() != places.len() || (uvs.len() > 1 && uvs.iter().all(|uv| *uv == first)) {
                    return Err(AvatarError::Networks(
                        "the body has no texture coordinates; use --atlas front-back, or a body with a texture"
                            .to_owned(),
                    ));
                }
                (1, uvs.iter().map(|uv| (0, *uv * side as f32 - 0.5)).collect())
            }
            AtlasLayout::FrontBack => (2, front_back(places, side)),
        };
        Ok(Self { charts, side, taps: points.into_iter().map(|(chart, point)| taps(chart, point, side)).collect() })
    }

    /// Returns the number of texels of a chart.
    pub fn texels(&self) -> usize {
        self.side * self.side
    }

    /// Returns an atlas of linear RGB coefficients (chart, channel, row, column) whose samples approximate these
    /// harmonics of order 0. Texels that no Gaussian touches get the colour around them.
    pub fn splat(&self, harmonics: &[Element], order: HarmonicOrder) -> Vec<f32> {
        let texels = self.texels();
        let mut sums = vec![[0.0f64; 4]; self.charts * texels];
        for (taps, row) in self.taps.iter().zip(harmonics.chunks_exact(order.coefficients())) {
            for (texel, share) in taps.iter().filter(|_| row[0].iter().all(|value| value.is_finite())) {
                let sum = &mut sums[*texel as usize];
                let share = f64::from(*share);
                (0..3).for_each(|k| sum[k] += share * f64::from(row[0][k]));
                sum[3] += share;
            }
        }
        fill(&mut sums, self.side);
        let value = |i: usize| {
            let (chart, channel, texel) = (i / (3 * texels), i / texels % 3, i % texels);
            let sum = sums[chart * texels + texel];
            (sum[channel] / sum[3].max(1e-12)) as f32
        };
        (0..self.charts * 3 * texels).map(value).collect()
    }

    /// Adds the samples of an atlas to the harmonics; `channels` is three per coefficient.
    pub fn query(&self, atlas: &[f32], channels: usize, harmonics: &mut [Element], coefficients: usize) {
        let texels = self.texels();
        harmonics.par_chunks_mut(coefficients).zip(&self.taps).with_min_len(1024).for_each(|(rows, taps)| {
            for channel in 0..channels.min(3 * coefficients) {
                for (texel, share) in taps {
                    let (chart, texel) = (*texel as usize / texels, *texel as usize % texels);
                    let value = atlas.get((chart * channels + channel) * texels + texel).copied().unwrap_or(0.0);
                    rows[channel / 3][channel % 3] += share * value;
                }
            }
        });
    }

    /// Returns the derivatives with respect to the atlas from those with respect to the harmonics, summed in the order
    /// of the Gaussians.
    pub fn backward(&self, slopes: &[Element], coefficients: usize) -> Vec<f32> {
        let (texels, channels) = (self.texels(), 3 * coefficients);
        let mut atlas = vec![0.0; self.charts * channels * texels];
        atlas.par_chunks_mut(texels).enumerate().for_each(|(plane, out)| {
            let (chart, channel) = (plane / channels, plane % channels);
            for (rows, taps) in slopes.chunks_exact(coefficients).zip(&self.taps) {
                if taps[0].0 as usize / texels != chart {
                    continue;
                }
                for (texel, share) in taps {
                    out[*texel as usize % texels] += share * rows[channel / 3][channel % 3];
                }
            }
        });
        atlas
    }
}

fn taps(chart: usize, point: Vec2, side: usize) -> Taps {
    let axis = |value: f32| {
        let last = side - 1;
        // A NaN becomes 0.
        let at = if value > 0.0 { value.min(last as f32) } else { 0.0 };
        let low = (at as usize).min(last);
        (low, (low + 1).min(last), at - low as f32)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (axis(point.x), axis(point.y));
    let texel = |x: usize, y: usize| ((chart * side + y) * side + x) as u32;
    [
        (texel(x0, y0), (1.0 - fx) * (1.0 - fy)),
        (texel(x1, y0), fx * (1.0 - fy)),
        (texel(x0, y1), (1.0 - fx) * fy),
        (texel(x1, y1), fx * fy),
    ]
}

/// Returns chart and texel of each position: canonical x to the right and y up, both charts at one scale.
fn front_back(places: &[Vec3], side: usize) -> Vec<(usize, Vec2)> {
    let mean = places.iter().map(|place| f64::from(place.z)).sum::<f64>() / places.len().max(1) as f64;
    let lowest = places.iter().copied().reduce(Vec3::min).unwrap_or_default().truncate();
    let highest = places.iter().copied().reduce(Vec3::max).unwrap_or_default().truncate();
    let scale = (side as f32 - 1.0 - 2.0 * BORDER).max(0.0) / (highest - lowest).max_element().max(1e-3);
    let center = (lowest + highest) * 0.5;
    places
        .iter()
        .map(|place| {
            let from_center = (place.truncate() - center) * scale;
            let chart = usize::from(f64::from(place.z) < mean);
            (chart, Vec2::splat((side as f32 - 1.0) * 0.5) + Vec2::new(from_center.x, -from_center.y))
        })
        .collect()
}

/// Fills empty texels from their neighbours, ring by ring.
fn fill(sums: &mut [[f64; 4]], side: usize) {
    for chart in sums.chunks_mut(side * side) {
        let mut empty: Vec<usize> = (0..chart.len()).filter(|i| chart[*i][3] <= 0.0).collect();
        while !empty.is_empty() {
            let around = |i: &usize| {
                let (x, y) = (i % side, i / side);
                let beside = [
                    (x > 0, i.wrapping_sub(1)),
                    (x + 1 < side, i + 1),
                    (y > 0, i.wrapping_sub(side)),
                    (y + 1 < side, i + side),
                ];
                let mut sum = [0.0; 4];
                for (_, j) in beside.into_iter().filter(|(inside, j)| *inside && chart[*j][3] > 0.0) {
                    (0..3).for_each(|k| sum[k] += chart[j][k] / chart[j][3]);
                    sum[3] += 1.0;
                }
                sum
            };
            let found: Vec<[f64; 4]> = empty.par_iter().with_min_len(1024).map(around).collect();
            if found.iter().all(|sum| sum[3] <= 0.0) {
                // A chart without any Gaussian.
                break;
            }
            let mut rest = Vec::new();
            for (i, sum) in empty.into_iter().zip(found) {
                if sum[3] > 0.0 { chart[i] = sum } else { rest.push(i) }
            }
            empty = rest;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> (Vec<Vec3>, Vec<Vec2>) {
        let at = |i: usize| ((i % 9) as f32 / 8.0, (i / 9) as f32 / 8.0);
        let places = (0..81).map(|i| Vec3::new(at(i).0, 1.7 * at(i).1, if i % 2 == 0 { 0.1 } else { -0.1 })).collect();
        (places, (0..81).map(|i| Vec2::new(at(i).0, at(i).1) * 0.9 + 0.05).collect())
    }

    #[test]
    fn the_first_atlas_gives_the_colors_back_and_derivatives_are_the_transpose() {
        let (places, uvs) = grid();
        for layout in [AtlasLayout::Uv, AtlasLayout::FrontBack] {
            let map = AtlasMap::new(layout, &places, &uvs, 64).unwrap();
            let order = HarmonicOrder::One;
            let mut wanted = vec![[0.0; 4]; 81 * order.coefficients()];
            (0..81).for_each(|i| wanted[i * order.coefficients()] = [i as f32 / 81.0, 0.3, -0.5, 0.0]);
            let atlas = map.splat(&wanted, order);
            assert!(atlas.iter().all(|value| value.is_finite()));
            let mut found = vec![[0.0; 4]; wanted.len()];
            map.query(&atlas, 3, &mut found, order.coefficients());
            for (found, wanted) in found.iter().zip(&wanted) {
                assert!((0..3).all(|k| (found[k] - wanted[k]).abs() < 0.02), "{layout:?} {found:?} {wanted:?}");
            }
            // <slopes, query(atlas)> = <backward(slopes), atlas>.
            let channels = 3 * order.coefficients();
            let atlas: Vec<f32> = (0..map.charts * channels * 64 * 64).map(|i| (i as f32 * 0.3).sin()).collect();
            let slopes: Vec<Element> =
                (0..wanted.len()).map(|i| [0.2, 1.0, -0.4, 0.0].map(|v| v * (i as f32).cos())).collect();
            let mut found = vec![[0.0; 4]; wanted.len()];
            map.query(&atlas, channels, &mut found, order.coefficients());
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
            let (left, right) = (
                dot(found.as_flattened(), slopes.as_flattened()),
                dot(&map.backward(&slopes, order.coefficients()), &atlas),
            );
            assert!((left - right).abs() < 1e-4, "{left} {right}");
        }
    }

    #[test]
    fn bodies_without_coordinates_are_named_and_odd_ones_stay_in_the_atlas() {
        let (places, _) = grid();
        let error = AtlasMap::new(AtlasLayout::Uv, &places, &[Vec2::ZERO; 81], 64).unwrap_err().to_string();
        assert!(error.contains("--atlas front-back"), "{error}");
        let odd = [Vec2::NAN, Vec2::splat(-7.0), Vec2::splat(7.0)];
        let map = AtlasMap::new(AtlasLayout::Uv, &places[..3], &odd, 8).unwrap();
        assert!(map.taps.iter().flatten().all(|(texel, share)| *texel < 64 && share.is_finite()));
        assert!(
            AtlasMap::new(AtlasLayout::FrontBack, &[], &[], 8).unwrap().splat(&[], HarmonicOrder::Zero).len() == 6 * 64
        );
    }
}
