//! Progress of a training: curve, table, image.

use std::{fmt, path::Path};

use anyhow::{Context, Result};
use flyrig_report::{
    plot::{Line, Plot, Series},
    write_whole,
};
use flyrig_stfa::{Loss, SampleErrors};
use serde::{Deserialize, Serialize};

/// Number of points of the curve.
const CURVE_POINTS: usize = 120;
/// Number of steps that the progress bar's message averages.
const RECENT: usize = 200;

/// Scores on the test people, who are not trained on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    pub step: u64,
    /// Mean PSNR over samples, dB.
    pub psnr_db: f64,
    /// Mean PSNR of direct appearance on the same pixels, dB.
    pub direct_db: f64,
    /// Gain of the networks over direct appearance in colour alone, where rendering and truth both cover a pixel, dB.
    pub color_gain_db: f64,
    /// Gain in the mean structural similarity of the patches over direct appearance, colour alone.
    pub ssim_gain: f64,
    /// Ratio of fine contrast to that of the truth, of the networks and of direct appearance.
    pub contrast: [f64; 2],
    /// Fraction of the samples on which the networks are better.
    pub better: f64,
}

impl Scores {
    /// Averages the errors of the networks and of direct appearance.
    pub fn new(step: u64, errors: &[SampleErrors]) -> Self {
        let count = errors.len().max(1) as f64;
        let mean = |of: fn(&SampleErrors) -> f64| errors.iter().map(of).sum::<f64>() / count;
        Self {
            step,
            psnr_db: mean(|e| psnr(e.learned.mse)),
            direct_db: mean(|e| psnr(e.direct.mse)),
            color_gain_db: mean(|e| psnr(e.learned.color_mse) - psnr(e.direct.color_mse)),
            ssim_gain: mean(|e| e.learned.ssim - e.direct.ssim),
            contrast: [mean(|e| e.learned.contrast), mean(|e| e.direct.contrast)],
            better: mean(|e| f64::from(u8::from(e.learned.mse < e.direct.mse))),
        }
    }
}

impl fmt::Display for Scores {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "people never seen: {:.2} dB, direct appearance {:.2} dB, better on {:.0} % of the samples, {:+.2} dB and SSIM {:+.4} in colour, fine contrast {:.2} (direct {:.2})",
            self.psnr_db,
            self.direct_db,
            self.better * 100.0,
            self.color_gain_db,
            self.ssim_gain,
            self.contrast[0],
            self.contrast[1]
        )
    }
}

fn psnr(mse: f64) -> f64 {
    -10.0 * mse.max(1e-10).log10()
}

/// Losses and scores so far.
#[derive(Debug, Default)]
pub struct Progress {
    pub losses: Vec<Loss>,
    pub scores: Vec<Scores>,
}

impl Progress {
    /// Reads the progress of an earlier run up to the step at which it is resumed.
    pub fn open(folder: &Path, step: u64) -> Result<Self> {
        let path = folder.join("progress.json");
        if step == 0 || !path.exists() {
            return Ok(Self::default());
        }
        let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let (mut losses, mut scores): (Vec<Loss>, Vec<Scores>) =
            serde_json::from_str(&text).with_context(|| format!("{} is damaged; delete it", path.display()))?;
        losses.retain(|loss| loss.step < step);
        scores.retain(|score| score.step <= step);
        Ok(Self { losses, scores })
    }

    /// Formats the recent gain over direct appearance on the training samples.
    pub fn message(&self) -> String {
        let recent = &self.losses[self.losses.len().saturating_sub(RECENT)..];
        let count = recent.len().max(1) as f64;
        let mean = |of: fn(&Loss) -> f64| recent.iter().map(|loss| psnr(of(loss))).sum::<f64>() / count;
        let (ours, direct) = (mean(|loss| loss.mse), mean(|loss| loss.direct_mse));
        let held_out =
            self.scores.last().map_or(String::new(), |s| format!(", held out {:+.2}", s.psnr_db - s.direct_db));
        format!("{ours:.2} dB, {:+.2} over direct{held_out}", ours - direct)
    }

    /// Writes table, image, and the file from which a run resumes.
    pub fn save(&self, folder: &Path) -> Result<()> {
        write_whole(&folder.join("progress.json"), &serde_json::to_vec(&(&self.losses, &self.scores))?)?;
        let rows: Vec<String> =
            self.losses.iter().map(|l| format!("{},{:.6},{:.6}\n", l.step, l.mse, l.direct_mse)).collect();
        write_whole(&folder.join("loss.csv"), format!("step,mse,direct_mse\n{}", rows.concat()).as_bytes())?;
        write_whole(&folder.join("loss.svg"), self.plot().svg().as_bytes())
    }

    fn plot(&self) -> Plot {
        let gain = |losses: &[Loss]| {
            let sum: f64 = losses.iter().map(|loss| psnr(loss.mse) - psnr(loss.direct_mse)).sum();
            sum / losses.len().max(1) as f64
        };
        let width = self.losses.len().div_ceil(CURVE_POINTS).max(1);
        let trained =
            self.losses.chunks(width).filter_map(|chunk| Some((chunk.last()?.step as f64, gain(chunk), String::new())));
        let held_out = self.scores.iter().map(|s| (s.step as f64, s.psnr_db - s.direct_db, String::new()));
        Plot {
            title: "Gain over direct appearance".to_owned(),
            x_label: "step".to_owned(),
            y_label: "PSNR gain, dB".to_owned(),
            log_x: false,
            log_y: false,
            series: vec![
                Series { name: "people trained on".to_owned(), points: trained.collect(), line: Line::Through },
                Series { name: "people never seen".to_owned(), points: held_out.collect(), line: Line::Through },
            ],
        }
    }
}
