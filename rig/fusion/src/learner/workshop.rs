//! Fit of an avatar to key sets, in rounds.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use flyrig_avatar::{Avatar, AvatarFitSettings, AvatarModel, KnownPoses, TrainingFrame};
use flyrig_body::{Skeleton, Template};
use flyrig_fit::{Fit, FitSettings, TrainingView};
use flyrig_gpu::GpuContext;
use flyrig_stream::EncodedTemplate;
use flyrig_types::{CameraId, Rig};

use super::{
    judge::{Compared, Judge},
    key_sets::{Choice, KeySet, is_held_back},
};
use crate::{
    error::FusionError,
    settings::session::SessionSettings,
    subject::{avatar_stream::encode_tracked_avatar, surface::GraphedSurface},
};

/// Steps of a round before any version was proven, and of a later one.
const TRIAL_STEPS: u32 = 200;
const ROUND_STEPS: u32 = 300;
/// Share of a fit's course at which later rounds begin: their rates are lower.
const LATER: f32 = 0.4;
/// Least number of cameras of which one is left out of the first rounds.
const LEAST_CAMERAS: usize = 3;
/// Least number of key sets of the first round: to fit to, and held back.
const LEAST_FITTED: usize = 6;
const LEAST_HELD_BACK: usize = 2;
/// New key sets that start a round after one without success.
const FRESH: usize = 4;
/// Newer held-back key sets of a pose that was known after which the version in use is compared again.
const UNCHECKED: usize = 2;
/// Growth of the error in use from which a round begins.
const WORSE: f64 = 1.1;
/// Share of the error in use below which a version is adopted.
const BETTER: f64 = 0.99;

/// Start of a workshop.
#[derive(Debug)]
pub(crate) struct Beginning {
    pub gpu: GpuContext,
    pub rig: Rig,
    pub settings: SessionSettings,
    pub template: Template,
    /// Body of a person in a skirt or coat.
    pub undressed: Option<Template>,
    pub base: Arc<GraphedSurface>,
    /// Avatar that the person is made of already.
    pub in_use: Option<Arc<Avatar>>,
    /// Set when comparisons are to end early.
    pub stopped: Arc<AtomicBool>,
}

/// Result of a round.
#[derive(Debug, Clone)]
pub(crate) struct Verdict {
    /// Change of the person.
    pub change: Change,
    pub round: u32,
    /// Key sets that were not held back.
    pub fitted: usize,
    /// Error on the key sets that were held back, of the person in use and of the new version.
    pub errors: [f64; 2],
    /// Time of the work since the last result.
    pub took: Duration,
}

/// Change of the person after a round.
#[derive(Debug, Clone)]
pub(crate) enum Change {
    /// The version in use is better.
    Keep,
    /// The new version is better on key sets that were held back, but was fitted to all cameras: another round must confirm it.
    Prove,
    /// The person becomes an avatar, for which viewers get this template.
    Adopt { avatar: Arc<Avatar>, stream: Arc<EncodedTemplate> },
    /// The avatar in use does not fit the person any more.
    Drop,
}

/// Fit of one person's avatar.
#[derive(Debug)]
pub(crate) struct Workshop {
    gpu: GpuContext,
    /// Avatar as the last round left it; `None` during a round, and where the next one begins with the surface.
    avatar: Option<Arc<Avatar>>,
    in_use: Option<Arc<Avatar>>,
    judge: Judge,
    /// Key sets by slot.
    sets: BTreeMap<usize, (u64, KeySet)>,
    /// Number of key sets that came so far.
    came: u64,
    fit: Option<Fit<AvatarModel>>,
    steps: u32,
    rounds: u32,
    /// Key sets that came since the last round began and show something new.
    fresh: usize,
    /// Held-back key sets that came since the last comparison and show what is known.
    unchecked: usize,
    /// Error of the version in use when it was compared last, and the camera.
    error_in_use: Option<(CameraId, f64)>,
    /// Whether the last round was a success.
    succeeded: bool,
    /// Whether a version was better on key sets, and with [`LEAST_CAMERAS`] in a camera, that it was not fitted to.
    proven: bool,
    /// Skeleton of the tracked person, and whether a graph deforms it.
    skeleton: Skeleton,
    is_deformed: bool,
    /// Body of a person in a skirt or coat.
    undressed: Option<Template>,
    /// Time of the work since the last result.
    took: Duration,
    /// Cameras of the rig.
    cameras: Vec<CameraId>,
    /// Camera of this round's comparison, and whether it is left out of the fit.
    compared: Option<CameraId>,
    is_trial: bool,
}

impl Workshop {
    /// Starts from the person as it is.
    pub fn new(beginning: Beginning) -> Result<Self, FusionError> {
        let Beginning { gpu, rig, settings, template, undressed, base, in_use, stopped } = beginning;
        let in_use_is_known = in_use.is_some();
        let avatar = in_use.as_ref().map(|avatar| avatar.shared_on(&base.graph));
        let cameras = rig.cameras.iter().map(|camera| camera.id.clone()).collect();
        let skeleton = template.skeleton.clone();
        let judge = Judge::new(&gpu, (template, base), (&rig, &settings), stopped);
        Ok(Self {
            gpu,
            avatar,
            in_use,
            judge,
            sets: BTreeMap::new(),
            came: 0,
            fit: None,
            steps: 0,
            rounds: 0,
            fresh: 0,
            unchecked: 0,
            error_in_use: None,
            succeeded: true,
            proven: in_use_is_known,
            skeleton,
            undressed,
            is_deformed: settings.tracking.options().is_some(),
            took: Duration::ZERO,
            cameras,
            compared: None,
            is_trial: false,
        })
    }

    /// Adds a key set, or replaces the one in its slot.
    pub fn add(&mut self, set: KeySet) {
        self.came += 1;
        let Choice { slot, is_new } = set.choice;
        // One that was lost on the way may come again.
        let is_new = is_new || !self.sets.contains_key(&slot);
        self.fresh += usize::from(is_new);
        self.unchecked += usize::from(!is_new && is_held_back(slot));
        self.sets.insert(slot, (self.came, set));
    }

    /// Returns whether [`Self::work`] has anything to do.
    pub fn is_busy(&self) -> bool {
        let held = self.sets.keys().filter(|slot| is_held_back(**slot)).count();
        let is_due = self.succeeded || self.fresh >= FRESH;
        self.fit.is_some()
            || self.is_check_due()
            || is_due && held >= LEAST_HELD_BACK && self.sets.len() - held >= LEAST_FITTED
    }

    /// Returns whether the version in use may not fit the person any more.
    fn is_check_due(&self) -> bool {
        self.in_use.is_some() && self.unchecked >= UNCHECKED
    }

    /// Begins a round, descends by one step, or ends the round with a comparison, which is returned. Between rounds, compares the version
    /// in use with newer images.
    pub fn work(&mut self) -> Result<Option<Verdict>, FusionError> {
        let start = Instant::now();
        let verdict = self.work_untimed();
        self.took += start.elapsed();
        verdict.map(|verdict| verdict.map(|verdict| Verdict { took: std::mem::take(&mut self.took), ..verdict }))
    }

    fn work_untimed(&mut self) -> Result<Option<Verdict>, FusionError> {
        let Some(fit) = &mut self.fit else {
            if self.is_check_due() {
                let verdict = self.check();
                self.judge.rest();
                return verdict;
            }
            if self.is_busy() {
                self.begin()?;
            }
            return Ok(None);
        };
        let (start, steps) = if self.proven { (LATER, ROUND_STEPS) } else { (0.0, TRIAL_STEPS) };
        if self.steps < steps {
            fit.step(start + (1.0 - start) * self.steps as f32 / steps as f32)?;
            self.steps += 1;
            return Ok(None);
        }
        let Some(fit) = self.fit.take() else { return Ok(None) };
        let fitted = Arc::new(fit.into_model().into_avatar());
        let verdict = self.compare(&fitted);
        self.judge.rest();
        // The next trial leaves out another camera, which this one has seen.
        self.avatar = Some(fitted).filter(|_| self.proven || !self.is_trial);
        verdict.map(Some)
    }

    /// Returns the next camera to compare: one after the other of those that see the person in the newest key sets that were held back.
    fn next_camera(&self, sets: &Compared<'_>) -> Option<CameraId> {
        let seeing: Vec<&CameraId> = self.cameras.iter().filter(|camera| sets.is_compared_in(camera)).collect();
        seeing.get(self.rounds as usize % seeing.len().max(1)).copied().cloned()
    }

    /// Begins a round with the key sets that are not held back. Waits for others where no image of them, or of those that were held
    /// back, shows the person.
    fn begin(&mut self) -> Result<(), FusionError> {
        self.fresh = 0;
        let sets = Compared::of(&self.sets);
        let seeing = self.cameras.iter().filter(|camera| sets.is_seen_in(camera)).count();
        self.compared = self.next_camera(&sets).filter(|_| seeing > 0);
        self.is_trial = !self.proven && seeing >= LEAST_CAMERAS;
        let Some(camera) = self.compared.clone() else {
            self.succeeded = false;
            return Ok(());
        };
        self.rounds += 1;
        let left_out = Some(camera).filter(|_| self.is_trial);
        let avatar = match self.avatar.take() {
            Some(avatar) => avatar,
            None => {
                let surface = self.judge.surface(&sets, left_out.as_ref())?;
                Arc::new(Avatar { undressed: self.undressed.clone(), ..surface })
            }
        };
        let (mut frames, mut views) = (Vec::new(), Vec::<TrainingView>::new());
        for (_, set) in self.sets.values().filter(|(_, set)| !is_held_back(set.choice.slot)) {
            let frame = |pose| TrainingFrame { pose, translations: set.translations.clone() };
            let at_set = frames.len();
            frames.push(frame(set.pose.clone()));
            for view in set.views.iter().filter(|view| left_out.as_ref() != Some(&view.crop.camera().id)) {
                let own = view.pose.as_ref().map(|pose| {
                    frames.push(frame(pose.clone()));
                    frames.len() - 1
                });
                views.push(view.crop.clone().of_frame(own.unwrap_or(at_set)));
            }
        }
        // A version in use is needed as it is; any other becomes the model without a copy.
        let mut avatar = Arc::unwrap_or_clone(avatar);
        avatar.set_mean(frames.iter().map(|frame| frame.translations.as_slice()));
        avatar.known_poses = KnownPoses::new(&frames.iter().map(|frame| frame.pose.clone()).collect::<Vec<_>>());
        let model = AvatarModel::new(avatar, frames, AvatarFitSettings::default());
        let settings = FitSettings { seed: u64::from(self.rounds), ..FitSettings::default() };
        self.fit = Some(Fit::new(&self.gpu, model, views, settings)?);
        self.steps = 0;
        Ok(())
    }

    /// Compares the version in use with the surface on the newest key sets that were held back. Returns a verdict if it does not fit the
    /// person any more; a round begins if it fits worse than it did.
    fn check(&mut self) -> Result<Option<Verdict>, FusionError> {
        self.unchecked = 0;
        let sets = Compared::of(&self.sets);
        let before = self.error_in_use.clone().filter(|(camera, _)| sets.is_compared_in(camera));
        let camera = before.as_ref().map(|(camera, _)| camera.clone()).or_else(|| self.next_camera(&sets));
        let (Some(avatar), Some(camera)) = (self.in_use.clone(), camera) else { return Ok(None) };
        let surface = self.judge.error(None, &sets, &camera)?;
        let in_use = self.judge.error(Some(&avatar), &sets, &camera)?;
        let (Some(surface), Some(in_use)) = (surface, in_use) else { return Ok(None) };
        if surface < BETTER * in_use {
            self.in_use = None;
            let (round, fitted, took) = (self.rounds, sets.seen.len(), Duration::ZERO);
            return Ok(Some(Verdict { round, fitted, errors: [in_use, surface], change: Change::Drop, took }));
        }
        match before {
            Some((_, before)) => self.succeeded |= in_use > WORSE * before,
            None => self.error_in_use = Some((camera, in_use)),
        }
        Ok(None)
    }

    /// Compares the fitted avatar with the person in use, on the newest key sets that were held back.
    fn compare(&mut self, new: &Arc<Avatar>) -> Result<Verdict, FusionError> {
        self.unchecked = 0;
        self.succeeded = false;
        let Some(camera) = self.compared.clone() else { return Ok(self.undecided()) };
        let sets = Compared::of(&self.sets);
        let mut error = |avatar| self.judge.error(avatar, &sets, &camera);
        let (surface, found) = (error(None)?, error(Some(new))?);
        let old = self.in_use.as_ref().map(|avatar| error(Some(avatar))).transpose()?.flatten();
        // Its memory is free for the template of the stream.
        self.judge.rest();
        let (Some(surface), Some(found)) = (surface, found) else { return Ok(self.undecided()) };
        let in_use = old.unwrap_or(surface);
        let change = if found < BETTER * in_use.min(surface) {
            // Key sets alone prove less than a camera that the fit has not seen.
            if self.proven || self.is_trial { self.adopt(Arc::clone(new))? } else { Change::Prove }
        } else if old.is_some_and(|old| surface < BETTER * old) {
            Change::Drop
        } else {
            Change::Keep
        };
        let (round, fitted, took) = (self.rounds, sets.seen.len(), Duration::ZERO);
        let verdict = Verdict { round, fitted, errors: [in_use, found], change, took };
        self.succeeded = matches!(verdict.change, Change::Adopt { .. } | Change::Prove);
        self.proven |= self.succeeded;
        match &verdict.change {
            Change::Adopt { avatar, .. } => {
                (self.in_use, self.error_in_use) = (Some(Arc::clone(avatar)), Some((camera, found)));
            }
            Change::Drop => self.in_use = None,
            Change::Keep | Change::Prove => self.error_in_use = old.map(|old| (camera, old)),
        }
        Ok(verdict)
    }

    /// Returns the change to a version, whose template is encoded here and not in the session's thread.
    fn adopt(&self, avatar: Arc<Avatar>) -> Result<Change, FusionError> {
        let stream = encode_tracked_avatar(&avatar, &self.skeleton, self.is_deformed)?;
        Ok(Change::Adopt { avatar, stream: Arc::new(stream) })
    }

    /// Returns the result of a round whose camera has no view in the key sets that were held back.
    fn undecided(&self) -> Verdict {
        let took = Duration::ZERO;
        Verdict { change: Change::Keep, round: self.rounds, fitted: 0, errors: [f64::NAN; 2], took }
    }
}
