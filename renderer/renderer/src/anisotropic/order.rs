//! Order of the spherical harmonics of a colour.

/// Order of the harmonics by which the colours of a scene depend on the direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HarmonicOrder {
    /// One colour for all directions.
    Zero,
    /// Colours linear in the direction.
    One,
    /// Colours quadratic in the direction.
    Two,
}

impl HarmonicOrder {
    /// All orders, the lowest first.
    pub const ALL: [Self; 3] = [Self::Zero, Self::One, Self::Two];

    /// Returns the number of coefficients of one colour channel.
    #[must_use]
    pub const fn coefficients(self) -> usize {
        match self {
            Self::Zero => 1,
            Self::One => 4,
            Self::Two => 9,
        }
    }
}
