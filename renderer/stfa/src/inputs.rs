//! Construction of the networks' inputs from the observations of direct appearance.

use flyrig_renderer::{AppearanceSettings, Observations, linear_from_srgb, srgb_from_linear};
use rayon::prelude::*;

use crate::{
    BodyGraph, StfaError,
    body_graph::POOLED,
    crops::{Crops, DETAIL},
    taps::{Tap, Taps},
};

/// Number of candidate colours: around the Gaussian, on the other side of the body, two bands of detail, and that of
/// the best view (the difference between views indicates their alignment).
pub const CANDIDATES: usize = 5;
/// Length of a Gaussian's state, which passes through the memory with its features: linear colour, visibility of itself
/// and of its mirror image, candidates as differences of sRGB values.
pub const STATE: usize = 5 + 3 * CANDIDATES;
/// Length of a node's inputs besides its image feature: sRGB of the diffused colour around it and visibility, of itself
/// and of its mirror image.
pub const NODE: usize = 8;

/// Offset of the best view's candidate in a state.
const BEST: usize = STATE - 3;

/// Gaussians per task.
const CHUNK: usize = if cfg!(test) { 700 } else { 8192 };

/// Sum of weights at which a mean has half its confidence.
pub(crate) const SMALL_WEIGHT: f32 = 0.02;

/// Networks' inputs of one frame, for all or some Gaussians.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FrameInputs {
    /// Samples of the feature maps, one row per Gaussian (Eq. 5).
    pub taps: Taps,
    /// State per Gaussian, [`STATE`] numbers.
    pub state: Vec<[f32; STATE]>,
    /// Share of the colour that was seen, and exp(-k d) of the best view (Eq. 11), per Gaussian.
    pub seen: Vec<[f32; 2]>,
    /// Samples of the feature maps, one row per node: mean of the Gaussians around it.
    pub node_taps: Taps,
    /// Inputs per node, [`NODE`] numbers.
    pub nodes: Vec<[f32; NODE]>,
}

/// Replaces a non-finite number with 0.
fn tame(value: f32) -> f32 {
    if value.is_finite() { value } else { 0.0 }
}

fn srgb(linear: [f32; 3]) -> [f32; 3] {
    linear.map(srgb_from_linear)
}

/// Gathers the inputs of the Gaussians in `which`, in its order; of all for `None`. `settings` are those of the
/// observing update.
///
/// # Errors
/// [`StfaError::Frame`] where body, observations and crops do not fit each other.
pub fn frame_inputs(
    body: &BodyGraph,
    observed: &Observations,
    crops: &Crops,
    settings: &AppearanceSettings,
    which: Option<&[u32]>,
) -> Result<FrameInputs, StfaError> {
    let (gaussians, nodes) = (body.gaussians(), body.nodes());
    let lengths = [
        ("observed colours", observed.seen.len(), gaussians),
        ("qualities", observed.quality.len(), gaussians),
        ("seen nodes", observed.node_seen.len(), nodes),
        ("node colours", observed.node_color.len(), nodes),
        ("views", observed.views.len(), crops.views),
    ];
    for (what, found, expected) in lengths {
        if found != expected {
            return Err(StfaError::Frame(format!("{found} {what}, expected {expected}")));
        }
    }
    if let Some(view) = observed.views.iter().position(|view| view.len() != gaussians) {
        return Err(StfaError::Frame(format!("view {view} kept no observation of each of {gaussians} Gaussians")));
    }
    if let Some(bad) = which.and_then(|which| which.iter().find(|&&index| index as usize >= gaussians)) {
        return Err(StfaError::Frame(format!("Gaussian {bad} of {gaussians}")));
    }
    let all: Vec<u32>;
    let which = match which {
        Some(which) => which,
        None => {
            all = (0..gaussians as u32).collect();
            &all
        }
    };
    let part = |which: &[u32]| {
        let mut taps = Taps::default();
        for &index in which {
            let denominator = row_weight(observed, settings, index as usize);
            push_taps(&mut taps, observed, crops, index as usize, 1.0 / denominator);
            taps.end_row();
        }
        taps
    };
    let taps = Taps::joined(which.par_chunks(CHUNK).map(part).collect());
    let detail = taps.sample(&[crops.detail(settings)]);
    let colors = crops.colors(settings);
    let [mean, best] = [taps.sample(std::slice::from_ref(&colors)), taps.heaviest().sample(&[colors])];
    let states: Vec<([f32; STATE], [f32; 2])> = which
        .par_iter()
        .zip(detail.par_chunks_exact(DETAIL))
        .zip(mean.par_chunks_exact(4).zip(best.par_chunks_exact(4)))
        .enumerate()
        .map(|(row, ((&index, detail), (mean, best)))| {
            let weight: f32 = taps.row(row).iter().map(|tap| tap.weight).sum();
            let (mut state, seen) = gaussian_state(body, observed, settings, index as usize, detail, weight);
            state[BEST..].copy_from_slice(&difference(best, mean));
            (state, seen)
        })
        .collect();
    let (state, seen) = states.into_iter().unzip();

    let mut node_taps = Taps::default();
    let mut node_values = Vec::with_capacity(nodes);
    for node in 0..nodes {
        let total: f32 = body.pooled[node].iter().map(|&g| sum_weight(observed, g as usize)).sum();
        for &gaussian in &body.pooled[node] {
            push_taps(&mut node_taps, observed, crops, gaussian as usize, 1.0 / (total + POOLED as f32 * SMALL_WEIGHT));
        }
        node_taps.end_row();
        let own = |node: usize| {
            let [r, g, b] = srgb(rgb(observed.node_color[node]));
            [r, g, b, tame(observed.node_seen[node][3])]
        };
        let ([a, b, c, d], [e, f, g, h]) = (own(node), own(body.mirror(node)));
        node_values.push([a, b, c, d, e, f, g, h]);
    }
    Ok(FrameInputs { taps, state, seen, node_taps, nodes: node_values })
}

/// Returns the difference of two sampled colours, whose fourth number is the mask weight; zero where one of them was
/// not seen.
fn difference(a: &[f32], b: &[f32]) -> [f32; 3] {
    if a[3] > 1e-3 && b[3] > 1e-3 { std::array::from_fn(|c| tame(a[c] / a[3] - b[c] / b[3])) } else { [0.0; 3] }
}

fn rgb(color: [f32; 4]) -> [f32; 3] {
    [color[0], color[1], color[2]].map(tame)
}

fn sum_weight(observed: &Observations, gaussian: usize) -> f32 {
    observed.views.iter().filter_map(|view| look(view[gaussian])).map(|[_, _, weight]| weight).sum()
}

/// Returns the normalisation of Eq. 5: weights are unchanged unless their sum exceeds 1. The baseline without
/// inpainting always normalises.
fn row_weight(observed: &Observations, settings: &AppearanceSettings, gaussian: usize) -> f32 {
    let sum = sum_weight(observed, gaussian);
    if settings.space { sum.max(1.0) } else { sum.max(1e-6) }
}

/// Returns pixel and weight, where a view shows the Gaussian.
fn look([x, y, weight, _]: [f32; 4]) -> Option<[f32; 3]> {
    (weight > 0.0 && [x, y, weight].iter().all(|v| v.is_finite())).then_some([x, y, weight])
}

fn push_taps(taps: &mut Taps, observed: &Observations, crops: &Crops, gaussian: usize, factor: f32) {
    for (view, (kept, origin)) in observed.views.iter().zip(&crops.origins).enumerate() {
        if let Some([x, y, weight]) = look(kept[gaussian]) {
            let pixel = [x - origin[0] as f32, y - origin[1] as f32];
            taps.taps.push(Tap { view: view as u32, pixel, weight: weight * factor });
        }
    }
}

/// Computes the colour that direct appearance paints before its memory, and the candidates.
fn gaussian_state(
    body: &BodyGraph,
    observed: &Observations,
    settings: &AppearanceSettings,
    gaussian: usize,
    detail: &[f32],
    tap_weight: f32,
) -> ([f32; STATE], [f32; 2]) {
    let sum = observed.seen[gaussian].map(tame);
    let [weights, nearness] = observed.quality[gaussian].map(tame);
    let visible = weights.clamp(0.0, 1.0);
    let own_color =
        if sum[3] > 0.0 { [sum[0], sum[1], sum[2]].map(|v| tame(v / sum[3])) } else { [linear_from_srgb(0.5); 3] };
    let own = visible / (visible + settings.inpaint_weight);
    let mut around = [0.0; 3];
    let mut mirrored = [0.0; 3];
    let mut mirror_visible = 0.0;
    for (&node, &weight) in body.gaussian_nodes[gaussian].iter().zip(&body.gaussian_weights[gaussian]) {
        let mirror = body.mirror(node as usize);
        let (here, there) = (rgb(observed.node_color[node as usize]), rgb(observed.node_color[mirror]));
        for c in 0..3 {
            around[c] += weight * here[c];
            mirrored[c] += weight * there[c];
        }
        mirror_visible += weight * tame(observed.node_seen[mirror][3]);
    }
    let mix = |c: usize| {
        if !settings.space {
            return own_color[c];
        }
        (1.0 - visible) * (around[c] + (own_color[c] - around[c]) * own) + visible * own_color[c]
    };
    let base = [mix(0), mix(1), mix(2)];
    let encoded = srgb(base);
    let mut state = [0.0; STATE];
    state[..3].copy_from_slice(&base);
    state[3] = visible;
    if settings.space {
        state[4] = mirror_visible;
        let (around, mirrored) = (srgb(around), srgb(mirrored));
        for c in 0..3 {
            state[5 + c] = around[c] - encoded[c];
            state[8 + c] = mirrored[c] - encoded[c];
        }
    }
    for (to, from) in state[11..BEST].iter_mut().zip(detail) {
        *to = from / (tap_weight + SMALL_WEIGHT);
    }
    let share = visible + (1.0 - visible) * own;
    (state, [share, nearness])
}
