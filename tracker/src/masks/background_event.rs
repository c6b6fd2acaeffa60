//! Changes of a camera's background that the user has to know of.

use std::fmt;

/// Change of a background, reported once.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum BackgroundEvent {
    /// This share of the image away from people differs from the plate, 0..=1; the plate is ignored until it has been
    /// relearnt.
    Changed(f64),
    /// The plate is in use again.
    Recovered,
    /// The image is shifted against the plate by this many pixels (x, y).
    Shifted(i64, i64),
    /// This share of the image, 0..=1, centred on a pixel, differs from the plate although no person is tracked there.
    Differs(f64, [u32; 2]),
}

impl fmt::Display for BackgroundEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Changed(share) => write!(
                f,
                "{:.0} % of the background differs from the plate (lights switched, or a plate of another scene); masks do \
                 without the plate until the background has been relearnt where no person stands",
                100.0 * share
            ),
            Self::Recovered => f.write_str("the background has been relearnt and is in use again"),
            Self::Shifted(x, y) => write!(
                f,
                "the image is shifted by {x}, {y} pixels against the plate: the camera was moved; calibrate again and \
                 record new plates (`flyrig plate`); until then masks learn the background where no person stands"
            ),
            Self::Differs(share, [x, y]) => write!(
                f,
                "{:.1} % of the image around pixel {x}, {y} differ from the plate away from tracked people: something was moved, \
                 or a person stood in the plate; it is being relearnt; recording the plate again (`flyrig plate`) is more accurate",
                100.0 * share
            ),
        }
    }
}
