//! Colours: changes of quantised Haar coefficients from frame to frame, in layers from coarse to fine.
//!
//! Encoder and decoder keep the coefficients in whole quantisation steps. A message changes some segments of the surface, each either by
//! the difference from the encoder's last state or by the state itself (a refresh, which corrects a decoder whatever it missed). Every
//! segment is refreshed once per [`ColorSettings::refresh_secs`]; for a decoder that missed nothing a refresh changes nothing, so it is
//! invisible. The error of a decoder that misses a message is limited to the changes of that message.
//!
//! A message ends at its byte budget: the remaining segments wait for the next frame.
//!
//! A viewer that joins, or has missed messages, does not wait for refreshes: [`WholeColors::whole`] returns messages with the present state
//! of all segments. Changes that overtake them are applied again on top.

use alloc::{collections::VecDeque, vec, vec::Vec};
use core::ops::Range;

use crate::{
    bytes::Fields,
    coefficients::{CoefficientModel, GROUP, Levels},
    error::StreamError,
    integers::MOST,
    message::{COLOR_MAGIC, MAX_MESSAGE_BYTES},
    quantise::quantise,
    range_coder::{BitCoder, Probability, RangeDecoder, RangeEncoder},
    srgb::Srgb,
    stamp::Stamp,
    template::{EncodedTemplate, StreamTemplate},
    tree::{CHANNELS, HaarTree, Steps},
};

/// Number of layers, from coarse to fine: a viewer can show any number of the first ones.
pub const LAYERS: usize = 3;

const WHAT: &str = "colour message";
/// Quantisation step of the two colour differences relative to that of the brightness.
const CHROMA: f32 = 1.8;
/// Rounding offset: changes below `1 - ROUND_UP` of a step count as none.
const ROUND_UP: f32 = 0.3;
/// Bit of a layer's number in messages of [`WholeColors::whole`], whose sequence number is that of the next message of changes.
const WHOLE: u8 = 0x80;
/// Frame sets per second above which the byte budget holds for a frame set, below which for the time between two of them; and the largest
/// multiple of the budget.
const FULL_RATE: f32 = 10.0;
const MOST_BUDGETS: f32 = 8.0;
/// Largest number and bytes of messages that a decoder keeps, to apply them again on top of an older whole state.
const MAX_KEPT: usize = 96;
const MAX_KEPT_BYTES: usize = 1 << 20;
/// Largest number of messages by which one is late; a larger difference is a damaged number.
const MOST_LATE: u32 = 1024;

/// Settings of a [`ColorEncoder`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorSettings {
    /// Quantisation step of the brightness, codes of 0..=255 sRGB.
    pub step: f32,
    /// Time within which every segment is refreshed, seconds.
    pub refresh_secs: f32,
    /// Byte budget of a frame over all layers, which a new person, or an encoder that restarts, reaches. Where frames come less than ten
    /// times per second, each may have as many bytes per second, up to eight times the budget.
    pub max_frame_bytes: usize,
}

impl Default for ColorSettings {
    fn default() -> Self {
        Self { step: 8.0, refresh_secs: 1.0, max_frame_bytes: 32_000 }
    }
}

/// Returns the levels of a layer: the finest three belong to the last layer, the next three to the one before.
fn layer_levels(tree: &HaarTree, layer: usize) -> Range<u32> {
    let all = tree.levels();
    let end = |layer: usize| all.end.saturating_sub((LAYERS - 1 - layer) as u32 * GROUP).max(all.start);
    let start = if layer == 0 { all.start } else { end(layer - 1) };
    start..end(layer)
}

/// Returns the groups of a layer's levels, the last one full.
fn groups(levels: Range<u32>) -> impl Iterator<Item = Range<u32>> {
    let count = (levels.end - levels.start).div_ceil(GROUP);
    (0..count).rev().map(move |i| {
        let end = levels.end - i * GROUP;
        end.saturating_sub(GROUP).max(levels.start)..end
    })
}

/// Probabilities of a message.
#[derive(Debug, Clone, Copy, Default)]
struct Model {
    is_refresh: Probability,
    /// Models of differences and of states, whose statistics differ.
    coefficients: [CoefficientModel; 2],
}

impl Model {
    /// Codes the part of a layer in a segment; returns whether it is a refresh.
    fn code(
        &mut self,
        coder: &mut impl BitCoder,
        tree: &HaarTree,
        (layer, segment): (usize, usize),
        is_refresh: bool,
        values: &mut [Levels],
    ) -> bool {
        let is_refresh = coder.bit(&mut self.is_refresh, is_refresh);
        let model = &mut self.coefficients[usize::from(is_refresh)];
        if layer == 0 {
            model.code_mean(coder, &mut values[segment]);
        }
        for group in groups(layer_levels(tree, layer)) {
            model.code_group(coder, tree, group, segment, values);
        }
        is_refresh
    }
}

/// Calls `each` with the places of a segment's coefficients in a layer, level by level, and their step.
fn each_level(tree: &HaarTree, steps: &Steps, layer: usize, segment: usize, mut each: impl FnMut(Range<usize>, f32)) {
    if layer == 0 {
        each(segment..segment + 1, steps.mean);
    }
    for level in layer_levels(tree, layer) {
        each(tree.places(level, segment), steps.of_level(level));
    }
}

/// Converts sRGB codes to brightness and two colour differences.
fn differences_of([r, g, b]: [f32; 3]) -> [f32; CHANNELS] {
    [0.25 * (r + 2.0 * g + b), (r - b) / CHROMA, (g - 0.5 * (r + b)) / CHROMA]
}

/// Converts brightness and colour differences to sRGB codes.
fn color_of([y, red_blue, green]: [f32; CHANNELS]) -> [f32; 3] {
    let (red_blue, green) = (red_blue * CHROMA, green * CHROMA);
    let others = y - 0.5 * green;
    [others + 0.5 * red_blue, y + 0.5 * green, others - 0.5 * red_blue]
}

/// Source of the present state of a person's colours: the encoder, or a decoder that follows it.
pub trait WholeColors: core::fmt::Debug + Send {
    /// Encodes the present state of the layers from `first_layer` on: layer and message for [`ColorDecoder::ingest`], several messages per
    /// layer where one would be too long. Empty before the first colours.
    fn whole(&self, first_layer: usize) -> Vec<(usize, Vec<u8>)>;
}

/// State of an encoder or a decoder.
struct State<'a> {
    stamp: Stamp,
    epoch: u32,
    step: f32,
    tree: &'a HaarTree,
    levels: &'a [Levels],
}

impl State<'_> {
    /// Encodes the known segments of a layer. `sequence` is that of the next message of changes.
    fn encode_layer(&self, layer: usize, sequence: u32, is_known: impl Fn(usize) -> bool) -> Vec<Vec<u8>> {
        let segments = self.tree.segments();
        let mut levels = self.levels.to_vec();
        let (mut messages, mut segment) = (Vec::new(), 0);
        while segment < segments {
            let first = segment;
            let (bytes, count_at) = begin(self.stamp, (self.epoch, self.step), sequence, layer as u8 | WHOLE, first);
            let (mut encoder, mut model) = (RangeEncoder::new(bytes), Model::default());
            while segment < segments && is_known(segment) {
                let mark = encoder.mark();
                model.code(&mut encoder, self.tree, (layer, segment), true, &mut levels);
                if encoder.len() > MAX_MESSAGE_BYTES {
                    encoder.rewind(mark);
                    break;
                }
                segment += 1;
            }
            if segment == first {
                // Unknown, or too long by itself.
                segment += 1;
                continue;
            }
            let mut bytes = encoder.finish();
            bytes[count_at] = (segment - first) as u8;
            messages.push(bytes);
        }
        messages
    }
}

/// Returns the first bytes of a message, and the place of its number of segments.
fn begin(stamp: Stamp, (epoch, step): (u32, f32), sequence: u32, layer: u8, first: usize) -> (Vec<u8>, usize) {
    let mut bytes = stamp.begin(COLOR_MAGIC);
    bytes.extend(epoch.to_le_bytes());
    bytes.extend(step.to_le_bytes());
    bytes.extend(sequence.to_le_bytes());
    bytes.push(layer);
    bytes.push(first as u8);
    let count_at = bytes.len();
    bytes.push(0);
    (bytes, count_at)
}

/// Encoder of the colours of one template, frame after frame.
#[derive(Debug, Clone)]
pub struct ColorEncoder {
    template: u64,
    settings: ColorSettings,
    /// Number of this encoder, by which decoders notice that the states restart.
    epoch: u32,
    order: Vec<u32>,
    tree: HaarTree,
    srgb: Srgb,
    steps: Steps,
    state: Vec<Levels>,
    changes: Vec<Levels>,
    layers: [LayerState; LAYERS],
    /// Stamp of the previous messages.
    last: Option<Stamp>,
    coefficients: Vec<[f32; 3]>,
    means: Vec<[f32; 3]>,
}

#[derive(Debug, Clone)]
struct LayerState {
    sequence: u32,
    /// First segment of the next message.
    first: usize,
    /// Next segment to refresh, and number of refreshes that are due.
    next_refresh: usize,
    due: f32,
}

impl ColorEncoder {
    /// Creates an encoder for a template. `epoch` must differ from that of an earlier encoder of the same person and template.
    #[must_use]
    pub fn new(template: &EncodedTemplate, settings: ColorSettings, epoch: u32) -> Self {
        let tree = HaarTree::new(template.template.gaussians());
        // All segments are due at first.
        let layer = LayerState { sequence: 0, first: 0, next_refresh: 0, due: tree.segments() as f32 };
        let settings = ColorSettings {
            step: if settings.step.is_finite() { settings.step.clamp(0.25, 128.0) } else { 8.0 },
            refresh_secs: settings.refresh_secs.max(0.1),
            max_frame_bytes: settings.max_frame_bytes,
        };
        Self {
            template: template.template.hash,
            settings,
            epoch,
            order: template.gaussian_order.clone(),
            srgb: Srgb::new(),
            steps: tree.steps(settings.step),
            state: vec![[0; CHANNELS]; tree.coefficients()],
            changes: vec![[0; CHANNELS]; tree.coefficients()],
            layers: core::array::from_fn(|_| layer.clone()),
            last: None,
            coefficients: vec![[0.0; 3]; tree.coefficients()],
            means: Vec::new(),
            tree,
        }
    }

    /// Encodes the linear colours of a frame, in the order of the template's source, as one message per layer. A colour that is missing or
    /// not finite counts as black.
    pub fn encode(&mut self, stamp: Stamp, colors: &[[f32; 4]]) -> [Vec<u8>; LAYERS] {
        let stamp = Stamp { template: self.template, ..stamp };
        let item = |i: usize| {
            let [r, g, b, _] = colors.get(self.order[i] as usize).copied().unwrap_or_default();
            differences_of([r, g, b].map(|linear| self.srgb.code(linear)))
        };
        self.tree.forward(item, &mut self.coefficients, &mut self.means);
        let since = |last: Stamp| stamp.capture_nanos.saturating_sub(last.capture_nanos) as f32 / 1e9;
        let elapsed = self.last.map_or(0.0, since);
        if self.last.replace(stamp).is_none() {
            self.set_all();
        }
        let refreshed = self.tree.segments() as f32 * (elapsed / self.settings.refresh_secs).clamp(0.0, 1.0);
        let budgets = (elapsed * FULL_RATE).clamp(1.0, MOST_BUDGETS);
        let mut left = (self.settings.max_frame_bytes as f32 * budgets) as usize;
        core::array::from_fn(|layer| {
            self.layers[layer].due += refreshed;
            let message = self.encode_layer(stamp, layer, left.min(MAX_MESSAGE_BYTES));
            left = left.saturating_sub(message.len());
            message
        })
    }

    /// Sets the states of all segments to the first colours, so that they are whole whatever the budget is.
    fn set_all(&mut self) {
        for layer in 0..LAYERS {
            for segment in 0..self.tree.segments() {
                let (coefficients, state) = (&self.coefficients, &mut self.state);
                each_level(&self.tree, &self.steps, layer, segment, |places, step| {
                    let values = coefficients[places.clone()].as_flattened();
                    for (state, value) in state[places].as_flattened_mut().iter_mut().zip(values) {
                        *state = quantise(value / step, ROUND_UP).clamp(-MOST, MOST);
                    }
                });
            }
        }
    }

    fn encode_layer(&mut self, stamp: Stamp, layer: usize, max_bytes: usize) -> Vec<u8> {
        let segments = self.tree.segments();
        let LayerState { sequence, first, .. } = self.layers[layer];
        let (bytes, count_at) = begin(stamp, (self.epoch, self.settings.step), sequence, layer as u8, first);

        let due = (self.layers[layer].due as usize).min(segments);
        let refreshes = self.layers[layer].next_refresh..self.layers[layer].next_refresh + due;
        let is_due = |segment: usize| refreshes.contains(&segment) || refreshes.contains(&(segment + segments));
        let mut encoder = RangeEncoder::new(bytes);
        let mut model = Model::default();
        let mut count = 0;
        for i in 0..segments {
            let segment = (first + i) % segments;
            let is_refresh = is_due(segment);
            let mark = encoder.mark();
            let (coefficients, state, changes) = (&self.coefficients, &self.state, &mut self.changes);
            each_level(&self.tree, &self.steps, layer, segment, |places, step| {
                let values = coefficients[places.clone()].as_flattened();
                let old = state[places.clone()].as_flattened();
                change(values, old, 1.0 / step, is_refresh, changes[places].as_flattened_mut());
            });
            model.code(&mut encoder, &self.tree, (layer, segment), is_refresh, &mut self.changes);
            if encoder.len() > max_bytes {
                encoder.rewind(mark);
                break;
            }
            let (state, changes) = (&mut self.state, &self.changes);
            each_level(&self.tree, &self.steps, layer, segment, |places, _| {
                add(&changes[places.clone()], is_refresh, &mut state[places]);
            });
            count += 1;
        }
        let layer = &mut self.layers[layer];
        layer.sequence = layer.sequence.wrapping_add(1);
        // The next message begins where this one broke off.
        layer.first = (first + count) % segments;
        // Refreshes that did not fit stay due.
        let coded = |segment: usize| (segment + segments - first) % segments < count;
        while layer.due >= 1.0 && coded(layer.next_refresh) {
            layer.next_refresh = (layer.next_refresh + 1) % segments;
            layer.due -= 1.0;
        }
        layer.due = layer.due.min(segments as f32);
        let mut bytes = encoder.finish();
        bytes[count_at] = count as u8;
        bytes
    }
}

impl WholeColors for ColorEncoder {
    fn whole(&self, first_layer: usize) -> Vec<(usize, Vec<u8>)> {
        let Some(stamp) = self.last else { return Vec::new() };
        let state = State { stamp, epoch: self.epoch, step: self.settings.step, tree: &self.tree, levels: &self.state };
        let of_layer = |layer: usize| state.encode_layer(layer, self.layers[layer].sequence, |_| true);
        (first_layer..LAYERS).flat_map(|layer| of_layer(layer).into_iter().map(move |bytes| (layer, bytes))).collect()
    }
}

/// Computes the changes in whole steps that bring the old states to the values, or for a refresh the new states.
fn change(values: &[f32], old: &[i32], per_step: f32, is_refresh: bool, changes: &mut [i32]) {
    for ((change, value), &old) in changes.iter_mut().zip(values).zip(old) {
        let by = quantise(value * per_step - old as f32, ROUND_UP);
        // States are at most MOST, so nothing wraps; checks of each number would cost more than the whole loop.
        let new = old.wrapping_add(by).clamp(-MOST, MOST);
        *change = if is_refresh { new } else { new.wrapping_sub(old).clamp(-MOST, MOST) };
    }
}

/// Adds changes to states, or replaces the states for a refresh.
fn add(changes: &[Levels], is_refresh: bool, state: &mut [Levels]) {
    if is_refresh {
        return state.copy_from_slice(changes);
    }
    for (state, change) in state.as_flattened_mut().iter_mut().zip(changes.as_flattened()) {
        *state = state.wrapping_add(*change).clamp(-MOST, MOST);
    }
}

/// Decoder of the colours of one person and template.
#[derive(Debug, Clone)]
pub struct ColorDecoder {
    template: u64,
    tree: HaarTree,
    srgb: Srgb,
    step: f32,
    steps: Steps,
    epoch: Option<u32>,
    state: Vec<Levels>,
    values: Vec<Levels>,
    layers: [DecodedLayer; LAYERS],
    /// Stamp of the newest message.
    last: Option<Stamp>,
    /// Last messages of changes of this encoder, of all layers.
    kept: VecDeque<Changes>,
    kept_bytes: usize,
    /// Whether each segment of the coarsest layer has arrived with these steps, from an earlier encoder as well.
    is_shown: Vec<bool>,
    means: Vec<[f32; 3]>,
}

#[derive(Debug, Clone)]
struct DecodedLayer {
    is_known: Vec<bool>,
    sequence: Option<u32>,
    missed: u64,
}

/// Changes of a layer, still encoded.
#[derive(Debug, Clone)]
struct Changes {
    layer: usize,
    sequence: u32,
    first: usize,
    count: usize,
    bytes: Vec<u8>,
}

impl ColorDecoder {
    /// Creates a decoder for a template; all colours are grey.
    #[must_use]
    pub fn new(template: &StreamTemplate) -> Self {
        let tree = HaarTree::new(template.gaussians());
        let layer = DecodedLayer { is_known: vec![false; tree.segments()], sequence: None, missed: 0 };
        Self {
            template: template.hash,
            srgb: Srgb::new(),
            step: 0.0,
            steps: Steps::default(),
            epoch: None,
            state: vec![[0; CHANNELS]; tree.coefficients()],
            values: vec![[0; CHANNELS]; tree.coefficients()],
            is_shown: layer.is_known.clone(),
            layers: core::array::from_fn(|_| layer.clone()),
            last: None,
            kept: VecDeque::new(),
            kept_bytes: 0,
            means: Vec::new(),
            tree,
        }
    }

    /// Ingests a message and returns its stamp.
    ///
    /// # Errors
    /// [`StreamError`]; a message of another template changes nothing.
    pub fn ingest(&mut self, bytes: &[u8]) -> Result<Stamp, StreamError> {
        let mut fields = Fields::new(WHAT, COLOR_MAGIC, bytes)?;
        fields.check(bytes.len() <= MAX_MESSAGE_BYTES, "it is too large")?;
        let stamp = Stamp::read(&mut fields)?;
        if stamp.template != self.template {
            return Err(StreamError::OtherTemplate { what: WHAT });
        }
        let (epoch, step, sequence) = (fields.u32()?, fields.f32()?, fields.u32()?);
        let (numbered, first, count) = (fields.u8()?, usize::from(fields.u8()?), usize::from(fields.u8()?));
        let (layer, is_whole) = (usize::from(numbered & !WHOLE), numbered & WHOLE != 0);
        let segments = self.tree.segments();
        fields.check((0.25..=128.0).contains(&step), "its quantisation step makes no sense")?;
        fields.check(layer < LAYERS && first < segments && count <= segments, "it names a part that does not exist")?;
        if self.epoch != Some(epoch) || self.step.to_bits() != step.to_bits() {
            self.restart(epoch, step);
        }
        let known = &mut self.layers[layer];
        let next = known.sequence.map_or(sequence, |last| last.wrapping_add(1));
        let ahead = sequence.wrapping_sub(next);
        let late = next.wrapping_sub(sequence);
        let is_late = (1..=MOST_LATE).contains(&late);
        let changes = Changes { layer, sequence, first, count, bytes: fields.bytes.to_vec() };
        if is_whole {
            if !is_late {
                known.sequence = Some(sequence.wrapping_sub(1));
            }
            self.apply(&changes, |_| true);
            let is_part = |segment: usize| (segment + segments - first) % segments < count;
            let later: Vec<Changes> = self.kept.iter().filter(|kept| kept.is_after(&changes)).cloned().collect();
            later.iter().for_each(|later| self.apply(later, is_part));
        } else {
            if is_late {
                // A later state has arrived already.
                return Ok(stamp);
            }
            known.missed += u64::from(ahead.min(1 << 16));
            known.sequence = Some(sequence);
            self.apply(&changes, |_| true);
            self.keep(changes);
        }
        self.last = Some(stamp);
        Ok(stamp)
    }

    /// Applies a message to those of its segments that `is_wanted` accepts.
    fn apply(&mut self, message: &Changes, is_wanted: impl Fn(usize) -> bool) {
        let (layer, segments) = (message.layer, self.tree.segments());
        let mut decoder = RangeDecoder::new(&message.bytes);
        let mut model = Model::default();
        for i in 0..message.count {
            let segment = (message.first + i) % segments;
            let is_refresh = model.code(&mut decoder, &self.tree, (layer, segment), false, &mut self.values);
            if !is_wanted(segment) {
                continue;
            }
            let is_known = &mut self.layers[layer].is_known[segment];
            *is_known |= is_refresh;
            if !*is_known {
                continue;
            }
            self.is_shown[segment] |= layer == 0;
            let (state, values) = (&mut self.state, &self.values);
            each_level(&self.tree, &self.steps, layer, segment, |places, _| {
                add(&values[places.clone()], is_refresh, &mut state[places]);
            });
        }
    }

    fn keep(&mut self, changes: Changes) {
        self.kept_bytes += changes.bytes.len();
        self.kept.push_back(changes);
        while self.kept.len() > MAX_KEPT || self.kept_bytes > MAX_KEPT_BYTES {
            let Some(oldest) = self.kept.pop_front() else { break };
            self.kept_bytes -= oldest.bytes.len();
        }
    }

    /// Follows an encoder that restarted. The colours of the previous one are shown until new ones arrive.
    fn restart(&mut self, epoch: u32, step: f32) {
        if self.step.to_bits() != step.to_bits() {
            self.steps = self.tree.steps(step);
            self.state.fill([0; CHANNELS]);
            self.is_shown.fill(false);
        }
        (self.epoch, self.step) = (Some(epoch), step);
        self.kept.clear();
        self.kept_bytes = 0;
        for layer in &mut self.layers {
            layer.is_known.fill(false);
            layer.sequence = None;
        }
    }

    /// Returns the number of missed messages of a layer since the start.
    #[must_use]
    pub fn missed(&self, layer: usize) -> u64 {
        self.layers.get(layer).map_or(0, |layer| layer.missed)
    }

    /// Returns the fraction of a layer's segments that have arrived, 0..=1.
    #[must_use]
    pub fn known(&self, layer: usize) -> f32 {
        self.layers.get(layer).map_or(0.0, |layer| {
            layer.is_known.iter().filter(|known| **known).count() as f32 / layer.is_known.len().max(1) as f32
        })
    }

    /// Computes the linear colours, opacity 1, in the template's order. Segments that have not arrived yet are grey.
    pub fn colors(&mut self, colors: &mut Vec<[f32; 4]>) {
        colors.resize(self.tree.items(), [0.0; 4]);
        let (state, base, mean_step) = (&self.state, &self.is_shown, self.steps.mean);
        let mean = |segment: usize| match base.get(segment) {
            Some(true) => state[segment].map(|v| v as f32 * mean_step),
            _ => [128.0, 0.0, 0.0],
        };
        let difference = |place: usize, step: f32| state[place].map(|v| v as f32 * step);
        let srgb = &self.srgb;
        self.tree.inverse(&self.steps, mean, difference, &mut self.means, |i, item| {
            let [r, g, b] = color_of(item).map(|code| srgb.linear(code));
            colors[i] = [r, g, b, 1.0];
        });
    }
}

impl Changes {
    /// Returns whether these changes follow a whole state of their layer.
    fn is_after(&self, whole: &Self) -> bool {
        self.layer == whole.layer && self.sequence.wrapping_sub(whole.sequence) <= MOST_LATE
    }
}

impl WholeColors for ColorDecoder {
    fn whole(&self, first_layer: usize) -> Vec<(usize, Vec<u8>)> {
        let (Some(stamp), Some(epoch)) = (self.last, self.epoch) else { return Vec::new() };
        let state = State { stamp, epoch, step: self.step, tree: &self.tree, levels: &self.state };
        let mut messages = Vec::new();
        for (layer, known) in self.layers.iter().enumerate().skip(first_layer) {
            let next = known.sequence.map_or(0, |last| last.wrapping_add(1));
            let is_known = |segment: usize| known.is_known[segment];
            messages.extend(state.encode_layer(layer, next, is_known).into_iter().map(|bytes| (layer, bytes)));
        }
        messages
    }
}
