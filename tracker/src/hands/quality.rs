//! Quality of hands and head.

/// Source of a hand's fingers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HandState {
    /// Fitted to landmarks of at least one view.
    Fitted,
    /// Relaxed: the hand is too small in every view.
    TooSmall,
    /// Relaxed: the network finds no hand where it should be.
    NotSeen,
    /// Relaxed: landmarks do not agree with a hand of this body.
    Disagrees,
}

/// Quality of one hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandQuality {
    /// Source of the fingers.
    pub state: HandState,
    /// Length of the hand in the view where it is largest, pixels; 0 when no camera sees it.
    pub largest_px: f64,
    /// Views whose landmarks were used.
    pub views: usize,
    /// Median distance of the landmarks from the fitted hand, pixels; `None` unless fitted.
    pub residual_px: Option<f64>,
}

/// Quality of the head.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HeadQuality {
    /// Views whose landmarks were used; with 0 the head keeps the body's pose.
    pub views: usize,
    /// Rotation away from the body's pose, radians.
    pub turned_rad: f64,
    /// Median distance of the landmarks from the fitted face, pixels; `None` unless fitted.
    pub residual_px: Option<f64>,
}

/// Quality of hands and head.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HandsQuality {
    /// Left, right.
    pub hands: [HandQuality; 2],
    /// Head.
    pub head: HeadQuality,
    /// Crops that the hand network and the face network ran on.
    pub crops: [usize; 2],
    /// Time of the networks and of the fits, seconds.
    pub seconds: [f64; 2],
}

impl HandsQuality {
    /// Returns the number of hands that were fitted to landmarks.
    #[must_use]
    pub fn fitted(&self) -> usize {
        self.hands.iter().filter(|hand| hand.state == HandState::Fitted).count()
    }
}
