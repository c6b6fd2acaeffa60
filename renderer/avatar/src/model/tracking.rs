//! Avatar as the Gaussians of live tracking: their surface, and the same Gaussians hung on another deformation graph.

use std::sync::Arc;

use flyrig_body::{BodyError, DeformationGraph, SurfaceGaussians, attached_surface, displacement};
use glam::{DVec3, Vec3, Vec4};

use crate::model::avatar::{Avatar, Hanging};

impl Avatar {
    /// Returns one surface Gaussian for each of the avatar's: the points of [`Self::template`] that they are attached to.
    ///
    /// # Errors
    /// [`BodyError::Mesh`] for an avatar whose lists do not belong together.
    pub fn attached_surface(&self) -> Result<SurfaceGaussians, BodyError> {
        let attachments: Vec<_> = self.attachments.iter().map(|a| (a.triangle, a.barycentric)).collect();
        let positions = self.attachments.iter().map(|a| a.blend(&self.template, &self.template.positions)).collect();
        attached_surface(&self.template, &attachments, positions, self.skin.clone())
    }

    /// Returns the avatar deformed by `graph`, which was built for [`Self::attached_surface`]. Its mean shape stays the same.
    #[must_use]
    pub fn hung_on(&self, graph: &DeformationGraph) -> Self {
        let hanging = Hanging {
            nodes: graph.nodes.clone(),
            gaussian_nodes: graph.gaussian_nodes.clone(),
            gaussian_weights: graph.gaussian_weights.clone(),
            mean: self.mean_on(graph),
        };
        Self { hanging: Some(hanging), ..self.clone() }
    }

    /// Returns this avatar where it hangs on `graph` already, else [`Self::hung_on`].
    #[must_use]
    pub fn shared_on(self: &Arc<Self>, graph: &DeformationGraph) -> Arc<Self> {
        let hangs = self.hanging.as_ref().is_some_and(|hanging| {
            hanging.nodes == graph.nodes
                && hanging.gaussian_nodes == graph.gaussian_nodes
                && hanging.gaussian_weights == graph.gaussian_weights
        });
        if hangs { Arc::clone(self) } else { Arc::new(self.hung_on(graph)) }
    }

    /// Returns the mean translations of the nodes of `graph`: those of the Gaussians at the nodes, where it is another graph
    /// than the avatar's own.
    fn mean_on(&self, graph: &DeformationGraph) -> Vec<DVec3> {
        let Some(Hanging { nodes, gaussian_nodes, gaussian_weights, mean }) = &self.hanging else {
            return vec![DVec3::ZERO; graph.nodes.len()];
        };
        if *nodes == graph.nodes {
            return mean.clone();
        }
        let of_node = |&gaussian: &u32| {
            let hung = gaussian_nodes.get(gaussian as usize).zip(gaussian_weights.get(gaussian as usize));
            let by = hung.map(|(around, weights)| displacement(nodes, mean, *around, *weights));
            by.map_or(DVec3::ZERO, |by| Vec4::from(by).truncate().as_dvec3())
        };
        graph.node_gaussian.iter().map(of_node).collect()
    }

    /// Returns the canonical position of each Gaussian without deformation, metres.
    #[must_use]
    pub fn centers(&self) -> Vec<Vec3> {
        self.places.iter().zip(&self.parameters.offset).map(|(place, by)| *place + Vec4::from(*by).truncate()).collect()
    }
}

#[cfg(test)]
mod tests {
    use flyrig_body::{DEFAULT_SIGMA2_M2, build_graph, sample_surface};

    use super::*;
    use crate::model::avatar::tests::{random_pose, small};
    use crate::model::posing::{Bones, PosedAvatar};

    /// Returns an avatar whose clothes hang two centimetres beside the body.
    fn dressed() -> Avatar {
        let mut avatar = small(3000, 60);
        avatar.hanging.as_mut().unwrap().mean.iter_mut().for_each(|mean| *mean = DVec3::new(0.0, 0.0, 0.02));
        avatar
    }

    #[test]
    fn the_surface_is_that_which_the_avatar_was_made_of() {
        let avatar = dressed();
        let sampled = sample_surface(&avatar.template, 3000, 5).unwrap();
        let attached = avatar.attached_surface().unwrap();
        let off = attached.positions.iter().zip(&sampled.positions).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(off < 1e-6, "{off}");
        assert_eq!(
            (&attached.triangle, &attached.parts, &attached.skin),
            (&sampled.triangle, &sampled.parts, &sampled.skin)
        );
        let graph = build_graph(&avatar.template, &attached, 60, DEFAULT_SIGMA2_M2).unwrap();
        let Hanging { nodes, .. } = avatar.hanging.as_ref().unwrap();
        assert_eq!(&graph.nodes, nodes, "the same graph");
        assert_eq!(avatar.hung_on(&graph), avatar);
        let shared = Arc::new(avatar.clone());
        assert!(Arc::ptr_eq(&shared, &shared.shared_on(&graph)));
        let broken = Avatar { skin: Vec::new(), ..avatar };
        assert!(broken.attached_surface().is_err());
    }

    #[test]
    fn on_another_graph_the_mean_shape_stays() {
        let avatar = dressed();
        let graph = build_graph(&avatar.template, &avatar.attached_surface().unwrap(), 90, DEFAULT_SIGMA2_M2).unwrap();
        let hung = Arc::new(avatar.clone()).shared_on(&graph);
        assert_eq!(hung.hanging.as_ref().unwrap().mean.len(), 90);
        let bones = Bones::new(&avatar.template.skeleton, &random_pose(&avatar, 3).0);
        let (mut before, mut after) = (PosedAvatar::default(), PosedAvatar::default());
        avatar.pose(&bones, None, &mut before);
        hung.pose(&bones, None, &mut after);
        for (a, b) in before.center.iter().zip(&after.center) {
            assert!(Vec3::from_slice(a).distance(Vec3::from_slice(b)) < 1e-5, "{a:?} {b:?}");
        }
        let none = Avatar { hanging: None, ..avatar };
        assert!(none.hung_on(&graph).hanging.unwrap().mean.iter().all(|mean| *mean == DVec3::ZERO));
        assert_eq!(none.centers().len(), 3000);
    }
}
