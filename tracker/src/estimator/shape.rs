//! The person's shape: bone lengths from landmarks, and lengths, girths and build from outlines.

use super::*;

impl PoseEstimator {
    /// Fits bone lengths to the person in a few frame sets (5 to 10, buffered at the start; the more the person moves in them the
    /// better) and replaces the template by the fitted one. Estimate the buffered sets again then, in order, and go on. Nobody of
    /// `others`, landmarks by person and set, is taken for the person. Returns the person's own landmarks by set as well.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person; the template stays as it was.
    pub fn fit_shape(
        &mut self,
        sets: &[FrameSet],
        others: &[Vec<Option<Marks>>],
    ) -> Result<(ShapeFit, Vec<Option<Marks>>), TrackError> {
        let mut keypoints = Vec::new();
        let (mut first, mut last) = (None, None);
        let mut places = Vec::new();
        for (index, set) in sets.iter().enumerate() {
            let others: Vec<Marks> = others.iter().filter_map(|marks| *marks.get(index)?).collect();
            let found = self.find_at_once(set, &others);
            places.push(found.as_ref().ok().map(|fitted| self.model.marks(&fitted.turns)));
            match found {
                Ok(fitted) => {
                    keypoints.push(fitted.keypoints);
                    first.get_or_insert_with(|| (fitted.turns.clone(), set.master_nanos));
                    self.remember(set, fitted.turns, fitted.looks, Texture::default());
                }
                Err(error) => last = Some(error),
            }
        }
        self.reset();
        let mut fit = match (first.is_some(), last) {
            (false, Some(error)) => return Err(error),
            _ => self.fit_shape_to_keypoints(&keypoints)?,
        };
        if self.config.shape_rounds > 0 && self.rig.cameras.len() > 1 {
            self.fit_shape_to_outlines(sets, &mut fit)?;
        }
        self.reset();
        if let Some((turns, nanos)) = first {
            self.start_at(turns, nanos);
        }
        Ok((fit, places))
    }

    /// Fits bone lengths to the landmarks of a person in a few sets, by set and slot, and goes on tracking with them. Before a
    /// single camera, which cannot measure anything, the height is the configuration's or an average one.
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person in two views; the template stays as it was.
    pub fn fit_shape_to_keypoints(&mut self, keypoints: &[Vec<Option<ViewKeypoints>>]) -> Result<ShapeFit, TrackError> {
        let (template, fit) = self.measure_shape(keypoints)?;
        self.take_shape(template)?;
        Ok(fit)
    }

    /// Fits bone lengths as [`Self::fit_shape_to_keypoints`] does, but goes on with the shape as it is. Returns the template of
    /// the fitted shape for [`Self::take_shape`].
    ///
    /// # Errors
    /// Kind `Lost` when too few of the sets show a person in two views.
    pub fn measure_shape(&self, keypoints: &[Vec<Option<ViewKeypoints>>]) -> Result<(Template, ShapeFit), TrackError> {
        if self.rig.cameras.len() == 1 {
            template_of_height(&self.base, self.config.height_m)
        } else {
            let seen = |views: &&Vec<_>| seen_landmarks(views, self.config.confidence_threshold) >= MIN_LANDMARKS;
            let keypoints: Vec<Vec<_>> = keypoints.iter().filter(seen).cloned().collect();
            fit_template_shape(&self.base, &self.rig, &keypoints, &self.config)
        }
    }

    /// Goes on tracking with a template of [`Self::measure_shape`].
    ///
    /// # Errors
    /// Kind `Template` when it is not usable.
    pub fn take_shape(&mut self, template: Template) -> Result<(), TrackError> {
        self.model = BodyModel::new(&template)?;
        self.template = template;
        if let Some(track) = self.track.take() {
            self.start_at(track.turns, track.nanos);
        }
        Ok(())
    }

    /// Follows the person, or searches whole images: nobody waits for the set.
    fn find_at_once(&mut self, set: &FrameSet, others: &[Marks]) -> Result<Fitted, TrackError> {
        let pictures = self.check(set)?;
        let given = (self.config.search_crops, self.looks_at_all);
        (self.config.search_crops, self.looks_at_all) = (0, true);
        let found = self.follow_or_search(set, &pictures, others, true, &mut StageSeconds::default());
        (self.config.search_crops, self.looks_at_all) = given;
        found
    }

    /// Solves for shape and poses of all sets together, from landmarks and the outlines of masks.
    fn fit_shape_to_outlines(&mut self, sets: &[FrameSet], fit: &mut ShapeFit) -> Result<(), TrackError> {
        let mut found = Vec::new();
        for set in sets {
            let Ok(mut fitted) = self.find_at_once(set, &[]) else { continue };
            let pictures = self.check(set)?;
            let masks = self.masks(set, &pictures, &mut fitted);
            fitted.evidence.before = None;
            self.remember(set, fitted.turns.clone(), fitted.looks.clone(), Texture::default());
            found.push((set, fitted, masks));
        }
        let space = ShapeSpace::new(&self.base);
        let mut shape: Vec<f64> =
            space.prior().iter().map(|(name, mean, _)| fit.factor(name).unwrap_or(*mean)).collect();
        for _ in 0..self.config.shape_rounds {
            let given = |set: &FrameSet, masks: &[Option<Mask>], slot: usize| -> Option<Mask> {
                let own = masks.get(slot).cloned().flatten();
                own.or_else(|| set.frames.get(slot)?.as_ref()?.mask.clone().filter(|_| !self.config.masks))
            };
            let problems: Vec<ShapeSet<'_>> = found
                .iter()
                .map(|(set, fitted, masks)| {
                    let masks: Vec<Option<Mask>> = (0..masks.len()).map(|slot| given(set, masks, slot)).collect();
                    let masks: Vec<Option<&Mask>> = masks.iter().map(Option::as_ref).collect();
                    let outline = self.match_outline(set, fitted, &fitted.turns, &masks, 2.0);
                    ShapeSet { problem: fitted.evidence.problem(&self.model, &self.config), outline }
                })
                .collect();
            let start =
                ShapeAndPoses { shape: shape.clone(), poses: found.iter().map(|(_, f, _)| f.turns.clone()).collect() };
            let Some((solved, sigma)) = (ShapeProblem { space: &space, sets: &problems }).solve(&start) else { break };
            drop(problems);
            for ((_, fitted, _), pose) in found.iter_mut().zip(solved.poses) {
                fitted.turns = pose;
            }
            shape = solved.shape;
            self.template = space.template(&shape)?;
            self.model = BodyModel::new(&self.template)?;
            fit.set(&space, &shape, &sigma, &self.template);
        }
        tracing::info!(?fit, "fitted the body to landmarks and outlines");
        Ok(())
    }

    /// Takes a template of the person's shape instead, and forgets the pose.
    ///
    /// # Errors
    /// Kind `Template` when it is not usable.
    pub fn set_template(&mut self, template: &Template) -> Result<(), TrackError> {
        self.model = BodyModel::new(template)?;
        (self.base, self.template) = (template.clone(), template.clone());
        self.reset();
        Ok(())
    }
}
