//! Refinement of the pose by outlines of masks and the body's texture.

use super::*;

/// Largest distance of the body's outline from the mask's that is matched in the last round, metres.
const OUTLINE_REACH_M: f64 = 0.05;
/// Solver steps per round of matching.
const STEPS: usize = 4;

/// World positions and normals of the template's vertices.
pub(super) type Skinned = (Vec<Vec3>, Vec<Vec3>);

/// Body in a pose, at the frame set's time and at that of each view's image.
pub(super) struct PosedBody {
    now: Skinned,
    /// Body at the time of each view of the fit; `None` where that is the frame set's time.
    own: Vec<Option<Skinned>>,
}

impl PosedBody {
    /// Returns the body at the time of a view.
    pub fn at(&self, view: usize) -> &Skinned {
        self.own[view].as_ref().unwrap_or(&self.now)
    }
}

impl PoseEstimator {
    /// Moves the pose so that the body's outline lies on that of the masks and its surface shows the remembered brightness;
    /// the texture then learns from the images. `body` is the body in the fitted pose, and `gates` where it is drawn.
    pub(super) fn refine(
        &self,
        set: &FrameSet,
        pictures: &[Option<Rgb<'_>>],
        fitted: &Fitted,
        masks: &[Option<&Mask>],
        (mut body, mut gates): (PosedBody, &[Option<BodyGate>]),
        texture: &mut Texture,
    ) -> JointTurns {
        let mut turns = fitted.turns.clone();
        let of_view = |view: &FitView| {
            let picture = pictures.get(view.slot).and_then(Option::as_ref);
            let camera = &self.rig.cameras[view.slot];
            Brightness::around(picture?, camera, &view.view, &body.now.0)
        };
        let images: Vec<Option<[Brightness; LEVELS]>> = fitted.evidence.views.par_iter().map(of_view).collect();
        for round in 0..self.config.outline_rounds {
            // First with a wide reach, then with a narrow one.
            let last = round + 1 >= self.config.outline_rounds;
            let mut lines = self.outline_points(fitted, (&body, gates), masks, if last { 1.0 } else { 2.0 });
            lines.extend(self.texture_points(fitted, &body, texture, &images, usize::from(last)));
            if lines.is_empty() {
                break;
            }
            let mut problem = fitted.evidence.problem(&self.model, &self.config);
            problem.lines = &lines;
            let Some((better, _)) = problem.solve(&turns, STEPS).filter(|(turns, _)| finite(turns)) else {
                break;
            };
            turns = better;
            (body, gates) = (self.posed(set, fitted, &turns), &[]);
        }
        for (index, (view, image)) in fitted.evidence.views.iter().zip(&images).enumerate() {
            if let Some(images) = image {
                let mask = masks.get(view.slot).copied().flatten();
                texture.learn(&self.textured(view, body.at(index)), images, mask, view.slot, set.master_nanos);
            }
        }
        turns
    }

    /// Matches the outline of the body in a pose with the masks of all views.
    pub(super) fn match_outline(
        &self,
        set: &FrameSet,
        fitted: &Fitted,
        turns: &JointTurns,
        masks: &[Option<&Mask>],
        widen: f64,
    ) -> Vec<LinePoint> {
        self.outline_points(fitted, (&self.posed(set, fitted, turns), &[]), masks, widen)
    }

    /// Skins the body in a pose at the times of all views.
    pub(super) fn posed(&self, set: &FrameSet, fitted: &Fitted, turns: &JointTurns) -> PosedBody {
        let own = |view: &FitView| {
            (view.delay_secs.abs() > MIN_DELAY_SECS).then(|| self.skinned(turns, set, view.delay_secs))
        };
        PosedBody { now: self.skinned(turns, set, 0.0), own: fitted.evidence.views.iter().map(own).collect() }
    }

    /// Returns the body as one view sees its surface.
    fn textured<'a>(&'a self, view: &'a FitView, (vertices, normals): &'a Skinned) -> TexturedBody<'a> {
        TexturedBody { camera: &self.rig.cameras[view.slot], view: &view.view, vertices, normals }
    }

    /// Matches the surface of the body with its brightness in all views.
    fn texture_points(
        &self,
        fitted: &Fitted,
        body: &PosedBody,
        texture: &Texture,
        images: &[Option<[Brightness; LEVELS]>],
        level: usize,
    ) -> Vec<LinePoint> {
        let of_view = |(index, view): (usize, &FitView)| {
            let Some(image) = images.get(index).and_then(Option::as_ref).map(|images| &images[level]) else {
                return Vec::new();
            };
            let seen = self.textured(view, body.at(index));
            let mut points = texture.lines((&self.surface, &self.model), &seen, image, level, (view.slot, index));
            shift(&mut points, body, index);
            points
        };
        fitted.evidence.views.par_iter().enumerate().flat_map_iter(of_view).collect()
    }

    /// Matches the outline of the body with the masks of all views, within `widen` times [`OUTLINE_REACH_M`]. Views with a
    /// gate show the body there already.
    fn outline_points(
        &self,
        fitted: &Fitted,
        (body, gates): (&PosedBody, &[Option<BodyGate>]),
        masks: &[Option<&Mask>],
        widen: f64,
    ) -> Vec<LinePoint> {
        let of_view = |(index, view): (usize, &FitView)| {
            let Some(mask) = masks.get(view.slot).copied().flatten() else { return Vec::new() };
            let (vertices, normals) = body.at(index);
            let seen = SeenBody {
                camera: &self.rig.cameras[view.slot],
                view: &view.view,
                template: &self.surface,
                model: &self.model,
                vertices,
                normals,
                gate: gates.get(view.slot).and_then(Option::as_ref),
            };
            let mut points = seen.match_mask(mask, index, widen * OUTLINE_REACH_M, widen * self.config.outline_sigma_m);
            shift(&mut points, body, index);
            points
        };
        fitted.evidence.views.par_iter().enumerate().flat_map_iter(of_view).collect()
    }
}

/// Sets the displacement of a view's points from the frame set's time to the image's.
fn shift(points: &mut [LinePoint], body: &PosedBody, view: usize) {
    for point in points {
        point.shift = (body.at(view).0[point.vertex] - body.now.0[point.vertex]).as_dvec3();
    }
}
