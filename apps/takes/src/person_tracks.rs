//! Landmarks and silhouettes of one moving person, from which a rig is calibrated.

use anyhow::{Result, ensure};
use flyrig_body::{ShapeParams, default_template};
use flyrig_calib::{CalibError, OutlineCorner, PersonFit, PersonOptions, PersonTracks, calibrate_person};
use flyrig_sync::{HullCorner, silhouette_hull};
use flyrig_tracker::{PoseConfig, PoseNet, Viewers};
use flyrig_types::{FrameSet, Image, Rig};
use glam::DVec2;

/// Indices of the landmarks in use in the network's output: nose, eyes, ears, shoulders to wrists, index fingers, hips to toes.
const LANDMARKS: [usize; 23] = [0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 19, 20, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32];
/// Pairs of landmarks at a constant distance.
const LIMBS: [(usize, usize); 17] = [
    (7, 8),
    (0, 7),
    (0, 8),
    (2, 5),
    (11, 12),
    (11, 13),
    (13, 15),
    (12, 14),
    (14, 16),
    (23, 24),
    (23, 25),
    (25, 27),
    (24, 26),
    (26, 28),
    (27, 29),
    (28, 30),
    (29, 31),
];
/// Groups of (left, right) landmarks that the network confuses together: face, arms, legs.
const MIRRORED: [&[(usize, usize)]; 3] =
    [&[(2, 5), (7, 8)], &[(11, 12), (13, 14), (15, 16), (19, 20)], &[(23, 24), (25, 26), (27, 28), (29, 30), (31, 32)]];
/// Median reprojection error, as a fraction of the image's longer side, beyond which a camera shows another person.
const MOST_ERROR: f64 = 0.02;
/// Least confidence of a landmark.
const CONFIDENCE: f64 = 0.3;

/// Finder of a person's landmarks and silhouettes, in each camera independently.
pub struct PersonFinder {
    viewers: Viewers,
    /// One per calibration; the same landmarks, but silhouettes as seen through its lenses.
    calibrations: Vec<(Rig, PersonTracks)>,
}

impl PersonFinder {
    /// Creates a finder for calibrations of the same cameras, at least one. `plates` are images of the empty scene, one per slot.
    ///
    /// # Errors
    /// The network cannot be loaded, or a plate does not fit its camera.
    pub fn new(calibrations: &[Rig], plates: Vec<Option<Image>>) -> Result<Self> {
        let Some(first) = calibrations.first() else { anyhow::bail!("no calibration") };
        let template = default_template(&ShapeParams::default())?;
        let viewers = Viewers::new(&PoseNet::embedded()?, &template, first, plates, &PoseConfig::default())?;
        let empty = |rig: &Rig| (rig.clone(), PersonTracks::new(rig.cameras.len(), LANDMARKS.len()));
        Ok(Self { viewers, calibrations: calibrations.iter().map(empty).collect() })
    }

    /// Adds a frame set.
    ///
    /// # Errors
    /// An image cannot be read by the network.
    pub fn add(&mut self, set: &FrameSet) -> Result<()> {
        for (slot, found) in self.viewers.estimate(set)?.into_iter().enumerate() {
            let (Some(found), Some(frame)) = (found, &set.frames[slot]) else { continue };
            let keypoints = found.keypoints.into_iter().next().flatten();
            for (rig, tracks) in &mut self.calibrations {
                if let Some(mask) = found.masks.iter().flatten().next() {
                    let corner = |corner: HullCorner| OutlineCorner { ray: corner.ray, is_cut: corner.is_cut };
                    let hull = silhouette_hull(&rig.cameras[slot], mask).into_iter().map(corner).collect();
                    tracks.add_outline(slot, frame.capture_nanos, hull);
                }
                let Some(keypoints) = &keypoints else { continue };
                let seen = LANDMARKS.iter().map(|landmark| keypoints[*landmark]).map(|point| {
                    let is_good = point.usable() && point.confidence >= CONFIDENCE;
                    is_good.then_some((point.pixel, point.confidence))
                });
                tracks.add(slot, frame.capture_nanos, &seen.collect::<Vec<Option<(DVec2, f64)>>>());
            }
        }
        Ok(())
    }

    /// Returns calibrations and tracks, in the order of [`Self::new`].
    ///
    /// # Errors
    /// Names a camera that sees nobody.
    pub fn into_tracks(self) -> Result<Vec<(Rig, PersonTracks)>> {
        for (rig, tracks) in &self.calibrations {
            for (slot, camera) in rig.cameras.iter().enumerate() {
                ensure!(
                    tracks.images(slot) > 0,
                    "camera {}: no person is seen; let one person move where all cameras see them whole",
                    camera.id
                );
            }
        }
        Ok(self.calibrations)
    }
}

/// Refines poses and time offsets of a rig from tracks of a [`PersonFinder`].
///
/// # Errors
/// See [`calibrate_person`].
pub fn fit_person(rig: &Rig, tracks: &PersonTracks, options: PersonOptions) -> Result<PersonFit, CalibError> {
    let number = |landmark: usize| LANDMARKS.iter().position(|known| *known == landmark);
    let numbers = |pairs: &[(usize, usize)]| -> Vec<(usize, usize)> {
        pairs.iter().filter_map(|(a, b)| Some((number(*a)?, number(*b)?))).collect()
    };
    calibrate_person(rig, tracks, &numbers(&LIMBS), &MIRRORED.map(numbers), options)
}

/// Checks that all cameras see the same person.
///
/// # Errors
/// Names the camera whose landmarks are far from those of the others.
pub fn ensure_same_person(rig: &Rig, fit: &PersonFit) -> Result<()> {
    for (camera, solved) in rig.cameras.iter().zip(&fit.cameras) {
        let side = f64::from(camera.intrinsics.width.max(camera.intrinsics.height));
        ensure!(
            solved.error_px.1 < MOST_ERROR * side,
            "camera {}: its landmarks are {:.0} px off those of the other cameras: one person alone may be in view, and the calibration \
             must be roughly right",
            camera.id,
            solved.error_px.1
        );
    }
    Ok(())
}
