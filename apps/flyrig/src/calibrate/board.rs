//! `flyrig calibrate board`: boards to print.

use anyhow::{Context as _, Result, anyhow};
use clap::{Args, ValueEnum};
use flyrig_calib::{Board, BoardSheet, Pattern};
use flyrig_report::write_whole;

use super::output::refuse_existing;
use crate::arguments::TargetArgs;

/// Arguments of `flyrig calibrate board`.
#[derive(Debug, Args)]
#[command(mut_arg("out", |arg| arg.required(false).default_value("board")))]
pub struct CalibrateBoardArgs {
    /// Squares along the long side.
    #[arg(long, default_value_t = 9)]
    pub columns: u32,
    /// Squares along the short side.
    #[arg(long, default_value_t = 6)]
    pub rows: u32,
    /// Side of a square, millimetres.
    #[arg(long, default_value_t = 30.0)]
    pub square_mm: f64,
    /// Pattern of the board.
    #[arg(long, value_enum, default_value = "charuco")]
    pub pattern: PatternName,
    /// Dictionary of the markers, by its name in OpenCV.
    #[arg(long, default_value = "DICT_5X5_100")]
    pub dictionary: String,
    /// Side of a marker as a fraction of that of a square.
    #[arg(long, default_value_t = 0.75)]
    pub marker: f64,
    /// Paper size; a sheet of the size of the board otherwise.
    #[arg(long, value_enum)]
    pub paper: Option<Paper>,
    #[command(flatten)]
    pub target: TargetArgs,
}

/// Pattern of a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PatternName {
    /// Squares with markers: any part of the board is recognized.
    Charuco,
    /// Squares alone: the whole board must be visible.
    Chessboard,
}

/// Size of paper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Paper {
    A4,
    A3,
    A2,
    A1,
    A0,
}

impl Paper {
    /// Returns the long and the short side, millimetres.
    pub fn size_mm(self) -> [f64; 2] {
        match self {
            Self::A4 => [297.0, 210.0],
            Self::A3 => [420.0, 297.0],
            Self::A2 => [594.0, 420.0],
            Self::A1 => [841.0, 594.0],
            Self::A0 => [1189.0, 841.0],
        }
    }
}

/// Runs the command.
pub fn board(args: &CalibrateBoardArgs) -> Result<()> {
    let pattern = match args.pattern {
        PatternName::Chessboard => Pattern::Chessboard,
        PatternName::Charuco => Pattern::Charuco { dictionary: args.dictionary.clone(), marker: args.marker },
    };
    let board = Board { columns: args.columns, rows: args.rows, square_mm: args.square_mm, pattern };
    let sheet = BoardSheet::new(&board, args.paper.map(Paper::size_mm)).map_err(|reason| anyhow!(reason))?;
    std::fs::create_dir_all(&args.target.out)
        .with_context(|| format!("cannot create {}", args.target.out.display()))?;
    refuse_existing(&args.target.out, &["board.svg", "board.pdf", "board.toml"], args.target.force)?;
    let files = [
        ("board.svg", sheet.to_svg().into_bytes()),
        ("board.pdf", sheet.to_pdf()),
        ("board.toml", board.to_toml().into_bytes()),
    ];
    for (name, bytes) in &files {
        write_whole(&args.target.out.join(name), bytes)?;
    }
    let [width, height] = sheet.size_mm;
    println!("{}: board.svg, board.pdf ({width:.0} x {height:.0} mm), board.toml", args.target.out.display());
    println!(
        "next: print at 100 % without fitting to the page, measure the ruler, glue the sheet to something flat, and write the measured \
         side of a square into board.toml; then flyrig calibrate lens, with each camera close to the board"
    );
    Ok(())
}
