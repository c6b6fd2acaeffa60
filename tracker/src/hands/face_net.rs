//! The face landmark network (MediaPipe Face Mesh, Kartynnik et al. 2019).

use glam::DVec2;

use crate::error::TrackError;
use crate::network::landmark_net::{LandmarkNet, sigmoid};

/// Side of the network's crop, pixels.
pub const FACE_SIDE: usize = 192;
/// Number of landmarks on the surface of a face.
pub const FACE_LANDMARKS: usize = 468;

static EMBEDDED: &[u8] = include_bytes!("../../assets/face.onnx");

/// Network that finds landmarks of a face in a crop; its licence is beside the file in `assets`.
#[derive(Clone)]
pub struct FaceNet {
    net: LandmarkNet,
}

/// Output for one crop.
#[derive(Debug, Clone, PartialEq)]
pub struct FaceOutput {
    /// Pixels of the crop, centre of the first pixel at 0; [`FACE_LANDMARKS`] of them.
    pub landmarks: Vec<DVec2>,
    /// Probability of a face.
    pub presence: f64,
}

impl std::fmt::Debug for FaceNet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("FaceNet")
    }
}

impl FaceNet {
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
        let net = Self { net: LandmarkNet::load(bytes, FACE_SIDE, "face")? };
        net.run(&net.net.blank())?;
        Ok(net)
    }

    /// Runs one crop: 192 x 192 x 3 RGB in 0..=1, row by row, eyes level.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the length is wrong or an output is missing or not finite.
    pub fn run(&self, rgb: &[f32]) -> Result<FaceOutput, TrackError> {
        let outputs = self.net.run(rgb)?;
        let raw = outputs.of_size(FACE_LANDMARKS * 3)?;
        let presence = sigmoid(f64::from(outputs.of_size(1)?[0]));
        // The network's coordinates have pixel corners at integers.
        let landmark = |p: &[f32]| DVec2::new(f64::from(p[0]) - 0.5, f64::from(p[1]) - 0.5);
        Ok(FaceOutput { landmarks: raw.chunks_exact(3).map(landmark).collect(), presence })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::TrackErrorKind;

    #[test]
    fn the_embedded_network_sees_no_face_in_grey_and_refuses_a_wrong_size() {
        let net = FaceNet::embedded().unwrap();
        let output = net.run(&vec![0.5; FACE_SIDE * FACE_SIDE * 3]).unwrap();
        assert!(output.presence < 0.5, "presence {}", output.presence);
        assert_eq!(output.landmarks.len(), FACE_LANDMARKS);
        assert_eq!(net.run(&[0.5; 12]).unwrap_err().kind, TrackErrorKind::Net);
    }

    #[test]
    fn damaged_files_are_errors() {
        for bytes in [b"not an ONNX file".as_slice(), b"", &EMBEDDED[..EMBEDDED.len() / 2]] {
            assert_eq!(FaceNet::from_onnx(bytes).unwrap_err().kind, TrackErrorKind::Net);
        }
    }
}
