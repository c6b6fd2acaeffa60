//! Diagrams as SVG, drawn by plotters.

use std::{io, ops::Range};

use plotters::{
    coord::{
        Shift,
        ranged1d::{AsRangedCoord, ValueFormatter},
    },
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};

const COLORS: [RGBColor; 6] = [
    RGBColor(0xc2, 0x41, 0x0c),
    RGBColor(0x1d, 0x4e, 0xd8),
    RGBColor(0x15, 0x80, 0x3d),
    RGBColor(0x7e, 0x22, 0xce),
    RGBColor(0x0e, 0x74, 0x90),
    RGBColor(0xa1, 0x62, 0x07),
];
const TEXT: RGBColor = RGBColor(0x11, 0x11, 0x11);
const FAINT_TEXT: RGBColor = RGBColor(0x37, 0x41, 0x51);
const GRID: RGBColor = RGBColor(0xe5, 0xe7, 0xeb);
/// Drawing resolution, pixels per pixel of the SVG: plotters rounds to whole pixels, which shows as steps in a flat line.
const FINE: u32 = 4;
/// Text sizes, pixels of the SVG.
const TITLE_SIZE: f64 = 16.0;
const TEXT_SIZE: f64 = 12.0;
const LABEL_SIZE: f64 = 10.0;
/// Distance of the legend's rows, pixels of the SVG.
const ROW: f64 = 19.0;
/// Factor by which plotters shrinks text.
const SHRINK: f64 = 1.24;
/// Largest number of points in a series with dots; more would hide the line.
const MOST_DOTS: usize = 100;
/// Largest plotted value, so that the range of an axis does not overflow.
const LARGEST: f64 = 1e100;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Failure = DrawingAreaErrorKind<io::Error>;

/// Named points of a plot.
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x, y and label of each point.
    pub points: Vec<(f64, f64, String)>,
    /// Line through the points.
    pub line: Line,
}

/// Line of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// Line from point to point.
    Through,
    /// Line along the Pareto front: points that no other point of the series beats in both directions (less is better).
    Front,
}

/// Diagram.
///
/// ```
/// use flyrig_report::plot::{Line, Plot, Series};
///
/// let points = vec![(1.0, 30.2, "fast".to_owned()), (8.0, 33.7, "slow".to_owned())];
/// let plot = Plot {
///     title: "Run time against quality".to_owned(),
///     x_label: "ms per frame".to_owned(),
///     y_label: "PSNR, dB".to_owned(),
///     log_x: true,
///     log_y: false,
///     series: vec![Series { name: "direct appearance".to_owned(), points, line: Line::Front }],
/// };
/// assert!(plot.svg().starts_with("<svg"));
/// ```
pub struct Plot {
    /// Heading.
    pub title: String,
    /// Quantity and unit along x.
    pub x_label: String,
    /// Quantity and unit along y.
    pub y_label: String,
    /// Whether the x axis is logarithmic.
    pub log_x: bool,
    /// Whether the y axis is logarithmic.
    pub log_y: bool,
    /// Points, by series.
    pub series: Vec<Series>,
}

impl Plot {
    /// Draws the diagram as SVG on white.
    #[must_use]
    pub fn svg(&self) -> String {
        self.drawn((820, 440), true)
    }

    /// Draws only the lines, low and wide, for a page with its own heading.
    #[must_use]
    pub(crate) fn strip(&self) -> String {
        self.drawn((820, 260), false)
    }

    /// Returns whether no point can be drawn.
    #[must_use]
    pub(crate) fn is_empty(&self) -> bool {
        self.points().next().is_none()
    }

    fn drawn(&self, size: (u32, u32), is_alone: bool) -> String {
        self.draw(size, is_alone).unwrap_or_else(|error| {
            // Text in memory is always written; a diagram is not worth a report.
            tracing::error!("the diagram '{}' was not drawn: {error}", self.title);
            "<svg xmlns=\"http://www.w3.org/2000/svg\"></svg>\n".to_owned()
        })
    }

    /// Draws the diagram at a size in pixels, with title, dots and labels if it stands alone.
    fn draw(&self, (width, height): (u32, u32), is_alone: bool) -> Result<String, Failure> {
        let (fine_width, fine_height) = (FINE * width, FINE * height);
        let mut svg = String::new();
        {
            let area = SVGBackend::with_string(&mut svg, (fine_width, fine_height)).into_drawing_area();
            area.fill(&WHITE)?;
            let x = range(self.points().map(|p| p.0), self.log_x);
            let y = range(self.points().map(|p| p.1), self.log_y);
            let log = |range: Range<f64>| {
                let ticks = log_ticks(&range);
                range.log_scale().with_key_points(ticks)
            };
            match (self.log_x, self.log_y) {
                (false, false) => self.chart(&area, x, y, is_alone)?,
                (false, true) => self.chart(&area, x, log(y), is_alone)?,
                (true, false) => self.chart(&area, log(x), y, is_alone)?,
                (true, true) => self.chart(&area, log(x), log(y), is_alone)?,
            }
            area.present()?;
        }
        let fine = format!("width=\"{fine_width}\" height=\"{fine_height}\" ");
        Ok(svg.replacen(&fine, &format!("width=\"{width}\" height=\"{height}\" "), 1))
    }

    /// Returns the points that can be drawn.
    fn points(&self) -> impl Iterator<Item = &(f64, f64, String)> {
        self.series.iter().flat_map(|series| self.points_of(series))
    }

    fn points_of<'a>(&self, series: &'a Series) -> impl Iterator<Item = &'a (f64, f64, String)> + Clone + use<'a> {
        let (log_x, log_y) = (self.log_x, self.log_y);
        let usable = |v: f64, log: bool| v.abs() < LARGEST && (!log || v > 1.0 / LARGEST);
        series.points.iter().filter(move |(x, y, _)| usable(*x, log_x) && usable(*y, log_y))
    }

    fn chart<X, Y>(&self, area: &Area<'_>, x: X, y: Y, is_alone: bool) -> Result<(), Failure>
    where
        X: AsRangedCoord<Value = f64, CoordDescType: ValueFormatter<f64>>,
        Y: AsRangedCoord<Value = f64, CoordDescType: ValueFormatter<f64>>,
    {
        let font =
            |size: f64, color: &RGBColor| ("sans-serif", f64::from(FINE) * SHRINK * size).into_font().color(color);
        let letters = self.series.iter().map(|series| series.name.chars().count()).max().unwrap_or(0);
        let legend_width = 40 + 7 * u32::try_from(letters.min(40)).unwrap_or(0);
        let right = if is_alone { 24 } else { legend_width };
        let mut builder = ChartBuilder::on(area);
        builder.margin(10 * FINE).margin_right(right * FINE).x_label_area_size(46 * FINE).y_label_area_size(64 * FINE);
        if is_alone {
            builder.caption(&self.title, font(TITLE_SIZE, &TEXT));
        }
        let mut chart = builder.build_cartesian_2d(x, y)?;
        let format = |value: &f64| short(*value);
        let grid = GRID.stroke_width(FINE);
        chart
            .configure_mesh()
            .max_light_lines(0)
            .bold_line_style(grid)
            .axis_style(grid)
            .set_all_tick_mark_size(4 * FINE)
            .label_style(font(TEXT_SIZE, &FAINT_TEXT))
            .axis_desc_style(font(TEXT_SIZE, &TEXT))
            .x_label_formatter(&format)
            .y_label_formatter(&format)
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .draw()?;
        let mut dots = Vec::new();
        for (series, color) in self.series.iter().zip(COLORS.into_iter().cycle()) {
            let line: Vec<(f64, f64)> = self.points_of(series).map(|p| (p.0, p.1)).collect();
            if is_alone && line.len() <= MOST_DOTS {
                let dot = |(x, y, label): &(f64, f64, String)| (chart.backend_coord(&(*x, *y)), label.clone(), color);
                dots.extend(self.points_of(series).map(dot));
            }
            let thick = color.stroke_width(8 * FINE / 5);
            match series.line {
                Line::Through => chart.draw_series(LineSeries::new(line, thick))?,
                Line::Front => chart.draw_series(DashedLineSeries::new(front(&line), 5 * FINE, 4 * FINE, thick))?,
            };
        }
        let (width, height) = area.dim_in_pixel();
        let [width, height] = [width, height].map(|fine| f64::from(fine) / f64::from(FINE));
        // Labels make way for the legend.
        let legend_left = width - f64::from(legend_width) - if is_alone { 24.0 } else { 0.0 };
        let top = if is_alone { 32.0 } else { 12.0 };
        let legend = [legend_left, top, legend_left + f64::from(legend_width), top + ROW * self.series.len() as f64];
        let mut taken = vec![legend];
        for ((x, y), label, color) in dots {
            area.draw(&Circle::new((x, y), 4 * FINE as i32, color.filled()))?;
            let at = [x, y].map(|fine| f64::from(fine) / f64::from(FINE));
            let place = free_place(&mut taken, at, &label, [width, height]);
            let [x, y] = place.map(|at| (at * f64::from(FINE)).round() as i32);
            let style = font(LABEL_SIZE, &FAINT_TEXT).pos(Pos::new(HPos::Left, VPos::Bottom));
            area.draw(&Text::new(label, (x, y), style))?;
        }
        let px = |at: f64| (at * f64::from(FINE)).round() as i32;
        area.draw(&Rectangle::new(
            [(px(legend[0]), px(legend[1])), (px(legend[2]), px(legend[3]))],
            WHITE.mix(0.85).filled(),
        ))?;
        for (row, (series, color)) in self.series.iter().zip(COLORS.into_iter().cycle()).enumerate() {
            let (x, y) = (legend[0] + 8.0, legend[1] + ROW * (row as f64 + 0.5));
            let mark = [(px(x), px(y - 1.0)), (px(x + 12.0), px(y + 1.0))];
            area.draw(&Rectangle::new(mark, color.filled()))?;
            let style = font(TEXT_SIZE, &TEXT).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(series.name.as_str(), (px(x + 17.0), px(y)), style))?;
        }
        Ok(())
    }
}

/// Returns the range of an axis, with a margin around the values.
fn range(values: impl Iterator<Item = f64>, log: bool) -> Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    let (low, high) = if low <= high { (low, high) } else { (1.0, 2.0) };
    if log {
        return low / 1.25..high * 1.25;
    }
    let pad = (0.08 * (high - low)).max(1e-9 + 0.02 * high.abs());
    low - pad..high + pad
}

/// Returns 1, 2 and 5 times the powers of ten in a range: plotters marks only powers of ten, of which a short axis has none.
fn log_ticks(range: &Range<f64>) -> Vec<f64> {
    let (first, last) = (range.start.log10().floor() as i32, range.end.log10().ceil() as i32);
    let factors: &[f64] = match last - first {
        ..=4 => &[1.0, 2.0, 5.0],
        _ => &[1.0],
    };
    let step = usize::try_from((last - first) / 10 + 1).unwrap_or(1);
    let all = (first..=last).step_by(step).flat_map(|power| factors.iter().map(move |m| m * 10f64.powi(power)));
    all.filter(|value| range.contains(value)).collect()
}

/// Returns the lower left corner of a point's label: beside it, inside of the image, and not on a box in `taken`.
fn free_place(taken: &mut Vec<[f64; 4]>, [px, py]: [f64; 2], label: &str, [width, height]: [f64; 2]) -> [f64; 2] {
    let (long, tall) = (6.0 * label.chars().count() as f64, 11.0);
    let left = (px + 6.0).min(width - 4.0 - long);
    // Above the point, below it, farther above, farther below ...
    let steps = (0..24).map(|i| f64::from(i / 2) * tall * if i % 2 == 0 { -1.0 } else { 1.0 });
    let boxes = steps.map(|step| [left, py - 5.0 + step - tall, left + long, py - 5.0 + step]);
    let meets = |a: &[f64; 4], b: &[f64; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
    let inside = |place: &[f64; 4]| place[1] > 0.0 && place[3] < height;
    let mut all = boxes.filter(inside);
    let first = all.next().unwrap_or([left, py - 5.0 - tall, left + long, py - 5.0]);
    let place = if label.is_empty() || !taken.iter().any(|other| meets(other, &first)) {
        first
    } else {
        all.find(|place| !taken.iter().any(|other| meets(other, place))).unwrap_or(first)
    };
    if !label.is_empty() {
        taken.push(place);
    }
    [place[0], place[3]]
}

/// Returns the points that no other point beats in both directions, from left to right.
fn front(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut best = f64::INFINITY;
    sorted.retain(|p| {
        let better = p.1 < best;
        best = best.min(p.1);
        better
    });
    sorted
}

fn short(value: f64) -> String {
    // Ticks are summed up by plotters, which leaves a trace of rounding at 0.
    if value.abs() < 1e-12 {
        return "0".to_owned();
    }
    if !(1e-3..1e7).contains(&value.abs()) {
        return format!("{value:.1e}");
    }
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let points = [(1.0, 9.0), (2.0, 5.0), (3.0, 6.0), (4.0, 1.0), (2.0, 4.0)];
        assert_eq!(front(&points), [(1.0, 9.0), (2.0, 4.0), (4.0, 1.0)]);
    }

    #[test]
    fn a_diagram_of_anything_is_sound() {
        let plot = |points: Vec<(f64, f64, String)>, line| Plot {
            title: "a < b".to_owned(),
            x_label: "x".to_owned(),
            y_label: "y".to_owned(),
            log_x: true,
            log_y: false,
            series: vec![Series { name: "s".to_owned(), points, line }],
        };
        for points in [
            vec![],
            vec![(5.0, 5.0, "one".to_owned())],
            vec![(f64::NAN, 1.0, String::new()), (10.0, 0.0, String::new()), (1000.0, 3.0, "z".to_owned())],
            vec![(1e-300, f64::MAX, "small".to_owned()), (1e300, f64::MIN, "large".to_owned())],
            vec![(-1.0, f64::INFINITY, "none".to_owned()), (0.0, -0.0, "<&>".to_owned())],
            vec![(1e-90, 1e90, "far".to_owned()), (1e90, -1e90, "off".to_owned())],
            vec![(1e9, 1e9, "close".to_owned()), (1e9 + 1e-6, 1e9 + 1e-6, "by".to_owned())],
        ] {
            for line in [Line::Through, Line::Front] {
                for (log_x, log_y) in [(true, false), (false, false), (false, true), (true, true)] {
                    let svg = Plot { log_x, log_y, ..plot(points.clone(), line) }.svg();
                    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"), "{svg}");
                    assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("a &lt; b"), "{svg}");
                }
            }
        }
    }

    #[test]
    fn a_short_logarithmic_axis_has_ticks() {
        assert_eq!(log_ticks(&(12.0..80.0)), [20.0, 50.0]);
        assert_eq!(log_ticks(&(0.9..11.0)), [1.0, 2.0, 5.0, 10.0]);
        assert_eq!(log_ticks(&(0.9e-90..1e90)).len(), 9, "not hundreds");
    }

    #[test]
    fn ticks_are_short() {
        let values = [0.0, -0.0, 5.6e-17, 0.2, -1.5, 1000.0, 0.000_25, 2e8];
        assert_eq!(values.map(short), ["0", "0", "0", "0.2", "-1.5", "1000", "2.5e-4", "2.0e8"]);
    }
}
