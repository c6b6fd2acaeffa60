//! Boards as files for printing at true scale.

use std::fmt::Write as _;

use pdf_writer::{Content, Finish as _, Name, Pdf, Rect, Ref, Str};

use crate::board::{Board, Pattern};
use crate::dictionary::dictionary;

/// Least white margin around the board, millimetres: detectors need some, printers leave some unprinted.
const MARGIN_MM: f64 = 12.0;
/// Length of the printed ruler and the spacing of its marks, millimetres.
const RULER_MM: f64 = 100.0;
const MARK_MM: f64 = 10.0;
/// Height of text, millimetres.
const TEXT_MM: f64 = 2.6;
const POINTS_PER_MM: f64 = 72.0 / 25.4;

/// Sheet of black rectangles and lines of text, millimetres from its top left.
///
/// ```
/// use flyrig_calib::{Board, BoardSheet};
///
/// let a4 = [210.0, 297.0];
/// let sheet = BoardSheet::new(&Board { square_mm: 25.0, ..Board::default() }, Some(a4))?;
/// assert_eq!(sheet.size_mm, [297.0, 210.0], "turned along the board");
/// assert!(sheet.to_svg().starts_with("<svg"));
/// # Ok::<(), String>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct BoardSheet {
    /// Width and height of the sheet.
    pub size_mm: [f64; 2],
    /// Position of the board's top left corner.
    pub board_at_mm: [f64; 2],
    /// Black rectangles: x, y, width, height.
    pub rectangles: Vec<[f64; 4]>,
    /// Lines of text: x, y of the baseline's left end, text.
    texts: Vec<([f64; 2], String)>,
}

impl BoardSheet {
    /// Lays a board out in the centre of a sheet, long side along long side; on a sheet of its own size where none is
    /// given.
    ///
    /// # Errors
    /// As [`Board::check`]; also when the sheet is too small for the board.
    pub fn new(board: &Board, sheet_mm: Option<[f64; 2]>) -> Result<Self, String> {
        board.check()?;
        let side = board.square_mm;
        let [width, height] = [board.columns, board.rows].map(|count| f64::from(count) * side);
        let needed = [width + 2.0 * MARGIN_MM, height + 2.0 * MARGIN_MM];
        let size_mm = match sheet_mm {
            Some([a, b]) if (width > height) == (a > b) => [a, b],
            Some([a, b]) => [b, a],
            None => [needed[0].max(RULER_MM + 2.0 * MARGIN_MM), needed[1]],
        };
        if size_mm[0] < needed[0] || size_mm[1] < needed[1] {
            return Err(format!(
                "the board needs {:.0} x {:.0} mm with its margin, the paper has {:.0} x {:.0}; make squares smaller or fewer, or take \
                 larger paper",
                needed[0], needed[1], size_mm[0], size_mm[1]
            ));
        }
        let [left, top] = [(size_mm[0] - width) / 2.0, (size_mm[1] - height) / 2.0];
        let mut sheet = Self { size_mm, board_at_mm: [left, top], rectangles: Vec::new(), texts: Vec::new() };
        let mut marker = 0;
        for row in 0..board.rows {
            for column in 0..board.columns {
                let at = [left + f64::from(column) * side, top + f64::from(row) * side];
                if (row + column) % 2 == 0 {
                    sheet.rectangles.push([at[0], at[1], side, side]);
                } else if let Pattern::Charuco { dictionary: name, marker: share } = &board.pattern {
                    sheet.marker(name, marker, at, side, *share)?;
                    marker += 1;
                }
            }
        }
        sheet.ruler(board);
        Ok(sheet)
    }

    /// Draws a marker into the middle of a white square: a black border one bit wide around its bits.
    fn marker(&mut self, name: &str, id: usize, square: [f64; 2], side: f64, share: f64) -> Result<(), String> {
        let dictionary = dictionary(name)?;
        let bits = dictionary.marker_size();
        let code = *dictionary.codes().get(id).ok_or_else(|| format!("dictionary {name} has no marker {id}"))?;
        let size = side * share;
        let bit = size / (bits + 2) as f64;
        let at = [square[0] + (side - size) / 2.0, square[1] + (side - size) / 2.0];
        for row in 0..bits + 2 {
            // Neighbouring black bits are one rectangle, so that no viewer shows seams.
            let mut begin = None;
            for column in 0..=bits + 2 {
                let inner = (1..=bits).contains(&row) && (1..=bits).contains(&column);
                let is_black = column < bits + 2 && (!inner || code >> ((row - 1) * bits + column - 1) & 1 == 1);
                match (begin, is_black) {
                    (None, true) => begin = Some(column),
                    (Some(first), false) => {
                        let (x, y) = (at[0] + first as f64 * bit, at[1] + row as f64 * bit);
                        self.rectangles.push([x, y, (column - first) as f64 * bit, bit]);
                        begin = None;
                    }
                    _ => {}
                }
            }
        }
        Ok(())
    }

    /// Draws a ruler with instructions below the board.
    fn ruler(&mut self, board: &Board) {
        let (left, y) = (MARGIN_MM, self.size_mm[1] - MARGIN_MM * 0.55);
        self.rectangles.push([left, y, RULER_MM, 0.2]);
        for mark in 0..=(RULER_MM / MARK_MM) as u32 {
            let tall = if mark % 5 == 0 { 3.0 } else { 1.8 };
            self.rectangles.push([left + f64::from(mark) * MARK_MM - 0.1, y - tall, 0.2, tall]);
        }
        let (kind, marker) = match &board.pattern {
            Pattern::Chessboard => ("chessboard", String::new()),
            Pattern::Charuco { dictionary, .. } => ("ChArUco", format!(", {dictionary}")),
        };
        self.texts.push((
            [left, y + TEXT_MM * 1.3],
            format!(
                "100 mm: print at 100 %, then measure. flyrig {kind} {}x{}, squares {} mm{marker}",
                board.columns, board.rows, board.square_mm
            ),
        ));
    }

    /// Returns the sheet as SVG.
    #[must_use]
    pub fn to_svg(&self) -> String {
        let [width, height] = self.size_mm;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n<path d=\""
        );
        for [x, y, width, height] in &self.rectangles {
            let _ = write!(svg, "M{x:.4} {y:.4}h{width:.4}v{height:.4}h-{width:.4}z");
        }
        svg += "\"/>\n";
        for ([x, y], text) in &self.texts {
            let _ = writeln!(
                svg,
                "<text x=\"{x}\" y=\"{y}\" font-family=\"sans-serif\" font-size=\"{TEXT_MM}\">{text}</text>"
            );
        }
        svg + "</svg>\n"
    }

    /// Returns the sheet as PDF.
    #[must_use]
    pub fn to_pdf(&self) -> Vec<u8> {
        let points = |mm: f64| (mm * POINTS_PER_MM) as f32;
        let [catalog, pages, page, font, contents] = [1, 2, 3, 4, 5].map(Ref::new);
        let name = Name(b"F1");
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages);
        pdf.pages(pages).kids([page]).count(1);
        let mut entry = pdf.page(page);
        entry.media_box(Rect::new(0.0, 0.0, points(self.size_mm[0]), points(self.size_mm[1])));
        entry.parent(pages).contents(contents);
        entry.resources().fonts().pair(name, font);
        entry.finish();
        pdf.type1_font(font).base_font(Name(b"Helvetica"));
        let mut content = Content::new();
        for [x, y, width, height] in &self.rectangles {
            // PDF counts upwards.
            content.rect(points(*x), points(self.size_mm[1] - y - height), points(*width), points(*height));
        }
        content.fill_nonzero();
        for ([x, y], text) in &self.texts {
            content.begin_text().set_font(name, points(TEXT_MM));
            content.next_line(points(*x), points(self.size_mm[1] - y)).show(Str(text.as_bytes())).end_text();
        }
        pdf.stream(contents, &content.finish());
        pdf.finish()
    }
}
