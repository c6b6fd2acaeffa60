//! Spatial and temporal smoothness, FlyHuman Eq. 4.

use glam::DVec3;

/// Eq. 4 over the directed edges of the graph, times λ_reg.
#[derive(Debug)]
pub(super) struct Regularizer {
    /// Directed edges (node, neighbour); a node without neighbours has none.
    pub edges: Vec<(u32, u32)>,
    /// λ_reg λ_spat.
    pub spatial: f64,
    /// λ_reg λ_temp.
    pub temporal: f64,
    /// Price of every node's distance from where its pose puts it.
    pub anchor: f64,
    /// Whether there were frames before this one; the temporal term is off without.
    pub history: bool,
}

impl Regularizer {
    /// Weight of the Laplacian's edges in the second derivative, times the identity.
    pub(super) fn stiffness(&self) -> f64 {
        2.0 * (self.spatial + self.temporal())
    }

    fn temporal(&self) -> f64 {
        if self.history { self.temporal } else { 0.0 }
    }

    /// The loss at translations `t` with smoothed translations `smooth`; adds the gradient where asked.
    pub(super) fn loss(&self, t: &[DVec3], smooth: &[DVec3], mut gradient: Option<&mut [DVec3]>) -> f64 {
        let (mut loss, temporal) = (0.0, self.temporal());
        if self.anchor > 0.0 {
            loss += self.anchor * t.iter().map(|t| t.length_squared()).sum::<f64>();
            for (gradient, t) in gradient.iter_mut().flat_map(|gradient| gradient.iter_mut()).zip(t) {
                *gradient += 2.0 * self.anchor * *t;
            }
        }
        for &(i, j) in &self.edges {
            let (i, j) = (i as usize, j as usize);
            let spread = t[i] - t[j];
            let change = spread - (smooth[i] - smooth[j]);
            loss += self.spatial * spread.length_squared() + temporal * change.length_squared();
            if let Some(gradient) = gradient.as_deref_mut() {
                let pull = 2.0 * (self.spatial * spread + temporal * change);
                gradient[i] += pull;
                gradient[j] -= pull;
            }
        }
        loss
    }
}
