//! A landmark network of the user's choice: input in its format, landmarks from points, heatmaps or SimCC bins (Li et al.
//! 2022).

use std::path::Path;
use std::sync::Arc;

use glam::DVec2;

use crate::error::TrackError;
use crate::image::crop::Crop;
use crate::image::pixels::Rgb;
use crate::landmarks::keypoints::LANDMARK_COUNT;
use crate::network::landmark_net::{LandmarkNet, sigmoid};
use crate::network::network_file::{Channels, NetworkFile, OutputForm, PointValue, Unit};
use crate::network::output::{CropLandmark, NetOutput};

/// Landmarks of one run: pixels of the input, centre of the first pixel at 0, and confidence; by index in the output.
type Points = Vec<(DVec2, f64)>;

/// Network that a [`NetworkFile`] describes.
#[derive(Clone)]
pub(crate) struct ChosenNet {
    net: LandmarkNet,
    /// Width and height of the input, pixels.
    size: [usize; 2],
    channels_first: bool,
    file: Arc<NetworkFile>,
    /// Index of each body landmark in the output.
    indices: [Option<usize>; LANDMARK_COUNT],
}

impl ChosenNet {
    /// Loads a description and its network, and runs it once.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] names the file and what is wrong with it.
    pub fn read(path: &Path) -> Result<Self, TrackError> {
        let (file, onnx) = NetworkFile::read(path)?;
        Self::new(file, &onnx)
    }

    /// Loads the network of a description from the bytes of its ONNX file, and runs it once.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] names the file and what is wrong with it.
    pub fn new(file: NetworkFile, onnx: &[u8]) -> Result<Self, TrackError> {
        let name = file.file.display().to_string();
        let mut chosen = None;
        let shape = |sides: &[Option<usize>]| {
            let found = input(sides, file.input)?;
            chosen = Some(found);
            let ([width, height], channels_first) = found;
            Ok(if channels_first { [1, 3, height, width] } else { [1, height, width, 3] })
        };
        let net = LandmarkNet::load_shaped(onnx, shape, &name)?;
        let (size, channels_first) = chosen.unwrap_or_default();
        let indices = file.indices().map_err(|what| net.failed(&what))?;
        let chosen = Self { net, size, channels_first, file: Arc::new(file), indices };
        chosen.points(&chosen.net.blank())?;
        Ok(chosen)
    }

    /// Runs the network on a square of an image. The input may be wider or higher than the square.
    ///
    /// # Errors
    /// Kind [`crate::TrackErrorKind::Net`] when the network fails, or an output is missing or not finite.
    pub fn infer(&self, picture: &Rgb, crop: Crop) -> Result<NetOutput, TrackError> {
        let [width, height] = self.size;
        let (long, short) = (width.max(height), width.min(height));
        let wide = Crop { side: crop.side * long as f64 / short as f64, ..crop };
        let margin = [(long - width) / 2, (long - height) / 2];
        let points = self.points(&self.input(&wide.sample_square(picture, long), long, margin))?;
        let margin = DVec2::new(margin[0] as f64, margin[1] as f64);
        let landmark = |index: Option<usize>| {
            let (at, confidence) = *points.get(index?)?;
            let DVec2 { x, y } = crop.crop_from_image(wide.to_image_from(at + margin, long));
            Some(CropLandmark { x, y, confidence, ..CropLandmark::UNSEEN })
        };
        let landmarks = self.indices.map(|index| landmark(index).unwrap_or(CropLandmark::UNSEEN));
        // Presence is the mean of the better half: the others may be hidden, or out of the image.
        let mut confidences: Vec<f64> =
            self.indices.iter().zip(&landmarks).filter_map(|(index, seen)| index.map(|_| seen.confidence)).collect();
        confidences.sort_by(|a, b| b.total_cmp(a));
        confidences.truncate(confidences.len().div_ceil(2));
        let presence = confidences.iter().sum::<f64>() / confidences.len().max(1) as f64;
        Ok(NetOutput { landmarks, presence, mask: None })
    }

    /// Creates the error of a caller that offers a crop in BlazePose's format.
    pub fn takes_no_crop(&self) -> TrackError {
        self.net.failed("has an input format of its own and takes no crop of the built-in network")
    }

    /// Returns the network's input from a square of RGB in 0..=1, cut by a margin left and right, or above and below.
    fn input(&self, rgb: &[f32], side: usize, margin: [usize; 2]) -> Vec<f32> {
        let [width, height] = self.size;
        let NetworkFile { mean, deviation, channels, .. } = &*self.file;
        let value = |x: usize, y: usize, channel: usize| {
            let color = if *channels == Channels::Bgr { 2 - channel } else { channel };
            (255.0 * rgb[((y + margin[1]) * side + x + margin[0]) * 3 + color] - mean[channel]) / deviation[channel]
        };
        let rows = |channel: usize| (0..height).flat_map(move |y| (0..width).map(move |x| (x, y, channel)));
        if self.channels_first {
            (0..3).flat_map(rows).map(|(x, y, channel)| value(x, y, channel)).collect()
        } else {
            rows(0)
                .flat_map(|(x, y, _)| (0..3).map(move |channel| (x, y, channel)))
                .map(|(x, y, c)| value(x, y, c))
                .collect()
        }
    }

    /// Runs the network and decodes its landmarks.
    fn points(&self, input: &[f32]) -> Result<Points, TrackError> {
        let outputs = self.net.run(input)?.all()?;
        let outputs: Vec<Array> = outputs.iter().map(|(shape, values)| Array { shape, values }).collect();
        let count = self.indices.iter().flatten().max().map_or(0, |most| most.saturating_add(1));
        let found = match self.file.output {
            OutputForm::Points => points(&outputs, count, &self.file, self.size),
            OutputForm::Heatmaps => heatmaps(&outputs, count, self.size),
            OutputForm::Simcc => simcc(&outputs, count, self.size),
        };
        let shapes = || outputs.iter().map(|output| format!("{:?}", output.shape)).collect::<Vec<_>>().join(", ");
        let form = self.file.output;
        let mut found = found.ok_or_else(|| {
            self.net.failed(&format!(
                "has outputs of {}, none of which holds {count} landmarks as {form:?}; see output, point and landmarks",
                shapes()
            ))
        })?;
        found.iter_mut().for_each(|(_, confidence)| *confidence = (*confidence / self.file.certain).clamp(0.0, 1.0));
        Ok(found)
    }
}

/// Returns width, height and whether channels come first, of an input in one of the usual orders.
fn input(sides: &[Option<usize>], given: Option<[usize; 2]>) -> Result<([usize; 2], bool), String> {
    let (height, width, channels_first) = match *sides {
        [_, Some(3), height, width] => (height, width, true),
        [_, height, width, Some(3)] => (height, width, false),
        _ => {
            return Err(format!(
                "takes {sides:?}, expected images of three channels: [1, 3, height, width] or [1, height, width, 3]"
            ));
        }
    };
    match (width, height, given) {
        (Some(width), Some(height), Some(given)) if given != [width, height] => {
            Err(format!("takes images of {width}x{height}, but input is {given:?}"))
        }
        (Some(width), Some(height), _) => Ok(([width, height], channels_first)),
        (_, _, Some(given)) => Ok((given, channels_first)),
        _ => Err("leaves the size of its input open: set input = [width, height]".to_owned()),
    }
}

/// Output of the network.
struct Array<'a> {
    shape: &'a [usize],
    values: &'a [f32],
}

impl Array<'_> {
    /// Iterates over the rows, which are as long as the last side.
    fn rows(&self) -> impl ExactSizeIterator<Item = &[f32]> {
        self.values.chunks_exact(self.shape.last().copied().unwrap_or(1).max(1))
    }
}

/// Decodes landmarks that are a few numbers each.
fn points(outputs: &[Array<'_>], count: usize, file: &NetworkFile, [width, height]: [usize; 2]) -> Option<Points> {
    let numbers = file.point.len();
    // Several outputs may fit: an array whose rows are landmarks is preferred, then the smallest.
    let fits = |output: &&Array| output.values.len().is_multiple_of(numbers) && output.values.len() / numbers >= count;
    let output = outputs
        .iter()
        .filter(fits)
        .min_by_key(|output| (output.shape.last() != Some(&numbers), output.values.len()))?;
    let scale = match file.unit {
        Unit::Pixels => DVec2::ONE,
        Unit::Share => DVec2::new(width as f64, height as f64),
    };
    let point = |numbers: &[f32]| {
        let (mut at, mut confidence) = (DVec2::ZERO, 1.0f64);
        for (value, number) in numbers.iter().map(|value| f64::from(*value)).zip(&file.point) {
            match number {
                PointValue::X => at.x = value,
                PointValue::Y => at.y = value,
                PointValue::Confidence => confidence = confidence.min(value),
                PointValue::Logit => confidence = confidence.min(sigmoid(value)),
                PointValue::Skip => {}
            }
        }
        (at * scale - 0.5, confidence)
    };
    Some(output.values.chunks_exact(numbers).map(point).collect())
}

/// Decodes one heatmap per landmark: the place of its peak, with the height as confidence.
fn heatmaps(outputs: &[Array<'_>], count: usize, size: [usize; 2]) -> Option<Points> {
    let output = outputs.iter().find(|output| matches!(output.shape, [1, maps, _, _] if *maps >= count))?;
    let &[_, _, rows, columns] = output.shape else { return None };
    let peak = |map: &[f32]| {
        let (best, value) = highest(map)?;
        let (x, y) = (best % columns, best / columns);
        let at = |x: usize, y: usize| map[y * columns + x];
        let across = between(x.checked_sub(1).map(|x| at(x, y)), value, (x + 1 < columns).then(|| at(x + 1, y)));
        let down = between(y.checked_sub(1).map(|y| at(x, y)), value, (y + 1 < rows).then(|| at(x, y + 1)));
        let place = DVec2::new(x as f64 + across, y as f64 + down);
        let cell = DVec2::new(size[0] as f64 / columns as f64, size[1] as f64 / rows as f64);
        Some((place * cell, f64::from(value)))
    };
    output.values.chunks_exact((rows * columns).max(1)).map(peak).collect()
}

/// Decodes the peaks of bins along x and y; the lower of the two heights is the confidence.
fn simcc(outputs: &[Array<'_>], count: usize, [width, height]: [usize; 2]) -> Option<Points> {
    let axis = |output: &&Array, side: usize| matches!(output.shape, [1, landmarks, bins] if *landmarks >= count && bins.is_multiple_of(side) && *bins > 0);
    // Square inputs have two outputs of one shape, x first.
    let along_x = outputs.iter().position(|output| axis(&output, width))?;
    let along_y = (0..outputs.len()).find(|&y| y != along_x && axis(&&outputs[y], height))?;
    let peak = |row: &[f32], side: usize| {
        let (best, value) = highest(row)?;
        let beside = |at: Option<usize>| at.and_then(|at| row.get(at)).copied();
        let shift = between(beside(best.checked_sub(1)), value, beside(Some(best + 1)));
        Some(((best as f64 + shift) * side as f64 / row.len() as f64, f64::from(value)))
    };
    let rows = outputs[along_x].rows().zip(outputs[along_y].rows());
    rows.map(|(along_x, along_y)| {
        let ((x, first), (y, second)) = (peak(along_x, width)?, peak(along_y, height)?);
        Some((DVec2::new(x, y), first.min(second)))
    })
    .collect()
}

/// Returns index and value of the largest number.
fn highest(values: &[f32]) -> Option<(usize, f32)> {
    values.iter().copied().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))
}

/// Returns the offset of the peak of a parabola through three neighbouring values from the middle one, -0.5..=0.5.
fn between(before: Option<f32>, value: f32, after: Option<f32>) -> f64 {
    let (Some(before), Some(after)) = (before, after) else { return 0.0 };
    let bend = f64::from(before) + f64::from(after) - 2.0 * f64::from(value);
    let shift = 0.5 * f64::from(before - after) / bend;
    if shift.is_finite() { shift.clamp(-0.5, 0.5) } else { 0.0 }
}

#[cfg(test)]
#[path = "chosen_net_tests.rs"]
mod tests;
