//! Where a rig's images come from, as far as advice depends on it.

/// Origin of the images. A simulated camera has no cable, and a file no trigger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ImageOrigin {
    /// Cameras of this computer.
    #[default]
    Cameras,
    /// Cameras of other computers.
    Network,
    /// Simulated cameras.
    Simulated,
    /// Stored images, videos and recordings.
    Stored,
}

impl ImageOrigin {
    /// Returns what to do about a camera that sends nothing and reports no error.
    #[must_use]
    pub fn silence_advice(self) -> &'static str {
        match self {
            Self::Cameras => "look at its trigger, its cable and its bus",
            Self::Network => "look at its computer and at the network between",
            Self::Simulated => {
                "the simulator takes longer than that for an image: simulate smaller images or fewer cameras, or set \
                 source.real_time = false"
            }
            Self::Stored => "its file takes longer than that to read: copy it to a faster disk",
        }
    }

    /// Returns what to do about a camera thread that does not come back.
    #[must_use]
    pub(crate) fn stuck_advice(self) -> &'static str {
        match self {
            Self::Cameras => "unplug its camera and plug it in again",
            Self::Network | Self::Simulated | Self::Stored => "start flyrig again if it stays so",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_camera_of_this_computer_has_a_cable() {
        let others = [ImageOrigin::Network, ImageOrigin::Simulated, ImageOrigin::Stored];
        for advice in others.map(|origin| [origin.silence_advice(), origin.stuck_advice()]).concat() {
            let words = ["cable", "trigger", "plug", "bus"];
            assert!(words.iter().all(|word| !advice.contains(word)), "{advice}");
        }
        assert!(ImageOrigin::default().silence_advice().contains("cable"));
    }
}
