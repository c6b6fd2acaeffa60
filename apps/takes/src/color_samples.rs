//! Colours of people's surfaces in the images of several cameras, from which the cameras are matched.

use anyhow::Result;
use flyrig_body::{ShapeParams, default_template};
use flyrig_calib::{ColorPoint, ColorSample};
use flyrig_fusion::{
    EstimatedPerception, Observed, Origin, PerceptionSettings, Session, SessionBuilder, SessionSettings, Subject,
    TrackState,
};
use flyrig_gpu::GpuContext;
use flyrig_types::{FrameSet, Image, Rig};
use glam::DVec2;

/// Number of Gaussians per person: enough for colours, in a quarter of the time.
const GAUSSIANS: usize = 30_000;
/// Number of points per person and frame set.
const POINTS: usize = 2000;
/// Least weight of the viewing angle (Eq. 7) and least proximity exp(-k d) to the rendered surface of a point in a view.
const LEAST_WEIGHT: f32 = 0.1;
const LEAST_NEARNESS: f32 = 0.85;
/// Image width over half the side of the square that a colour is averaged in.
const REACH: u32 = 200;
/// Range of sRGB values in the square, relative to their mean, at which a sample's weight is halved, and beyond which it is 0.
const EVEN: (f64, f64) = (0.05, 0.5);

/// Sampler of the colours of tracked people.
pub struct ColorSampler {
    session: Session,
    rig: Rig,
    sets: u64,
    points: Vec<ColorPoint>,
}

impl ColorSampler {
    /// Creates a sampler. Colours are taken as they are in the images: `rig` has no corrections. `first` are frame sets from which shapes
    /// are estimated; people who come later are measured then. `given_masks` uses the frames' own masks.
    ///
    /// # Errors
    /// The network or the graphics adapter fails, or a plate does not fit its camera.
    pub fn new(
        rig: &Rig,
        plates: &[Option<Image>],
        given_masks: bool,
        people: usize,
        first: &[FrameSet],
        gpu: GpuContext,
    ) -> Result<Self> {
        let perception = PerceptionSettings {
            masks: if given_masks { Origin::Given } else { Origin::Estimated },
            people,
            ..PerceptionSettings::default()
        };
        let template = default_template(&ShapeParams::default())?;
        let mut settings = SessionSettings { perception, ..SessionSettings::default() };
        settings.body.gaussians = GAUSSIANS;
        settings.validate()?;
        let mut estimated = EstimatedPerception::new(rig, &template, &settings.perception, plates)?;
        if let Err(error) = estimated.learn_shapes(first) {
            tracing::debug!(%error, "no person in the first frame sets");
        }
        let mut session = SessionBuilder::new(gpu, rig.clone()).settings(settings).perception(estimated).build()?;
        session.keep_observations()?;
        Ok(Self { session, rig: rig.clone(), sets: 0, points: Vec::new() })
    }

    /// Tracks the people of a frame set, and samples their colours where `samples`.
    ///
    /// # Errors
    /// Those of [`Session::process`].
    pub fn add(&mut self, set: &FrameSet, samples: bool) -> Result<()> {
        self.session.process(set)?;
        if !samples {
            return Ok(());
        }
        self.sets += 1;
        let people: Vec<_> = self.session.subjects().iter().map(Subject::id).collect();
        for person in people {
            if self.session.subject(person).is_some_and(|subject| subject.watch().state() == TrackState::Steady) {
                let observed = self.session.observed(person)?;
                self.points.extend(seen(&self.rig, &observed, self.sets));
            }
        }
        Ok(())
    }

    /// Returns the sampled points.
    #[must_use]
    pub fn into_points(self) -> Vec<ColorPoint> {
        self.points
    }
}

/// Samples the points that at least two views see well.
fn seen(rig: &Rig, observed: &Observed, instant: u64) -> Vec<ColorPoint> {
    let views = &observed.observations.views;
    let count = observed.center_scale.len();
    let sample = |view: usize, gaussian: usize| {
        let [x, y, weight, nearness] = *views.get(view)?.get(gaussian)?;
        if weight < LEAST_WEIGHT || nearness < LEAST_NEARNESS {
            return None;
        }
        let (camera, (width, height, rgba)) = (*observed.slots.get(view)?, observed.pictures.get(view)?);
        let (srgb, evenness) = srgb_at([*width, *height], rgba, [x, y])?;
        let intrinsics = &rig.cameras.get(camera)?.intrinsics;
        let diagonal = DVec2::new(f64::from(*width), f64::from(*height)).length();
        let r = DVec2::new(x.into(), y.into()).distance(intrinsics.center_px) / (0.5 * diagonal);
        Some(ColorSample { camera, srgb, r2: r * r, weight: evenness * f64::from(weight) })
    };
    let point = |gaussian| {
        let samples: Vec<ColorSample> = (0..views.len()).filter_map(|view| sample(view, gaussian)).collect();
        (samples.len() > 1).then_some(ColorPoint { instant, samples })
    };
    let all: Vec<ColorPoint> = (0..count).filter_map(point).collect();
    let step = all.len().div_ceil(POINTS).max(1);
    // Different points each time.
    all.into_iter().skip(instant as usize % step).step_by(step).collect()
}

/// Returns the mean sRGB values around a pixel of an image with the mask as alpha, and their weight, 0 to 1: on a patterned surface,
/// a small position error is a colour error. `None` at the mask's edge and outside.
fn srgb_at([width, height]: [u32; 2], rgba: &[u8], [x, y]: [f32; 2]) -> Option<([f64; 3], f64)> {
    let reach = i64::from(width / REACH).max(1);
    let (x, y) = (x.round() as i64, y.round() as i64);
    if x < reach || y < reach || x + reach >= i64::from(width) || y + reach >= i64::from(height) {
        return None;
    }
    let (mut sums, mut least, mut most) = ([0u32; 3], [u8::MAX; 3], [0u8; 3]);
    for row in y - reach..=y + reach {
        let from = 4 * (row as usize * width as usize + (x - reach) as usize);
        for pixel in rgba.get(from..from + 4 * (2 * reach as usize + 1))?.chunks_exact(4) {
            if pixel[3] < 255 {
                return None;
            }
            for k in 0..3 {
                sums[k] += u32::from(pixel[k]);
                (least[k], most[k]) = (least[k].min(pixel[k]), most[k].max(pixel[k]));
            }
        }
    }
    let count = (2 * reach + 1).pow(2) as f64;
    let mean: [f64; 3] = sums.map(|sum| f64::from(sum) / (255.0 * count));
    let range = (0..3).map(|k| f64::from(most[k] - least[k]) / (255.0 * mean[k])).fold(0.0, f64::max);
    // Black gives NaN, which does not compare below.
    (range < EVEN.1).then(|| (mean, 1.0 / (1.0 + (range / EVEN.0).powi(2))))
}
