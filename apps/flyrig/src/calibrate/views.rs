//! Boards in the images of a take.

use std::{
    collections::BTreeMap,
    fmt,
    ops::ControlFlow,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, anyhow, ensure};
use clap::Args;
use flyrig_calib::{Board, BoardDetector, BoardShot, BoardView, GrayImage, detector};
use flyrig_fusion::{InputFormat, Intake};
use flyrig_gpu::GpuContext;
use flyrig_report::{arguments::parse_seconds, progress_bar, stop};
use flyrig_sync::SyncSettings;
use flyrig_takes::{Footage, Needs, Take, TakeOptions, require_inputs};
use flyrig_types::{CameraId, FrameSet};
use rayon::prelude::*;

use crate::{
    arguments::{InputArgs, parse_most_ms},
    opening::open_take,
};

/// A take of a board, and the part that is used.
#[derive(Debug, Args)]
pub struct BoardTakeArgs {
    /// Seconds of the input that are used [default: all of a folder of images, 120 of anything else].
    #[arg(long, value_parser = parse_seconds)]
    pub secs: Option<f64>,
    /// Time between used frame sets, milliseconds [default: every image of a folder, 100 of anything else].
    #[arg(long, value_parser = parse_most_ms)]
    pub every_ms: Option<f64>,
    #[command(flatten)]
    pub source: InputArgs,
}

/// Seconds of a take that is no folder of images, and time between its used frame sets, milliseconds.
const USUAL_SECS: f64 = 120.0;
const USUAL_EVERY_MS: f64 = 100.0;

impl BoardTakeArgs {
    /// Returns whether the input is a folder of images: somebody chose them, so each counts.
    fn is_folder(&self) -> bool {
        Footage::from_paths(&self.source.input).is_ok_and(|footage| footage.folder().is_some())
    }

    /// Returns the seconds that are used; infinity for all.
    fn secs(&self) -> f64 {
        self.secs.unwrap_or(if self.is_folder() { f64::INFINITY } else { USUAL_SECS })
    }

    /// Returns the time between used frame sets, milliseconds.
    fn every_ms(&self) -> f64 {
        self.every_ms.unwrap_or(if self.is_folder() { 0.0 } else { USUAL_EVERY_MS })
    }
}

/// Number of images that are searched in parallel.
const BATCH: usize = 16;

/// Time that live cameras have for their first frame, seconds.
const PATIENCE_SECS: f64 = 15.0;

/// Opens the frames of a take. `gpu` opens a graphics adapter, for simulated cameras alone.
pub fn open_frames(args: &BoardTakeArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Take> {
    let options = TakeOptions { fps: args.source.rate.fps, needs: Needs::Frames, ..TakeOptions::default() };
    open_take(&args.source.input, &options, gpu)
}

/// Loads the board that is searched for in a take.
///
/// # Errors
/// Names the take, and the board's file with what is wrong in it.
pub fn load_board(board: &Path, take: &BoardTakeArgs) -> Result<Board> {
    require_inputs(&take.source.input)?;
    Board::load(board).with_context(|| {
        let inputs: Vec<_> = take.source.input.iter().map(|path| path.display().to_string()).collect();
        format!("cannot search {} for a board", inputs.join(", "))
    })
}

/// Boards that were seen in a take.
pub struct SeenBoards {
    pub ids: Vec<CameraId>,
    /// Width and height of each camera's images, pixels; `None` without an image.
    pub sizes: Vec<Option<[u32; 2]>>,
    /// Frame sets in which at least one camera saw the board.
    pub shots: Vec<BoardShot>,
    /// Number of searched images per camera.
    pub images: Vec<usize>,
    /// Time of the first frame set, nanoseconds.
    pub begin_nanos: i64,
    /// Part of the take that was searched.
    pub looked: Looked,
}

/// Part of a take that was searched for boards.
#[derive(Debug, Clone, Copy, Default)]
pub struct Looked {
    /// Number of frame sets that were searched, and of all until the end.
    sets: [usize; 2],
    every_ms: f64,
    /// Seconds after which the search ended, if the take went on.
    until_secs: Option<f64>,
}

impl fmt::Display for Looked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [looked, all] = self.sets;
        match looked == all {
            true => write!(f, "looked at all {all} frame sets")?,
            false => write!(f, "looked at {looked} of {all} frame sets, one per {} ms (--every-ms)", self.every_ms)?,
        }
        match self.until_secs {
            Some(secs) => write!(f, " of the first {secs} s (--secs)"),
            None => Ok(()),
        }
    }
}

impl SeenBoards {
    /// Opens a take, detects the board and prints how much was searched. `gpu` opens a graphics adapter, for simulated cameras alone.
    pub fn find(args: &BoardTakeArgs, board: &Board, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Self> {
        let bar = progress_bar((args.secs() * 1e3) as u64, "boards, ms of the take");
        if args.secs().is_infinite() {
            bar.unset_length();
        }
        let seen = Self::detect_all(open_frames(args, gpu)?, board, args, |seen, at| {
            bar.set_position((at * 1e3) as u64);
            bar.set_message(format!("{} boards", seen.shots.iter().map(|shot| shot.views.len()).sum::<usize>()));
            Ok(ControlFlow::Continue(()))
        })?;
        bar.finish_and_clear();
        println!("{}", seen.looked);
        Ok(seen)
    }

    /// Detects the board in a take until its end. `each` gets the results so far and the seconds since the first frame set, and may break.
    pub fn detect_all(
        take: Take,
        board: &Board,
        args: &BoardTakeArgs,
        mut each: impl FnMut(&Self, f64) -> Result<ControlFlow<()>>,
    ) -> Result<Self> {
        let (secs, every_ms) = (args.secs(), args.every_ms());
        let detector = detector(board).map_err(|reason| anyhow!(reason))?;
        let ids: Vec<CameraId> = take.sources.iter().map(|source| source.camera().clone()).collect();
        let count = ids.len();
        let mut seen = Self {
            ids,
            sizes: vec![None; count],
            shots: Vec::new(),
            images: vec![0; count],
            begin_nanos: 0,
            looked: Looked { every_ms, ..Looked::default() },
        };
        let pacing = take.pacing();
        let mut intake = Intake::start_opening(take.sources, InputFormat::AnySize, &SyncSettings::default(), pacing)?;
        let started = Instant::now();
        let (mut first, mut next, mut batch) = (None, i64::MIN, Vec::new());
        while !intake.ended() && !stop::requested() {
            let Some(set) = intake.next_set(Duration::from_millis(200)) else {
                let is_silent = first.is_none() && started.elapsed().as_secs_f64() > PATIENCE_SECS;
                ensure!(
                    !is_silent,
                    "no image came in {PATIENCE_SECS} s; flyrig doctor says what is wrong with the cameras"
                );
                continue;
            };
            let from = *first.get_or_insert(set.master_nanos);
            seen.begin_nanos = from;
            let at = set.master_nanos.saturating_sub(from) as f64 * 1e-9;
            if at > secs {
                seen.looked.until_secs = Some(secs);
                break;
            }
            seen.looked.sets[1] += 1;
            // Jitter may bring the right frame set slightly early.
            if set.master_nanos < next {
                continue;
            }
            next = set.master_nanos.saturating_add((0.9e6 * every_ms) as i64);
            seen.looked.sets[0] += 1;
            batch.push(set);
            if batch.len() * count >= BATCH {
                seen.detect(&batch, detector.as_ref())?;
                batch.clear();
                if each(&seen, at)?.is_break() {
                    break;
                }
            }
        }
        seen.detect(&batch, detector.as_ref())?;
        for (slot, id) in seen.ids.iter().enumerate() {
            match intake.last_error(slot) {
                Some(error) if seen.images[slot] == 0 => {
                    return Err(anyhow!("no image of camera {id} could be used; the last: {error}"));
                }
                Some(error) => eprintln!("warning: not every image of camera {id} could be used; the last: {error}"),
                None => {}
            }
        }
        Ok(seen)
    }

    fn detect(&mut self, sets: &[FrameSet], detector: &dyn BoardDetector) -> Result<()> {
        let jobs: Vec<(usize, usize)> =
            sets.iter().enumerate().flat_map(|(i, set)| set.present().map(move |(slot, _)| (i, slot))).collect();
        let found: BTreeMap<(usize, usize), BoardView> = jobs
            .par_iter()
            .filter_map(|&(i, slot)| {
                let frame = sets[i].frames[slot].as_ref()?;
                let corners = detector.detect(&GrayImage::of(&frame.image)?);
                let view = BoardView { camera: slot, nanos: frame.capture_nanos, corners };
                (!view.corners.is_empty()).then_some(((i, slot), view))
            })
            .collect();
        for (i, slot) in jobs {
            let Some(frame) = &sets[i].frames[slot] else { continue };
            let size = [frame.image.width(), frame.image.height()];
            let known = *self.sizes[slot].get_or_insert(size);
            ensure!(
                known == size,
                "camera {}: its images are {}x{} and {}x{}; calibrate with one size",
                self.ids[slot],
                known[0],
                known[1],
                size[0],
                size[1]
            );
            self.images[slot] += 1;
        }
        for (i, set) in sets.iter().enumerate() {
            let views: Vec<BoardView> = found.range((i, 0)..(i + 1, 0)).map(|(_, view)| view.clone()).collect();
            if !views.is_empty() {
                self.shots.push(BoardShot { nanos: set.master_nanos, views });
            }
        }
        Ok(())
    }

    /// Returns the views of one camera in the order of time.
    pub fn of_camera(&self, slot: usize) -> Vec<BoardView> {
        self.shots.iter().flat_map(|shot| &shot.views).filter(|view| view.camera == slot).cloned().collect()
    }

    /// Checks that a camera saw the board.
    pub fn check(&self, slot: usize, board: &Board) -> Result<()> {
        ensure!(
            !self.of_camera(slot).is_empty(),
            "camera {}: no board in its {} images; check board.toml ({} x {} squares), light and focus, and show the whole board{}",
            self.ids[slot],
            self.images[slot],
            board.columns,
            board.rows,
            match board.pattern {
                flyrig_calib::Pattern::Chessboard => "",
                flyrig_calib::Pattern::Charuco { .. } =>
                    " (its dictionary and size of markers must be those of the print)",
            }
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use flyrig_report::arguments::FpsArgs;
    use image::{Rgb, RgbImage};

    use super::*;
    use crate::{arguments::InputArgs, video_file::VideoFile};

    /// Searches a take without a board and says how much of it was looked at.
    fn looked(input: &[PathBuf], secs: Option<f64>, every_ms: Option<f64>) -> String {
        let board = Board { columns: 7, rows: 6, square_mm: 50.0, pattern: flyrig_calib::Pattern::Chessboard };
        let source = InputArgs { input: input.to_vec(), rate: FpsArgs { fps: 30.0 } };
        let args = BoardTakeArgs { secs, every_ms, source };
        let take = open_frames(&args, &|| anyhow::bail!("no adapter is needed")).unwrap();
        let seen = SeenBoards::detect_all(take, &board, &args, |_, _| Ok(ControlFlow::Continue(()))).unwrap();
        assert!(seen.shots.is_empty());
        assert!(seen.images.iter().all(|images| *images == seen.looked.sets[0]), "{:?}", seen.images);
        seen.looked.to_string()
    }

    #[test]
    fn every_image_of_a_folder_is_used_and_of_videos_the_part_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let image = |i: u32| RgbImage::from_fn(64, 48, |x, y| Rgb([(x * y + 7 * i) as u8; 3]));
        let mut videos = Vec::new();
        for camera in ["a", "b"] {
            let stills = folder.path().join("take/images").join(camera);
            std::fs::create_dir_all(&stills).unwrap();
            let path = folder.path().join(format!("{camera}.mp4"));
            let mut video = VideoFile::create(&path, (64, 48)).unwrap();
            for i in 0..60 {
                image(i).save(stills.join(format!("{i:06}.png"))).unwrap();
                video.write(&image(i), 0, i64::from(i) * 1_000_000_000 / 30).unwrap();
            }
            video.finish().unwrap();
            videos.push(path);
        }
        let stills = [folder.path().join("take")];
        assert_eq!(looked(&stills, None, None), "looked at all 60 frame sets");
        assert_eq!(looked(&stills, None, Some(100.0)), "looked at 20 of 60 frame sets, one per 100 ms (--every-ms)");
        let part = looked(&stills, Some(0.5), None);
        assert_eq!(part, "looked at all 16 frame sets of the first 0.5 s (--secs)");
        assert_eq!(looked(&videos, None, None), "looked at 20 of 60 frame sets, one per 100 ms (--every-ms)");
        assert_eq!(looked(&videos, None, Some(4.0)), "looked at all 60 frame sets");
    }
}
