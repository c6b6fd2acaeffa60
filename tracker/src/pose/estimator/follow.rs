//! From images to landmarks, and from landmarks to a pose: tracking, search and the fit to landmarks.

use super::*;

impl PoseEstimator {
    /// Tracks the person from the last pose; searches the images where that fails.
    pub(super) fn follow_or_search(
        &mut self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        others: &[Marks],
        may_search: bool,
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        if let Some(track) = &self.track
            && let Some(fitted) =
                self.follow(set, pictures, (track, &track.predicted(set.master_nanos)), others, seconds)?
        {
            self.search = Search::default();
            return Ok(fitted);
        }
        let rhythm = (self.lost / 4).clamp(1, RAREST_SEARCH);
        if !may_search || !self.lost.is_multiple_of(rhythm) {
            return Err(TrackError::lost(format!("frame set {}: no person here; the next search is soon", set.index)));
        }
        let start = Instant::now();
        let scene = SearchScene {
            net: &self.net,
            cameras: &self.rig.cameras,
            up: self.rig.world_up,
            pictures,
            backgrounds: &self.backgrounds,
            nanos: set.master_nanos,
            center: self.rig.center_of_attention(),
            taken: others,
            config: &self.config,
        };
        let sightings = self.search.step(&scene)?;
        let inferences: Vec<Option<Inference>> =
            sightings.into_iter().map(|sighting| sighting.map(Inference::fresh)).collect();
        seconds.search += start.elapsed().as_secs_f64();
        if inferences.iter().all(Option::is_none) {
            return Err(TrackError::lost(format!("frame set {}: no person found yet; the search goes on", set.index)));
        }
        let first = self.fit(set, inferences, None, seconds)?;
        // Runs again on crops around the fitted body: upright ones, and also in the views without a choice.
        let marks = self.model.marks(&first.turns);
        let start = Track {
            turns: first.turns.clone(),
            nanos: set.master_nanos,
            marks,
            velocity: None,
            inferences: vec![None; self.rig.cameras.len()],
            texture: Texture::default(),
        };
        match self.follow(set, pictures, (&start, &start.marks), others, seconds)? {
            Some(second) if second.relative <= first.relative * 1.5 => Ok(second),
            _ => Ok(first),
        }
    }

    /// Returns the views that are due when the body's landmarks are at `marks`.
    fn due(&self, set: &FrameSet, pictures: &[Option<Rgb<'_>>], track: &Track, marks: &Marks) -> Vec<bool> {
        // The motion of a person who was seen only once cannot be predicted.
        let (look_after_m, most) = match (self.infers_always || track.velocity.is_none(), self.config.max_inferences) {
            (true, _) => (0.0, usize::MAX),
            (false, 0) => (self.config.settings.look_after_m, usize::MAX),
            (false, most) => (self.config.settings.look_after_m, most),
        };
        let has_image = |slot: usize| pictures.get(slot).is_some_and(Option::is_some);
        due(&track.inferences, has_image, marks, set.master_nanos, look_after_m, most)
    }

    /// Runs the network after the refinement of a frame set without an inference, in views where outlines and texture have
    /// moved the body farther than predicted; `None` where they have not, or where the new landmarks do not fit.
    pub(super) fn infer_after_refinement(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        turns: &JointTurns,
        others: &[Marks],
        seconds: &mut StageSeconds,
    ) -> Result<Option<Fitted>, TrackError> {
        let Some(track) = &self.track else { return Ok(None) };
        let marks = self.model.marks(turns);
        if !self.due(set, pictures, track, &marks).contains(&true) {
            return Ok(None);
        }
        self.follow(set, pictures, (track, &marks), others, seconds)
    }

    /// Runs the network on crops around the predicted landmarks where it is due, and fits the pose; `None` when the person
    /// is no longer there.
    fn follow(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        (track, predicted): (&Track, &Marks),
        others: &[Marks],
        seconds: &mut StageSeconds,
    ) -> Result<Option<Fitted>, TrackError> {
        let start = Instant::now();
        let due = self.due(set, pictures, track, predicted);
        let inference = |slot: usize| -> Result<Option<Inference>, TrackError> {
            let Some(picture) = &pictures[slot] else { return Ok(None) };
            let camera = &self.rig.cameras[slot];
            let expected = project_all(camera, predicted);
            let Some(crop) = Crop::around(&expected) else { return Ok(None) };
            let sighting = Sighting::infer(&self.net, picture, crop)?;
            // Two people in one crop: the network may have chosen the other one.
            let own = sighting.mean_distance(&expected).unwrap_or(f64::INFINITY);
            let is_other = |marks| sighting.mean_distance(&project_all(camera, marks)).is_some_and(|d| d < own);
            Ok((!others.iter().any(is_other)).then(|| Inference::fresh(sighting)))
        };
        let slots: Vec<usize> = (0..pictures.len()).filter(|&slot| due[slot]).collect();
        let mut inferences = track.inferences.clone();
        for (slot, inference) in slots.iter().zip(map_parallel(slots.len(), |at| inference(slots[at]))) {
            inferences[*slot] = inference?;
        }
        seconds.net += start.elapsed().as_secs_f64();
        match self.fit(set, inferences, Some((track, predicted)), seconds) {
            Ok(fitted) if fitted.relative < OFF_TRACK => Ok(Some(fitted)),
            Ok(_) => Ok(None),
            Err(error) if error.kind == TrackErrorKind::Lost => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Fits the pose to the landmarks of all views, from the tracked pose or from an alignment of the trunk.
    fn fit(
        &self,
        set: &FrameSet,
        inferences: Vec<Option<Inference>>,
        track: Option<(&Track, &[DVec3; LANDMARK_COUNT])>,
        seconds: &mut StageSeconds,
    ) -> Result<Fitted, TrackError> {
        let config = &self.config;
        let lost = |what: &str| TrackError::lost(format!("frame set {}: {what}", set.index));
        let sees = |inference: &&Inference| inference.sighting.output.presence >= config.presence_threshold;
        let keypoints: Vec<Option<ViewKeypoints>> = inferences
            .iter()
            .map(|inference| {
                let inference = inference.as_ref().filter(|inference| inference.body.is_none());
                inference.filter(sees).map(|inference| inference.sighting.keypoints)
            })
            .collect();
        let start = Instant::now();
        let points = triangulate(&self.rig.cameras, &keypoints, config.confidence_threshold, config.inlier_m);
        seconds.triangulate += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let mut views = Vec::new();
        for (slot, frame) in set.present() {
            let camera = &self.rig.cameras[slot];
            let view = View::new(camera);
            let delay_secs = secs(frame.capture_nanos.saturating_sub(set.master_nanos));
            let delay_secs = delay_secs.clamp(-MAX_DELAY_SECS, MAX_DELAY_SECS);
            let mut seen = [None; LANDMARK_COUNT];
            let mut shift = [DVec3::ZERO; LANDMARK_COUNT];
            if let Some(inference) = inferences[slot].as_ref().filter(sees) {
                // Hidden landmarks as well: the network estimates their place, and the fit knows how accurately.
                seen = observe(camera, &view, &inference.sighting.keypoints, 0.0);
                if let Some((track, predicted)) = track {
                    for (i, (carried, trust)) in inference.carried(&track.marks, predicted).into_iter().enumerate() {
                        shift[i] = track.motion(i, delay_secs) + carried;
                        seen[i] = seen[i].map(|seen| Observation { trust, ..seen });
                    }
                }
            }
            views.push(FitView { slot, view, seen, shift, delay_secs });
        }
        let is_sure = |seen: &&Observation| seen.confidence >= config.confidence_threshold;
        let most = views.iter().map(|v| v.seen.iter().flatten().filter(is_sure).count()).max().unwrap_or(0);
        if most < MIN_LANDMARKS {
            return Err(lost("no view shows enough of a person"));
        }
        let mut evidence = Evidence { views, points: [None; LANDMARK_COUNT], before: None };
        // A single view does not constrain depth: the network's own estimate of the third dimension is used.
        let triangulated = points.iter().flatten().count();
        let mut world = points.each_ref().map(|point| point.as_ref().map(|p| p.position));
        if triangulated < MIN_LANDMARKS {
            let sightings = inferences.iter().map(|inference| inference.as_ref().map(|inference| &*inference.sighting));
            let seen = keypoints.iter().zip(sightings).zip(&self.rig.cameras);
            let surest = seen
                .filter_map(|((k, s), camera)| k.as_ref().and(s).map(|s| (s, camera)))
                .max_by(|a, b| a.0.output.presence.total_cmp(&b.0.output.presence));
            let scale = self.model.trunk_length() / 0.5;
            let lifted = surest.and_then(|(s, camera)| lift(camera, s, config.confidence_threshold, scale));
            if let Some(lifted) = lifted {
                world = lifted;
                evidence.points = lifted.map(|point| point.map(|p| (p, 0.1)));
            }
        }
        let turns = match track {
            Some((track, _)) => {
                let dt = secs(set.master_nanos.saturating_sub(track.nanos));
                let sigma_rad = config.smooth_rad * (dt * 30.0).clamp(0.1, 30.0).sqrt();
                evidence.before = Some(Before { turns: track.turns.clone(), sigma_rad });
                let has_news = inferences.iter().flatten().any(|inference| inference.body.is_none());
                if has_news {
                    evidence.problem(&self.model, config).solve(&track.turns, config.max_steps)
                } else {
                    // Carried landmarks are no new measurement. A fit to them alone would leave the place found by outlines and
                    // texture, and masks made there would follow its bias.
                    Some((track.turns.clone(), 0))
                }
            }
            None => {
                let aligned = align_trunk(&self.model, &world)
                    .ok_or_else(|| lost("the views do not agree on a person's trunk"))?;
                let problem = evidence.problem(&self.model, config);
                // World points first: their cost has no far minima behind the cameras.
                let near = FitProblem {
                    points: world.map(|point| point.map(|p| (p, 0.03))),
                    views: &[],
                    robust: 6.0,
                    ..problem.clone()
                };
                let near = near.solve(&aligned, 40).map_or(aligned, |(turns, _)| turns);
                problem.solve(&near, 40)
            }
        };
        seconds.fit += start.elapsed().as_secs_f64();
        let (turns, _) = turns.filter(|(turns, _)| finite(turns)).ok_or_else(|| lost("the fit has no finite cost"))?;
        self.measure(turns, inferences, keypoints, points, evidence)
            .ok_or_else(|| lost("no landmark agrees with the fit"))
    }

    /// Measures residuals and quality of a fitted pose; `None` when no landmark is left.
    fn measure(
        &self,
        turns: JointTurns,
        inferences: Vec<Option<Inference>>,
        keypoints: Vec<Option<ViewKeypoints>>,
        points: [Option<WorldPoint>; LANDMARK_COUNT],
        evidence: Evidence,
    ) -> Option<Fitted> {
        let marks = self.model.marks(&turns);
        let mut all = Vec::new();
        let mut all_relative = Vec::new();
        let mut views = Vec::with_capacity(keypoints.len());
        for (slot, inference) in inferences.iter().enumerate() {
            let presence = inference.as_ref().map_or(0.0, |inference| inference.sighting.output.presence);
            let mut distances = Vec::new();
            let mut inliers = 0;
            let fit_view = evidence.views.iter().find(|view| view.slot == slot);
            if let Some(fit_view) = fit_view {
                for (i, seen) in fit_view.seen.iter().enumerate() {
                    let sure = seen.filter(|seen| seen.confidence >= self.config.confidence_threshold);
                    let Some(seen) = sure else { continue };
                    let moved = fit_view.view.project(marks[i] + fit_view.shift[i]);
                    let (Some(pixel), Some(px_per_m)) = (moved, fit_view.view.px_per_m(marks[i])) else { continue };
                    let distance = (pixel - seen.ideal_px).length();
                    let relative = distance / (px_per_m * self.config.inlier_m);
                    distances.push(distance);
                    all.push(distance);
                    all_relative.push(relative);
                    inliers += usize::from(relative < 1.0);
                }
            }
            let no_mask = Some(if self.config.masks { NoMask::NoFrame } else { NoMask::Off });
            views.push(ViewQuality {
                presence,
                inliers,
                residual_px: median(&mut distances),
                mask_overlap: None,
                no_mask,
            });
        }
        let residual_px = median(&mut all)?;
        let relative = median(&mut all_relative)?;
        (residual_px.is_finite() && relative.is_finite()).then_some(Fitted {
            turns,
            inferences,
            keypoints,
            points,
            views,
            residual_px,
            relative,
            evidence,
        })
    }
}
