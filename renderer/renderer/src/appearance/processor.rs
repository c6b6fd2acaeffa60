//! Native twins of the kernels of direct appearance. Threads share the Gaussians; every sum runs in the order of the
//! WGSL.

use flyrig_gpu::CameraConstants;
use glam::{IVec2, Vec2, Vec3, Vec4};
use rayon::prelude::*;

use crate::appearance::graph_buffers::GraphBuffers;
use crate::appearance::hierarchy::DiffusionHierarchy;
use crate::appearance::kernels::{MIN_COVERAGE, MIN_RENDERED_ALPHA, NEAR_M, SettingsConstants};
use crate::appearance::settings::ViewInput;
use crate::buffers::GaussianBuffers;

/// Gaussians per task.
const CHUNK: usize = 2048;

/// Accumulated observations, one element per Gaussian.
pub(super) struct ObservationSums<'a> {
    /// Sum of weight times linear RGB; sum of weights.
    pub seen: &'a mut [[f32; 4]],
    /// Sum of Eq. 6 weights; exp(-k d) of the closest view.
    pub quality: &'a mut [[f32; 2]],
    /// Pixel, weight and exp(-k d) of this view alone; empty where not requested.
    pub kept: &'a mut [[f32; 4]],
}

/// Images of one view.
struct View<'a> {
    camera: CameraConstants,
    settings: &'a SettingsConstants,
    linear: &'a [f32],
    picture: &'a [u32],
    canonical: &'a [[f32; 4]],
    rendered: &'a [[f32; 4]],
}

/// Samples of a view's images at one position.
struct Sample {
    pixel: Vec2,
    /// Linear RGB of the person's part.
    color: Vec3,
    coverage: f32,
    rendered: Vec4,
    shown: Vec4,
}

/// Adds a view's observation of every Gaussian (Eq. 5 to 8): `observe.wgsl`.
pub(super) fn observe(
    settings: &SettingsConstants,
    view: &ViewInput<'_>,
    gaussians: &GaussianBuffers,
    linear: &[f32],
    ObservationSums { seen, quality, kept }: ObservationSums<'_>,
) {
    let posed = view.gaussians.unwrap_or(gaussians);
    let (Some(center_scale), Some(normal)) = (posed.center_scale.slice(), posed.normal.slice()) else { return };
    let (Some(positions), Some(last)) = (gaussians.canonical.slice(), gaussians.color.slice()) else { return };
    let (Some(picture), Some(canonical), Some(rendered)) =
        (view.picture.slice(), view.canonical.slice(), view.rendered.slice())
    else {
        return;
    };
    let (picture, canonical, rendered) = (picture.as_slice(), canonical.as_slice(), rendered.as_slice());
    let view = View { camera: CameraConstants::from(view.camera), settings, linear, picture, canonical, rendered };
    let mut kept: Vec<&mut [[f32; 4]]> = kept.chunks_mut(CHUNK).collect();
    kept.resize_with(seen.len().div_ceil(CHUNK), Default::default);
    let outs = seen.par_chunks_mut(CHUNK).zip(quality.par_chunks_mut(CHUNK));
    outs.zip(kept).enumerate().for_each(|(chunk, ((seen, quality), kept))| {
        for (offset, (seen, quality)) in seen.iter_mut().zip(quality).enumerate() {
            let i = chunk * CHUNK + offset;
            let (normal, depth) = (Vec4::from(normal[i]).truncate(), normal[i][3]);
            // The drawn surface lies above the centre (base/body/src/inset.rs): what a camera sees of the Gaussian is there.
            let position = Vec4::from(center_scale[i]).truncate() + depth * normal;
            let at = Vec4::from(positions[i]).truncate();
            let last = Vec4::from(last[i]).truncate();
            let Some((pixel, color, [weight, nearness], total)) = view.observe(position, normal, at, last) else {
                continue;
            };
            if weight > 0.0 {
                *quality = [quality[0] + weight, quality[1].max(nearness)];
            }
            *seen = (Vec4::from(*seen) + (color * total).extend(total)).to_array();
            if let Some(kept) = kept.get_mut(offset) {
                *kept = [pixel.x, pixel.y, total, nearness];
            }
        }
    });
}

impl View<'_> {
    /// Observes a Gaussian in one view: pixel, colour, weight of Eq. 6 with exp(-k d), and weight in the sum.
    #[inline]
    fn observe(
        &self,
        position: Vec3,
        normal: Vec3,
        canonical: Vec3,
        last: Vec3,
    ) -> Option<(Vec2, Vec3, [f32; 2], f32)> {
        let settings = self.settings;
        let angle = angle_weight(normal, position - self.camera.center());
        if settings.view_weight == 0.0 && angle <= 0.0 {
            return None;
        }
        let pixel = self.camera.project(self.camera.to_camera(position), NEAR_M)?;
        let Sample { pixel, mut color, coverage, rendered, shown } = self.sample(pixel)?;
        let (mut weight, mut nearness) = (0.0, 0.0);
        if rendered.w >= MIN_RENDERED_ALPHA {
            // Eq. 8: near the rendered surface in canonical space, so that an arm never paints the belly behind it.
            let d = canonical.distance(rendered.truncate() / rendered.w);
            let surface = (1.0 - settings.occlusion_per_m * d).max(0.0);
            let believed = angle * surface * coverage;
            if believed > 0.0 && believed.is_finite() {
                weight = believed;
                nearness = (-settings.occlusion_per_m * d).exp();
                color = self.sharpened(color, last, shown);
            }
        }
        Some((pixel, color, [weight, nearness], weight + settings.view_weight * coverage))
    }

    /// Samples all images at a position; `None` outside of them and where too little of the person is seen.
    #[inline]
    fn sample(&self, pixel: Vec2) -> Option<Sample> {
        let size = IVec2::new(self.camera.size[0] as i32, self.camera.size[1] as i32);
        if !(pixel.cmpge(Vec2::splat(-0.5)).all() && pixel.cmple(size.as_vec2() - 0.5).all()) {
            return None;
        }
        let base = pixel.floor();
        let fraction = pixel - base;
        let base = base.as_ivec2();
        let (mut color, mut coverage) = (Vec3::ZERO, 0.0);
        let (mut rendered, mut shown) = (Vec4::ZERO, Vec4::ZERO);
        for corner in 0..4 {
            let offset = IVec2::new(corner & 1, corner >> 1);
            let texel = (base + offset).clamp(IVec2::ZERO, size - 1);
            let side = Vec2::select(offset.cmpeq(IVec2::ONE), fraction, 1.0 - fraction);
            let share = side.x * side.y;
            let index = (texel.y * size.x + texel.x) as usize;
            let [red, green, blue, mask] = self.picture[index].to_le_bytes();
            let min_mask = self.settings.min_mask;
            let belief = share * ((f32::from(mask) / 255.0 - min_mask) / (1.0 - min_mask)).clamp(0.0, 1.0);
            let channel = |byte: u8| self.linear[usize::from(byte)];
            color += belief * Vec3::new(channel(red), channel(green), channel(blue));
            coverage += belief;
            rendered += share * Vec4::from(self.canonical[index]);
            shown += share * Vec4::from(self.rendered[index]);
        }
        let is_enough = coverage >= MIN_COVERAGE;
        is_enough.then(|| Sample { pixel, color: color / coverage, coverage, rendered, shown })
    }

    /// Adds the detail that rendering removes: a Gaussian's image is its colour mixed with its neighbours'.
    #[inline]
    fn sharpened(&self, color: Vec3, last: Vec3, shown: Vec4) -> Vec3 {
        let sharpness = self.settings.sharpness;
        if self.settings.corrects != 0 {
            let corrected = sharpness * (last + color - shown.truncate() / shown.w);
            return if corrected.is_finite() { corrected.clamp(Vec3::NEG_ONE, Vec3::ONE) } else { Vec3::ZERO };
        }
        if !(sharpness > 0.0 && shown.w >= MIN_RENDERED_ALPHA) {
            return color;
        }
        let sharper = color + sharpness * (last - shown.truncate() / shown.w);
        if sharper.is_finite() { sharper.clamp(Vec3::ZERO, Vec3::ONE) } else { color }
    }
}

/// Computes Eq. 7 in observation space. The sine comes from the cross product: sqrt(1 - cos^2) loses half the digits
/// where the weight is largest.
#[inline]
fn angle_weight(normal: Vec3, camera_to_point: Vec3) -> f32 {
    // False for NaN.
    let faces_camera = normal.dot(camera_to_point) < 0.0;
    let lengths = (normal.length_squared() * camera_to_point.length_squared()).sqrt();
    let is_usable = faces_camera && lengths > 0.0 && lengths.is_finite();
    if is_usable { 1.0 - (normal.cross(camera_to_point).length() / lengths).min(1.0) } else { 0.0 }
}

/// Computes the visibility-weighted mean of the Gaussians around each node: `gather.wgsl`.
pub(super) fn gather(graph: &GraphBuffers, seen: &[[f32; 4]]) {
    let (Some(entry_start), Some(entries)) = (graph.entry_start.slice(), graph.entries.slice()) else { return };
    let Some(mut node_seen) = graph.node_seen.slice_mut() else { return };
    let nodes = node_seen.par_iter_mut().take(graph.node_count as usize).zip(entry_start.par_windows(2));
    nodes.with_min_len(64).for_each(|(mean, range)| {
        let (mut sum, mut weights) = (Vec4::ZERO, 0.0);
        for [gaussian, weight] in &entries[range[0] as usize..range[1] as usize] {
            let weight = f32::from_bits(*weight);
            let one = Vec4::from(seen[*gaussian as usize]);
            // Eq. 5: normalised only when the weights add up to more than 1.
            sum += weight * one / one.w.max(1.0);
            weights += weight;
        }
        *mean = [0.0; 4];
        if sum.w > 0.0 && weights > 0.0 {
            *mean = (sum.truncate() / sum.w).extend(sum.w / weights).to_array();
        }
    });
}

/// Solves the screened Laplace equation over the levels of the graph: `diffuse.wgsl`.
pub(super) fn diffuse(graph: &GraphBuffers, settings: &SettingsConstants) {
    let (Some(levels), Some(links), Some(parents)) = (graph.levels.slice(), graph.links.slice(), graph.parents.slice())
    else {
        return;
    };
    let (Some(edges), Some(children)) = (graph.edges.slice(), graph.children.slice()) else { return };
    let (Some(mut node_seen), Some(mut node_color)) = (graph.node_seen.slice_mut(), graph.node_color.slice_mut())
    else {
        return;
    };
    for level in levels.iter().skip(1) {
        for node in level[0] as usize..(level[0] + level[1]) as usize {
            let mut sum = Vec4::ZERO;
            for &child in &children[links[node][2] as usize..links[node][3] as usize] {
                let one = Vec4::from(node_seen[child as usize]);
                sum += (one.truncate() * one.w).extend(one.w);
            }
            if sum.w > 0.0 {
                sum = (sum.truncate() / sum.w).extend(sum.w);
            }
            node_seen[node] = sum.to_array();
        }
    }
    let Some(root) = levels.last().map(|level| level[0] as usize) else { return };
    let [r, g, b] = [settings.unseen; 3];
    node_color[root] = if node_seen[root][3] > 0.0 { node_seen[root] } else { [r, g, b, 1.0] };
    let mut source: Vec<[f32; 4]> = Vec::new();
    for level in levels.iter().rev().skip(1) {
        let nodes = level[0] as usize..(level[0] + level[1]) as usize;
        for node in nodes.clone() {
            node_color[node] = node_color[parents[node] as usize];
        }
        for _ in 0..DiffusionHierarchy::RELAX_STEPS {
            source.clear();
            source.extend_from_slice(&node_color[nodes.clone()]);
            let relaxed = |(offset, color): (usize, &mut [f32; 4])| {
                let node = nodes.start + offset;
                let own = Vec4::from(node_seen[node]);
                let (mut sum, mut weight) = (own.truncate() * own.w, own.w);
                for [other, bits] in &edges[links[node][0] as usize..links[node][1] as usize] {
                    let w = settings.smoothness * f32::from_bits(*bits);
                    sum += w * Vec4::from(source[*other as usize - nodes.start]).truncate();
                    weight += w;
                }
                let old = Vec4::from(source[offset]).truncate();
                if weight > 0.0 {
                    let damping = DiffusionHierarchy::DAMPING;
                    *color = (old * (1.0 - damping) + sum / weight * damping).extend(1.0).to_array();
                }
            };
            node_color[nodes.clone()].par_iter_mut().enumerate().with_min_len(512).for_each(relaxed);
        }
    }
}

/// Inpaints unseen Gaussians (Eq. 9), updates the memory (Eq. 10) and blends with it (Eq. 11, 12): `paint.wgsl`.
pub(super) fn paint(
    settings: &SettingsConstants,
    graph: &GraphBuffers,
    (seen, quality): (&[[f32; 4]], &[[f32; 2]]),
    memory: &mut [[f32; 4]],
    color: &mut [[f32; 4]],
) {
    let (Some(nodes), Some(weights), Some(node_color)) =
        (graph.gaussian_nodes.slice(), graph.gaussian_weights.slice(), graph.node_color.slice())
    else {
        return;
    };
    let unseen = Vec3::splat(settings.unseen);
    let one = |(i, (memory, color)): (usize, (&mut [f32; 4], &mut [f32; 4]))| {
        let sum = Vec4::from(seen[i]);
        let [weight, nearness] = quality[i];
        let visible = weight.min(1.0);
        let mut observed = if sum.w > 0.0 { sum.truncate() / sum.w } else { unseen };
        // What the paper's linear layer does with the two features it gets: a badly seen point follows the surface around it,
        // a seen one keeps its own detail.
        let own = visible / (visible + settings.inpaint_weight);
        // Share of the current colour that was seen rather than filled in.
        let share = visible + (1.0 - visible) * own;
        let mut current = observed;
        if settings.space != 0 {
            let around: Vec3 = nodes[i]
                .iter()
                .zip(&weights[i])
                .map(|(&node, &weight)| weight * Vec4::from(node_color[node as usize]).truncate())
                .sum();
            if settings.corrects != 0 && settings.sharpness > 0.0 {
                // The share that observations lack is that of the surface around: a change of light is corrected entirely.
                observed += (1.0 / settings.sharpness - 1.0) * around;
            }
            // Eq. 9 with f_gcn = mix(around, observed, own).
            let filled = around * (1.0 - own) + observed * own;
            current = (1.0 - visible) * filled + visible * observed;
        }
        if settings.time != 0 {
            let mut past = Vec4::from(*memory);
            let total = past.w + visible;
            if visible > 0.0 {
                let mean = (past.w * past.truncate() + visible * current) / total;
                let updated = mean.extend(total.min(settings.memory_weight_max));
                if updated.is_finite() {
                    past = updated;
                    *memory = updated.to_array();
                }
            }
            let trust = past.w / settings.memory_weight_max * (1.0 - share * nearness);
            let trust = trust.clamp(0.0, 1.0);
            current = current * (1.0 - trust) + past.truncate() * trust;
        }
        *color = current.extend(1.0).to_array();
    };
    memory.par_iter_mut().zip(color.par_iter_mut()).enumerate().with_min_len(CHUNK).for_each(one);
}
