//! Self-contained HTML pages: images, scores, times, memory.

use std::{fmt::Write as _, io::Write as _, path::Path};

use anyhow::{Context, Result};
use base64::{Engine as _, prelude::BASE64_STANDARD};
use flyrig_fusion::StageSummary;
use flyrig_metrics::CameraScore;
use flyrig_types::escape_html;

use crate::plot::{Line, Plot, Series};

/// Contents of a report; empty parts are left out.
///
/// ```
/// use flyrig_report::{Curve, Report};
///
/// let report = Report {
///     title: "Memory".to_owned(),
///     facts: vec![("adapter".to_owned(), "software".to_owned())],
///     curves: vec![Curve {
///         title: "Resident memory".to_owned(),
///         x_label: "seconds".to_owned(),
///         y_label: "MiB".to_owned(),
///         lines: vec![("flyrig run".to_owned(), vec![(0.0, 310.0), (60.0, 312.5)])],
///     }],
///     ..Report::default()
/// };
/// assert!(report.html().contains("<h1>Memory</h1>"));
/// ```
#[derive(Debug, Default)]
pub struct Report {
    /// Heading of the page.
    pub title: String,
    /// Interval at which browsers reload the page, seconds; `None` for a static page.
    pub refresh_secs: Option<u32>,
    /// Name and value pairs: adapter, commit, frame rate, counts.
    pub facts: Vec<(String, String)>,
    /// Summary below the heading.
    pub sentences: Vec<String>,
    /// Text and relative address of links below the summary.
    pub links: Vec<(String, String)>,
    /// Tables of text.
    pub tables: Vec<Table>,
    /// Heading and SVG of each drawing; the SVG is inserted unescaped.
    pub drawings: Vec<(String, String)>,
    /// Heading and rows of each table of scores.
    pub scores: Vec<(String, Vec<CameraScore>)>,
    /// Run time of each stage.
    pub stages: Vec<StageSummary>,
    /// Values over frames or seconds.
    pub curves: Vec<Curve>,
    /// Rows of images.
    pub contact: Vec<ContactRow>,
}

/// Table of text.
#[derive(Debug, Default)]
pub struct Table {
    /// Heading.
    pub title: String,
    /// Heading of each column.
    pub head: Vec<String>,
    /// Cells, row by row.
    pub rows: Vec<Vec<String>>,
}

/// Line plot.
#[derive(Debug)]
pub struct Curve {
    /// Heading.
    pub title: String,
    /// Quantity and unit along x.
    pub x_label: String,
    /// Quantity and unit along y.
    pub y_label: String,
    /// Name and points of each line.
    pub lines: Vec<(String, Vec<(f64, f64)>)>,
}

/// Row of the contact sheet.
#[derive(Debug)]
pub struct ContactRow {
    /// Caption of the row.
    pub label: String,
    /// Caption and PNG bytes of each image.
    pub pictures: Vec<(String, Vec<u8>)>,
}

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:1240px;padding:0 1rem;color:#1c2430;background:#fafbfc}\
h1{font-size:1.6rem}h2{font-size:1.15rem;margin-top:2rem}table{border-collapse:collapse;background:#fff}\
td,th{padding:.3rem .8rem;border-bottom:1px solid #dde3ea;text-align:right}td:first-child,th:first-child{text-align:left}\
.row{display:flex;gap:6px;margin:.2rem 0 1rem}.row figure{margin:0;flex:1}.row img{width:100%;display:block;background:#000}\
figcaption{font-size:.8rem;color:#5a6675}svg{background:#fff;border:1px solid #dde3ea}";

impl Report {
    /// Formats the page.
    #[must_use]
    pub fn html(&self) -> String {
        let mut page = String::new();
        let title = escape_html(&self.title);
        let _ = write!(
            page,
            "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\"><title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
        );
        if let Some(secs) = self.refresh_secs {
            let _ = write!(page, "<meta http-equiv=refresh content={secs}>");
        }
        self.write_texts(&mut page);
        for (title, svg) in &self.drawings {
            let _ = write!(page, "<h2>{}</h2>{svg}", escape_html(title));
        }
        self.write_scores(&mut page);
        self.write_contact(&mut page);
        self.write_stages(&mut page);
        for curve in &self.curves {
            let _ = write!(page, "<h2>{}</h2>{}", escape_html(&curve.title), curve.svg());
        }
        page.push_str("</html>\n");
        page
    }

    /// Writes sentences, links, facts and tables.
    fn write_texts(&self, page: &mut String) {
        for sentence in &self.sentences {
            let _ = write!(page, "<p>{}", escape_html(sentence));
        }
        for (text, address) in &self.links {
            let _ = write!(page, "<p><a href=\"{}\">{}</a>", escape_html(address), escape_html(text));
        }
        if !self.facts.is_empty() {
            page.push_str("<table>");
            for (name, value) in &self.facts {
                let _ =
                    write!(page, "<tr><td>{}<td style=\"text-align:left\">{}", escape_html(name), escape_html(value));
            }
            page.push_str("</table>");
        }
        for Table { title, head, rows } in &self.tables {
            let cells = |mark: &str, row: &[String]| -> String {
                row.iter().map(|cell| format!("<{mark}>{}", escape_html(cell))).collect()
            };
            let rows: String = rows.iter().map(|row| format!("<tr>{}", cells("td", row))).collect();
            let _ = write!(page, "<h2>{}</h2><table><tr>{}{rows}</table>", escape_html(title), cells("th", head));
        }
    }

    fn write_scores(&self, page: &mut String) {
        for (name, scores) in &self.scores {
            let _ = write!(
                page,
                "<h2>{}</h2><table><tr><th>camera<th>frames<th>PSNR dB<th>SSIM<th>FLIP<th>mask IoU",
                escape_html(name)
            );
            for s in scores {
                let iou = s.iou.map_or_else(|| "-".to_owned(), |v| format!("{v:.4}"));
                let _ = write!(
                    page,
                    "<tr><td>{}<td>{}<td>{:.2}<td>{:.4}<td>{:.4}<td>{iou}",
                    escape_html(&s.camera),
                    s.frames,
                    s.psnr_db,
                    s.ssim,
                    s.flip
                );
            }
            page.push_str("</table>");
        }
    }

    fn write_contact(&self, page: &mut String) {
        if !self.contact.is_empty() {
            page.push_str("<h2>Images</h2>");
        }
        for row in &self.contact {
            let _ = write!(page, "<figcaption>{}</figcaption><div class=row>", escape_html(&row.label));
            for (caption, png) in &row.pictures {
                let data = BASE64_STANDARD.encode(png);
                let caption = escape_html(caption);
                let _ = write!(
                    page,
                    "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{data}\"><figcaption>{caption}</figcaption></figure>"
                );
            }
            page.push_str("</div>");
        }
    }

    fn write_stages(&self, page: &mut String) {
        if self.stages.is_empty() {
            return;
        }
        page.push_str(
            "<h2>Time per stage</h2><table><tr><th>stage<th>frames<th>mean ms<th>median ms<th>95 % ms<th>99 % ms",
        );
        for s in &self.stages {
            let _ = write!(
                page,
                "<tr><td>{}<td>{}<td>{:.2}<td>{:.2}<td>{:.2}<td>{:.2}",
                escape_html(&s.name),
                s.frames,
                s.mean_ms,
                s.p50_ms,
                s.p95_ms,
                s.p99_ms
            );
        }
        page.push_str("</table>");
    }

    /// Writes the page, whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        write_whole(path, self.html().as_bytes())
    }
}

/// Writes a file whole or not at all.
///
/// # Errors
/// The file cannot be written; names the file and the fix.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    flyrig_types::write_whole(path, |out| out.write_all(bytes))
        .with_context(|| format!("cannot write {}; check that the folder exists and has room", path.display()))
}

impl Curve {
    fn svg(&self) -> String {
        let series = |(name, points): &(String, Vec<(f64, f64)>)| Series {
            name: name.clone(),
            points: points.iter().map(|&(x, y)| (x, y, String::new())).collect(),
            line: Line::Through,
        };
        let plot = Plot {
            title: self.title.clone(),
            x_label: self.x_label.clone(),
            y_label: self.y_label.clone(),
            log_x: false,
            log_y: false,
            series: self.lines.iter().map(series).collect(),
        };
        if plot.is_empty() {
            return "<p>no values</p>".to_owned();
        }
        // Inside an HTML page the namespace is implied.
        plot.strip().replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_holds_what_it_was_given_and_nothing_unescaped() {
        let report = Report {
            title: "a <b>".to_owned(),
            facts: vec![("adapter".to_owned(), "x & y".to_owned())],
            curves: vec![Curve {
                title: "memory".to_owned(),
                x_label: "s".to_owned(),
                y_label: "MiB".to_owned(),
                lines: vec![
                    ("rss".to_owned(), vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)]),
                    ("none".to_owned(), vec![]),
                ],
            }],
            sentences: vec!["1 < 2".to_owned()],
            links: vec![("the \"film\"".to_owned(), "a\"b.mp4".to_owned())],
            tables: vec![Table {
                title: "cameras".to_owned(),
                head: vec!["camera".to_owned()],
                rows: vec![vec!["left & right".to_owned()]],
            }],
            drawings: vec![("above".to_owned(), "<svg><circle r=\"1\"/></svg>".to_owned())],
            contact: vec![ContactRow {
                label: "frame 1".to_owned(),
                pictures: vec![("input".to_owned(), vec![1, 2, 3])],
            }],
            ..Report::default()
        };
        let html = report.html();
        assert!(html.contains("a &lt;b&gt;") && html.contains("x &amp; y"));
        assert!(html.contains("<p>1 &lt; 2") && html.contains("<th>camera<tr><td>left &amp; right</table>"));
        assert!(html.contains("<p><a href=\"a&quot;b.mp4\">the &quot;film&quot;</a>"), "{html}");
        assert!(html.contains("<h2>above</h2><svg><circle"));
        assert!(html.contains("data:image/png;base64,AQID"));
        assert!(html.contains("<polyline") && !html.contains("NaN"));
        assert!(!html.contains("http"), "self-contained");
        let live = Report { refresh_secs: Some(2), ..Report::default() }.html();
        assert!(live.contains("<meta http-equiv=refresh content=2>"), "{live}");
    }

    #[test]
    fn a_report_is_written_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("index.html");
        Report::default().save(&path).unwrap();
        assert!(path.exists());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        let error = Report::default().save(&folder.path().join("none/index.html")).unwrap_err();
        assert!(error.to_string().contains("cannot write"), "{error}");
    }
}
