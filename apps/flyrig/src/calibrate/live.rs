//! `flyrig calibrate live`: calibrates a rig while the board is shown, with instructions for the next step.

use std::{
    fmt::Write as _,
    io::IsTerminal as _,
    ops::ControlFlow,
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Result, ensure};
use clap::Args;
use flyrig_calib::{Board, BoardShot, CalibError, RigFit, RigOptions, calibrate_lens, calibrate_rig, load_lenses};
use flyrig_gpu::GpuContext;
use flyrig_monitor::PageServer;
use flyrig_report::stop;
use flyrig_types::{CameraId, Intrinsics};
use indicatif::{ProgressBar, ProgressStyle};

use super::{
    advice::{CalibrationState, Step, different},
    page, rig,
    views::{BoardTakeArgs, SeenBoards, open_frames},
};
use crate::arguments::{SolveArgs, TargetArgs};

/// Arguments of `flyrig calibrate live`.
#[derive(Debug, Args)]
#[command(mut_arg("secs", |arg| arg.default_value("1800")))]
pub struct CalibrateLiveArgs {
    /// Precision at which the calibration ends: standard deviation of every camera in the middle of the boards, millimetres.
    #[arg(long, default_value_t = 1.0, value_parser = parse_target_mm)]
    pub target_mm: f64,
    /// Address of the page; 0.0.0.0:8090 makes it reachable for other computers and phones.
    #[arg(long, default_value = "127.0.0.1:8090")]
    pub listen: String,
    #[command(flatten)]
    pub take: BoardTakeArgs,
    #[command(flatten)]
    pub solve: SolveArgs,
    #[command(flatten)]
    pub target: TargetArgs,
}

fn parse_target_mm(text: &str) -> Result<f64, String> {
    let target = text.parse().ok().filter(|target| (0.01..=1000.0).contains(target));
    target.ok_or_else(|| "expected millimetres, between 0.01 and 1000".to_owned())
}

/// Intervals between two instructions, and between two solves.
const LOOK_EVERY: Duration = Duration::from_millis(500);
const SOLVE_EVERY: Duration = Duration::from_secs(3);
/// Interval between two lines if standard error is no terminal.
const SAY_EVERY: Duration = Duration::from_secs(3);
/// Largest number of boards in an intermediate solve, spread over all; the last solve uses every board.
const SOLVED_BOARDS: usize = 120;
/// Number of new boards that justify another solve.
const NEW_BOARDS: usize = 4;

/// Runs the command.
pub fn live(args: &CalibrateLiveArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    stop::flag();
    let board = Board::load(&args.solve.board.board)?;
    rig::refuse_calibrated(&args.target, &args.solve)?;
    let opened = open_frames(&args.take, gpu)?;
    let ids: Vec<CameraId> = opened.sources.iter().map(|source| source.camera().clone()).collect();
    ensure!(ids.len() > 1, "one camera alone is no rig; flyrig calibrate lens calibrates it");
    let server = PageServer::start("--listen", &args.listen, "text/html; charset=utf-8")?;
    eprintln!("calibrate live: progress at http://{}/ (Ctrl-C calibrates with what was seen)", server.address());
    let mut watching = Watching::new(args, board.clone(), server);
    let mut seen = SeenBoards::detect_all(opened, &board, &args.take, |seen, _| watching.update(seen))?;
    watching.show.finish_and_clear();
    different(&seen.shots, watching.looked_at, &seen.sizes, &mut watching.shots);
    seen.shots = watching.shots;
    println!("{}", seen.looked);
    rig::check_floor(args.solve.floor, &seen)?;
    rig::calibrate((&args.target.out, &args.solve), &board, &seen, None)
}

/// Calibration under way.
struct Watching<'a> {
    args: &'a CalibrateLiveArgs,
    board: Board,
    server: PageServer,
    show: ProgressBar,
    /// Different boards, and the number of shots that they were selected from.
    shots: Vec<BoardShot>,
    looked_at: usize,
    /// Running solve.
    solving: Option<JoinHandle<Result<RigFit, CalibError>>>,
    /// Result of the last solve, its start, and its number of boards.
    solved: Option<Result<RigFit, CalibError>>,
    began: Option<Instant>,
    solved_boards: usize,
    last_look: Option<Instant>,
    last_step: Option<Step>,
    /// Time of the last line if standard error is no terminal.
    said: Option<Instant>,
}

impl<'a> Watching<'a> {
    fn new(args: &'a CalibrateLiveArgs, board: Board, server: PageServer) -> Self {
        let style = ProgressStyle::with_template("{msg}").unwrap_or_else(|_| ProgressStyle::default_spinner());
        Self {
            args,
            board,
            server,
            show: ProgressBar::new_spinner().with_style(style),
            shots: Vec::new(),
            looked_at: 0,
            solving: None,
            solved: None,
            began: None,
            solved_boards: 0,
            last_look: None,
            last_step: None,
            said: None,
        }
    }

    /// Updates the instruction from the boards so far; breaks once every camera is known well enough.
    fn update(&mut self, seen: &SeenBoards) -> Result<ControlFlow<()>> {
        if self.last_look.is_some_and(|last| last.elapsed() < LOOK_EVERY) {
            return Ok(ControlFlow::Continue(()));
        }
        self.last_look = Some(Instant::now());
        if self.shots.is_empty() && !seen.shots.is_empty() {
            rig::check_floor(self.args.solve.floor, seen)?;
        }
        different(&seen.shots, self.looked_at, &seen.sizes, &mut self.shots);
        self.looked_at = seen.shots.len();
        if let Some(done) = self.solving.take_if(|solving| solving.is_finished()) {
            // A panic has been logged already.
            self.solved = done.join().ok();
        }
        let progress = CalibrationState {
            ids: &seen.ids,
            sizes: &seen.sizes,
            shots: &self.shots,
            with_lenses: self.args.solve.lenses.is_none(),
            solved: self.solved.as_ref(),
            target_mm: self.args.target_mm,
        };
        let step = progress.next();
        let sentence = step.sentence(&seen.ids, self.args.target_mm);
        self.show.set_message(status(&progress, &sentence));
        let is_said =
            self.said.is_some_and(|said| said.elapsed() < SAY_EVERY) || self.last_step.as_ref() == Some(&step);
        if !std::io::stderr().is_terminal() && (!is_said || matches!(step, Step::Done(_))) {
            eprintln!("next: {sentence}");
            self.said = Some(Instant::now());
        }
        self.server.publish(page::live(&progress, &sentence).html());
        let is_done = matches!(step, Step::Done(_));
        let is_placed = !matches!(
            step,
            Step::NoImage(_) | Step::NoBoard(_) | Step::MoreBoards { .. } | Step::Cover { .. } | Step::Link { .. }
        );
        self.last_step = Some(step);
        if is_done {
            return Ok(ControlFlow::Break(()));
        }
        let is_due = self.began.is_none_or(|began| began.elapsed() > SOLVE_EVERY);
        if is_placed && is_due && self.solving.is_none() && self.shots.len() >= self.solved_boards + NEW_BOARDS {
            (self.began, self.solved_boards) = (Some(Instant::now()), self.shots.len());
            self.solving = Some(self.solve(seen)?);
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Starts a solve in its own thread, while further boards are detected.
    fn solve(&self, seen: &SeenBoards) -> Result<JoinHandle<Result<RigFit, CalibError>>> {
        let every = self.shots.len().div_ceil(SOLVED_BOARDS);
        // The first board may lie on the floor.
        let shots: Vec<BoardShot> = self.shots.iter().step_by(every).cloned().collect();
        let (ids, sizes, board) = (seen.ids.clone(), seen.sizes.clone(), self.board.clone());
        let (lenses, floor_first) = (self.args.solve.lenses.clone(), self.args.solve.floor);
        let work = move || {
            let known = match &lenses {
                Some(folder) => load_lenses(folder, &|_| None)?,
                None => Vec::new(),
            };
            let lens = |(slot, id): (usize, &CameraId)| -> Result<Intrinsics, CalibError> {
                if let Some((_, intrinsics)) = known.iter().find(|(known, _)| known == id) {
                    return Ok(*intrinsics);
                }
                let views: Vec<_> =
                    shots.iter().flat_map(|shot| &shot.views).filter(|view| view.camera == slot).cloned().collect();
                let fit = calibrate_lens(&board, id, sizes[slot].unwrap_or_default(), &views)?;
                Ok(fit.intrinsics)
            };
            let lenses = ids.iter().enumerate().map(lens).collect::<Result<Vec<_>, _>>()?;
            calibrate_rig(&board, &ids, &lenses, &shots, RigOptions { floor_first, ..RigOptions::default() })
        };
        Ok(std::thread::Builder::new().name("calibration".to_owned()).spawn(work)?)
    }
}

/// Formats the table for the terminal.
fn status(progress: &CalibrationState<'_>, sentence: &str) -> String {
    let mut text =
        format!("{:<14} {:>7} {:>8} {:>10}  shares boards with\n", "camera", "boards", "covered", "known, mm");
    for (slot, id) in progress.ids.iter().enumerate() {
        let with: Vec<String> = (0..progress.ids.len())
            .filter(|&other| other != slot && progress.shared(slot, other) > 0)
            .map(|other| format!("{} {}", progress.ids[other], progress.shared(slot, other)))
            .collect();
        let _ = writeln!(
            text,
            "{id:<14} {:>7} {:>7.0}% {:>10}  {}",
            progress.boards(slot),
            100.0 * progress.covered(slot),
            progress.known(slot),
            with.join(", ")
        );
    }
    let _ = write!(text, "next: {sentence}");
    text
}
