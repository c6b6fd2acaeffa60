//! Sums of bytes, run times and errors of one encoding.

use anyhow::Result;
use flyrig_metrics::{CameraScore, Picture, ScoreSheet, person_box, psnr, score_view};
use flyrig_types::{Mask, RenderedView};
use flyrig_viewer::{PeopleScene, ShownPerson};

use super::{
    forms::Coded,
    table::FormRow,
    take::{CodedTake, Kept},
};

/// Sums of an encoding over its frames.
#[derive(Default)]
pub struct FormTally {
    sizes: Vec<usize>,
    gaussians: usize,
    motion: usize,
    template: usize,
    /// Milliseconds of encoding, decoding and posing.
    times: [f64; 3],
    /// PSNR of each view against the uncoded one, decibels.
    coded: Vec<f64>,
    sheet: ScoreSheet,
    /// Error images of the previous frame, by camera.
    before: Vec<Option<Vec<f32>>>,
    /// Sum of squared changes of the error, and their number.
    flicker: (f64, u64),
}

impl FormTally {
    pub fn new(cameras: usize) -> Self {
        Self { before: vec![None; cameras], ..Self::default() }
    }

    /// Renders and scores a frame.
    pub fn add(&mut self, take: &CodedTake, kept: &Kept, coded: &Coded, scene: &mut PeopleScene) -> Result<()> {
        self.sizes.push(coded.bytes);
        self.gaussians = coded.posed.center_scale.len();
        self.motion += coded.motion_bytes;
        self.template = coded.template_bytes;
        for (sum, time) in self.times.iter_mut().zip([coded.encode_ms, coded.decode_ms, coded.pose_ms]) {
            *sum += time;
        }
        scene.set_people([ShownPerson { posed: &coded.posed, colors: &coded.colors, axes: coded.axes.as_ref() }])?;
        for (at, (camera, wanted)) in take.cameras.iter().zip(&kept.views).enumerate() {
            let view = scene.draw(camera)?;
            self.compare(at, &view, &wanted.uncoded)?;
            if let Some((image, mask)) = &wanted.truth {
                self.sheet.extend(score_view(&camera.id, kept.number, &view, image, mask.as_ref())?);
            }
        }
        Ok(())
    }

    /// Compares a view with that of the uncoded Gaussians.
    fn compare(&mut self, camera: usize, view: &RenderedView, uncoded: &RenderedView) -> Result<()> {
        let (width, height) = (view.width, view.height);
        let mask = Mask::new(width, height, uncoded.rgba.chunks_exact(4).map(|p| p[3]).collect())?;
        let Ok(area) = person_box(&mask, 8) else { return Ok(()) };
        let ours = Picture::on_black(width, height, &view.rgba)?;
        let wanted = Picture::on_black(width, height, &uncoded.rgba)?;
        self.coded.push(psnr(&ours, &wanted, area)?);
        let pixels = ours.pixels().iter().zip(wanted.pixels());
        let errors: Vec<f32> = pixels.flat_map(|(a, b)| [0, 1, 2].map(|c| 255.0 * (a[c] - b[c]))).collect();
        if let Some(before) = &self.before[camera] {
            let coverage = mask.coverage();
            for (i, (a, b)) in errors.iter().zip(before).enumerate() {
                if coverage[i / 3] > 127 {
                    self.flicker.0 += f64::from(a - b).powi(2);
                    self.flicker.1 += 1;
                }
            }
        }
        self.before[camera] = Some(errors);
        Ok(())
    }

    /// Returns the row of the table.
    pub fn row(mut self, take: &CodedTake, form: String) -> FormRow {
        let frames = self.sizes.len().max(1) as f64;
        let bytes = self.sizes.iter().sum::<usize>() as f64 / frames;
        self.sizes.sort_unstable();
        let p99 = self.sizes.get((self.sizes.len() * 99).div_ceil(100).saturating_sub(1)).copied().unwrap_or(0);
        let (truth, ours) = (take.uncoded.mean(), self.sheet.mean());
        let lost = |of: &dyn Fn(&CameraScore) -> f64| Some(of(truth.as_ref()?) - of(ours.as_ref()?));
        // Decibels of the mean error: frames without any would dominate a mean of decibels.
        let squares: f64 = self.coded.iter().map(|db| 10f64.powf(-db / 10.0)).sum();
        let [encode_ms, decode_ms, pose_ms] = self.times.map(|sum| sum / frames);
        FormRow {
            dataset: take.name.clone(),
            pose: take.pose,
            form,
            gaussians: self.gaussians,
            template_bytes: self.template,
            bytes,
            p99_bytes: p99 as f64,
            motion_bytes: self.motion as f64 / frames,
            coded_db: -10.0 * (squares / self.coded.len().max(1) as f64).log10(),
            worst_db: self.coded.iter().copied().fold(f64::INFINITY, f64::min),
            truth_db: truth.as_ref().map(|score| score.psnr_db),
            lost_db: lost(&|score| score.psnr_db),
            lost_ssim: lost(&|score| score.ssim),
            gained_flip: lost(&|score| -score.flip),
            flicker: (self.flicker.0 / self.flicker.1.max(1) as f64).sqrt(),
            encode_ms,
            decode_ms,
            pose_ms,
        }
    }
}
