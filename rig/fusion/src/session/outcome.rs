//! Results of a session: the outcome of one frame set, and counts over all.

/// Result of one frame set.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// At least one person was posed and painted.
    Updated,
    /// Nothing has moved in any image for a while, so the frame set was left out to save time. Needs a budget.
    Still,
    /// No person was updated, for this reason.
    Held(String),
}

/// Counts of updates, and of the faults after which a session continued, over all people.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Number of updates of people.
    pub updated: u64,
    /// Number of people without a usable pose in a frame set, summed over the frame sets.
    pub lost: u64,
    /// Number of images without a mask of a person, or with an empty one.
    pub without_mask: u64,
    /// Number of updates whose deformation was dropped because of a non-finite number.
    pub poisoned: u64,
}
