//! The pose network: BlazePose (Bazarevsky et al. 2020), or one of the user's choice.

use std::path::Path;

use crate::error::{TrackError, TrackErrorKind};
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::landmarks::keypoints::{LANDMARK_COUNT, Sharpness};
use crate::network::chosen_net::ChosenNet;
use crate::network::heatmap::{HEATMAP_SIDE, Heatmaps};
use crate::network::landmark_net::{LandmarkNet, LoadedNet, sigmoid};
use crate::network::network_file::read_onnx;
use crate::network::output::{CropLandmark, NET_SIDE, NetOutput};

/// Floats per landmark in BlazePose's output.
const LANDMARK_STRIDE: usize = 5;
/// Landmarks of BlazePose: 33 of the body, and 6 helpers of the original's tracking that are not used.
const NET_LANDMARKS: usize = 39;

/// Pixels of the crop per cell of a heatmap.
const PX_PER_CELL: f64 = (NET_SIDE / HEATMAP_SIDE) as f64;
/// Numbers of BlazePose's mask.
const MASK_SIZE: usize = NET_SIDE * NET_SIDE;

static FULL: &[u8] = include_bytes!("../../assets/pose_full.onnx");
static LITE: &[u8] = include_bytes!("../../assets/pose_lite.onnx");

/// Network that finds a person's landmarks: one of those built in (BlazePose full and lite; licence beside the files in
/// `assets`), another BlazePose, or one of the user's choice.
#[derive(Clone)]
pub struct PoseNet {
    kind: Kind,
}

#[derive(Clone)]
enum Kind {
    BlazePose { net: LandmarkNet, has_mask: bool },
    Chosen(Box<ChosenNet>),
}

impl std::fmt::Debug for PoseNet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("PoseNet")
    }
}

impl PoseNet {
    /// Loads BlazePose full, which is built into this crate. Takes a few hundred milliseconds; clone it instead of loading it
    /// twice.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the file does not load.
    pub fn embedded() -> Result<Self, TrackError> {
        Self::blazepose(FULL, true)
    }

    /// Loads the network that a setting names: "full" (or nothing) and "lite" are built in, an ONNX file holds another
    /// BlazePose (`assets/convert_mediapipe.py`), and any other file describes a network of the user's choice
    /// (docs/guide/people.md). Leaves out BlazePose's mask, a fifth of the work, unless `with_mask`.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] names the file, and the key where one is wrong.
    pub fn load(network: &Path, with_mask: bool) -> Result<Self, TrackError> {
        if let Some(bytes) = built_in(network) {
            return Self::blazepose(bytes, with_mask);
        }
        let failed = |what: String| TrackError::new(TrackErrorKind::Net, format!("{}: {what}", network.display()));
        let hint = "\"full\" and \"lite\" are built in, an .onnx file holds another BlazePose, a .toml file describes any other network";
        std::fs::metadata(network).map_err(|error| failed(format!("{error}; {hint}")))?;
        if network.extension().is_none_or(|extension| extension != "onnx") {
            return Ok(Self { kind: Kind::Chosen(Box::new(ChosenNet::read(network)?)) });
        }
        Self::blazepose(&read_onnx(network)?, with_mask).map_err(|error| failed(error.message))
    }

    /// Whether a setting names a built-in network.
    #[must_use]
    pub fn is_built_in(network: &Path) -> bool {
        built_in(network).is_some()
    }

    /// Loads a network from the bytes of an ONNX file with BlazePose's outputs, which are identified by their sizes, and runs it
    /// once.
    fn blazepose(bytes: &[u8], has_mask: bool) -> Result<Self, TrackError> {
        let loaded = LoadedNet::of_crops(bytes, NET_SIDE, "pose")?;
        let net = if has_mask { loaded } else { loaded.without_output(MASK_SIZE)? }.runnable()?;
        run_blazepose(&net, &net.blank(), has_mask)?;
        Ok(Self { kind: Kind::BlazePose { net, has_mask } })
    }

    /// Whether outputs hold the depth of landmarks.
    #[must_use]
    pub fn sees_depth(&self) -> bool {
        matches!(self.kind, Kind::BlazePose { .. })
    }

    /// Returns the body landmarks of a crop of 256 x 256 x 3 values (RGB in 0..=1, row by row), metres from the middle of the
    /// hips in the axes of the crop. For comparisons with other runtimes; the tracker itself crops images.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the crop has another size, the network fails or is one of the user's choice.
    pub fn crop_world_landmarks(&self, rgb: &[f32]) -> Result<Vec<[f64; 3]>, TrackError> {
        match &self.kind {
            Kind::BlazePose { net, has_mask } => {
                let output = run_blazepose(net, rgb, *has_mask)?;
                Ok(output.landmarks.iter().filter_map(|landmark| landmark.world).collect())
            }
            Kind::Chosen(net) => Err(net.takes_no_crop()),
        }
    }

    /// Runs the network on a square of an image.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the network fails, or an output is missing or not finite.
    pub(crate) fn infer(&self, picture: &Rgb, crop: Crop) -> Result<NetOutput, TrackError> {
        match &self.kind {
            Kind::BlazePose { net, has_mask } => run_blazepose(net, &crop.sample(picture), *has_mask),
            Kind::Chosen(net) => net.infer(picture, crop),
        }
    }
}

/// Returns the ONNX file of a built-in network by its name.
fn built_in(network: &Path) -> Option<&'static [u8]> {
    match network.to_str()? {
        "" | "full" => Some(FULL),
        "lite" => Some(LITE),
        _ => None,
    }
}

/// Runs BlazePose on a crop of 256 x 256 x 3 values, RGB in 0..=1, row by row.
fn run_blazepose(net: &LandmarkNet, rgb: &[f32], has_mask: bool) -> Result<NetOutput, TrackError> {
    let outputs = net.run(rgb)?;
    let find = |count| outputs.of_size(count);
    let raw = find(NET_LANDMARKS * LANDMARK_STRIDE)?;
    let world = find(NET_LANDMARKS * 3)?;
    let heatmaps = find(NET_LANDMARKS * HEATMAP_SIDE * HEATMAP_SIDE)?;
    let heatmaps = Heatmaps::new(&heatmaps, NET_LANDMARKS);
    let presence = f64::from(find(1)?[0]).clamp(0.0, 1.0);
    let logits = has_mask.then(|| find(MASK_SIZE)).transpose()?;
    let mask = logits.map(|logits| logits.into_iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect());
    let mut landmarks = [CropLandmark::default(); LANDMARK_COUNT];
    for (i, landmark) in landmarks.iter_mut().enumerate() {
        let [x, y, _, visible, present] = std::array::from_fn(|k| f64::from(raw[i * LANDMARK_STRIDE + k]));
        let peak = heatmaps.as_ref().and_then(|maps| maps.peak(i, [x, y].map(|at| at / PX_PER_CELL)));
        let [x, y] = peak.map_or([x, y], |peak| peak.at.map(|at| at * PX_PER_CELL));
        *landmark = CropLandmark {
            // The network's coordinates have pixel corners at integers.
            x: x - 0.5,
            y: y - 0.5,
            confidence: sigmoid(visible).min(sigmoid(present)),
            sharpness: peak.map_or(Sharpness::NoPeak, |peak| peak.sharpness()),
            world: Some(std::array::from_fn(|k| f64::from(world[i * 3 + k]))),
        };
    }
    Ok(NetOutput { landmarks, presence, mask })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::TrackErrorKind;

    fn grey() -> Rgb<'static> {
        Rgb { width: NET_SIDE, height: NET_SIDE, bytes: vec![128; NET_SIDE * NET_SIDE * 3].into() }
    }

    fn whole() -> Crop {
        Crop::upright(glam::DVec2::splat(0.5 * NET_SIDE as f64 - 0.5), NET_SIDE as f64)
    }

    #[test]
    fn the_embedded_network_sees_nobody_in_grey_and_refuses_a_wrong_size() {
        let net = PoseNet::embedded().unwrap();
        let output = net.infer(&grey(), whole()).unwrap();
        let without = PoseNet::load(Path::new(""), false).unwrap().infer(&grey(), whole()).unwrap();
        assert!(
            without.mask.is_none() && without.landmarks == output.landmarks,
            "the mask's branch changes nothing else"
        );
        assert!(output.presence < 0.5, "presence {}", output.presence);
        let mask = output.mask.unwrap();
        assert_eq!(mask.len(), NET_SIDE * NET_SIDE);
        assert!(mask.iter().all(|p| (0.0..=1.0).contains(p)));
        let Kind::BlazePose { net, .. } = net.kind else { panic!("the embedded network is BlazePose") };
        assert_eq!(run_blazepose(&net, &[0.5; 12], true).unwrap_err().kind, TrackErrorKind::Net);
    }

    #[test]
    fn runs_from_many_threads_and_from_rayons_own_do_not_meet() {
        use rayon::prelude::*;
        let net = PoseNet::embedded().unwrap();
        let run = |_| net.infer(&grey(), whole()).unwrap().presence.to_bits();
        let expected = run(0);
        std::thread::scope(|scope| {
            for thread in 0..4 {
                scope.spawn(move || match thread % 2 {
                    0 => (0..8).into_par_iter().for_each(|i| assert_eq!(run(i), expected)),
                    _ => (0..8).for_each(|i| assert_eq!(run(i), expected)),
                });
            }
        });
    }

    #[test]
    fn networks_are_loaded_by_name_and_by_file() {
        let output = |network: &Path| PoseNet::load(network, true).unwrap().infer(&grey(), whole()).unwrap();
        let full = output(Path::new(""));
        assert_eq!(output(Path::new("full")).landmarks, full.landmarks);
        let lite = output(Path::new("lite"));
        assert!(lite.landmarks != full.landmarks && lite.presence < 0.5, "presence {}", lite.presence);
        let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/pose_lite.onnx"));
        assert_eq!(output(file).landmarks, lite.landmarks);

        let refused = |path: &Path| PoseNet::load(path, true).unwrap_err().to_string();
        let unknown = refused(Path::new("light"));
        assert!(unknown.contains("light") && unknown.contains("\"full\" and \"lite\" are built in"), "{unknown}");
        let folder = tempfile::tempdir().unwrap();
        let other = folder.path().join("face.onnx");
        std::fs::write(&other, b"not an ONNX file").unwrap();
        let damaged = refused(&other);
        assert!(damaged.contains("face.onnx") && damaged.contains("convert_mediapipe.py"), "{damaged}");
    }

    #[test]
    fn a_damaged_file_is_an_error() {
        assert_eq!(PoseNet::blazepose(b"not an ONNX file", true).unwrap_err().kind, TrackErrorKind::Net);
        assert_eq!(PoseNet::blazepose(&FULL[..FULL.len() / 2], true).unwrap_err().kind, TrackErrorKind::Net);
    }
}
