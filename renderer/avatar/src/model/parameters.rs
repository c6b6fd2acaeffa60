//! Learned attributes of an avatar's Gaussians, in canonical space.

use flyrig_fit::Element;
use flyrig_renderer::HarmonicOrder;
use rayon::prelude::*;

/// Learned attributes: one row per Gaussian, and one row of harmonics per coefficient. Derivatives have the same form.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussianParameters {
    /// Offset from the Gaussian's position on the surface, canonical metres; w unused.
    pub offset: Vec<Element>,
    /// Logarithms of the standard deviations along the Gaussian's own axes in metres; w: logit of the opacity.
    pub shape: Vec<Element>,
    /// Quaternion x, y, z, w: canonical from the Gaussian's axes.
    pub rotation: Vec<Element>,
    /// Coefficients of linear RGB in world directions; w unused.
    pub harmonics: Vec<Element>,
    order: HarmonicOrder,
}

impl GaussianParameters {
    /// Creates zero attributes with identity rotations.
    #[must_use]
    pub fn zeroed(count: usize, order: HarmonicOrder) -> Self {
        Self {
            offset: vec![[0.0; 4]; count],
            shape: vec![[0.0; 4]; count],
            rotation: vec![[0.0, 0.0, 0.0, 1.0]; count],
            harmonics: vec![[0.0; 4]; count * order.coefficients()],
            order,
        }
    }

    /// Assembles lists; `None` where their lengths do not match.
    #[must_use]
    pub fn from_lists([offset, shape, rotation, harmonics]: [Vec<Element>; 4]) -> Option<Self> {
        let count = offset.len();
        let order = HarmonicOrder::ALL.into_iter().find(|order| harmonics.len() == count * order.coefficients())?;
        (shape.len() == count && rotation.len() == count).then_some(Self { offset, shape, rotation, harmonics, order })
    }

    /// Returns the number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.offset.len()
    }

    /// Returns whether there are no Gaussians.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.offset.is_empty()
    }

    /// Returns the harmonic order of the colours.
    #[must_use]
    pub fn order(&self) -> HarmonicOrder {
        self.order
    }

    /// Returns the lists: offset, shape, rotation, harmonics.
    #[must_use]
    pub fn lists(&self) -> [&[Element]; 4] {
        [&self.offset, &self.shape, &self.rotation, &self.harmonics]
    }

    pub(crate) fn lists_mut(&mut self) -> [&mut [Element]; 4] {
        [&mut self.offset, &mut self.shape, &mut self.rotation, &mut self.harmonics]
    }

    /// Appends a Gaussian of one colour: coefficients of order zero, linear RGB.
    pub(crate) fn push(&mut self, shape: Element, rotation: Element, constant: Element) {
        self.offset.push([0.0; 4]);
        self.shape.push(shape);
        self.rotation.push(rotation);
        self.harmonics.push(constant);
        self.harmonics.resize(self.len() * self.order.coefficients(), [0.0; 4]);
    }

    /// Moves every number by a share, 0..=1, of its difference to `target`, which has the same form.
    pub fn approach(&mut self, target: &Self, share: f32) {
        for (list, target) in self.lists_mut().into_iter().zip(target.lists()) {
            list.par_iter_mut().zip(target).with_min_len(1024).for_each(|(row, target)| {
                // At the end exactly: differences are rounded.
                *row =
                    if share >= 1.0 { *target } else { std::array::from_fn(|k| row[k] + share * (target[k] - row[k])) };
            });
        }
    }

    /// Returns whether every number is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.lists().iter().all(|list| list.par_iter().all(|row| row.iter().all(|value| value.is_finite())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_equal_size_end_exactly_at_the_target() {
        let mut from = GaussianParameters::zeroed(3, HarmonicOrder::Zero);
        let mut target = from.clone();
        target.offset[1] = [0.1, -0.3, 7.0, 0.0];
        target.harmonics[2] = [0.7, 1e-9, -2.0, 0.0];
        for left in (1..=10u16).rev() {
            from.approach(&target, 1.0 / f32::from(left));
            let done = f32::from(11 - left) / 10.0;
            assert!((from.offset[1][2] - 7.0 * done).abs() < 1e-4, "{} after {done}", from.offset[1][2]);
        }
        assert_eq!(from, target);
        target.shape[0][3] = f32::NAN;
        from.approach(&target, 0.5);
        let poisoned = from.lists().concat().as_flattened().iter().filter(|value| value.is_nan()).count();
        assert_eq!(poisoned, 1, "poison stays where it is");
    }
}
