//! Spatial and temporal smoothness (FlyHuman Eq. 4), and the anchor.

use glam::DVec3;

use crate::deform::thickness::Thickness;

/// Terms of Eq. 4 over the directed edges of the graph, times λ_reg.
#[derive(Debug)]
pub(super) struct Regularizer {
    /// Directed edges (node, neighbour) with their stiffness; a node without neighbours has none.
    pub edges: Vec<(u32, u32, f64)>,
    /// λ_reg λ_spat.
    pub spatial: f64,
    /// λ_reg λ_temp.
    pub temporal: f64,
    /// Weight of every node's squared distance from the place of its pose.
    pub anchor: f64,
    /// Translations of the nodes in the mean shape, canonical metres, from which spatial smoothness and the anchor are measured.
    pub mean: Vec<DVec3>,
    /// Whether there were frame sets before this one; the temporal term is off without.
    pub history: bool,
}

impl Regularizer {
    /// Returns the factor of the graph Laplacian in the second derivative.
    pub(super) fn stiffness(&self) -> f64 {
        2.0 * (self.spatial + self.temporal())
    }

    fn temporal(&self) -> f64 {
        if self.history { self.temporal } else { 0.0 }
    }

    /// Returns the loss at translations `t` with smoothed translations `smooth`, and adds its gradient to `gradient`.
    /// Spatial smoothness and the anchor are measured from the mean shape and `thickness` beyond it.
    pub(super) fn loss(
        &self,
        t: &[DVec3],
        smooth: &[DVec3],
        thickness: Option<&Thickness>,
        mut gradient: Option<&mut [DVec3]>,
    ) -> f64 {
        let offset = |node: usize| self.mean[node] + thickness.map_or(DVec3::ZERO, |thickness| thickness.offset(node));
        let (mut loss, temporal) = (0.0, self.temporal());
        if self.anchor > 0.0 {
            let off = |(node, t): (usize, &DVec3)| *t - offset(node);
            loss += self.anchor * t.iter().enumerate().map(|at| off(at).length_squared()).sum::<f64>();
            for (gradient, at) in gradient.iter_mut().flat_map(|gradient| gradient.iter_mut()).zip(t.iter().enumerate())
            {
                *gradient += 2.0 * self.anchor * off(at);
            }
        }
        for &(i, j, stiff) in &self.edges {
            let (i, j) = (i as usize, j as usize);
            let apart = t[i] - t[j];
            let change = apart - (smooth[i] - smooth[j]);
            let spread = apart - (offset(i) - offset(j));
            loss += stiff * (self.spatial * spread.length_squared() + temporal * change.length_squared());
            if let Some(gradient) = gradient.as_deref_mut() {
                let pull = 2.0 * stiff * (self.spatial * spread + temporal * change);
                gradient[i] += pull;
                gradient[j] -= pull;
            }
        }
        loss
    }
}
