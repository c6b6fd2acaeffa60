//! Transfer from the average body to a person's.

use flyrig_body::Part;
use glam::Vec3;

use crate::clothes::sheet::{Node, Sheet};

/// Transfer of objects made for the average head to a person's.
pub(crate) struct HeadLift<'a> {
    head: Vec<&'a Node>,
}

impl<'a> HeadLift<'a> {
    pub(crate) fn new(body: &'a Sheet) -> Self {
        Self { head: body.nodes.iter().filter(|node| node.part == Part::Head && node.average.y > 1.46).collect() }
    }

    /// Returns the height of the average head's crown, metres.
    pub(crate) fn top_m(&self) -> f32 {
        self.head.iter().map(|node| node.average.y).fold(0.0, f32::max)
    }

    /// Moves a point near the average head like the head's points around it; carried by the closest one.
    pub(crate) fn node(&self, average: Vec3) -> Option<Node> {
        const REACH_M: f32 = 0.035;
        let (closest, nearest) = self
            .head
            .iter()
            .map(|&node| (node, node.average.distance_squared(average)))
            .min_by(|a, b| a.1.total_cmp(&b.1))?;
        let (mut moved, mut total) = (Vec3::ZERO, 0.0);
        for node in &self.head {
            let farther = (node.average.distance_squared(average) - nearest) / (2.0 * REACH_M * REACH_M);
            if farther < 8.0 {
                let weight = (-farther).exp();
                moved += (node.position - node.average) * weight;
                total += weight;
            }
        }
        Some(Node { position: average + moved / total, average, ..*closest })
    }
}
