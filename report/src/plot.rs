//! Plain SVG diagrams.

use std::fmt::Write as _;

const WIDTH: f64 = 820.0;
const HEIGHT: f64 = 440.0;
const LEFT: f64 = 70.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 54.0;
const COLORS: [&str; 4] = ["#c2410c", "#1d4ed8", "#15803d", "#7e22ce"];

/// Points of one kind.
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x, y and label of each point.
    pub points: Vec<(f64, f64, String)>,
    /// How they are joined.
    pub line: Line,
}

/// The line of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// From point to point.
    Through,
    /// Along those that no other one of the series beats in both directions (less is better).
    Front,
}

/// A diagram.
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
    /// The points.
    pub series: Vec<Series>,
}

/// From values to pixels along one axis.
struct Axis {
    low: f64,
    high: f64,
    log: bool,
    from: f64,
    to: f64,
}

impl Axis {
    fn new(values: impl Iterator<Item = f64>, log: bool, from: f64, to: f64) -> Self {
        let usable = |v: &f64| v.is_finite() && (!log || *v > 0.0);
        let (low, high) =
            values.filter(usable).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (1.0, 2.0) };
        let (low, high) = if log {
            (low / 1.25, high * 1.25)
        } else {
            let pad = (0.08 * (high - low)).max(1e-9 + 0.02 * high.abs());
            (low - pad, high + pad)
        };
        Self { low, high, log, from, to }
    }

    fn at(&self, value: f64) -> f64 {
        let share = if self.log {
            (value / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        self.from + share * (self.to - self.from)
    }

    fn ticks(&self) -> Vec<f64> {
        if self.log {
            let first = self.low.log10().floor() as i32;
            let last = self.high.log10().ceil() as i32;
            let all = (first..=last).flat_map(|e| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(e)));
            return all.filter(|v| (self.low..=self.high).contains(v)).collect();
        }
        let raw = (self.high - self.low) / 6.0;
        let power = 10f64.powf(raw.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= raw).unwrap_or(raw);
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last).map(|k| k as f64 * step).collect()
    }
}

impl Plot {
    /// Draws the diagram as SVG, on white.
    #[must_use]
    pub fn svg(&self) -> String {
        let all = || self.series.iter().flat_map(|s| &s.points).filter(|(x, y, _)| x.is_finite() && y.is_finite());
        let x = Axis::new(all().map(|p| p.0), self.log_x, LEFT, WIDTH - RIGHT);
        let y = Axis::new(all().map(|p| p.1), self.log_y, HEIGHT - BOTTOM, TOP);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" \
             height=\"{HEIGHT}\" font-family=\"sans-serif\" font-size=\"12\"><rect width=\"100%\" height=\"100%\" \
             fill=\"#fff\"/><text x=\"{LEFT}\" y=\"24\" font-size=\"16\" fill=\"#111\">{}</text>",
            escape(&self.title)
        );
        for tick in x.ticks() {
            let at = x.at(tick);
            let _ = write!(
                svg,
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{TOP}\" y2=\"{:.1}\" stroke=\"#e5e7eb\"/><text x=\"{at:.1}\" \
                 y=\"{:.1}\" text-anchor=\"middle\" fill=\"#374151\">{}</text>",
                HEIGHT - BOTTOM,
                HEIGHT - BOTTOM + 18.0,
                short(tick)
            );
        }
        for tick in y.ticks() {
            let at = y.at(tick);
            let _ = write!(
                svg,
                "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#e5e7eb\"/><text x=\"{:.1}\" \
                 y=\"{:.1}\" text-anchor=\"end\" fill=\"#374151\">{}</text>",
                WIDTH - RIGHT,
                LEFT - 8.0,
                at + 4.0,
                short(tick)
            );
        }
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"#111\">{}</text><text transform=\"rotate(-90)\" \
             x=\"{:.1}\" y=\"18\" text-anchor=\"middle\" fill=\"#111\">{}</text>",
            (LEFT + WIDTH - RIGHT) / 2.0,
            HEIGHT - 14.0,
            escape(&self.x_label),
            -(TOP + HEIGHT - BOTTOM) / 2.0,
            escape(&self.y_label)
        );
        // Legend first: labels make way for it.
        let rows = self.series.len() as f64;
        let mut taken = vec![[WIDTH - RIGHT - 200.0, TOP - 4.0, WIDTH, TOP + 18.0 * rows]];
        for (i, series) in self.series.iter().enumerate() {
            let color = COLORS[i % COLORS.len()];
            let points = || series.points.iter().filter(|(x, y, _)| x.is_finite() && y.is_finite());
            let line: Vec<(f64, f64)> = points().map(|p| (p.0, p.1)).collect();
            svg += &match series.line {
                Line::Through => polyline(&line, &x, &y, color, ""),
                Line::Front => polyline(&front(&line), &x, &y, color, " stroke-dasharray=\"5 4\""),
            };
            for (px, py, label) in points() {
                let (px, py) = (x.at(*px), y.at(*py));
                let [tx, ty] = free_place(&mut taken, [px, py], label);
                let _ = write!(
                    svg,
                    "<circle cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"4\" fill=\"{color}\"/><text x=\"{tx:.1}\" y=\"{ty:.1}\" \
                     font-size=\"10\" fill=\"#374151\">{}</text>",
                    escape(label)
                );
            }
            let at = WIDTH - RIGHT - 190.0;
            let row = TOP + 8.0 + 18.0 * i as f64;
            let _ = write!(
                svg,
                "<circle cx=\"{at:.1}\" cy=\"{row:.1}\" r=\"4\" fill=\"{color}\"/><text x=\"{:.1}\" y=\"{:.1}\" \
                 fill=\"#111\">{}</text>",
                at + 10.0,
                row + 4.0,
                escape(&series.name)
            );
        }
        svg + "</svg>\n"
    }
}

/// Where a point's label starts: beside it, inside of the picture, and not on another one in `taken`.
fn free_place(taken: &mut Vec<[f64; 4]>, [px, py]: [f64; 2], label: &str) -> [f64; 2] {
    let (width, height) = (6.0 * label.chars().count() as f64, 11.0);
    let left = (px + 6.0).min(WIDTH - 4.0 - width);
    // Above the point, below it, farther above, farther below ...
    let steps = (0..24).map(|i| f64::from(i / 2) * height * if i % 2 == 0 { -1.0 } else { 1.0 });
    let boxes = steps.map(|step| [left, py - 5.0 + step - height, left + width, py - 5.0 + step]);
    let meets = |a: &[f64; 4], b: &[f64; 4]| a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
    let inside = |place: &[f64; 4]| place[1] > 0.0 && place[3] < HEIGHT;
    let mut all = boxes.filter(inside);
    let first = all.next().unwrap_or([left, py - 5.0 - height, left + width, py - 5.0]);
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

/// The points that no other one beats in both directions, from left to right.
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

fn polyline(points: &[(f64, f64)], x: &Axis, y: &Axis, color: &str, more: &str) -> String {
    let path: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", x.at(p.0), y.at(p.1))).collect();
    format!("<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\"{more} points=\"{}\"/>", path.join(" "))
}

fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
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
        ] {
            for line in [Line::Through, Line::Front] {
                let svg = plot(points.clone(), line).svg();
                assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"), "{svg}");
                assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("a &lt; b"), "{svg}");
            }
        }
    }
}
