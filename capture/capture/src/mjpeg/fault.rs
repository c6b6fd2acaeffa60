//! Faults of a JPEG image's data.

use std::fmt;

/// Fault of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    /// Marker segment with impossible content.
    Header,
    /// Bits that are no Huffman code.
    Code,
    /// More coefficients than a block has, or one that 8-bit images cannot have.
    Coefficient,
    /// Mean of a block outside of black to white.
    Mean,
    /// Data that end before the last block.
    Early,
    /// Bytes behind the last block.
    Surplus,
    /// Padding bits that are not 1.
    Padding,
    /// Restart marker that is missing or out of order, or another marker within the data.
    Marker,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Header => "a header segment is impossible",
            Self::Code => "its data hold a code that does not exist",
            Self::Coefficient => "its data hold an impossible coefficient",
            Self::Mean => "a block is blacker than black or whiter than white",
            Self::Early => "its data end too early",
            Self::Surplus => "data are left behind its last block",
            Self::Padding => "its data do not end with padding",
            Self::Marker => "a marker is missing or out of order",
        })
    }
}

impl std::error::Error for Fault {}
