//! Level of effort: the work that a frame set gets.

use serde::Serialize;

/// Work that a frame set gets. Everything that is left out costs accuracy; docs/benchmarks/budget.md has the prices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Effort {
    /// Largest number of views on which the pose network runs again; 0: all in which the body has moved.
    pub looks: usize,
    /// Crops of an image on which the network runs in a search for a person; 0: all.
    pub search_crops: usize,
    /// Largest number of rounds in which the pose is matched with outlines and texture.
    pub rounds: usize,
    /// Whether coverage and colours along outlines are solved for.
    pub mattes: bool,
    /// Frame sets from one solve of the deformation to the next.
    pub solve_every: u32,
    /// Frame sets from one painting to the next, networks included.
    pub paint_every: u32,
}

impl Effort {
    /// All work in every frame set.
    pub const FULL: Self = Self { looks: 0, search_crops: 3, rounds: 2, mattes: true, solve_every: 1, paint_every: 1 };

    /// Levels from all work to little. Each gives up what costs the fewest decibels per millisecond.
    pub const LEVELS: [Self; 7] = {
        let mut levels = [Self::FULL; 7];
        levels[1] = Self { mattes: false, ..levels[0] };
        levels[2] = Self { paint_every: 2, ..levels[1] };
        levels[3] = Self { rounds: 1, ..levels[2] };
        levels[4] = Self { solve_every: 2, search_crops: 2, ..levels[3] };
        levels[5] = Self { looks: 2, search_crops: 1, ..levels[4] };
        levels[6] = Self { solve_every: 3, paint_every: 3, ..levels[5] };
        levels
    };
}

impl Default for Effort {
    fn default() -> Self {
        Self::FULL
    }
}
