//! Learnt attributes of an avatar's Gaussians, in canonical space.

use flyrig_renderer::HarmonicOrder;
use rayon::prelude::*;

/// An element of every list: four numbers.
pub(crate) type Element = [f32; 4];

/// Learnt attributes: a row a Gaussian, but as many rows of harmonics as their order has coefficients. Derivatives have the same form.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussianParameters {
    /// Offset from the Gaussian's place on the surface, canonical metres; w unused.
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
    /// All zero, but rotations, which are the identity.
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

    /// From lists of these lengths; None where they do not belong together.
    #[must_use]
    pub fn from_lists([offset, shape, rotation, harmonics]: [Vec<Element>; 4]) -> Option<Self> {
        let count = offset.len();
        let order = HarmonicOrder::ALL.into_iter().find(|order| harmonics.len() == count * order.coefficients())?;
        (shape.len() == count && rotation.len() == count).then_some(Self { offset, shape, rotation, harmonics, order })
    }

    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.offset.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.offset.is_empty()
    }

    /// Order of the colours.
    #[must_use]
    pub fn order(&self) -> HarmonicOrder {
        self.order
    }

    /// The lists: offset, shape, rotation, harmonics.
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

    /// Whether every number is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.lists().iter().all(|list| list.par_iter().all(|row| row.iter().all(|value| value.is_finite())))
    }
}
