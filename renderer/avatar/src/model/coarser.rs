//! Coarser avatars for small images: pairs of neighbours merged into one Gaussian of their mean, extent and colour.

use flyrig_body::SkinWeights;
use glam::{Mat3, Quat, Vec3};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use rayon::prelude::*;

use crate::model::avatar::Avatar;
use crate::model::parameters::GaussianParameters;
use flyrig_fit::Element;
use flyrig_fit::Neighbors;

/// Least cosine between two normals of one surface: the sides of a sleeve stay apart.
const SAME_SIDE: f32 = 0.5;
/// Least share of skin weights in common: two fingers stay apart.
const SAME_BONES: f32 = 0.5;
/// Least variance along an axis, square metres: no merged Gaussian is thinner than 0.1 mm.
const LEAST_VARIANCE: f64 = 1e-8;

impl Avatar {
    /// Returns the avatar with about half as many Gaussians, for images whose pixels are as large as their distances:
    /// each is merged with the nearest free neighbour on the same side of the surface. Mean, covariance, opacity and
    /// colours of the pair are preserved, weighted by opacity times area; the pair moves with its heavier Gaussian.
    #[must_use]
    pub fn coarser(&self) -> Self {
        let pairs = self.pairs();
        let merged: Vec<_> = pairs.par_iter().with_min_len(256).map(|pair| self.merge(*pair)).collect();
        let order = self.parameters.order();
        let mut parameters = GaussianParameters::zeroed(pairs.len(), order);
        let colors = parameters.harmonics.chunks_exact_mut(order.coefficients());
        for ((i, merged), colors) in merged.into_iter().enumerate().zip(colors) {
            parameters.offset[i] = merged.offset;
            parameters.shape[i] = merged.shape;
            parameters.rotation[i] = merged.rotation;
            colors.copy_from_slice(&merged.harmonics);
        }
        let heavier = || pairs.iter().map(|[heavy, _]| *heavy);
        let hanging = self.hanging.as_ref().map(|hanging| {
            let mut coarse = hanging.clone();
            coarse.gaussian_nodes = heavier().map(|i| hanging.gaussian_nodes[i]).collect();
            coarse.gaussian_weights = heavier().map(|i| hanging.gaussian_weights[i]).collect();
            coarse
        });
        Self {
            template: self.template.clone(),
            undressed: self.undressed.clone(),
            places: heavier().map(|i| self.places[i]).collect(),
            attachments: heavier().map(|i| self.attachments[i]).collect(),
            skin: heavier().map(|i| self.skin[i]).collect(),
            hanging,
            known_poses: self.known_poses.clone(),
            parameters,
            light: self.light.clone(),
            card: self.card.clone(),
        }
    }

    /// Returns the heavier and the lighter Gaussian of each pair; the same one twice where no neighbour was free.
    fn pairs(&self) -> Vec<[usize; 2]> {
        let count = self.gaussians();
        let normals = self.normals();
        let centers: Vec<Vec3> = (0..count).map(|i| self.center(i)).collect();
        let mut edges: Vec<(f32, [usize; 2])> = Vec::new();
        let neighbors = Neighbors::new(&centers);
        for i in 0..count {
            for j in neighbors.of(i).iter().map(|j| *j as usize).filter(|j| *j != i) {
                if normals[i].dot(normals[j]) > SAME_SIDE && shared_weight(&self.skin[i], &self.skin[j]) > SAME_BONES {
                    edges.push((centers[i].distance_squared(centers[j]), [i.min(j), i.max(j)]));
                }
            }
        }
        edges.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut partner: Vec<usize> = (0..count).collect();
        for (_, [i, j]) in edges {
            if partner[i] == i && partner[j] == j {
                (partner[i], partner[j]) = (j, i);
            }
        }
        let ordered = |i: usize, j: usize| if self.weight(i) < self.weight(j) { [j, i] } else { [i, j] };
        partner.iter().enumerate().filter(|(i, j)| *i <= **j).map(|(i, j)| ordered(i, *j)).collect()
    }

    /// Returns the canonical centre, metres.
    fn center(&self, i: usize) -> Vec3 {
        self.places[i] + Vec3::from_slice(&self.parameters.offset[i])
    }

    /// Returns opacity times the area along the two larger axes, square metres.
    fn weight(&self, i: usize) -> f32 {
        let [x, y, z, logit] = self.parameters.shape[i];
        let area = (x + y + z - x.min(y).min(z)).exp();
        area / (1.0 + (-logit).exp())
    }

    fn merge(&self, [heavy, light]: [usize; 2]) -> Merged {
        let GaussianParameters { offset, shape, rotation, harmonics, .. } = &self.parameters;
        let coefficients = self.parameters.order().coefficients();
        let colors_of = |i: usize| &harmonics[i * coefficients..(i + 1) * coefficients];
        let own = || Merged {
            offset: offset[heavy],
            shape: shape[heavy],
            rotation: rotation[heavy],
            harmonics: colors_of(heavy).to_vec(),
        };
        let weights = [heavy, light].map(|i| f64::from(self.weight(i)));
        let sum = weights[0] + weights[1];
        if heavy == light || !sum.is_normal() {
            return own();
        }
        let shares = weights.map(|weight| weight / sum);
        let both = |value: &dyn Fn(usize) -> f64| shares[0] * value(heavy) + shares[1] * value(light);
        let between = (self.center(light) - self.center(heavy)).as_dvec3();
        let apart = Vector3::from(between.to_array());
        let covariance = self.covariance(heavy) * shares[0]
            + self.covariance(light) * shares[1]
            + apart * apart.transpose() * (shares[0] * shares[1]);
        let Some(axes) = SymmetricEigen::try_new(covariance, 1e-15, 100) else { return own() };
        let opacity = both(&|i| 1.0 / (1.0 + (-f64::from(shape[i][3])).exp())).clamp(1e-6, 1.0 - 1e-6);
        let [x, y, z] = [0, 1, 2].map(|k| (0.5 * axes.eigenvalues[k].max(LEAST_VARIANCE).ln()) as f32);
        let [first, second] =
            [0, 1].map(|k| Vec3::from_slice(axes.eigenvectors.column(k).map(|v| v as f32).as_slice()));
        // Eigenvectors may be a mirrored frame.
        let turn = Quat::from_mat3(&Mat3::from_cols(first, second, first.cross(second)));
        let moved = Vec3::from_slice(&offset[heavy]) + (shares[1] * between).as_vec3();
        let mut colors = colors_of(heavy).to_vec();
        for (row, other) in colors.iter_mut().zip(colors_of(light)) {
            (0..4).for_each(|k| row[k] = (shares[0] * f64::from(row[k]) + shares[1] * f64::from(other[k])) as f32);
        }
        Merged {
            offset: moved.extend(0.0).to_array(),
            shape: [x, y, z, (opacity / (1.0 - opacity)).ln() as f32],
            rotation: turn.normalize().to_array(),
            harmonics: colors,
        }
    }

    /// Returns the canonical covariance, square metres.
    fn covariance(&self, i: usize) -> Matrix3<f64> {
        let [x, y, z, _] = self.parameters.shape[i];
        let axes = Mat3::from_quat(Quat::from_array(self.parameters.rotation[i]).normalize()).as_dmat3();
        let axes = Matrix3::from_column_slice(&axes.to_cols_array());
        let variances = Vector3::new(x, y, z).map(|logarithm| f64::from(2.0 * logarithm).exp());
        axes * Matrix3::from_diagonal(&variances) * axes.transpose()
    }
}

/// Merges the attributes of two Gaussians.
struct Merged {
    offset: Element,
    shape: Element,
    rotation: Element,
    harmonics: Vec<Element>,
}

/// Returns the skin weight that two Gaussians have in common.
fn shared_weight(a: &SkinWeights, b: &SkinWeights) -> f32 {
    let in_b = |joint: u16| {
        b.joints.iter().zip(b.weights).filter(|(other, _)| **other == joint).map(|(_, weight)| weight).sum::<f32>()
    };
    a.joints
        .iter()
        .zip(a.weights)
        .filter(|(_, weight)| *weight > 0.0)
        .map(|(joint, weight)| weight.min(in_b(*joint)))
        .sum()
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat};

    use super::*;
    use crate::model::avatar::tests::small;

    /// Computes the moments of all Gaussians in the rest pose: weight, mean, second moments, mean colour.
    fn moments(avatar: &Avatar) -> (f64, glam::DVec3, DMat3, glam::DVec3) {
        let (mut sum, mut mean, mut second, mut color) = (0.0, glam::DVec3::ZERO, DMat3::ZERO, glam::DVec3::ZERO);
        for i in 0..avatar.gaussians() {
            let [x, y, z, logit] = avatar.parameters.shape[i].map(f64::from);
            let mut scales = [x.exp(), y.exp(), z.exp()];
            let turn = DQuat::from_array(avatar.parameters.rotation[i].map(f64::from)).normalize();
            let axes = DMat3::from_quat(turn) * DMat3::from_diagonal(scales.into());
            scales.sort_by(f64::total_cmp);
            let weight = scales[1] * scales[2] / (1.0 + (-logit).exp());
            let center = avatar.places[i].as_dvec3() + Vec3::from_slice(&avatar.parameters.offset[i]).as_dvec3();
            let outer = DMat3::from_cols(center * center.x, center * center.y, center * center.z);
            sum += weight;
            mean += weight * center;
            second += (axes * axes.transpose() + outer) * weight;
            color += weight
                * Vec3::from_slice(&avatar.parameters.harmonics[i * avatar.parameters.order().coefficients()])
                    .as_dvec3();
        }
        (sum, mean / sum, second * (1.0 / sum), color / sum)
    }

    #[test]
    fn a_pair_keeps_its_moments() {
        let mut avatar = small(2, 1);
        // Beside each other on one bone, wide and narrow.
        avatar.places[1] = avatar.places[0] + Vec3::new(0.01, 0.002, -0.004);
        (avatar.attachments[1], avatar.skin[1]) = (avatar.attachments[0], avatar.skin[0]);
        avatar.parameters.shape = vec![[-5.0, -4.6, -6.0, 3.0], [-4.4, -5.5, -4.9, 0.5]];
        avatar.parameters.rotation[1] = Quat::from_rotation_y(0.7).to_array();
        let coefficients = avatar.parameters.order().coefficients();
        (avatar.parameters.harmonics[0], avatar.parameters.harmonics[coefficients]) =
            ([1.0, 0.2, 0.0, 0.0], [0.0, 0.4, 2.0, 0.0]);
        let coarse = avatar.coarser();
        coarse.check().unwrap();
        assert_eq!(coarse.gaussians(), 1);
        let ((_, mean, second, color), (_, found_mean, found_second, found_color)) =
            (moments(&avatar), moments(&coarse));
        assert!(mean.distance(found_mean) < 1e-6 && color.distance(found_color) < 1e-5, "{color} {found_color}");
        let error = (second - found_second).to_cols_array().iter().fold(0.0f64, |most, v| most.max(v.abs()));
        assert!(error < 1e-7, "{error}: {second} {found_second}");
        // Opacity is the mean by weight: between those of the two.
        assert!((0.5..3.0).contains(&coarse.parameters.shape[0][3]));
    }

    #[test]
    fn sides_and_bones_stay_apart() {
        let avatar = small(6000, 7);
        let (normals, coarse) = (avatar.normals(), avatar.coarser());
        coarse.check().unwrap();
        assert!((3000..4000).contains(&coarse.gaussians()), "{}", coarse.gaussians());
        for [i, j] in avatar.pairs() {
            assert!(normals[i].dot(normals[j]) > 0.4 && shared_weight(&avatar.skin[i], &avatar.skin[j]) > 0.4);
        }
        let mut all: Vec<usize> = avatar.pairs().into_iter().flatten().collect();
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), 6000);
    }

    #[test]
    fn poison_stays_in_its_pair() {
        let mut avatar = small(500, 7);
        avatar.parameters.shape[3] = [f32::NAN; 4];
        avatar.parameters.offset[4] = [f32::INFINITY; 4];
        avatar.parameters.rotation[5] = [0.0; 4];
        avatar.parameters.shape[6][3] = f32::NEG_INFINITY;
        let coarse = avatar.coarser();
        let poisoned = coarse
            .parameters
            .lists()
            .iter()
            .flat_map(|list| list.iter())
            .filter(|row| row.iter().any(|v| !v.is_finite()))
            .count();
        assert!(poisoned <= 8 && (200..400).contains(&coarse.gaussians()), "{poisoned}");
        assert_eq!(small(1, 1).coarser().gaussians(), 1);
    }
}
