//! Agreement of one camera with the reconstruction: outline and brightness, and the words about it.

use std::collections::BTreeMap;

use anyhow::Result;
use flyrig_capture::to_rgb8;
use flyrig_metrics::CameraScore;
use flyrig_types::{CameraId, Image, Mask, RenderedView};
use serde::Serialize;

/// Coverage from which a pixel belongs to the person.
const COVERED: u8 = 128;
/// Least number of rows or columns that both silhouettes share.
const LEAST_LINES: usize = 8;
/// Share of the person's height by which an outline may be beside. 1 % of an adult is 18 mm, the width of a finger: less is not seen as a
/// double edge. 2 %, a wrist, tears hands and feet.
const OUTLINE_GOOD: f64 = 0.01;
const OUTLINE_BAD: f64 = 0.02;
/// PSNR of a held-out view, dB. A real take with a right calibration reaches 22 to 26 dB; with the one that it came with, a camera fell to
/// 18 dB, with torn hands and legs.
const PSNR_GOOD_DB: f64 = 22.0;
const PSNR_BAD_DB: f64 = 19.0;
/// Difference among the input views of one reconstruction, beyond which they contradict each other, and the share of it below which a camera
/// less makes them agree.
const INNER_GOOD: f64 = 0.004;
const CLEARLY: f64 = 0.6;
/// Difference in light, relative. A held-out camera sees a side that the others hardly see and that is lit differently: 23 % on a simulated take
/// whose colours are right. A camera whose values are a fifth too low differs by 39 %.
const LIGHT_GOOD: f64 = 0.3;
const LIGHT_BAD: f64 = 0.45;
/// Least speed of the outline at which a time offset shows, pixels per frame (root mean square).
const MOVING_PX: f64 = 1.0;
/// Exponent that converts sRGB bytes to light.
const GAMMA: f64 = 2.2;

/// One comparison of silhouettes.
#[derive(Debug, Clone, Copy)]
struct Offset {
    nanos: i64,
    /// Place of our outline relative to the mask's, pixels.
    by: [f64; 2],
    /// Centre of the mask's box, and its height, pixels.
    center: [f64; 2],
    height: f64,
}

/// Comparisons of one camera's images with rendered views.
#[derive(Debug, Default)]
pub struct CameraCheck {
    offsets: Vec<Offset>,
    /// Light of the image and of our view on pixels of the person, summed.
    light: [f64; 2],
}

/// Verdict of one camera's images.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Verdict {
    pub camera: String,
    pub grade: Grade,
    /// Distance of our outline from the mask's, pixels; `None` without a mask.
    pub outline_px: Option<f64>,
    /// Distance relative to the height of the person in the image.
    pub outline_share: Option<f64>,
    /// Whether that distance follows the motion, as a time offset does, rather than being constant.
    pub follows_motion: bool,
    /// Light of the camera relative to what the other cameras predict.
    pub light: Option<f64>,
    pub words: String,
}

/// Grade of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Grade {
    Good,
    Fair,
    Bad,
}

impl CameraCheck {
    /// Compares a rendered view with the camera's image and the person's mask in it. Images of another size are left out.
    ///
    /// # Errors
    /// The image cannot be read.
    pub fn add(&mut self, nanos: i64, view: &RenderedView, image: &Image, mask: &Mask) -> Result<()> {
        let rgb = to_rgb8(image)?;
        self.compare(nanos, view, &rgb, mask.coverage());
        Ok(())
    }

    /// Compares a rendered view with sRGB pixels and the coverage of the person's mask.
    pub fn compare(&mut self, nanos: i64, view: &RenderedView, rgb: &[u8], mask: &[u8]) {
        let (width, pixels) = (view.width as usize, mask.len());
        if view.rgba.len() != 4 * pixels || rgb.len() != 3 * pixels || width == 0 {
            return;
        }
        let ours = Outline::new(view.rgba.iter().skip(3).step_by(4).copied(), width);
        let truth = Outline::new(mask.iter().copied(), width);
        if let (Some(by), Some((center, height))) = (ours.offset_from(&truth), truth.extent()) {
            self.offsets.push(Offset { nanos, by, center, height });
        }
        for ((ours, truth), _) in
            view.rgba.chunks_exact(4).zip(rgb.chunks_exact(3)).zip(mask).filter(|((p, _), m)| p[3] > 250 && **m > 250)
        {
            self.light[0] += light(truth);
            self.light[1] += light(ours);
        }
    }

    /// Returns the median distance of our outlines from those of the masks, relative to the person's height.
    fn share(&self) -> Option<f64> {
        median(self.offsets.iter().map(|offset| length(offset.by) / offset.height))
    }

    /// Forms the verdict, with the score of the camera's held-out images, if any.
    pub fn verdict(&self, camera: &str, score: Option<&CameraScore>) -> Verdict {
        let shares = self.share();
        let outline_px = median(self.offsets.iter().map(|offset| length(offset.by)));
        let light = (self.light[1] > 0.0 && score.is_some()).then(|| self.light[0] / self.light[1]);
        let outline = graded(shares.unwrap_or(0.0), OUTLINE_GOOD, OUTLINE_BAD);
        let brightness = graded(light.map_or(0.0, |light| (light - 1.0).abs()), LIGHT_GOOD, LIGHT_BAD);
        let picture = score.map_or(Grade::Good, |score| graded(-score.psnr_db, -PSNR_GOOD_DB, -PSNR_BAD_DB));
        let grade = outline.max(brightness).max(picture);
        let mut reasons = Vec::new();
        if let Some(score) = score {
            reasons.push(format!("{:.1} dB when held out", score.psnr_db));
        }
        if let (Some(px), Some(share)) = (outline_px, shares) {
            reasons.push(format!("its outline is {px:.0} px beside, {:.1} % of the person's height", 100.0 * share));
        }
        if let Some(light) = light.filter(|_| brightness > Grade::Good) {
            let word = if light < 1.0 { "darker" } else { "brighter" };
            reasons.push(format!("it is {:.0} % {word} than the others predict", 100.0 * (light - 1.0).abs()));
        }
        // What was fitted to a camera says less about it.
        let words = match (score.is_some(), grade) {
            _ if reasons.is_empty() => "was not compared, because the person was not seen in it",
            (true, Grade::Good) => "is good: ",
            (true, Grade::Fair) => "is fair: ",
            (true, Grade::Bad) => "is not good: ",
            (false, Grade::Good) => "fits the result, which was also fitted to it: ",
            (false, Grade::Fair) => "fits roughly, although the result was also fitted to it: ",
            (false, Grade::Bad) => "does not fit, although the result was also fitted to it: ",
        };
        Verdict {
            camera: camera.to_owned(),
            grade,
            outline_px,
            outline_share: shares,
            follows_motion: self.follows_motion(),
            light,
            words: format!("Camera {camera} {words}{}.", reasons.join("; ")),
        }
    }

    /// Returns whether the offsets are better explained by a time offset, as multiples of the person's velocity in the image, than by a
    /// constant.
    fn follows_motion(&self) -> bool {
        let steps: Vec<([f64; 2], [f64; 2])> = self
            .offsets
            .windows(2)
            .filter(|pair| pair[1].nanos > pair[0].nanos)
            .map(|pair| (minus(pair[1].center, pair[0].center), pair[1].by))
            .collect();
        let count = steps.len() as f64;
        let speeds: f64 = steps.iter().map(|(velocity, _)| dot(*velocity, *velocity)).sum();
        if count < 4.0 || speeds < count * MOVING_PX.powi(2) {
            return false;
        }
        let late = steps.iter().map(|(velocity, by)| dot(*velocity, *by)).sum::<f64>() / speeds;
        let mean = [0, 1].map(|axis| steps.iter().map(|(_, by)| by[axis]).sum::<f64>() / count);
        let square = |rest: [f64; 2]| dot(rest, rest);
        let moving: f64 = steps.iter().map(|(velocity, by)| square(minus(*by, velocity.map(|v| late * v)))).sum();
        moving < steps.iter().map(|(_, by)| square(minus(*by, mean))).sum()
    }
}

/// Camera that disturbs the others: without it, their outlines fit.
#[derive(Debug, PartialEq)]
pub struct Culprit {
    pub camera: CameraId,
    /// Distance of the other cameras' outlines without it, and in the median of the other reconstructions, relative to the person's height.
    shares: [f64; 2],
}

impl Culprit {
    /// Finds the camera by the comparisons of the input views in each reconstruction, by the camera that it leaves out. A wrong camera is
    /// predicted wrongly, but it also makes the others' predictions wrong; only without it do the rest agree.
    pub fn find(without: &BTreeMap<CameraId, CameraCheck>) -> Option<Self> {
        let shares = without.iter().filter_map(|(camera, check)| Some((camera, check.share()?)));
        let (camera, least) = shares.clone().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let others = median(shares.filter(|(other, _)| *other != camera).map(|(_, share)| share))?;
        let is_clear = others > INNER_GOOD && least < CLEARLY * others;
        is_clear.then(|| Self { camera: camera.clone(), shares: [least, others] })
    }

    /// Explains the finding.
    pub fn words(&self) -> String {
        let Self { camera, shares: [without, with] } = self;
        format!(
            "{camera} disturbs the others: without it their outlines are {:.1} % of the person's height beside, with it {:.1} %.",
            100.0 * without,
            100.0 * with
        )
    }
}

impl Verdict {
    /// Names the next step for the camera that needs one most, which is the culprit if there is one; `None` if all are good.
    pub fn next_step(verdicts: &[Self], culprit: Option<&Culprit>, take: &str) -> Option<String> {
        let is_culprit = |verdict: &Self| culprit.is_some_and(|found| found.camera.as_str() == verdict.camera);
        let worst = verdicts.iter().filter(|verdict| verdict.grade > Grade::Good).max_by(|a, b| {
            let key = |verdict: &Self| (is_culprit(verdict), verdict.grade);
            let share = |verdict: &Self| verdict.outline_share.unwrap_or(0.0);
            key(a).cmp(&key(b)).then(share(a).total_cmp(&share(b)))
        })?;
        let name = &worst.camera;
        if let Some(px) = worst.outline_px.filter(|_| worst.outline_share > Some(OUTLINE_GOOD)) {
            return Some(if worst.follows_motion {
                format!(
                    "Next: the outline of {name} is {px:.0} px beside and follows the motion, as with clocks that differ: flyrig sync-check {take}"
                )
            } else {
                format!(
                    "Next: the outline of {name} is {px:.0} px beside, wherever the person is: flyrig calibrate person {take} --out better"
                )
            });
        }
        if let Some(light) = worst.light.filter(|light| (light - 1.0).abs() > LIGHT_GOOD) {
            let word = if light < 1.0 { "dark" } else { "bright" };
            return Some(format!("Next: {name} is too {word}: flyrig calibrate color {take} --out better"));
        }
        Some(format!(
            "Next: outlines and brightness fit, yet {name} is predicted poorly: look for parts that no other camera sees, and for masks \
             that lose hands or feet in the images below"
        ))
    }
}

/// First and last covered pixel of each row and column.
struct Outline {
    rows: Vec<Option<[usize; 2]>>,
    columns: Vec<Option<[usize; 2]>>,
}

impl Outline {
    fn new(coverage: impl Iterator<Item = u8>, width: usize) -> Self {
        let (mut rows, mut columns) = (Vec::new(), vec![None; width]);
        for (at, _) in coverage.enumerate().filter(|(_, alpha)| *alpha >= COVERED) {
            let (x, y) = (at % width, at / width);
            if rows.len() <= y {
                rows.resize(y + 1, None);
            }
            for (ends, at) in [(&mut rows[y], x), (&mut columns[x], y)] {
                *ends = Some(ends.map_or([at, at], |[first, _]: [usize; 2]| [first, at]));
            }
        }
        Self { rows, columns }
    }

    /// Returns the offset from another outline, pixels: the median over rows and over columns, which parts that one of them lacks do not move.
    /// `None` where they share too little.
    fn offset_from(&self, other: &Self) -> Option<[f64; 2]> {
        let along = |ours: &[Option<[usize; 2]>], others: &[Option<[usize; 2]>]| {
            let both: Vec<f64> = ours
                .iter()
                .zip(others)
                .filter_map(|(ours, others)| ours.as_ref().zip(others.as_ref()))
                .map(|(ours, others)| (0.5 * (ours[0] + ours[1]) as f64) - 0.5 * (others[0] + others[1]) as f64)
                .collect();
            if both.len() < LEAST_LINES { None } else { median(both.into_iter()) }
        };
        Some([along(&self.rows, &other.rows)?, along(&self.columns, &other.columns)?])
    }

    /// Returns the centre of the box and its height, pixels.
    fn extent(&self) -> Option<([f64; 2], f64)> {
        let ends = |lines: &[Option<[usize; 2]>]| {
            let first = lines.iter().position(Option::is_some)?;
            Some((first as f64, lines.iter().rposition(Option::is_some)? as f64))
        };
        let ((top, bottom), (left, right)) = (ends(&self.rows)?, ends(&self.columns)?);
        (bottom > top).then_some(([0.5 * (left + right), 0.5 * (top + bottom)], bottom - top))
    }
}

/// Returns the light of an sRGB pixel, 0..=1.
fn light(pixel: &[u8]) -> f64 {
    let value = |at: usize| (f64::from(pixel[at]) / 255.0).powf(GAMMA);
    0.2126 * value(0) + 0.7152 * value(1) + 0.0722 * value(2)
}

fn graded(value: f64, good: f64, bad: f64) -> Grade {
    if value <= good {
        Grade::Good
    } else if value <= bad {
        Grade::Fair
    } else {
        Grade::Bad
    }
}

fn length(a: [f64; 2]) -> f64 {
    a[0].hypot(a[1])
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

/// Returns the median; `None` of nothing.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 100;

    /// Draws a person of 80 pixels with an arm, shifted by whole pixels; the arm may be missing.
    fn person(shift: [i64; 2], has_arm: bool) -> Vec<u8> {
        let inside = |i: usize| {
            let (x, y) = ((i % SIDE) as i64 - shift[0], (i / SIDE) as i64 - shift[1]);
            (10..90).contains(&y)
                && ((40..60).contains(&x) || has_arm && (30..35).contains(&y) && (60..75).contains(&x))
        };
        (0..SIDE * SIDE).map(|i| if inside(i) { 255 } else { 0 }).collect()
    }

    fn view(alpha: &[u8], grey: u8) -> RenderedView {
        let rgba = alpha.iter().flat_map(|&a| [grey, grey, grey, a]).collect();
        RenderedView { width: SIDE as u32, height: SIDE as u32, rgba }
    }

    fn score(psnr_db: f64) -> CameraScore {
        CameraScore { camera: "03".into(), frames: 1, psnr_db, ssim: 0.9, flip: 0.1, iou: None, parts: None }
    }

    /// Compares a person who walks by `step` pixels per frame with ours, which is shifted by `off(frame)`.
    fn check(step: i64, grey: u8, off: impl Fn(i64) -> [i64; 2]) -> CameraCheck {
        let mut check = CameraCheck::default();
        for frame in 0..6 {
            let walked = [step * (if frame < 3 { frame } else { 6 - frame }), 0];
            let shift = [walked[0] + off(frame)[0], walked[1] + off(frame)[1]];
            let (ours, truth) = (person(shift, true), person(walked, false));
            check.compare(frame * 33_000_000, &view(&ours, 100), &[grey; 3 * SIDE * SIDE], &truth);
        }
        check
    }

    #[test]
    fn an_outline_that_fits_is_good_even_where_the_mask_lacks_an_arm() {
        let verdict = check(2, 100, |_| [0, 0]).verdict("03", Some(&score(25.0)));
        assert_eq!((verdict.grade, verdict.outline_px), (Grade::Good, Some(0.0)));
        assert!(verdict.words.starts_with("Camera 03 is good: 25.0 dB when held out"), "{}", verdict.words);
        assert_eq!(Verdict::next_step(&[verdict], None, "take"), None);
    }

    #[test]
    fn a_constant_offset_is_the_pose_and_one_along_the_motion_the_clock() {
        let moved = check(4, 100, |_| [-3, 2]).verdict("03", None);
        assert_eq!((moved.grade, moved.follows_motion), (Grade::Bad, false));
        assert!((moved.outline_px.unwrap() - 13f64.sqrt()).abs() < 1e-9, "{moved:?}");
        let step = Verdict::next_step(std::slice::from_ref(&moved), None, "take").unwrap();
        assert!(step.contains("the outline of 03 is 4 px beside") && step.contains("calibrate person take"), "{step}");
        // Ours is half a frame ahead, forth and back.
        let late = check(4, 100, |frame| [if frame <= 3 { 2 } else { -2 }, 0]).verdict("03", None);
        assert!(late.follows_motion && late.grade == Grade::Bad, "{late:?}");
        // The worst camera is named.
        let slight = check(4, 100, |_| [1, 0]).verdict("04", None);
        let step = Verdict::next_step(&[slight, late], None, "take").unwrap();
        assert!(step.contains("of 03 is 2 px") && step.contains("sync-check take"), "{step}");
    }

    #[test]
    fn the_camera_without_which_the_others_agree_is_named_first() {
        let off = |px: i64| check(0, 100, move |_| [px, 0]);
        let without = |px: [i64; 3]| {
            let names = ["00", "01", "02"].map(CameraId::from);
            names.into_iter().zip(px.map(off)).collect::<BTreeMap<CameraId, CameraCheck>>()
        };
        let found = Culprit::find(&without([2, 0, 3])).unwrap();
        assert_eq!(found.camera.as_str(), "01");
        assert!(found.words().starts_with("01 disturbs the others: without it"), "{}", found.words());
        // Another camera looks worse, because the culprit took part.
        let verdicts = [off(5).verdict("00", None), off(3).verdict("01", None)];
        let step = Verdict::next_step(&verdicts, Some(&found), "take").unwrap();
        assert!(step.contains("the outline of 01 is 3 px"), "{step}");
        assert_eq!(Culprit::find(&without([0, 0, 0])), None);
        assert_eq!(Culprit::find(&without([2, 2, 2])), None);
    }

    #[test]
    fn a_dark_camera_is_sent_to_the_colours_and_a_poor_one_to_the_images() {
        let dark = check(0, 75, |_| [0, 0]).verdict("02", Some(&score(23.0)));
        assert_eq!(dark.grade, Grade::Bad);
        assert!(dark.words.contains("47 % darker"), "{}", dark.words);
        assert!(
            Verdict::next_step(&[dark], None, "take").unwrap().contains("02 is too dark: flyrig calibrate color take")
        );
        let poor = check(0, 100, |_| [0, 0]).verdict("02", Some(&score(17.0)));
        assert_eq!(poor.grade, Grade::Bad);
        assert!(Verdict::next_step(&[poor], None, "take").unwrap().contains("predicted poorly"));
    }

    #[test]
    fn nothing_to_compare_is_no_fault() {
        let mut empty = CameraCheck::default();
        empty.compare(0, &view(&[0; SIDE * SIDE], 9), &[0; 3 * SIDE * SIDE], &[0; SIDE * SIDE]);
        empty.compare(0, &view(&[0; SIDE * SIDE], 9), &[0; 30], &[0; 10]);
        let verdict = empty.verdict("01", None);
        assert_eq!(verdict.words, "Camera 01 was not compared, because the person was not seen in it.");
        let input = check(0, 100, |_| [0, 0]).verdict("02", None);
        assert!(
            input.words.starts_with("Camera 02 fits the result, which was also fitted to it: its outline"),
            "{}",
            input.words
        );
    }
}
