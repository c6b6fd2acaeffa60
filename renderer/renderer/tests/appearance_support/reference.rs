//! Direct appearance as plain f64 code, written from the equations; nothing is shared with the kernels but the
//! levels of the graph.

use flyrig_renderer::{AppearanceSettings, DiffusionHierarchy, DiffusionLevel};
use glam::{DVec2, DVec3, DVec4};

use super::scene::{Frame, Person, View};

/// Linear RGB of sRGB 0.5.
pub const MID_GREY: f64 = 0.214_041_140_482_232_55;

/// Sum of weight * colour, sum of weights, sum of Eq. 6 weights, best exp(-k d).
#[derive(Debug, Clone, Copy, Default)]
struct Seen {
    color: DVec3,
    weight: f64,
    visible: f64,
    closeness: f64,
}

/// State that is carried from frame to frame.
pub struct State {
    /// Colour, weight.
    pub memory: Vec<DVec4>,
    /// Colours of the last frame.
    pub last: Option<Vec<DVec3>>,
}

/// One frame. Returns the colours.
pub fn update(
    person: &Person,
    levels: &[DiffusionLevel],
    frame: &Frame,
    views: &[View],
    settings: &AppearanceSettings,
    state: &mut State,
) -> Vec<DVec3> {
    let none = settings.corrects.then_some(DVec3::ZERO);
    let last =
        |i: usize| state.last.as_ref().filter(|_| settings.time || settings.corrects).map(|last| last[i]).or(none);
    let seen: Vec<Seen> =
        (0..person.canonical.len()).map(|i| observe(person, frame, views, settings, i, last(i))).collect();
    let nodes = diffuse(levels, &gather(person, &seen), settings);
    let one = |(i, seen)| paint(person, settings, &nodes, i, seen, &mut state.memory[i]);
    let colors: Vec<DVec3> = seen.iter().enumerate().map(one).collect();
    state.last = Some(colors.clone());
    colors
}

fn observe(
    person: &Person,
    frame: &Frame,
    views: &[View],
    settings: &AppearanceSettings,
    i: usize,
    past: Option<DVec3>,
) -> Seen {
    let mut seen = Seen::default();
    let [k, min_mask] = [settings.occlusion_per_m, settings.min_mask].map(f64::from);
    let extra = if settings.space || settings.corrects { 0.0 } else { 1e-3 };
    let position = xyz(frame.center_scale[i]) + f64::from(frame.normal[i][3]) * xyz(frame.normal[i]);
    for view in views {
        let Some(pixel) = view.camera.project(position) else { continue };
        let (width, height) = (view.camera.intrinsics.width, view.camera.intrinsics.height);
        let last = DVec2::new(f64::from(width) - 0.5, f64::from(height) - 0.5);
        if pixel.min_element() < -0.5 || pixel.x > last.x || pixel.y > last.y {
            continue;
        }
        let (mut color, mut coverage, mut rendered, mut drawn) = (DVec3::ZERO, 0.0, DVec4::ZERO, DVec4::ZERO);
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let corner = pixel.floor() + DVec2::new(dx, dy);
            let share = (1.0 - (pixel.x - corner.x).abs()) * (1.0 - (pixel.y - corner.y).abs());
            let x = (corner.x as i64).clamp(0, i64::from(width) - 1) as usize;
            let y = (corner.y as i64).clamp(0, i64::from(height) - 1) as usize;
            let index = y * width as usize + x;
            let texel: [f64; 4] = std::array::from_fn(|c| f64::from(view.rgba[index * 4 + c]) / 255.0);
            let belief = share * ((texel[3] - min_mask) / (1.0 - min_mask)).clamp(0.0, 1.0);
            color += DVec3::new(linear(texel[0]), linear(texel[1]), linear(texel[2])) * belief;
            coverage += belief;
            rendered += DVec4::from_array(view.canonical[index].map(f64::from)) * share;
            drawn += DVec4::from_array(view.rendered[index].map(f64::from)) * share;
        }
        if coverage < 0.01 {
            continue;
        }
        color /= coverage;
        let mut weight = 0.0;
        if rendered.w >= 0.5 {
            let normal = xyz(frame.normal[i]).normalize();
            let v = (position - view.camera.position()).normalize();
            let facing = normal.dot(v);
            let angle = if facing < 0.0 { 1.0 - (1.0 - facing * facing).max(0.0).sqrt() } else { 0.0 };
            let d = (rendered.truncate() / rendered.w - xyz(person.canonical[i])).length();
            weight = angle * (1.0 - k * d).max(0.0) * coverage;
            if weight > 0.0 {
                seen.visible += weight;
                seen.closeness = seen.closeness.max((-k * d).exp());
                if settings.corrects {
                    let off = color - drawn.truncate() / drawn.w;
                    color = f64::from(settings.sharpness) * (past.unwrap_or_default() + off);
                } else if let Some(last) = past.filter(|_| drawn.w >= 0.5) {
                    let lacking = last - drawn.truncate() / drawn.w;
                    color = (color + lacking * f64::from(settings.sharpness)).clamp(DVec3::ZERO, DVec3::ONE);
                }
            } else {
                weight = 0.0;
            }
        }
        let total = weight + extra * coverage;
        seen.color += color * total;
        seen.weight += total;
    }
    seen
}

/// Mean colour and mean visibility around each node.
fn gather(person: &Person, seen: &[Seen]) -> Vec<DVec4> {
    let graph = &person.graph;
    let mut sums = vec![(DVec4::ZERO, 0.0); graph.nodes.len()];
    for (i, seen) in seen.iter().enumerate() {
        for (&node, &weight) in graph.gaussian_nodes[i].iter().zip(&graph.gaussian_weights[i]) {
            let (sum, total) = &mut sums[node as usize];
            *sum += seen.color.extend(seen.weight) / seen.weight.max(1.0) * f64::from(weight);
            *total += f64::from(weight);
        }
    }
    sums.into_iter()
        .map(|(s, total)| if s.w > 0.0 { (s.truncate() / s.w).extend(s.w / total) } else { DVec4::ZERO })
        .collect()
}

/// Cascade from the coarsest level down.
fn diffuse(levels: &[DiffusionLevel], finest: &[DVec4], settings: &AppearanceSettings) -> Vec<DVec3> {
    let smoothness = f64::from(settings.smoothness);
    let mut seen = vec![finest.to_vec()];
    for pair in levels.windows(2) {
        let mut coarse = vec![DVec4::ZERO; pair[1].edges.len()];
        for (one, &parent) in seen.last().into_iter().flatten().zip(&pair[0].parent) {
            coarse[parent as usize] += (one.truncate() * one.w).extend(one.w);
        }
        for one in coarse.iter_mut().filter(|one| one.w > 0.0) {
            *one = (one.truncate() / one.w).extend(one.w);
        }
        seen.push(coarse);
    }
    let root = seen[levels.len() - 1][0];
    let mut colors = vec![if root.w > 0.0 { root.truncate() } else { unseen(settings) }];
    for (level, seen) in levels.iter().zip(&seen).rev().skip(1) {
        colors = level.parent.iter().map(|&p| colors[p as usize]).collect();
        for _ in 0..DiffusionHierarchy::RELAX_STEPS {
            colors = relax(level, seen, &colors, smoothness, f64::from(DiffusionHierarchy::DAMPING));
        }
    }
    colors
}

fn relax(level: &DiffusionLevel, seen: &[DVec4], old: &[DVec3], smoothness: f64, damping: f64) -> Vec<DVec3> {
    let one = |node: usize| {
        let (mut sum, mut weight) = (seen[node].truncate() * seen[node].w, seen[node].w);
        for &(other, edge) in &level.edges[node] {
            sum += old[other as usize] * smoothness * f64::from(edge);
            weight += smoothness * f64::from(edge);
        }
        if weight > 0.0 { old[node].lerp(sum / weight, damping) } else { old[node] }
    };
    (0..old.len()).map(one).collect()
}

/// The finest level's screened Laplace equation solved to the end, from what the views see.
pub fn exact_diffusion(
    person: &Person,
    levels: &[DiffusionLevel],
    frame: &Frame,
    views: &[View],
    settings: &AppearanceSettings,
) -> Vec<DVec3> {
    let nodes = gather_seen(person, frame, views, settings);
    let mut colors = diffuse(levels, &nodes, settings);
    for _ in 0..20_000 {
        colors = relax(&levels[0], &nodes, &colors, f64::from(settings.smoothness), 0.9);
    }
    upsample_all(person, &colors)
}

/// The cascade's result at the Gaussians.
pub fn cascade_diffusion(
    person: &Person,
    levels: &[DiffusionLevel],
    frame: &Frame,
    views: &[View],
    settings: &AppearanceSettings,
) -> Vec<DVec3> {
    let colors = diffuse(levels, &gather_seen(person, frame, views, settings), settings);
    upsample_all(person, &colors)
}

/// Gathers what the views see of all Gaussians at the nodes.
fn gather_seen(person: &Person, frame: &Frame, views: &[View], settings: &AppearanceSettings) -> Vec<DVec4> {
    let seen: Vec<Seen> =
        (0..person.canonical.len()).map(|i| observe(person, frame, views, settings, i, None)).collect();
    gather(person, &seen)
}

fn upsample_all(person: &Person, nodes: &[DVec3]) -> Vec<DVec3> {
    (0..person.canonical.len()).map(|i| upsample(person, nodes, i)).collect()
}

fn upsample(person: &Person, nodes: &[DVec3], i: usize) -> DVec3 {
    let pairs = person.graph.gaussian_nodes[i].iter().zip(&person.graph.gaussian_weights[i]);
    pairs.map(|(&node, &weight)| nodes[node as usize] * f64::from(weight)).sum()
}

fn paint(
    person: &Person,
    settings: &AppearanceSettings,
    nodes: &[DVec3],
    i: usize,
    seen: &Seen,
    memory: &mut DVec4,
) -> DVec3 {
    let visible = seen.visible.min(1.0);
    let mut observed = if seen.weight > 0.0 { seen.color / seen.weight } else { unseen(settings) };
    let own = visible / (visible + f64::from(settings.inpaint_weight));
    let share = visible + (1.0 - visible) * own;
    let current = if settings.space {
        let around = upsample(person, nodes, i);
        if settings.corrects {
            observed += (1.0 / f64::from(settings.sharpness) - 1.0) * around;
        }
        let filled = around * (1.0 - own) + observed * own;
        filled * (1.0 - visible) + observed * visible
    } else {
        observed
    };
    if !settings.time {
        return current;
    }
    let most = f64::from(settings.memory_weight_max);
    let total = memory.w + visible;
    if total > 0.0 {
        *memory = ((memory.truncate() * memory.w + current * visible) / total).extend(total.min(most));
    }
    let trust = memory.w / most * (1.0 - share * seen.closeness);
    current * (1.0 - trust) + memory.truncate() * trust
}

/// Colour of a surface that nobody saw.
fn unseen(settings: &AppearanceSettings) -> DVec3 {
    DVec3::splat(if settings.corrects { 0.0 } else { MID_GREY })
}

fn xyz(v: [f32; 4]) -> DVec3 {
    DVec4::from_array(v.map(f64::from)).truncate()
}

fn linear(srgb: f64) -> f64 {
    if srgb <= 0.04045 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}
