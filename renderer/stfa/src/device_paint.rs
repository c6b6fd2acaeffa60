//! One frame through the networks without leaving their device: what [`frame_inputs`](crate::frame_inputs), sampling and
//! memory do on the processor, as tensors.

use flyrig_learn::burn_tensor::{Device, Int, Tensor, TensorData, module, ops::ConvOptions};
#[cfg(test)]
use flyrig_renderer::Observations;
use flyrig_renderer::{AppearanceSettings, linear_from_srgb as linear};

use crate::{
    BodyGraph, Parameters, StfaError,
    body_graph::POOLED,
    crops::{BLURS_PX, Crops, DETAIL, blur_kernel},
    inputs::{SMALL_WEIGHT, STATE},
    network::{Network, linear_from_srgb, srgb_from_linear},
};

/// What direct appearance found out, on the device: [`Observations`](flyrig_renderer::Observations) as tables.
#[derive(Debug, Clone)]
pub(crate) struct ObservedTensors {
    pub(crate) views: Vec<Tensor<2>>,
    pub(crate) seen: Tensor<2>,
    pub(crate) quality: Tensor<2>,
    pub(crate) node_seen: Tensor<2>,
    pub(crate) node_color: Tensor<2>,
}

impl ObservedTensors {
    /// Copies them to the device.
    #[cfg(test)]
    pub(crate) fn upload(observed: &Observations, device: &Device) -> Self {
        let wide = |values: &[[f32; 4]]| table(values.as_flattened(), 4, device);
        Self {
            views: observed.views.iter().map(|view| wide(view)).collect(),
            seen: wide(&observed.seen),
            quality: table(observed.quality.as_flattened(), 2, device),
            node_seen: wide(&observed.node_seen),
            node_color: wide(&observed.node_color),
        }
    }

    fn tamed(&self) -> Self {
        Self {
            views: self.views.clone(),
            seen: tame(self.seen.clone()),
            quality: tame(self.quality.clone()),
            node_seen: tame(self.node_seen.clone()),
            node_color: tame(self.node_color.clone()),
        }
    }
}

/// What the networks know of a body, on their device.
#[derive(Debug)]
struct BodyTensors {
    place: Tensor<2>,
    edges: Tensor<1, Int>,
    /// Of each node.
    mirror: Tensor<1, Int>,
    /// Four a Gaussian.
    nodes: Tensor<1, Int>,
    /// Mirror images of those.
    mirror_nodes: Tensor<1, Int>,
    /// A column a node of a Gaussian.
    weights: Tensor<3>,
    /// [`POOLED`] Gaussians a node.
    pooled: Tensor<1, Int>,
}

/// Paints every Gaussian as [`LearnedAppearance`](crate::LearnedAppearance) does, whatever device the networks are on.
#[derive(Debug)]
pub(crate) struct DevicePainter {
    network: Network,
    body: BodyTensors,
    gaussians: usize,
    /// f_acc and w_acc of every Gaussian (Eq. 10).
    memory: Option<[Tensor<2>; 2]>,
}

impl DevicePainter {
    pub(crate) fn new(parameters: &Parameters, body: &BodyGraph, device: &Device) -> Self {
        let network =
            Network { device: device.clone(), size: parameters.size, tensors: parameters.tensors(device, false) };
        let (place, edges) = network.body_tensors(body);
        let gaussians = body.gaussians();
        let nodes = || body.gaussian_nodes.as_flattened().iter().copied();
        let weights = table(body.gaussian_weights.as_flattened(), 4, device).reshape([gaussians, 4, 1]);
        let body = BodyTensors {
            place,
            edges,
            mirror: network.indices((0..body.nodes()).map(|node| body.mirror(node) as u32)),
            nodes: network.indices(nodes()),
            mirror_nodes: network.indices(nodes().map(|node| body.mirror(node as usize) as u32)),
            weights,
            pooled: network.indices(body.pooled.as_flattened().iter().copied()),
        };
        Self { network, body, gaussians, memory: None }
    }

    /// Of the body.
    #[cfg(feature = "wgpu")]
    pub(crate) fn gaussians(&self) -> usize {
        self.gaussians
    }

    /// Of the body's graph.
    #[cfg(feature = "wgpu")]
    pub(crate) fn nodes(&self) -> usize {
        self.body.mirror.dims()[0]
    }

    /// Forgets all earlier frames.
    pub(crate) fn reset(&mut self) {
        self.memory = None;
    }

    /// Linear RGB and 1 of every Gaussian, a row each.
    pub(crate) fn paint(
        &mut self,
        observed: &ObservedTensors,
        crops: &Crops,
        settings: &AppearanceSettings,
    ) -> Result<Tensor<2>, StfaError> {
        if observed.views.len() != crops.views {
            return Err(StfaError::Frame(format!("{} views, {} images", observed.views.len(), crops.views)));
        }
        let observed = observed.tamed();
        let sampled = self.sample(&observed, crops, settings);
        let visible = observed.quality.clone().narrow(1, 0, 1).clamp(0.0, 1.0);
        let own = visible.clone() / (visible.clone() + settings.inpaint_weight);
        let state = self.state(&observed, &sampled, &visible, &own, settings);
        let feature = if settings.space {
            let nodes = self.node_inputs(&observed);
            let BodyTensors { place, edges, .. } = &self.body;
            let graph = self.network.graph(sampled.node_feature, nodes, place.clone(), edges);
            let around = self.at_gaussians(graph, &self.body.nodes);
            self.network.fill(sampled.feature, visible.clone(), around)
        } else {
            sampled.feature
        };
        let mut rows = Tensor::cat(vec![state, feature], 1);
        if settings.time {
            let share = visible.clone() + rest(&visible) * own;
            let certain = share * observed.quality.narrow(1, 1, 1);
            rows = self.fuse(rows, &visible, &certain, settings.memory_weight_max);
        }
        let base = srgb_from_linear(rows.clone().narrow(1, 0, 3));
        let painted = self.network.color(rows);
        // As on the processor: a colour that is none in one channel is direct appearance's in all.
        let sound = painted.clone().is_finite().float().sum_dim(1).greater_elem(2.5).expand([self.gaussians, 3]);
        let color = tame(linear_from_srgb(base.mask_where(sound, painted)));
        Ok(Tensor::cat(vec![color, Tensor::ones([self.gaussians, 1], &self.network.device)], 1))
    }

    /// A node's values at the Gaussians that hang on it.
    fn at_gaussians(&self, of_nodes: Tensor<2>, nodes: &Tensor<1, Int>) -> Tensor<2> {
        let columns = of_nodes.dims()[1];
        let gathered = of_nodes.select(0, nodes.clone()).reshape([self.gaussians, 4, columns]);
        (gathered * self.body.weights.clone()).sum_dim(1).reshape([self.gaussians, columns])
    }

    /// What the images show at the Gaussians (Eq. 5) and around the nodes.
    fn sample(&self, observed: &ObservedTensors, crops: &Crops, settings: &AppearanceSettings) -> Sampled {
        let device = &self.network.device;
        let features = self.network.size.feature();
        let zeros = |columns: usize| Tensor::<2>::zeros([self.gaussians, columns], device);
        let (mut feature, mut picture, mut weights) = (zeros(features), zeros(COLORS + DETAIL), zeros(1));
        let (mut best, mut best_weight) = (zeros(COLORS), zeros(1));
        if !crops.rgba.is_empty() {
            let planes: Vec<f32> = (0..crops.views).flat_map(|view| crops.planes(view, settings)).collect();
            let planes = self.network.pictures(planes, crops.views, crops.height, crops.width);
            let maps = self.network.encode(planes.clone());
            let shown = image_maps(planes, device);
            for (view, kept) in observed.views.iter().enumerate() {
                let place = Place::new(kept, crops.origins[view]);
                let weight = place.weight.clone();
                let levels = maps.iter().zip([1, 2, 4]).map(|(maps, stride)| place.sample(maps, view, stride));
                let here = place.sample(&shown, view, 1);
                feature = feature + Tensor::cat(levels.collect(), 1) * weight.clone();
                let colors = here.clone().narrow(1, 0, COLORS);
                let better = weight.clone().greater(best_weight.clone());
                best = best.mask_where(better.expand([self.gaussians, COLORS]), colors);
                best_weight = best_weight.max_pair(weight.clone());
                picture = picture + here * weight.clone();
                weights = weights + weight;
            }
        }
        let pool = |table: &Tensor<2>| {
            let columns = table.dims()[1];
            let nodes = self.body.mirror.dims()[0];
            let pooled = table.clone().select(0, self.body.pooled.clone()).reshape([nodes, POOLED, columns]);
            pooled.sum_dim(1).reshape([nodes, columns])
        };
        let node_feature = pool(&feature) / (pool(&weights) + POOLED as f32 * SMALL_WEIGHT);
        let divisor = weights.clone().clamp_min(if settings.space { 1.0 } else { 1e-6 });
        Sampled {
            feature: feature / divisor.clone(),
            picture: picture / divisor.clone(),
            weight: weights / divisor,
            best,
            node_feature,
        }
    }

    /// A [`STATE`] a Gaussian.
    fn state(
        &self,
        observed: &ObservedTensors,
        sampled: &Sampled,
        visible: &Tensor<2>,
        own: &Tensor<2>,
        settings: &AppearanceSettings,
    ) -> Tensor<2> {
        let rgb = |table: &Tensor<2>| table.clone().narrow(1, 0, 3);
        let last = |table: &Tensor<2>| table.clone().narrow(1, 3, 1);
        let (seen, weight) = (rgb(&observed.seen), last(&observed.seen));
        let unseen = weight.clone().greater_elem(0.0).bool_not().expand([self.gaussians, 3]);
        let own_color = tame(seen / weight).mask_fill(unseen, linear(0.5));
        let nothing = |columns: usize| Tensor::<2>::zeros([self.gaussians, columns], &self.network.device);
        let (base, filling) = if settings.space {
            let around = rgb(&self.at_gaussians(observed.node_color.clone(), &self.body.nodes));
            let mirrored = rgb(&self.at_gaussians(observed.node_color.clone(), &self.body.mirror_nodes));
            let mirror_visible = last(&self.at_gaussians(observed.node_seen.clone(), &self.body.mirror_nodes));
            let filled = around.clone() + (own_color.clone() - around.clone()) * own.clone();
            let base = rest(visible) * filled + visible.clone() * own_color;
            let encoded = srgb_from_linear(base.clone());
            let towards = |color: Tensor<2>| srgb_from_linear(color) - encoded.clone();
            (base, [mirror_visible, towards(around), towards(mirrored)])
        } else {
            (own_color, [nothing(1), nothing(3), nothing(3)])
        };
        let mean = sampled.picture.clone().narrow(1, 0, COLORS);
        let detail = sampled.picture.clone().narrow(1, COLORS, DETAIL) / (sampled.weight.clone() + SMALL_WEIGHT);
        let both = sampled.best.clone().narrow(1, 3, 1).greater_elem(1e-3);
        let both = both.bool_and(mean.clone().narrow(1, 3, 1).greater_elem(1e-3)).expand([self.gaussians, 3]);
        let color = |of: &Tensor<2>| rgb(of) / last(of).clamp_min(1e-3);
        let apart = tame(color(&sampled.best) - color(&mean)).mask_fill(both.bool_not(), 0.0);
        let [mirror_visible, around, mirrored] = filling;
        let state = Tensor::cat(vec![base, visible.clone(), mirror_visible, around, mirrored, detail, apart], 1);
        debug_assert_eq!(state.dims(), [self.gaussians, STATE]);
        state
    }

    /// What the graph network knows of every node beside its feature.
    fn node_inputs(&self, observed: &ObservedTensors) -> Tensor<2> {
        let color = srgb_from_linear(observed.node_color.clone().narrow(1, 0, 3));
        let own = Tensor::cat(vec![color, observed.node_seen.clone().narrow(1, 3, 1)], 1);
        Tensor::cat(vec![own.clone(), own.select(0, self.body.mirror.clone())], 1)
    }

    /// Eq. 10 to 12, as [`FeatureMemory`](crate::FeatureMemory). `certain` is the share that was seen times exp(-k d).
    fn fuse(&mut self, rows: Tensor<2>, visible: &Tensor<2>, certain: &Tensor<2>, max: f32) -> Tensor<2> {
        let (device, width) = (&self.network.device, rows.dims()[1]);
        let fresh = || [Tensor::zeros([self.gaussians, width], device), Tensor::zeros([self.gaussians, 1], device)];
        let [past, past_weight] = self.memory.take().unwrap_or_else(fresh);
        let whole = rows.clone().is_finite().float().sum_dim(1).greater_elem(width as f32 - 0.5);
        let takes = whole.bool_and(visible.clone().greater_elem(0.0));
        let total = past_weight.clone() + visible.clone();
        let mean = (past.clone() * past_weight.clone() + rows.clone() * visible.clone()) / total.clone();
        let past = past.mask_where(takes.clone().expand([self.gaussians, width]), mean);
        let past_weight = past_weight.mask_where(takes, total.clamp_max(max));
        self.memory = Some([past.clone(), past_weight.clone()]);
        let trust = (past_weight / max * rest(certain)).clamp(0.0, 1.0);
        let sound = rows.clone().is_finite();
        let blended = rows.clone() + (past.clone() - rows) * trust.clone();
        // As on the processor: a number that is none gives way to the past, where there is trust in it.
        let trusted = trust.greater_elem(0.0).expand([self.gaussians, width]);
        blended.mask_where(sound.bool_not().bool_and(trusted), past)
    }
}

/// What the images show, all views together.
struct Sampled {
    /// f_vis of each Gaussian.
    feature: Tensor<2>,
    /// Colours with belief, and detail.
    picture: Tensor<2>,
    /// Sum of the weights in the two above.
    weight: Tensor<2>,
    /// Colours with belief of the view that sees the Gaussian best.
    best: Tensor<2>,
    node_feature: Tensor<2>,
}

/// Columns of a colour with belief.
const COLORS: usize = 4;

/// Where the Gaussians lie in a view, columns.
struct Place {
    x: Tensor<2>,
    y: Tensor<2>,
    weight: Tensor<2>,
}

impl Place {
    /// Pixels of the crop. What is no number, and what the view has nothing to say of, weighs nothing.
    fn new(kept: &Tensor<2>, origin: [u32; 2]) -> Self {
        let [x, y, weight] = [0, 1, 2].map(|column| kept.clone().narrow(1, column, 1));
        let finite = x.clone().is_finite().bool_and(y.clone().is_finite()).bool_and(weight.clone().is_finite());
        let void = finite.bool_and(weight.clone().greater_elem(0.0)).bool_not();
        let [x, y, weight] = [x, y, weight].map(|values| values.mask_fill(void.clone(), 0.0));
        Self { x: x - origin[0] as f32, y: y - origin[1] as f32, weight }
    }

    /// Bilinear samples of a view's maps (views, height, width, channels), unweighted.
    fn sample(&self, maps: &Tensor<4>, view: usize, stride: usize) -> Tensor<2> {
        let [_, height, width, channels] = maps.dims();
        let map = maps.clone().narrow(0, view, 1).reshape([height * width, channels]);
        let axis = |value: &Tensor<2>, size: usize| {
            let at = (value.clone() / stride as f32).clamp(0.0, size as f32 - 1.0);
            let low = at.clone().floor();
            let high = (low.clone() + 1.0).clamp_max(size as f32 - 1.0);
            ([low.clone(), high], at - low)
        };
        let ([x0, x1], fx) = axis(&self.x, width);
        let ([y0, y1], fy) = axis(&self.y, height);
        let (left, top) = (rest(&fx), rest(&fy));
        let corner = |x: &Tensor<2>, y: &Tensor<2>, share: Tensor<2>| {
            let index = y.clone().int() * width as i32 + x.clone().int();
            map.clone().select(0, index.squeeze_dim(1)) * share
        };
        corner(&x0, &y0, left.clone() * top.clone())
            + corner(&x1, &y0, fx.clone() * top)
            + corner(&x0, &y1, left * fy.clone())
            + corner(&x1, &y1, fx * fy)
    }
}

/// Colours with belief and detail of all images, channels last: [`Crops::colors`] and [`Crops::detail`].
fn image_maps(planes: Tensor<4>, device: &Device) -> Tensor<4> {
    let [views, _, height, width] = planes.dims();
    let blurred = |sigma: f32| {
        let kernel = blur_kernel(sigma);
        let (size, radius) = (kernel.len(), kernel.len() / 2);
        let weights = |shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(kernel.clone(), shape), device);
        let options = |padding| ConvOptions::new([1, 1], padding, [1, 1], 1);
        let each = planes.clone().reshape([views * COLORS, 1, height, width]);
        let rows = module::conv2d(each, weights([1, 1, 1, size]), None, options([0, radius]));
        let both = module::conv2d(rows, weights([1, 1, size, 1]), None, options([radius, 0]));
        both.reshape([views, COLORS, height, width])
    };
    let belief = |of: &Tensor<4>| of.clone().narrow(1, 3, 1);
    let mean = |of: &Tensor<4>| {
        let void = belief(of).greater_elem(1e-3).bool_not().expand([views, 3, height, width]);
        (of.clone().narrow(1, 0, 3) / belief(of).clamp_min(1e-3)).mask_fill(void, 0.0)
    };
    let [fine, coarse] = BLURS_PX.map(|sigma| mean(&blurred(sigma)));
    let outside = belief(&planes).greater_elem(0.0).bool_not().expand([views, DETAIL, height, width]);
    let detail = Tensor::cat(vec![mean(&planes) - fine.clone(), fine - coarse], 1).mask_fill(outside, 0.0);
    Tensor::cat(vec![planes, detail], 1).permute([0, 2, 3, 1])
}

/// What is missing to 1.
fn rest(share: &Tensor<2>) -> Tensor<2> {
    share.clone().neg() + 1.0
}

/// Zero in place of what is no number.
fn tame(values: Tensor<2>) -> Tensor<2> {
    let void = values.clone().is_finite().bool_not();
    values.mask_fill(void, 0.0)
}

fn table(values: &[f32], columns: usize, device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len() / columns, columns]), device)
}

#[cfg(test)]
#[path = "device_paint_tests.rs"]
mod tests;
