//! Times of the images in one frame set: cameras expose one after the other, and a person moves meanwhile.

use flyrig_types::Pose;

use super::inputs::InputView;

/// Distinct instants of a frame set: its own first, then the others at which images were taken.
pub(super) struct Instants<'a> {
    poses: Vec<&'a Pose>,
    of_view: Vec<usize>,
}

impl<'a> Instants<'a> {
    /// Collects the distinct poses of the views; `pose` is that of the frame set's time.
    pub fn new(pose: &'a Pose, views: &[InputView<'a>]) -> Self {
        let mut poses = vec![pose];
        let of_view = views
            .iter()
            .map(|view| {
                let Some(own) = view.pose else { return 0 };
                poses.iter().position(|known| *known == own).unwrap_or_else(|| {
                    poses.push(own);
                    poses.len() - 1
                })
            })
            .collect();
        Self { poses, of_view }
    }

    /// Returns the pose at each instant; at least one.
    pub fn poses(&self) -> &[&'a Pose] {
        &self.poses
    }

    /// Returns the index of a view's instant; 0 is the frame set's own.
    pub fn of_view(&self, view: usize) -> usize {
        self.of_view[view]
    }
}
