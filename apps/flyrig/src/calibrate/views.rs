//! Boards in the images of a take.

use std::{
    collections::BTreeMap,
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
use flyrig_takes::{Needs, Take, TakeOptions, require_inputs};
use flyrig_types::{CameraId, FrameSet};
use rayon::prelude::*;

use crate::{
    arguments::{InputArgs, parse_most_ms},
    opening::open_take,
};

/// A take of a board, and the part that is used.
#[derive(Debug, Args)]
pub struct BoardTakeArgs {
    /// Seconds of the input that are used.
    #[arg(long, default_value_t = 120.0, value_parser = parse_seconds)]
    pub secs: f64,
    /// Time between used frame sets, milliseconds.
    #[arg(long, default_value_t = 100.0, value_parser = parse_most_ms)]
    pub every_ms: f64,
    #[command(flatten)]
    pub source: InputArgs,
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
}

impl SeenBoards {
    /// Opens a take and detects the board, which every camera must see. `gpu` opens a graphics adapter, for simulated cameras alone.
    pub fn find(args: &BoardTakeArgs, board: &Board, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<Self> {
        let bar = progress_bar((args.secs * 1e3) as u64, "boards, ms of the take");
        let seen = Self::detect_all(open_frames(args, gpu)?, board, args, |seen, at| {
            bar.set_position((at * 1e3) as u64);
            bar.set_message(format!("{} boards", seen.shots.iter().map(|shot| shot.views.len()).sum::<usize>()));
            Ok(ControlFlow::Continue(()))
        })?;
        bar.finish_and_clear();
        seen.check(board)?;
        Ok(seen)
    }

    /// Detects the board in a take until its end. `each` gets the results so far and the seconds since the first frame set, and may break.
    pub fn detect_all(
        take: Take,
        board: &Board,
        args: &BoardTakeArgs,
        mut each: impl FnMut(&Self, f64) -> Result<ControlFlow<()>>,
    ) -> Result<Self> {
        let (secs, every_nanos) = (args.secs, args.every_ms * 1e6);
        let detector = detector(board).map_err(|reason| anyhow!(reason))?;
        let ids: Vec<CameraId> = take.sources.iter().map(|source| source.camera().clone()).collect();
        let count = ids.len();
        let mut seen =
            Self { ids, sizes: vec![None; count], shots: Vec::new(), images: vec![0; count], begin_nanos: 0 };
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
                break;
            }
            // Jitter may bring the right frame set slightly early.
            if set.master_nanos < next {
                continue;
            }
            next = set.master_nanos.saturating_add((0.9 * every_nanos) as i64);
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

    /// Checks that every camera saw the board.
    pub fn check(&self, board: &Board) -> Result<()> {
        for (slot, id) in self.ids.iter().enumerate() {
            ensure!(
                !self.of_camera(slot).is_empty(),
                "camera {id}: no board in its {} images; check board.toml ({} x {} squares), light and focus, and show the whole \
                 board{}",
                self.images[slot],
                board.columns,
                board.rows,
                match board.pattern {
                    flyrig_calib::Pattern::Chessboard => "",
                    flyrig_calib::Pattern::Charuco { .. } =>
                        " (its dictionary and size of markers must be those of the print)",
                }
            );
        }
        Ok(())
    }
}
