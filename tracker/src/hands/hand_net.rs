//! The hand landmark network (MediaPipe Hands, Zhang et al. 2020, lite).

use glam::DVec2;

use crate::error::TrackError;
use crate::network::landmark_net::LandmarkNet;

/// Side of the network's crop, pixels.
pub const HAND_SIDE: usize = 224;
/// Number of landmarks of a hand: wrist, then four of each finger from the palm to the tip, thumb first.
pub const HAND_LANDMARKS: usize = 21;

static EMBEDDED: &[u8] = include_bytes!("../../assets/hand_lite.onnx");

/// Network that finds landmarks of a hand in a crop; its licence is beside the file in `assets`.
#[derive(Clone)]
pub struct HandNet {
    net: LandmarkNet,
}

/// Output for one crop.
#[derive(Debug, Clone, PartialEq)]
pub struct HandOutput {
    /// Pixels of the crop, centre of the first pixel at 0.
    pub landmarks: [DVec2; HAND_LANDMARKS],
    /// Probability of a hand.
    pub presence: f64,
}

impl std::fmt::Debug for HandNet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("HandNet")
    }
}

impl HandNet {
    /// Loads the network that is built into this crate. Clone it instead of loading it twice.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the file does not load.
    pub fn embedded() -> Result<Self, TrackError> {
        Self::from_onnx(EMBEDDED)
    }

    /// Loads a network from the bytes of an ONNX file with the outputs of MediaPipe's.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the file does not load or has other inputs or outputs.
    pub fn from_onnx(bytes: &[u8]) -> Result<Self, TrackError> {
        let net = Self { net: LandmarkNet::load(bytes, HAND_SIDE, "hand")? };
        net.run(&net.net.blank())?;
        Ok(net)
    }

    /// Runs one crop: 224 x 224 x 3 RGB in 0..=1, row by row, fingers up.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the length is wrong or an output is missing or not finite.
    pub fn run(&self, rgb: &[f32]) -> Result<HandOutput, TrackError> {
        let outputs = self.net.run(rgb)?;
        let raw = outputs.of_size(HAND_LANDMARKS * 3)?;
        let presence = f64::from(outputs.of_size(1)?[0]).clamp(0.0, 1.0);
        // The network's coordinates have pixel corners at integers.
        let landmarks =
            std::array::from_fn(|i| DVec2::new(f64::from(raw[3 * i]) - 0.5, f64::from(raw[3 * i + 1]) - 0.5));
        Ok(HandOutput { landmarks, presence })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::TrackErrorKind;

    #[test]
    fn the_embedded_network_sees_no_hand_in_grey_and_refuses_a_wrong_size() {
        let net = HandNet::embedded().unwrap();
        let output = net.run(&vec![0.5; HAND_SIDE * HAND_SIDE * 3]).unwrap();
        assert!(output.presence < 0.5, "presence {}", output.presence);
        assert!(output.landmarks.iter().all(|p| p.is_finite()));
        assert_eq!(net.run(&[0.5; 12]).unwrap_err().kind, TrackErrorKind::Net);
    }

    #[test]
    fn damaged_and_foreign_files_and_poisoned_images_are_errors() {
        for bytes in [b"not an ONNX file".as_slice(), b"", &EMBEDDED[..EMBEDDED.len() / 2]] {
            assert_eq!(HandNet::from_onnx(bytes).unwrap_err().kind, TrackErrorKind::Net);
        }
        let face = include_bytes!("../../assets/face.onnx");
        let error = HandNet::from_onnx(face).unwrap_err().to_string();
        assert!(error.contains("convert_mediapipe.py"), "{error}");
        let net = HandNet::embedded().unwrap();
        let poisoned = net.run(&vec![f32::NAN; HAND_SIDE * HAND_SIDE * 3]);
        assert!(poisoned.is_err() || poisoned.is_ok_and(|o| o.landmarks.iter().all(|p| p.is_finite())));
    }
}
