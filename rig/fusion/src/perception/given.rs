//! People whose poses are known, from a simulator or a recorded motion.

use flyrig_body::{Template, skin_mesh};
use flyrig_tracker::{Background, BodyGate, EdgeColor, Matte, PersonArea, matte};
use flyrig_types::{Camera, Frame, FrameSet, Image, Mask, PersonId, Pose, PoseTrack, Rig};
use glam::Vec3;

use super::{
    background::{BackgroundWatch, backgrounds, report},
    observation::{KnownPerson, Perception, PersonObservation, SeenPerson, ViewObservation},
    outfit_search::OutfitSearch,
    split_mask::{PosedMesh, split_mask},
};
use crate::{
    error::FusionError,
    health::stage_times::StageTimes,
    settings::perception::{Origin, PerceptionSettings},
};

/// Mask of all people in one frame, and the foreground colours along its outline.
type EdgedMask = (Option<Mask>, Vec<EdgeColor>);

/// Person with a known motion.
#[derive(Debug, Clone)]
pub struct GivenPerson {
    /// Id of the person.
    pub person: PersonId,
    /// Shape, skin and skeleton of the person.
    pub template: Template,
    /// Poses over time.
    pub track: PoseTrack,
    /// Whether the motion repeats.
    pub repeat: bool,
}

impl GivenPerson {
    /// Returns the pose at a time, nanoseconds.
    fn at(&self, nanos: i64) -> Pose {
        if self.repeat { self.track.at_repeated(nanos) } else { self.track.at(nanos) }
    }
}

/// Perception with poses from tracks, and masks from the frames or from the difference to the empty scene near the posed bodies.
///
/// # Example
/// ```
/// use flyrig_fusion::{
///     FrameSet, GivenPerception, Perception as _, PersonObservation, StageTimes,
///     body::{ShapeParams, default_template},
///     types::{PoseTrack, Rig},
/// };
///
/// let rig = Rig { cameras: Vec::new(), world_up: glam::DVec3::Y };
/// let body = default_template(&ShapeParams::default())?;
/// let track = PoseTrack::new(vec![(0, body.skeleton.rest_pose())])?;
/// let mut perception = GivenPerception::repeating(&rig, body, track);
///
/// let set = FrameSet { index: 0, master_nanos: 0, frames: Vec::new() };
/// let observed = perception.observe(&set, &mut StageTimes::default())?;
/// assert!(matches!(observed.as_slice(), [PersonObservation::Seen(_)]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct GivenPerception {
    people: Vec<GivenPerson>,
    cameras: Vec<Camera>,
    masks: Origin,
    /// Background of each camera, one element per slot.
    backgrounds: Vec<Option<Background>>,
    /// Search for clothes, one element per person.
    outfits: Vec<OutfitSearch>,
    watch: BackgroundWatch,
}

impl GivenPerception {
    /// Observes these people with the cameras of `rig`, with the masks of the frames. A frame's mask covers all people, and is divided
    /// among several by their posed bodies.
    #[must_use]
    pub fn new(rig: &Rig, people: Vec<GivenPerson>) -> Self {
        let backgrounds = vec![None; rig.cameras.len()];
        Self {
            outfits: vec![OutfitSearch::default(); people.len()],
            people,
            cameras: rig.cameras.clone(),
            masks: Origin::Given,
            backgrounds,
            watch: BackgroundWatch::default(),
        }
    }

    /// Observes one person who repeats a motion forever.
    #[must_use]
    pub fn repeating(rig: &Rig, template: Template, track: PoseTrack) -> Self {
        Self::new(rig, vec![GivenPerson { person: PersonId::default(), template, track, repeat: true }])
    }

    /// Declares that the people's templates are dressed already, so that clothes are not looked for.
    #[must_use]
    pub fn dressed(self) -> Self {
        Self { outfits: vec![OutfitSearch::over(); self.people.len()], ..self }
    }

    /// Makes masks from the difference to images of the empty scene, one per slot, or to the settings' key colour, where the settings
    /// estimate masks.
    ///
    /// # Errors
    /// [`FusionError::Track`] names the camera whose plate cannot be used, [`FusionError::Setting`] the key colour.
    pub fn with_masks(self, settings: &PerceptionSettings, plates: &[Option<Image>]) -> Result<Self, FusionError> {
        let backgrounds = backgrounds(&self.cameras, settings, plates)?;
        Ok(Self { masks: settings.masks, backgrounds, ..self })
    }
}

impl Perception for GivenPerception {
    fn move_camera(&mut self, slot: usize, camera: &Camera, plate: Option<&Image>) -> Result<(), FusionError> {
        let known = self.cameras.get_mut(slot).zip(self.backgrounds.get_mut(slot));
        if let Some((known, background)) = known {
            known.clone_from(camera);
            *background = background.as_ref().map(|background| background.after_move(camera, plate)).transpose()?;
        }
        Ok(())
    }

    fn people(&self) -> Vec<KnownPerson<'_>> {
        let people = self.people.iter().zip(&self.outfits);
        people
            .map(|(given, search)| KnownPerson {
                person: given.person,
                shape: u32::from(!search.outfit().is_bare()),
                template: &given.template,
                outfit: search.outfit(),
            })
            .collect()
    }

    fn observe(&mut self, set: &FrameSet, stages: &mut StageTimes) -> Result<Vec<PersonObservation>, FusionError> {
        let poses: Vec<Pose> = self.people.iter().map(|given| given.at(set.master_nanos)).collect();
        let (masks, edge_colors): (Vec<_>, Vec<_>) = self.masks(set, &poses, stages)?.into_iter().unzip();
        if self.masks == Origin::Estimated
            && self.watch.is_due(self.backgrounds.iter().flatten().any(Background::is_learning))
        {
            stages.time("background", || self.follow_backgrounds(set, &poses))?;
        }
        let confidence = if self.masks == Origin::Given { 1.0 } else { 0.5 };
        let mut views: Vec<Vec<ViewObservation>> = match self.people.as_slice() {
            [_] => vec![masks.into_iter().map(|mask| ViewObservation::of_mask(mask, confidence)).collect()],
            people => stages.time("divide masks", || self.divide(set, people, &poses, &masks, confidence)),
        };
        for (given, views) in self.people.iter().zip(&mut views) {
            for ((view, colors), (_, frame)) in views.iter_mut().zip(&edge_colors).zip(set.present()) {
                view.edge_colors.clone_from(colors);
                let nanos = frame.capture_nanos;
                view.pose = (nanos != set.master_nanos).then(|| given.at(nanos)).filter(Pose::is_valid);
            }
        }
        let seen = |((given, pose), views): ((&GivenPerson, Pose), Vec<ViewObservation>)| {
            let person = given.person;
            if pose.is_valid() {
                PersonObservation::Seen(SeenPerson { person, pose, confidence: 1.0, views })
            } else {
                PersonObservation::Lost { person, reason: "the pose holds numbers that are not finite".to_owned() }
            }
        };
        // Clothes that are found here are drawn from the next frame set on.
        let observations: Vec<PersonObservation> = self.people.iter().zip(poses).zip(views).map(seen).collect();
        for ((given, search), observation) in self.people.iter().zip(&mut self.outfits).zip(&observations) {
            if let PersonObservation::Seen(seen) = observation {
                search.ingest(set, seen, &given.template, &self.cameras);
            }
        }
        Ok(observations)
    }
}

impl GivenPerception {
    /// Looks for clothes in a few frame sets ([`crate::SHAPE_SETS`], over [`crate::SHAPE_SECS`]) before the session is built, so that they
    /// are known from the first frame set on. Otherwise they are found in the first seconds.
    ///
    /// # Errors
    /// As [`Perception::observe`].
    pub fn find_outfits(&mut self, sets: &[FrameSet]) -> Result<(), FusionError> {
        let mut searches = vec![OutfitSearch::default(); self.people.len()];
        for set in sets {
            for (search, observation) in searches.iter_mut().zip(self.observe(set, &mut StageTimes::default())?) {
                if let PersonObservation::Seen(seen) = observation {
                    search.add(set, &seen);
                }
            }
        }
        for (search, given) in searches.iter_mut().zip(&self.people) {
            search.finish(given.person, &given.template, &self.cameras);
        }
        self.outfits = searches;
        Ok(())
    }

    /// Returns the mask of all people in each present frame, and the foreground colours along its outline.
    fn masks(&self, set: &FrameSet, poses: &[Pose], stages: &mut StageTimes) -> Result<Vec<EdgedMask>, FusionError> {
        let mut masks = Vec::new();
        for (slot, frame) in set.present() {
            masks.push(match self.masks {
                Origin::Given => (frame.mask.clone(), Vec::new()),
                Origin::Estimated => {
                    let made = stages.time("mask from plate", || self.estimated_mask(slot, frame, poses))?;
                    made.map_or_else(Default::default, |Matte { mask, colors }| (Some(mask), colors))
                }
            });
        }
        Ok(masks)
    }

    /// Returns vertices, world metres, and triangles of all people with valid poses at the time of a frame.
    fn bodies(&self, frame: &Frame, poses: &[Pose]) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
        for ((given, search), pose) in self.people.iter().zip(&self.outfits).zip(poses) {
            let own = given.at(frame.capture_nanos);
            let pose = if own.is_valid() { &own } else { pose };
            if pose.is_valid() {
                let first = vertices.len() as u32;
                let template = search.dressed().unwrap_or(&given.template);
                vertices.extend(skin_mesh(template, pose).0);
                triangles.extend(template.triangles.iter().map(|corners| corners.map(|corner| corner + first)));
            }
        }
        (vertices, triangles)
    }

    /// Lets the backgrounds follow the light where no person stands.
    fn follow_backgrounds(&mut self, set: &FrameSet, poses: &[Pose]) -> Result<(), FusionError> {
        for (slot, frame) in set.present() {
            let bodies = self.bodies(frame, poses);
            let Some((camera, background)) = self.cameras.get(slot).zip(self.backgrounds.get_mut(slot)) else {
                continue;
            };
            if let Some(background) = background {
                let gate = BodyGate::new(camera, &bodies.0, &bodies.1);
                let people = gate.map(|gate| PersonArea { gate, mask: None });
                report(camera, &background.update(&frame.image, people.as_slice())?);
            }
        }
        Ok(())
    }

    /// Returns the mask of all people in a frame, from the camera's background and the posed bodies.
    fn estimated_mask(&self, slot: usize, frame: &Frame, poses: &[Pose]) -> Result<Option<Matte>, FusionError> {
        let Some((camera, background)) =
            self.cameras.get(slot).zip(self.backgrounds.get(slot).and_then(Option::as_ref))
        else {
            return Ok(None);
        };
        let (vertices, triangles) = self.bodies(frame, poses);
        let Some(gate) = BodyGate::new(camera, &vertices, &triangles) else { return Ok(None) };
        let are_dressed = self.outfits.iter().all(OutfitSearch::is_over);
        let gate = if are_dressed { gate.of_known_clothes() } else { gate };
        let Some(mask) = background.mask(&frame.image, &gate)? else { return Ok(None) };
        Ok(Some(matte(&frame.image, &mask, Some(background), None)?))
    }

    /// Divides the masks of all people: one element per person, then per present frame.
    fn divide(
        &self,
        set: &FrameSet,
        people: &[GivenPerson],
        poses: &[Pose],
        masks: &[Option<Mask>],
        confidence: f64,
    ) -> Vec<Vec<ViewObservation>> {
        let mut views: Vec<Vec<ViewObservation>> = people.iter().map(|_| Vec::new()).collect();
        for ((slot, frame), mask) in set.present().zip(masks) {
            let Some((mask, camera)) = mask.as_ref().zip(self.cameras.get(slot)) else {
                views.iter_mut().for_each(|views| views.push(ViewObservation::default()));
                continue;
            };
            // Each image shows the bodies at its own time.
            let meshes: Vec<PosedMesh<'_>> = people
                .iter()
                .zip(poses)
                .map(|(given, pose)| {
                    let own = given.at(frame.capture_nanos);
                    let pose = if own.is_valid() { &own } else { pose };
                    let vertices = skin_mesh(&given.template, pose).0;
                    PosedMesh { vertices, triangles: &given.template.triangles }
                })
                .collect();
            for (views, (own, others)) in views.iter_mut().zip(split_mask(camera, mask, &meshes)) {
                let mut view = ViewObservation::of_mask(Some(own), confidence);
                view.others = Some(others);
                views.push(view);
            }
        }
        views
    }
}
