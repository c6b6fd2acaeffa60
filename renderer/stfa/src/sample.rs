//! Training sample of one instant: inputs of the networks, and pixels of other cameras.

use std::{collections::HashMap, path::Path};

use flyrig_renderer::{AppearanceSettings, Observations, PosedGaussians, RasterSettings, pixel_shares};
use flyrig_types::Camera;
use rand::{RngExt as _, SeedableRng as _, rngs::SmallRng};
use safetensors::SafeTensors;

use crate::{
    BodyGraph, StfaError,
    body_graph::{EDGES, PLACE},
    crops::{Crops, ViewImage},
    inputs::{NODE, STATE, frame_inputs},
    taps::{Tap, Taps},
    tensor_file::{TensorFile, array, read, rows},
};

/// Side of the compared patches, pixels.
pub const PATCH: usize = 16;
/// Largest number of Gaussians per pixel; the shares of further ones are added to these.
pub const SHARES: usize = 12;

const VERSION: u32 = 2;
/// Least share of the person and of the rendering in a patch.
const MIN_PATCH_COVERAGE: f32 = 0.15;
/// Positions tried per patch.
const TRIES: usize = 40;

/// Held-out camera and its image.
#[derive(Debug, Clone, Copy)]
pub struct TargetImage<'a> {
    /// Held-out camera.
    pub camera: &'a Camera,
    /// Image with mask.
    pub picture: ViewImage<'a>,
}

/// Pixels of one held-out image and the Gaussians that they show.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TargetPixels {
    /// Samples of the feature maps, one row per Gaussian.
    pub taps: Taps,
    /// State per Gaussian, [`STATE`] numbers.
    pub state: Vec<[f32; STATE]>,
    /// Nodes of each Gaussian.
    pub nodes: Vec<[u32; 4]>,
    /// Weights of these nodes.
    pub node_weights: Vec<[f32; 4]>,
    /// Indices into the lists above, per pixel, patch by patch.
    pub gaussians: Vec<[u32; SHARES]>,
    /// Shares of these Gaussians in the pixel.
    pub shares: Vec<[f32; SHARES]>,
    /// sRGB of the pixel on black.
    pub truth: Vec<[u8; 4]>,
}

/// Training sample of one instant.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrainingSample {
    /// Crops of the input images.
    pub crops: Crops,
    /// Samples of the feature maps, one row per node.
    pub node_taps: Taps,
    /// Inputs per node, [`NODE`] numbers.
    pub nodes: Vec<[f32; NODE]>,
    /// Neighbours of each node.
    pub edges: Vec<[u32; EDGES]>,
    /// Positional encoding of each node.
    pub place: Vec<[f32; PLACE]>,
    /// Held-out images.
    pub targets: Vec<TargetPixels>,
}

/// Gathers a sample: the networks' inputs from `pictures` and their observations by direct appearance, and `patches`
/// random squares of every held-out image, chosen by `seed`.
///
/// # Errors
/// [`StfaError::Frame`] where inputs do not fit each other.
#[allow(clippy::too_many_arguments)]
pub fn training_sample(
    body: &BodyGraph,
    observed: &Observations,
    pictures: &[ViewImage<'_>],
    settings: &AppearanceSettings,
    posed: PosedGaussians<'_>,
    targets: &[TargetImage<'_>],
    patches: usize,
    seed: u64,
) -> Result<TrainingSample, StfaError> {
    let crops = Crops::cut(pictures)?;
    let mut rng = SmallRng::seed_from_u64(seed);
    let mut sample = TrainingSample { edges: body.edges.clone(), place: body.place.clone(), ..Default::default() };
    for target in targets {
        let picture = target.picture;
        if picture.rgba.len() != picture.width as usize * picture.height as usize * 4 {
            return Err(StfaError::Frame(format!("the image of camera {} has another size", target.camera.id)));
        }
        let pixels = patch_pixels(picture, patches, &mut rng);
        let shown = pixel_shares(target.camera, posed, &pixels, &RasterSettings::default()).rows;
        let mut places: HashMap<u32, u32> = HashMap::new();
        let mut which: Vec<u32> = Vec::new();
        let mut out = TargetPixels::default();
        for (row, &[x, y]) in shown.into_iter().zip(&pixels) {
            let (mut gaussians, mut shares) = ([0; SHARES], [0.0; SHARES]);
            let alpha: f32 = row.iter().map(|(_, share)| share).sum();
            let mut row = row;
            row.sort_by(|a, b| b.1.total_cmp(&a.1));
            row.truncate(SHARES);
            let kept: f32 = row.iter().map(|(_, share)| share).sum();
            for (i, (gaussian, share)) in row.into_iter().enumerate() {
                gaussians[i] = *places.entry(gaussian).or_insert_with(|| {
                    which.push(gaussian);
                    which.len() as u32 - 1
                });
                shares[i] = share * alpha / kept.max(1e-6);
            }
            out.gaussians.push(gaussians);
            out.shares.push(shares);
            let at = (y as usize * picture.width as usize + x as usize) * 4;
            let pixel = &picture.rgba[at..at + 4];
            let on_black = |c: usize| ((u32::from(pixel[c]) * u32::from(pixel[3]) + 127) / 255) as u8;
            out.truth.push([on_black(0), on_black(1), on_black(2), pixel[3]]);
        }
        let inputs = frame_inputs(body, observed, &crops, settings, Some(&which))?;
        (out.taps, out.state) = (inputs.taps, inputs.state);
        out.nodes = which.iter().map(|&g| body.gaussian_nodes[g as usize]).collect();
        out.node_weights = which.iter().map(|&g| body.gaussian_weights[g as usize]).collect();
        (sample.node_taps, sample.nodes) = (inputs.node_taps, inputs.nodes);
        if !which.is_empty() {
            sample.targets.push(out);
        }
    }
    sample.crops = crops;
    Ok(sample)
}

/// Selects the pixels of random squares on the person, square by square, row by row.
fn patch_pixels(picture: ViewImage<'_>, patches: usize, rng: &mut SmallRng) -> Vec<[u32; 2]> {
    let side = PATCH as u32;
    let mut pixels = Vec::new();
    if picture.width < side || picture.height < side {
        return pixels;
    }
    let on_person = |x: u32, y: u32| picture.rgba[(y as usize * picture.width as usize + x as usize) * 4 + 3] > 127;
    for _ in 0..patches {
        for _ in 0..TRIES {
            let x0 = rng.random_range(0..=picture.width - side);
            let y0 = rng.random_range(0..=picture.height - side);
            let square = (y0..y0 + side).flat_map(|y| (x0..x0 + side).map(move |x| [x, y]));
            let covered = square.clone().filter(|&[x, y]| on_person(x, y)).count();
            if covered as f32 >= MIN_PATCH_COVERAGE * (PATCH * PATCH) as f32 {
                pixels.extend(square);
                break;
            }
        }
    }
    pixels
}

impl TrainingSample {
    /// Writes the sample.
    ///
    /// # Errors
    /// [`StfaError::File`].
    pub fn save(&self, path: &Path) -> Result<(), StfaError> {
        let mut file = TensorFile::default();
        let crops = &self.crops;
        file.push("version", vec![1], &[VERSION]);
        file.push("crop_rgba", vec![crops.views, crops.height, crops.width, 4], &crops.rgba);
        file.push("crop_size", vec![3], &[crops.views as u32, crops.height as u32, crops.width as u32]);
        file.push("origins", vec![crops.origins.len(), 2], crops.origins.as_flattened());
        push_taps(&mut file, "node", &self.node_taps);
        file.push("nodes", vec![self.nodes.len(), NODE], self.nodes.as_flattened());
        file.push("edges", vec![self.edges.len(), EDGES], self.edges.as_flattened());
        file.push("place", vec![self.place.len(), PLACE], self.place.as_flattened());
        file.push("targets", vec![1], &[self.targets.len() as u32]);
        for (i, target) in self.targets.iter().enumerate() {
            let count = target.state.len();
            push_taps(&mut file, &format!("{i}"), &target.taps);
            file.push(format!("{i}.state"), vec![count, STATE], target.state.as_flattened());
            file.push(format!("{i}.nodes"), vec![count, 4], target.nodes.as_flattened());
            file.push(format!("{i}.node_weights"), vec![count, 4], target.node_weights.as_flattened());
            let pixels = target.truth.len();
            file.push(format!("{i}.gaussians"), vec![pixels, SHARES], target.gaussians.as_flattened());
            file.push(format!("{i}.shares"), vec![pixels, SHARES], target.shares.as_flattened());
            file.push(format!("{i}.truth"), vec![pixels, 4], target.truth.as_flattened());
        }
        file.write(path, HashMap::new())
    }

    /// Reads a sample and checks its consistency.
    ///
    /// # Errors
    /// [`StfaError::File`], [`StfaError::Sample`] for a damaged one.
    pub fn load(path: &Path) -> Result<Self, StfaError> {
        let bytes = read(path)?;
        let damaged = |what| StfaError::Sample { name: path.display().to_string(), what };
        let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(error.to_string()))?;
        let sample = Self::parse(&file).map_err(damaged)?;
        sample.check().map_err(damaged)?;
        Ok(sample)
    }

    fn parse(file: &SafeTensors<'_>) -> Result<Self, String> {
        let version = array::<u32>(file, "version", &[1])?;
        if version != [VERSION] {
            return Err(format!("version {version:?}, expected {VERSION}"));
        }
        let size: Vec<usize> = array::<u32>(file, "crop_size", &[3])?.into_iter().map(|v| v as usize).collect();
        let (views, height, width) = (size[0], size[1], size[2]);
        let crops = Crops {
            views,
            width,
            height,
            origins: rows(file, "origins")?,
            rgba: array(file, "crop_rgba", &[views, height, width, 4])?,
        };
        let count = array::<u32>(file, "targets", &[1])?[0];
        let target = |i: u32| -> Result<TargetPixels, String> {
            Ok(TargetPixels {
                taps: taps(file, &format!("{i}"))?,
                state: rows(file, &format!("{i}.state"))?,
                nodes: rows(file, &format!("{i}.nodes"))?,
                node_weights: rows(file, &format!("{i}.node_weights"))?,
                gaussians: rows(file, &format!("{i}.gaussians"))?,
                shares: rows(file, &format!("{i}.shares"))?,
                truth: rows(file, &format!("{i}.truth"))?,
            })
        };
        Ok(Self {
            crops,
            node_taps: taps(file, "node")?,
            nodes: rows(file, "nodes")?,
            edges: rows(file, "edges")?,
            place: rows(file, "place")?,
            targets: (0..count).map(target).collect::<Result<_, _>>()?,
        })
    }

    /// Returns whether all indices are in range and all lists have the right length.
    fn check(&self) -> Result<(), String> {
        let nodes = self.edges.len();
        let views = self.crops.views;
        let inside = |ok: bool, what: &str| if ok { Ok(()) } else { Err(format!("{what} does not fit")) };
        inside(self.crops.width.is_multiple_of(4) && self.crops.height.is_multiple_of(4), "the crop")?;
        inside(self.place.len() == nodes && self.nodes.len() == nodes, "the number of nodes")?;
        inside(self.node_taps.rows() == nodes && self.node_taps.fits(views), "the nodes' sampling")?;
        inside(self.edges.as_flattened().iter().all(|&n| (n as usize) < nodes), "an edge")?;
        for target in &self.targets {
            let (count, pixels) = (target.state.len(), target.truth.len());
            inside(target.taps.rows() == count && target.taps.fits(views), "a target's sampling")?;
            inside(target.nodes.len() == count && target.node_weights.len() == count, "a target's attachment")?;
            inside(target.nodes.as_flattened().iter().all(|&n| (n as usize) < nodes), "a target's node")?;
            inside(target.gaussians.len() == pixels && target.shares.len() == pixels, "a target's pixels")?;
            inside(target.gaussians.as_flattened().iter().all(|&g| (g as usize) < count), "a target's Gaussian")?;
            inside(count > 0 && pixels % (PATCH * PATCH) == 0, "a target's patches")?;
        }
        Ok(())
    }
}

fn push_taps(file: &mut TensorFile, name: &str, taps: &Taps) {
    let views: Vec<u32> = taps.taps.iter().map(|tap| tap.view).collect();
    let places: Vec<[f32; 3]> = taps.taps.iter().map(|tap| [tap.pixel[0], tap.pixel[1], tap.weight]).collect();
    file.push(format!("{name}.tap_starts"), vec![taps.starts.len()], &taps.starts);
    file.push(format!("{name}.tap_views"), vec![views.len(), 1], &views);
    file.push(format!("{name}.tap_places"), vec![places.len(), 3], places.as_flattened());
}

fn taps(file: &SafeTensors<'_>, name: &str) -> Result<Taps, String> {
    let views: Vec<[u32; 1]> = rows(file, &format!("{name}.tap_views"))?;
    let places: Vec<[f32; 3]> = rows(file, &format!("{name}.tap_places"))?;
    if views.len() != places.len() {
        return Err(format!("{name}: {} views of {} taps", views.len(), places.len()));
    }
    let starts_name = format!("{name}.tap_starts");
    let count = file.tensor(&starts_name).map(|t| t.shape().iter().product()).unwrap_or(0);
    let starts = array(file, &starts_name, &[count])?;
    let tap = |(&[view], &[x, y, weight]): (&[u32; 1], &[f32; 3])| Tap { view, pixel: [x, y], weight };
    Ok(Taps { starts, taps: views.iter().zip(&places).map(tap).collect() })
}
