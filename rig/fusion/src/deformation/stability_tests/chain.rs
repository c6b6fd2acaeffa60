//! Reference of the whole deformation in plain f64: images in, displaced positions out. Written from the equations, it shares only the
//! skeleton, the f64 skinning and the inset of the surface with the product.

use flyrig_body::{SurfaceGaussians, skin_jacobian_f64, skin_point_f64};
use flyrig_renderer::{Outputs, RasterSettings, linear_from_srgb};
use flyrig_tracker::{DeformSettings, DeformSolver};
use flyrig_types::Camera;
use glam::{DMat3, DMat4, DVec3};

use super::super::DeformOptions;
use super::reference::{self, Picture, Splat, blend, sorted_splats_at};
use super::reference_backward::{Incoming, backward, lift, touched_by};
use super::small_scene::{SceneShot, SmallScene};

/// Pixels per square metre of a person 400 pixels high.
const PAPER_PIXELS_A_M2: f64 = (400.0 / 1.75) * (400.0 / 1.75);

/// Image at the size that is compared.
struct View {
    camera: Camera,
    bones: Vec<DMat4>,
    /// Premultiplied linear colour and coverage.
    wanted: Vec<[f64; 4]>,
    /// Weights of the three colour channels and the mask.
    weights: [f64; 4],
    raster: RasterSettings,
}

pub struct Chain<'a> {
    scene: &'a SmallScene,
    settings: DeformSettings,
    max_level: u32,
    /// Share of the first residual at which conjugate gradients end.
    tolerance: f64,
    rest: SurfaceGaussians,
    /// Neighbouring nodes and stiffness of each edge.
    edges: Vec<(usize, usize, f64)>,
    pub translations: Vec<DVec3>,
    smooth: Vec<DVec3>,
    /// Thickness of the clothes on each part, metres.
    thickness: Option<Vec<f64>>,
    damping: f64,
    floor: Option<f64>,
    frame: usize,
    painted: bool,
}

impl<'a> Chain<'a> {
    pub fn new(scene: &'a SmallScene, settings: DeformSettings, max_level: u32, tolerance: f64) -> Self {
        let nodes = scene.graph.nodes.len();
        let options = DeformOptions::coarse(settings);
        let part = |node: usize| scene.surface.parts[scene.graph.node_gaussian[node] as usize];
        let stiff = |i, j| (options.stiffness(part(i)) * options.stiffness(part(j))).sqrt();
        let edges = |(i, others): (usize, &[u32; 4])| {
            others.map(|j| (i, j as usize, stiff(i, j as usize))).into_iter().filter(|(i, j, _)| i != j)
        };
        Self {
            scene,
            settings,
            max_level,
            tolerance,
            rest: scene.surface.inset(),
            edges: scene.graph.neighbors.iter().enumerate().flat_map(edges).collect(),
            translations: vec![DVec3::ZERO; nodes],
            smooth: vec![DVec3::ZERO; nodes],
            thickness: None,
            damping: settings.damping,
            floor: None,
            frame: 0,
            painted: false,
        }
    }

    /// Returns the displacement of a Gaussian by Eq. 2, metres.
    fn displacement(&self, t: &[DVec3], g: usize) -> DVec3 {
        let (nodes, weights) = (self.scene.graph.gaussian_nodes[g], self.scene.graph.gaussian_weights[g]);
        (0..4).map(|k| t[nodes[k] as usize] * f64::from(weights[k])).sum()
    }

    /// Returns the world centres of all Gaussians, metres.
    pub fn centers(&self, bones: &[DMat4]) -> Vec<DVec3> {
        self.scene.posed(&self.rest, bones, |g| self.displacement(&self.translations, g)).1
    }

    fn views(&self, shot: &SceneShot) -> Vec<View> {
        let SmallScene { template, surface, graph, cameras, .. } = self.scene;
        let spacing = (template.area_m2() / surface.len() as f64).sqrt();
        let view = |((camera, pose), rgba): ((&Camera, _), &Vec<u8>)| {
            let bones = template.skeleton.world_from_canonical(pose);
            let node =
                |&g: &u32| skin_point_f64(&bones, &surface.skin[g as usize], surface.positions[g as usize].as_dvec3());
            let middle = graph.node_gaussian.iter().map(node).sum::<DVec3>() / graph.node_gaussian.len() as f64;
            let i = &camera.intrinsics;
            let fine = (i.focal_px.x + i.focal_px.y) / 2.0 / camera.camera_from_world.transform_point(middle).z;
            let level = (fine * spacing).log2().round().clamp(0.0, f64::from(self.max_level)) as u32;
            let share = 0.5f64.powi(level as i32);
            let weight = 2.0 * PAPER_PIXELS_A_M2 / (fine * share).powi(2);
            let color = if self.painted { 0.1 * weight } else { 0.0 };
            let mut smaller = camera.clone();
            smaller.intrinsics.focal_px *= share;
            smaller.intrinsics.center_px = (i.center_px + 0.5) * share - 0.5;
            (smaller.intrinsics.width, smaller.intrinsics.height) = (i.width >> level, i.height >> level);
            let wanted = wanted(rgba, i.width as usize, i.height as usize, 1 << level);
            let plain = RasterSettings { outputs: Outputs::COLOR, ..RasterSettings::default() };
            let filter_variance_px2 = plain.filter_variance_px2 * (share * share) as f32;
            let raster = RasterSettings { filter_variance_px2, ..plain };
            View { camera: smaller, bones, wanted, weights: [color, color, color, weight], raster }
        };
        cameras.iter().zip(&shot.poses).zip(&shot.rgba).map(view).collect()
    }

    fn draw(&self, view: &View, t: &[DVec3]) -> (reference::Scene, Vec<Splat>, Picture) {
        let (scene, centers) = self.scene.posed(&self.rest, &view.bones, |g| self.displacement(t, g));
        let splats = sorted_splats_at(&scene, &view.camera, &view.raster, &centers);
        let picture = blend(&scene, &splats, view.camera.intrinsics.width, view.camera.intrinsics.height);
        (scene, splats, picture)
    }

    /// Returns the loss of Eq. 3 without its regulariser.
    fn data_loss(&self, views: &[View], t: &[DVec3]) -> f64 {
        views.iter().map(|view| image_loss(view, &self.draw(view, t).2.color)).sum()
    }

    /// Returns the data term's loss, its gradient with respect to the nodes, and the Gauss-Newton matrix.
    fn derivatives(&self, views: &[View], t: &[DVec3]) -> (f64, Vec<DVec3>, Vec<Vec<DMat3>>) {
        let nodes = t.len();
        let (mut loss, mut gradient) = (0.0, vec![DVec3::ZERO; nodes]);
        let mut matrix = vec![vec![DMat3::ZERO; nodes]; nodes];
        for view in views {
            let (scene, splats, picture) = self.draw(view, t);
            loss += image_loss(view, &picture.color);
            let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
            let touched = touched_by(splats, (width, height));
            let incoming = incoming(view, &picture.color);
            let out = backward(&scene, &view.camera, &view.raster, width, &touched, &incoming);
            for s in &touched.splats {
                let [xx, xy, xz, yy, yz, zz] = lift(&scene, &view.camera, &view.raster, s, out.carried[s.index]);
                let h = DMat3::from_cols_array(&[xx, xy, xz, xy, yy, yz, xz, yz, zz]);
                let bones = skin_jacobian_f64(&view.bones, &self.rest.skin[s.index]);
                let (slope, h) = (bones.transpose() * out.center[s.index], bones.transpose() * h * bones);
                let graph = &self.scene.graph;
                let of = |k: usize| {
                    (graph.gaussian_nodes[s.index][k] as usize, f64::from(graph.gaussian_weights[s.index][k]))
                };
                for (a, weight_a) in (0..4).map(of) {
                    gradient[a] += slope * weight_a;
                    for (b, weight_b) in (0..4).map(of) {
                        matrix[a][b] += h * (weight_a * weight_b);
                    }
                }
            }
        }
        (loss, gradient, matrix)
    }

    /// Returns the regulariser of Eq. 4 and its gradient.
    fn prior(&self, t: &[DVec3]) -> (f64, Vec<DVec3>) {
        let (spatial, temporal) = self.prior_weights();
        let (mut loss, mut gradient) = (0.0, vec![DVec3::ZERO; t.len()]);
        for &(i, j, stiff) in &self.edges {
            let apart = t[i] - t[j];
            let change = apart - (self.smooth[i] - self.smooth[j]);
            let spread = apart - (self.offset(i) - self.offset(j));
            loss += stiff * (spatial * spread.length_squared() + temporal * change.length_squared());
            gradient[i] += 2.0 * stiff * (spatial * spread + temporal * change);
            gradient[j] -= 2.0 * stiff * (spatial * spread + temporal * change);
        }
        (loss, gradient)
    }

    /// Returns the translation of a node with clothes as thick as those of its part, metres.
    fn offset(&self, node: usize) -> DVec3 {
        let (normal, part) = self.normal_and_part(node);
        self.thickness.as_ref().map_or(DVec3::ZERO, |thickness| normal * thickness[part])
    }

    fn normal_and_part(&self, node: usize) -> (DVec3, usize) {
        let g = self.scene.graph.node_gaussian[node] as usize;
        (self.scene.surface.normals[g].as_dvec3(), self.scene.surface.parts[g] as usize)
    }

    /// Returns the mean thickness along the normals for each part, weighted by the data; one hundredth of the weight is the mean of all parts.
    fn learn(&mut self, blocks: &[DMat3]) {
        let parts = (0..blocks.len()).map(|n| self.normal_and_part(n).1 + 1).max().unwrap_or(0);
        let (mut weights, mut sums) = (vec![0.0; parts], vec![0.0; parts]);
        for (n, block) in blocks.iter().enumerate() {
            let (normal, part) = self.normal_and_part(n);
            let weight = normal.dot(*block * normal);
            if weight > 0.0 {
                weights[part] += weight;
                sums[part] += weight
                    * self.translations[n]
                        .dot(normal)
                        .clamp(self.settings.thickness_m[0], self.settings.thickness_m[1]);
            }
        }
        let (weight, sum) = (weights.iter().sum::<f64>(), sums.iter().sum::<f64>());
        if weight > 0.0 {
            let now = (0..parts).map(|k| (sums[k] + 0.01 * sum) / (weights[k] + 0.01 * weight));
            self.thickness = Some(match &self.thickness {
                None => now.collect(),
                Some(known) => known.iter().zip(now).map(|(known, now)| 0.5 * (known + now)).collect(),
            });
        }
    }

    fn prior_weights(&self) -> (f64, f64) {
        let s = &self.settings;
        (s.regularization * s.spatial, if self.frame > 0 { s.regularization * s.temporal } else { 0.0 })
    }

    /// Solves one frame; returns the losses before the first and after each accepted step.
    pub fn track(&mut self, shot: &SceneShot) -> Vec<f64> {
        let views = self.views(shot);
        let total = |chain: &Self, t: &[DVec3]| chain.data_loss(&views, t) + chain.prior(t).0;
        if let Some(floor) = self.floor.filter(|_| self.frame >= 10) {
            let loss = total(self, &self.translations);
            if loss <= floor * (1.0 + self.settings.rest) {
                return vec![loss];
            }
        }
        let DeformSolver::GaussNewton { first_iterations, iterations } = self.settings.solver else { return vec![] };
        let mut losses = Vec::new();
        let mut blocks = Vec::new();
        for _ in 0..if self.frame < 10 { first_iterations } else { iterations } {
            let t = self.translations.clone();
            let (data, by_data, mut matrix) = self.derivatives(&views, &t);
            let (prior, by_prior) = self.prior(&t);
            let loss = data + prior;
            if losses.is_empty() {
                losses.push(loss);
            }
            let right: Vec<DVec3> = by_data.iter().zip(&by_prior).map(|(a, b)| -(*a + *b)).collect();
            blocks = (0..t.len()).map(|n| matrix[n][n]).collect();
            let trace = |n: usize| matrix[n][n].x_axis.x + matrix[n][n].y_axis.y + matrix[n][n].z_axis.z;
            let mean = (0..t.len()).map(trace).sum::<f64>() / (3 * t.len()) as f64;
            let (spatial, temporal) = self.prior_weights();
            let stiffness = DMat3::from_diagonal(DVec3::splat(2.0 * (spatial + temporal)));
            for &(i, j, stiff) in &self.edges {
                let stiffness = stiffness * stiff;
                matrix[i][i] += stiffness;
                matrix[j][j] += stiffness;
                matrix[i][j] -= stiffness;
                matrix[j][i] -= stiffness;
            }
            let mut accepted = false;
            for _ in 0..self.settings.attempts {
                let mut damped = matrix.clone();
                for (n, row) in damped.iter_mut().enumerate() {
                    row[n] += DMat3::from_diagonal(DVec3::splat(self.damping * mean));
                }
                let step = conjugate_gradients(&damped, &right, self.tolerance);
                let longest = step.iter().map(|s| s.length()).fold(0.0, f64::max);
                let share = (self.settings.max_step_m / longest).min(1.0);
                let limit = self.settings.max_translation_m;
                let new: Vec<DVec3> =
                    t.iter().zip(&step).map(|(t, s)| (*t + *s * share).clamp_length_max(limit)).collect();
                let along: f64 = right.iter().zip(&step).map(|(r, s)| r.dot(*s)).sum();
                let squared: f64 = step.iter().map(|s| s.length_squared()).sum();
                let predicted = share * along - 0.5 * share * share * (along - self.damping * mean * squared);
                if predicted < 1e-5 * loss {
                    break;
                }
                let new_loss = total(self, &new);
                if new_loss < loss {
                    let gain = (loss - new_loss) / predicted;
                    if gain > 0.75 {
                        self.damping = (self.damping / 4.0).max(1e-3);
                    } else if gain < 0.25 {
                        self.damping = (self.damping * 4.0).min(1e6);
                    }
                    self.translations = new;
                    losses.push(new_loss);
                    accepted = true;
                    break;
                }
                self.damping = (self.damping.max(1e-3) * 10.0).min(1e6);
            }
            if !accepted {
                break;
            }
        }
        let (first, last) = (losses[0], losses[losses.len() - 1]);
        self.floor = (last >= first * (1.0 - self.settings.rest)).then_some(last);
        for (smooth, t) in self.smooth.iter_mut().zip(&self.translations) {
            *smooth += (*t - *smooth) * self.settings.smoothing;
        }
        self.learn(&blocks);
        self.frame += 1;
        self.painted = true;
        losses
    }
}

/// Returns means of `side` x `side` pixels in linear light, weighted by coverage.
fn wanted(rgba: &[u8], width: usize, height: usize, side: usize) -> Vec<[f64; 4]> {
    let pixel = |x: usize, y: usize| {
        let mut mean = [0.0; 4];
        for (u, v) in (0..side).flat_map(|v| (0..side).map(move |u| (u, v))) {
            let p = &rgba[4 * ((y * side + v) * width + x * side + u)..][..4];
            let mask = f64::from(p[3]) / 255.0;
            for (c, mean) in mean.iter_mut().enumerate() {
                let value = if c < 3 { f64::from(linear_from_srgb(f32::from(p[c]) / 255.0)) } else { 1.0 };
                *mean += value * mask / (side * side) as f64;
            }
        }
        mean
    };
    (0..height / side).flat_map(|y| (0..width / side).map(move |x| pixel(x, y))).collect()
}

fn image_loss(view: &View, drawn: &[[f64; 4]]) -> f64 {
    let pixel = |(drawn, wanted): (&[f64; 4], &[f64; 4])| -> f64 {
        (0..4).map(|c| view.weights[c] * (drawn[c] - wanted[c]).powi(2)).sum()
    };
    drawn.iter().zip(&view.wanted).map(pixel).sum()
}

/// Returns the derivative of the loss with respect to the image, and the Gauss-Newton term of a shift by one pixel.
fn incoming(view: &View, drawn: &[[f64; 4]]) -> Incoming<f64> {
    let width = view.camera.intrinsics.width as usize;
    let height = drawn.len() / width;
    let slope = |(drawn, wanted): (&[f64; 4], &[f64; 4])| {
        std::array::from_fn(|c| 2.0 * view.weights[c] * (drawn[c] - wanted[c]))
    };
    let bend = |at: usize| {
        let (x, y) = (at % width, at / width);
        if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            return [0.0; 4];
        }
        let mut sums = [0.0; 4];
        for (c, weight) in view.weights.iter().enumerate() {
            let dx = 0.5 * (drawn[at + 1][c] - drawn[at - 1][c]);
            let dy = 0.5 * (drawn[at + width][c] - drawn[at - width][c]);
            for (sum, product) in sums[1..].iter_mut().zip([dx * dx, dx * dy, dy * dy]) {
                *sum += 2.0 * weight * product;
            }
        }
        sums
    };
    Incoming {
        color: drawn.iter().zip(&view.wanted).map(slope).collect(),
        depth_carry: (0..drawn.len()).map(bend).collect(),
    }
}

/// Solves by conjugate gradients over dense blocks, preconditioned by the diagonal blocks.
fn conjugate_gradients(matrix: &[Vec<DMat3>], right: &[DVec3], tolerance: f64) -> Vec<DVec3> {
    let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
    let times = |x: &[DVec3]| -> Vec<DVec3> {
        matrix.iter().map(|row| row.iter().zip(x).map(|(m, x)| *m * *x).sum()).collect()
    };
    let precondition = |r: &[DVec3]| -> Vec<DVec3> { (0..r.len()).map(|n| matrix[n][n].inverse() * r[n]).collect() };
    let (mut x, mut residual) = (vec![DVec3::ZERO; right.len()], right.to_vec());
    let mut z = precondition(&residual);
    let mut direction = z.clone();
    let mut size = dot(&residual, &z);
    let end = size * tolerance * tolerance;
    for _ in 0..200 {
        let image = times(&direction);
        let bend = dot(&direction, &image);
        if !(size > end && bend > 0.0) {
            break;
        }
        for n in 0..x.len() {
            x[n] += direction[n] * (size / bend);
            residual[n] -= image[n] * (size / bend);
        }
        z = precondition(&residual);
        let next = dot(&residual, &z);
        direction.iter_mut().zip(&z).for_each(|(d, z)| *d = *z + *d * (next / size));
        size = next;
    }
    x
}
