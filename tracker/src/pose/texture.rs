//! Remembered brightness of the body's surface per camera, and the motion of the body that shows it there again.
//!
//! Landmarks of a network scatter anew in every frame set. The surface does not: a fold or a stripe keeps its place on the
//! body, so its motion in the images is that of the bones. Each camera remembers its own brightness of each point, so that
//! neither differences between cameras nor light from one side disturb the comparison.

use flyrig_body::Template;
use flyrig_types::{Camera, Mask};
use glam::{DVec2, DVec3, Vec3};

use crate::image::grid::Grid;
use crate::image::pixels::Rgb;
use crate::image::view::View;
use crate::pose::body_model::BodyModel;
use crate::pose::line_point::{LineKind, LinePoint, bones, is_usable, undistorted_line};

/// Distance between neighbouring points on the rest surface, metres.
const SPACING_M: f64 = 0.03;
/// Size of a cell of the smoothed image at the body, metres; at least a pixel.
const CELL_M: f64 = 0.004;
/// Least cosine between a surface's normal and the line of sight: below, it is too near to an outline.
const FACING: f64 = 0.35;
/// Depth behind the nearest point in a cell beyond which points are hidden, metres.
const HIDDEN_M: f64 = 0.04;
/// Side of a cell in which points hide each other, metres.
const HIDING_CELL_M: f64 = 0.025;
/// Largest number of cells across a body: one that fills more of the camera's plane stands at the lens.
const MOST_CELLS: f64 = 2000.0;
/// Standard deviation of a point's brightness between frame sets, 0..=1: noise, folds, light.
const SIGMA: f64 = 0.06;
/// Least standard deviation of a line, cells of the smoothed image.
const SIGMA_CELLS: f64 = 0.3;
/// Largest standard deviation of a line that is used, cells.
const VAGUE_CELLS: f64 = 4.0;
/// Expected displacement of a surface, cells: a mismatch of slopes counts over this distance.
const DOUBT_CELLS: f64 = 1.0;
/// Share of a new brightness in the memory, once a point was seen twice. A slow memory would keep the errors of the pose in
/// which it was learnt.
const LEARN: f64 = 0.6;
/// Time after which a hidden point is relearnt, seconds: it reappears in other light.
const FORGET_SECS: f64 = 0.5;
/// Least coverage of a pixel that surely shows the person.
const SURE_COVERAGE: u8 = 230;

/// Number of image levels, from the widest filter to the narrowest.
pub(crate) const LEVELS: usize = 2;
/// Radius of each level's filter, cells: the wider, the farther a surface may be from its place.
const SMOOTH: [usize; LEVELS] = [2, 1];

/// Smoothed brightness of an image around the body.
#[derive(Debug, Clone)]
pub(crate) struct Brightness {
    origin: DVec2,
    /// Side of a cell, pixels of the image.
    cell: usize,
    grid: Grid,
}

impl Brightness {
    /// Smooths the part of an image that shows the vertices (world metres), with a margin. `None` when they are out of the
    /// image.
    pub fn around(picture: &Rgb<'_>, camera: &Camera, view: &View, vertices: &[Vec3]) -> Option<[Self; LEVELS]> {
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let mut scales = Vec::new();
        for vertex in vertices.iter().step_by(7) {
            let vertex = vertex.as_dvec3();
            if let (Some(pixel), Some(scale)) = (camera.project(vertex), view.px_per_m(vertex)) {
                (low, high) = (low.min(pixel), high.max(pixel));
                scales.push(scale);
            }
        }
        let scale = flyrig_solve::median(&mut scales)?;
        let cell = ((CELL_M * scale).round() as usize).clamp(1, 64);
        let margin = 0.1 * scale;
        let clamp = |v: f64, most: usize| v.clamp(0.0, most as f64) as usize / cell;
        let (x0, y0) = (clamp(low.x - margin, picture.width), clamp(low.y - margin, picture.height));
        let (x1, y1) = (clamp(high.x + margin, picture.width), clamp(high.y + margin, picture.height));
        if x1 < x0 + 4 || y1 < y0 + 4 {
            return None;
        }
        let mut grid = Grid::new(x1 - x0, y1 - y0, 0.0);
        let norm = 1.0 / (255.0 * (cell * cell) as f32);
        for (at, value) in grid.values.iter_mut().enumerate() {
            let (x, y) = ((at % grid.width + x0) * cell, (at / grid.width + y0) * cell);
            let mut sum = 0.0;
            for y in y..y + cell {
                for x in x..x + cell {
                    let [r, g, b] = picture.pixel(x, y).map(f32::from);
                    sum += 0.3 * r + 0.55 * g + 0.15 * b;
                }
            }
            *value = sum * norm;
        }
        // A cell's value belongs to the middle of its pixels.
        let origin = DVec2::new((x0 * cell) as f64, (y0 * cell) as f64) + 0.5 * (cell as f64 - 1.0);
        Some(SMOOTH.map(|radius| Self { origin, cell, grid: grid.box_mean(radius).box_mean(radius) }))
    }

    /// Returns the brightness at a pixel, 0..=1.
    fn value(&self, pixel: DVec2) -> Option<f64> {
        let at = (pixel - self.origin) / self.cell as f64;
        let grid = &self.grid;
        if !(at.x >= 0.0 && at.y >= 0.0 && at.x < grid.width as f64 - 1.0 && at.y < grid.height as f64 - 1.0) {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let (fx, fy) = (at.x - x as f64, at.y - y as f64);
        let value = |x: usize, y: usize| f64::from(grid.values[y * grid.width + x]);
        let top = value(x, y) + (value(x + 1, y) - value(x, y)) * fx;
        let bottom = value(x, y + 1) + (value(x + 1, y + 1) - value(x, y + 1)) * fx;
        Some(top + (bottom - top) * fy)
    }

    /// Returns the brightness, 0..=1, and its gradient per pixel of the image.
    fn slope(&self, pixel: DVec2) -> Option<(f64, DVec2)> {
        let step = self.cell as f64;
        let change = |d: DVec2| Some((self.value(pixel + d)? - self.value(pixel - d)?) / (2.0 * step));
        let slope = DVec2::new(change(DVec2::X * step)?, change(DVec2::Y * step)?);
        Some((self.value(pixel)?, slope))
    }
}

/// Brightness of a point in earlier images of one camera.
#[derive(Debug, Clone, Copy)]
struct Remembered {
    /// Brightness of each level, 0..=1, and its gradient per pixel.
    levels: [(f64, DVec2); LEVELS],
    sets: u32,
    nanos: i64,
}

/// Skinned body in front of one camera.
pub(crate) struct TexturedBody<'a> {
    pub camera: &'a Camera,
    pub view: &'a View,
    /// World positions and normals of the template's vertices at the image's time.
    pub vertices: &'a [Vec3],
    pub normals: &'a [Vec3],
}

/// Remembered brightness of points on the body, per camera.
#[derive(Debug, Clone, Default)]
pub(crate) struct Texture {
    /// Vertices of the points.
    points: Vec<usize>,
    /// Memory of each slot and point.
    seen: Vec<Vec<Option<Remembered>>>,
}

impl Texture {
    /// Chooses points on a template's surface, without any memory.
    pub fn new(template: &Template, slots: usize) -> Self {
        let mut cells = std::collections::BTreeMap::new();
        for (vertex, position) in template.positions.iter().enumerate() {
            let cell = (position.as_dvec3() / SPACING_M).floor().as_i64vec3();
            cells.entry(cell.to_array()).or_insert(vertex);
        }
        let points: Vec<usize> = cells.into_values().collect();
        let seen = vec![vec![None; points.len()]; slots];
        Self { points, seen }
    }

    /// Returns the remembered and visible points with the image lines on which they have the same brightness.
    pub fn lines(
        &self,
        (template, model): (&Template, &BodyModel),
        body: &TexturedBody<'_>,
        image: &Brightness,
        level: usize,
        (slot, view): (usize, usize),
    ) -> Vec<LinePoint> {
        let Some(seen) = self.seen.get(slot) else { return Vec::new() };
        let mut lines = Vec::new();
        for (index, pixel) in self.visible(body) {
            let Some(remembered) = seen[index] else { continue };
            let Some((value, slope)) = image.slope(pixel) else { continue };
            let (value_before, slope_before) = remembered.levels[level];
            // Where the slopes disagree, the image shows another surface, or the surface is far from its place.
            let other = DOUBT_CELLS * image.cell as f64 * (slope - slope_before).length();
            let slope = 0.5 * (slope + slope_before);
            let steepness = slope.length();
            let cell = image.cell as f64;
            let sigma = SIGMA.hypot(other);
            let sigma_px = (sigma / steepness).hypot(SIGMA_CELLS * cell);
            if sigma_px.is_nan() || sigma_px > VAGUE_CELLS * cell {
                continue;
            }
            let normal = slope / steepness;
            let away = (value_before - value) / steepness;
            let Some((normal, offset)) = undistorted_line(body.camera, body.view, pixel + normal * away, normal) else {
                continue;
            };
            let vertex = self.points[index];
            let bones = bones(model, template, vertex);
            if is_usable(model, &bones) {
                let kind = LineKind::Texture;
                lines.push(LinePoint {
                    kind,
                    vertex,
                    worn: DVec3::ZERO,
                    view,
                    normal,
                    offset,
                    sigma_px,
                    bones,
                    shift: DVec3::ZERO,
                });
            }
        }
        lines
    }

    /// Learns the brightness of the body in its accepted pose from one camera. `nanos` is the frame set's time.
    pub fn learn(
        &mut self,
        body: &TexturedBody<'_>,
        images: &[Brightness; LEVELS],
        mask: Option<&Mask>,
        slot: usize,
        nanos: i64,
    ) {
        let visible = self.visible(body);
        let Some(seen) = self.seen.get_mut(slot) else { return };
        for (index, pixel) in visible {
            let covered = mask.is_none_or(|mask| {
                let (x, y) = (pixel.x.round() as usize, pixel.y.round() as usize);
                mask.coverage().get(y * mask.width() as usize + x).is_some_and(|c| *c >= SURE_COVERAGE)
            });
            let [Some(far), Some(near)] = images.each_ref().map(|image| image.slope(pixel)) else { continue };
            let levels = [far, near];
            if !covered || !levels.iter().all(|(value, slope)| value.is_finite() && slope.is_finite()) {
                continue;
            }
            let known = seen[index].filter(|known| nanos.abs_diff(known.nanos) as f64 * 1e-9 < FORGET_SECS);
            seen[index] = Some(known.map_or(Remembered { levels, sets: 1, nanos }, |known| {
                let share = f64::max(1.0 / (f64::from(known.sets) + 1.0), LEARN);
                let mix = |level: usize| {
                    let ((value, slope), (v, s)) = (known.levels[level], levels[level]);
                    (value + share * (v - value), slope + share * (s - slope))
                };
                Remembered { levels: std::array::from_fn(mix), sets: known.sets.saturating_add(1), nanos }
            }));
        }
    }

    /// Returns the points that a camera sees, with their pixels.
    fn visible(&self, body: &TexturedBody<'_>) -> Vec<(usize, DVec2)> {
        let eye = body.view.center();
        let Some(nearest) = Nearest::new(body) else { return Vec::new() };
        let mut found = Vec::new();
        for (index, &vertex) in self.points.iter().enumerate() {
            let (Some(point), Some(normal)) = (body.vertices.get(vertex), body.normals.get(vertex)) else { continue };
            let (point, normal) = (point.as_dvec3(), normal.as_dvec3());
            let facing = normal.dot((eye - point).normalize_or_zero());
            if facing.is_nan() || facing < FACING || nearest.hides(body.view, point) {
                continue;
            }
            found.extend(body.camera.project(point).map(|pixel| (index, pixel)));
        }
        found
    }
}

/// Depth of the vertex nearest to a camera in each cell of the undistorted image.
struct Nearest {
    origin: DVec2,
    cell_px: f64,
    columns: usize,
    depths: Vec<f64>,
}

impl Nearest {
    /// Draws the depths; `None` when the body is not in front of the camera, or fills an absurd part of its plane.
    fn new(body: &TexturedBody<'_>) -> Option<Self> {
        let places: Vec<(DVec2, f64)> =
            body.vertices.iter().filter_map(|vertex| place(body.view, vertex.as_dvec3())).collect();
        let (mut low, mut high, mut least) = (DVec2::INFINITY, DVec2::NEG_INFINITY, f64::INFINITY);
        for (at, depth) in &places {
            (low, high, least) = (low.min(*at), high.max(*at), least.min(*depth));
        }
        let cell_px = (HIDING_CELL_M * body.view.focal_px / least).max(1.0);
        let size = ((high - low) / cell_px).floor();
        if !size.is_finite() || size.max_element() > MOST_CELLS {
            return None;
        }
        let columns = size.x as usize + 1;
        let depths = vec![f64::INFINITY; columns * (size.y as usize + 1)];
        let mut nearest = Self { origin: low, cell_px, columns, depths };
        for (at, depth) in places {
            let index = nearest.index(at);
            if let Some(least) = nearest.depths.get_mut(index) {
                *least = depth.min(*least);
            }
        }
        Some(nearest)
    }

    fn index(&self, at: DVec2) -> usize {
        let cell = (at - self.origin) / self.cell_px;
        cell.y as usize * self.columns + cell.x as usize
    }

    fn hides(&self, view: &View, point: DVec3) -> bool {
        let Some((at, depth)) = place(view, point) else { return true };
        self.depths.get(self.index(at)).is_none_or(|nearest| depth > nearest + HIDDEN_M)
    }
}

/// Returns undistorted pixels from the principal point and depth in metres of a world point.
fn place(view: &View, point: DVec3) -> Option<(DVec2, f64)> {
    let p = view.to_camera(point)?;
    Some((p.truncate() * (view.focal_px / p.z), p.z))
}

#[cfg(test)]
mod tests {
    use flyrig_body::skin_mesh;
    use flyrig_types::Pose;
    use glam::DQuat;

    use super::*;
    use crate::landmarks::keypoints::LANDMARK_COUNT;
    use crate::pose::body_model::JointTurns;
    use crate::pose::fit;
    use crate::pose::fit::FitView;
    use crate::testing::{body, fit_problem, random_turns, ring};

    /// A printed body in front of a camera, drawn triangle by triangle in the order of depth.
    fn photo(camera: &Camera, view: &View, template: &Template, pose: &Pose) -> Rgb<'static> {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let print = |vertex: u32| {
            let p = template.positions[vertex as usize].as_dvec3();
            127.0 + 50.0 * (40.0 * p.x + 9.0 * p.y).sin() + 50.0 * (38.0 * p.y - 11.0 * p.z).sin()
        };
        let (vertices, _) = skin_mesh(template, pose);
        let at = |v: u32| {
            Some((camera.project(vertices[v as usize].as_dvec3())?, view.to_camera(vertices[v as usize].as_dvec3())?.z))
        };
        let mut triangles: Vec<_> =
            template.triangles.iter().filter_map(|t| Some((t, [at(t[0])?, at(t[1])?, at(t[2])?]))).collect();
        triangles.sort_by(|a, b| b.1[0].1.total_cmp(&a.1[0].1));
        let mut bytes = vec![90u8; width * height * 3];
        for (triangle, [(a, _), (b, _), (c, _)]) in triangles {
            let area = (b - a).perp_dot(c - a);
            let (low, high) = (a.min(b).min(c).max(DVec2::ZERO), a.max(b).max(c));
            for y in low.y as usize..=(high.y as usize).min(height - 1) {
                for x in low.x as usize..=(high.x as usize).min(width - 1) {
                    let p = DVec2::new(x as f64, y as f64);
                    let share = [
                        (c - b).perp_dot(p - b) / area,
                        (a - c).perp_dot(p - c) / area,
                        (b - a).perp_dot(p - a) / area,
                    ];
                    if share.iter().all(|s| *s >= -1e-6) {
                        let value: f64 = share.iter().zip(triangle).map(|(s, v)| s * print(*v)).sum();
                        bytes[(y * width + x) * 3..][..3].fill(value as u8);
                    }
                }
            }
        }
        Rgb { width, height, bytes: bytes.into() }
    }

    struct Scene {
        template: Template,
        model: BodyModel,
        cameras: Vec<Camera>,
        views: Vec<FitView>,
    }

    impl Scene {
        fn new() -> Self {
            let template = body();
            let cameras = ring(3).cameras;
            let views = cameras.iter().enumerate().map(|(slot, camera)| FitView {
                slot,
                view: View::new(camera),
                seen: [None; LANDMARK_COUNT],
                shift: [DVec3::ZERO; LANDMARK_COUNT],
                delay_secs: 0.0,
            });
            Self { model: BodyModel::new(&template).unwrap(), views: views.collect(), template, cameras }
        }

        fn images(&self, slot: usize, shown: &JointTurns) -> [Brightness; LEVELS] {
            let (camera, view) = (&self.cameras[slot], &self.views[slot].view);
            let pose = self.model.to_pose(shown);
            let photo = photo(camera, view, &self.template, &pose);
            let (vertices, _) = skin_mesh(&self.template, &pose);
            Brightness::around(&photo, camera, view, &vertices).unwrap()
        }

        fn seen<R>(&self, slot: usize, turns: &JointTurns, each: impl FnOnce(&TexturedBody<'_>) -> R) -> R {
            let (vertices, normals) = skin_mesh(&self.template, &self.model.to_pose(turns));
            let (camera, view) = (&self.cameras[slot], &self.views[slot].view);
            each(&TexturedBody { camera, view, vertices: &vertices, normals: &normals })
        }

        fn learnt(&self, turns: &JointTurns) -> Texture {
            let mut texture = Texture::new(&self.template, self.cameras.len());
            for slot in 0..self.cameras.len() {
                let images = self.images(slot, turns);
                self.seen(slot, turns, |seen| texture.learn(seen, &images, None, slot, 0));
            }
            texture
        }

        /// Fits a pose to lines, which are trusted more than in the fit of a person: they alone are on trial here.
        fn solve(&self, mut lines: Vec<LinePoint>, start: &JointTurns, before: &JointTurns) -> JointTurns {
            lines.iter_mut().for_each(|line| line.sigma_px *= 0.1);
            let mut problem = fit_problem(&self.model, &self.views, 1.0);
            problem.before = Some(fit::Before { turns: before.clone(), sigma_rad: 0.15 });
            problem.lines = &lines;
            problem.solve(start, 4).unwrap().0
        }

        /// Follows the texture from one pose to the one in the images.
        fn follow(&self, texture: &Texture, from: &JointTurns, shown: &JointTurns) -> JointTurns {
            let images: Vec<_> = (0..self.cameras.len()).map(|slot| self.images(slot, shown)).collect();
            let mut turns = from.clone();
            for level in [0, 1, 1] {
                let lines: Vec<LinePoint> = images
                    .iter()
                    .enumerate()
                    .flat_map(|(slot, images)| {
                        let of = |seen: &TexturedBody<'_>| {
                            texture.lines((&self.template, &self.model), seen, &images[level], level, (slot, slot))
                        };
                        self.seen(slot, &turns, of)
                    })
                    .collect();
                turns = self.solve(lines, &turns, from);
            }
            turns
        }
    }

    fn mean_distance(scene: &Scene, a: &JointTurns, b: &JointTurns) -> f64 {
        let (a, b) = (scene.model.marks(a), scene.model.marks(b));
        a.iter().zip(b).map(|(a, b)| a.distance(b)).sum::<f64>() / a.len() as f64
    }

    #[test]
    fn a_print_follows_a_body_that_moves_and_an_arm_that_turns_about_itself() {
        let scene = Scene::new();
        let before = random_turns(&scene.model, 5);
        let texture = scene.learnt(&before);
        let mut after = before.clone();
        after.root += DVec3::new(0.012, -0.008, 0.01);
        let arm = scene.model.roles.upper_arm[0];
        let along = (scene.model.origins[scene.model.roles.forearm[0]] - scene.model.origins[arm]).normalize();
        after.turns[arm] = (after.turns[arm] * DQuat::from_axis_angle(along, 0.12)).normalize();
        let found = scene.follow(&texture, &before, &after);
        let (moved, left) = (mean_distance(&scene, &before, &after), mean_distance(&scene, &found, &after));
        assert!(left < 0.25 * moved, "{left} m of {moved} m");
        let turned = found.turns[arm].angle_between(after.turns[arm]);
        assert!(turned < 0.06, "the arm is off by {turned} rad");
    }

    #[test]
    fn a_body_in_its_place_stays_there_and_another_print_says_nothing() {
        let scene = Scene::new();
        let turns = random_turns(&scene.model, 5);
        let texture = scene.learnt(&turns);
        let still = mean_distance(&scene, &scene.follow(&texture, &turns, &turns), &turns);
        assert!(still < 5e-4, "{still} m");
        // As if the light had been switched: what the images show is nothing that was seen before.
        let mut other = texture;
        for remembered in other.seen.iter_mut().flatten().flatten() {
            for (value, slope) in &mut remembered.levels {
                (*value, *slope) = (1.0 - *value, -*slope);
            }
        }
        let [_, near] = scene.images(0, &turns);
        let of = |seen: &TexturedBody<'_>| other.lines((&scene.template, &scene.model), seen, &near, 1, (0, 0));
        assert!(scene.seen(0, &turns, of).is_empty());
    }

    #[test]
    fn what_is_hidden_unknown_behind_the_camera_or_poisoned_gives_no_line() {
        let scene = Scene::new();
        let turns = random_turns(&scene.model, 5);
        let images = scene.images(0, &turns);
        let lines = |texture: &Texture, vertices: &[Vec3], normals: &[Vec3], slot: usize| {
            let (camera, view) = (&scene.cameras[0], &scene.views[0].view);
            let seen = TexturedBody { camera, view, vertices, normals };
            texture.lines((&scene.template, &scene.model), &seen, &images[1], 1, (slot, 0)).len()
        };
        let (vertices, normals) = skin_mesh(&scene.template, &scene.model.to_pose(&turns));
        let known = scene.learnt(&turns);
        assert!(lines(&known, &vertices, &normals, 0) > 100);
        assert_eq!(lines(&Texture::new(&scene.template, 3), &vertices, &normals, 0), 0, "nothing was seen yet");
        assert_eq!(lines(&Texture::default(), &vertices, &normals, 0), 0);
        assert_eq!(lines(&known, &vertices, &normals, 7), 0, "no such camera");
        let behind: Vec<Vec3> = vertices.iter().map(|v| *v + (scene.cameras[0].position() * 3.0).as_vec3()).collect();
        assert_eq!(lines(&known, &behind, &normals, 0), 0);
        assert_eq!(lines(&known, &vec![Vec3::NAN; vertices.len()], &normals, 0), 0);
        assert_eq!(lines(&known, &vertices, &vec![Vec3::NAN; vertices.len()], 0), 0);
        assert_eq!(lines(&known, &[], &[], 0), 0);
        let away: Vec<Vec3> = normals.iter().map(|n| -*n).collect();
        assert!(lines(&known, &vertices, &away, 0) < lines(&known, &vertices, &normals, 0), "the far side is hidden");
    }

    #[test]
    fn large_cells_keep_places_and_an_image_without_the_body_has_no_brightness() {
        let scene = Scene::new();
        let (camera, view) = (&scene.cameras[0], &scene.views[0].view);
        let turns = random_turns(&scene.model, 5);
        let (vertices, _) = skin_mesh(&scene.template, &scene.model.to_pose(&turns));
        let bytes: Vec<u8> = (0..800 * 800).flat_map(|i| [(i % 800 / 4) as u8; 3]).collect();
        let ramp = Rgb { width: 800, height: 800, bytes: bytes.into() };
        // The same body four times as near has cells of several pixels.
        let eye = camera.position().as_vec3();
        let near: Vec<Vec3> = vertices.iter().map(|v| eye + (*v - eye) * 0.25).collect();
        for vertices in [&vertices, &near] {
            let [_, image] = Brightness::around(&ramp, camera, view, vertices).unwrap();
            let (value, slope) = image.slope(DVec2::new(402.5, 401.0)).unwrap();
            assert!((value - (402.5 - 1.5) / 4.0 / 255.0).abs() < 2e-3, "{value}");
            assert!((slope - DVec2::new(0.25 / 255.0, 0.0)).length() < 1e-4, "{slope}");
        }
        let behind: Vec<Vec3> = vertices.iter().map(|v| *v + (camera.position() * 3.0).as_vec3()).collect();
        assert!(Brightness::around(&ramp, camera, view, &behind).is_none());
        assert!(Brightness::around(&ramp, camera, view, &[]).is_none());
    }
}
