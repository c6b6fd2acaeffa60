//! `flyrig calibrate board`: boards to print.

use anyhow::{Context as _, Result, anyhow};
use flyrig_calib::{Board, BoardSheet, Pattern};
use flyrig_report::write_whole;

use super::output::refuse_existing;
use crate::cli::{CalibrateBoardArgs, Paper, PatternName};

/// Runs the command.
pub fn board(args: &CalibrateBoardArgs) -> Result<()> {
    let pattern = match args.pattern {
        PatternName::Chessboard => Pattern::Chessboard,
        PatternName::Charuco => Pattern::Charuco { dictionary: args.dictionary.clone(), marker: args.marker },
    };
    let board = Board { columns: args.columns, rows: args.rows, square_mm: args.square_mm, pattern };
    let sheet = BoardSheet::new(&board, args.paper.map(Paper::size_mm)).map_err(|reason| anyhow!(reason))?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot create {}", args.out.display()))?;
    refuse_existing(&args.out, &["board.svg", "board.pdf", "board.toml"], args.force)?;
    let files = [
        ("board.svg", sheet.to_svg().into_bytes()),
        ("board.pdf", sheet.to_pdf()),
        ("board.toml", board.to_toml().into_bytes()),
    ];
    for (name, bytes) in &files {
        write_whole(&args.out.join(name), bytes)?;
    }
    let [width, height] = sheet.size_mm;
    println!("{}: board.svg, board.pdf ({width:.0} x {height:.0} mm), board.toml", args.out.display());
    println!(
        "next: print at 100 % without fitting to the page, measure the ruler, glue the sheet to something flat, and write the measured \
         side of a square into board.toml; then flyrig calibrate lens, with each camera close to the board"
    );
    Ok(())
}
