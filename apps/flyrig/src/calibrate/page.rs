//! HTML page of a calibrated rig: results in sentences, a plan of the cameras, and each camera's image with its reprojection errors.

use std::fmt::Write as _;

use flyrig_calib::{RigCamera, RigFit};
use flyrig_report::{Curve, Report, Table};
use flyrig_types::{Camera, CameraId, ColorMatch, Intrinsics, Isometry, escape_html};
use glam::{DVec2, DVec3};

use super::advice::{CELLS, CalibrationState, WELL_LINKED};

/// Magnification of reprojection errors in drawings.
const LONGER: f64 = 50.0;
/// Largest number of drawn errors per camera.
const MOST_ERRORS: usize = 1500;
/// Width of an image's drawing, and side of the plan, pixels.
const WIDTH: f64 = 380.0;
const ABOVE: f64 = 460.0;

/// Builds the page. `sentences` are those of the terminal.
pub(super) fn page(ids: &[CameraId], fit: &RigFit, sentences: Vec<String>) -> Report {
    let begin = fit.shots.first().map_or(0, |(nanos, _)| *nanos);
    let secs = |nanos: i64| nanos.saturating_sub(begin) as f64 * 1e-9;
    let errors = fit.shots.iter().map(|(nanos, px)| (secs(*nanos), *px)).collect();
    Report {
        title: format!("Calibration of {} cameras", ids.len()),
        sentences,
        tables: vec![cameras(ids, fit), pairs(ids, fit)],
        drawings: vec![
            ("From above: cameras, where they look, and the boards that they share".to_owned(), above(ids, fit)),
            (
                format!(
                    "Images: corners that were seen, errors {LONGER} times as long, cells without a corner grey, deviations in pixels"
                ),
                ids.iter()
                    .zip(&fit.rig.cameras)
                    .zip(&fit.cameras)
                    .map(|((id, of), camera)| image(id, of, camera))
                    .collect(),
            ),
        ],
        curves: vec![Curve {
            title: "Error of each board".to_owned(),
            x_label: "seconds of the take".to_owned(),
            y_label: "rms, pixels".to_owned(),
            lines: vec![("boards".to_owned(), errors)],
        }],
        ..Report::default()
    }
}

fn cameras(ids: &[CameraId], fit: &RigFit) -> Table {
    let both = |values: Option<(f64, f64)>| match values {
        Some((degrees, millimetres)) => format!("{degrees:.3}°, {millimetres:.1} mm"),
        None => "open".to_owned(),
    };
    let row = |(id, camera): (&CameraId, &RigCamera)| {
        let worst = camera.uncertainty.as_ref().map(|uncertainty| (uncertainty.worst_px(), uncertainty.middle_mm));
        vec![
            id.to_string(),
            camera.views.to_string(),
            camera.corners.len().to_string(),
            format!("{:.3}", camera.rms_px),
            both(camera.deviation),
            both(camera.halves),
            worst.map_or_else(|| "open".to_owned(), |(px, _)| format!("{px:.2}")),
            worst.map_or_else(|| "open".to_owned(), |(_, mm)| format!("{mm:.2}")),
            format!("{:.1} ± {:.1}", 1e3 * camera.lag_s.0, 1e3 * camera.lag_s.1),
        ]
    };
    let head = [
        "camera",
        "boards",
        "corners",
        "rms px",
        "deviation",
        "two halves differ by",
        "worst in the image, px",
        "in the middle of the boards, mm",
        "time offset ms",
    ];
    Table {
        title: "Cameras; deviations are against the first one".to_owned(),
        head: head.map(str::to_owned).into(),
        rows: ids.iter().zip(&fit.cameras).map(row).collect(),
    }
}

fn pairs(ids: &[CameraId], fit: &RigFit) -> Table {
    let rows = fit.pairs.iter().map(|pair| {
        let (a, b) = pair.cameras;
        let apart_m = fit.rig.cameras[a].position().distance(fit.rig.cameras[b].position());
        vec![
            format!("{} and {}", ids[a], ids[b]),
            pair.shots.to_string(),
            pair.agreeing.to_string(),
            format!("{apart_m:.3}"),
        ]
    });
    Table {
        title: "Pairs of cameras that saw the board together".to_owned(),
        head: ["pair", "boards", "of them agree", "metres apart"].map(str::to_owned).into(),
        rows: rows.collect(),
    }
}

/// Builds the page of a calibration under way, which browsers reload by themselves.
pub(super) fn live(progress: &CalibrationState<'_>, sentence: &str) -> Report {
    let rows = progress.ids.iter().enumerate().map(|(slot, id)| {
        let covered = format!("{:.0} %", 100.0 * progress.covered(slot));
        vec![id.to_string(), progress.boards(slot).to_string(), covered, progress.known(slot)]
    });
    let head = ["camera", "boards", "image covered", "known, mm"];
    let images = (0..progress.ids.len()).filter_map(|slot| {
        let [width, height] = progress.sizes[slot]?;
        let of = Camera {
            id: progress.ids[slot].clone(),
            intrinsics: Intrinsics::pinhole(width, height, f64::from(width)),
            camera_from_world: Isometry::IDENTITY,
            time_offset_nanos: 0,
            color: ColorMatch::NONE,
        };
        Some(covered_image(&of, &progress.corners(slot), progress.boards(slot)))
    });
    Report {
        title: sentence.to_owned(),
        refresh_secs: Some(1),
        tables: vec![Table { title: "Cameras".to_owned(), head: head.map(str::to_owned).into(), rows: rows.collect() }],
        drawings: vec![
            (format!("Boards that cameras share: orange below {WELL_LINKED}"), links(progress)),
            ("Images: corners that were seen, cells without a corner grey".to_owned(), images.collect()),
        ],
        ..Report::default()
    }
}

/// Builds the page of a rig whose cameras could not be joined. `sentence` says what is missing.
pub(super) fn unjoined(progress: &CalibrationState<'_>, sentence: String) -> Report {
    let live = live(progress, "");
    Report {
        title: format!("The boards do not join these {} cameras", progress.ids.len()),
        refresh_secs: None,
        sentences: vec![sentence],
        tables: std::iter::once(shared(progress)).chain(live.tables).collect(),
        drawings: live.drawings,
        ..Report::default()
    }
}

/// Returns the numbers of boards that each two cameras saw together.
fn shared(progress: &CalibrationState<'_>) -> Table {
    let ids = || progress.ids.iter().map(CameraId::to_string);
    let cell = |a: usize, b: usize| if a == b { String::new() } else { progress.shared(a, b).to_string() };
    let count = progress.ids.len();
    let row = |(a, id): (usize, String)| std::iter::once(id).chain((0..count).map(|b| cell(a, b))).collect();
    Table {
        title: format!("Boards that two cameras saw together; {WELL_LINKED} or more join them well"),
        head: std::iter::once(String::new()).chain(ids()).collect(),
        rows: ids().enumerate().map(row).collect(),
    }
}

/// Draws the cameras on a circle, joined by lines with the number of shared boards.
fn links(progress: &CalibrationState<'_>) -> String {
    let count = progress.ids.len();
    let place = |slot: usize| {
        let angle = std::f64::consts::TAU * slot as f64 / count as f64;
        DVec2::splat(ABOVE / 2.0) + DVec2::new(angle.sin(), -angle.cos()) * (0.38 * ABOVE)
    };
    let mut svg = format!("<svg width=\"{ABOVE}\" height=\"{ABOVE}\" viewBox=\"0 0 {ABOVE} {ABOVE}\">");
    for (a, b) in (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))) {
        let shared = progress.shared(a, b);
        if shared == 0 {
            continue;
        }
        let (from, to) = (place(a), place(b));
        let middle = from.lerp(to, 0.42);
        let color = if shared < WELL_LINKED { "#d97706" } else { "#9db8d6" };
        let _ = write!(
            svg,
            "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{color}\" stroke-width=\"3\"/><text x=\"{:.1}\" \
             y=\"{:.1}\" font-size=\"12\" fill=\"#5a6675\">{shared}</text>",
            from.x, from.y, to.x, to.y, middle.x, middle.y
        );
    }
    for (slot, id) in progress.ids.iter().enumerate() {
        let at = place(slot);
        let _ = write!(
            svg,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"6\" fill=\"#1c2430\"/><text x=\"{:.1}\" y=\"{:.1}\" font-size=\"14\">{}</text>",
            at.x,
            at.y,
            at.x + 9.0,
            at.y - 9.0,
            escape_html(id.as_str())
        );
    }
    svg + "</svg>"
}

/// Draws the cameras from above, x to the right and y up, joined by lines whose width grows with the number of shared boards.
fn above(ids: &[CameraId], fit: &RigFit) -> String {
    let places: Vec<DVec2> = fit.rig.cameras.iter().map(|camera| camera.position().truncate()).collect();
    let reach = places.iter().map(|place| place.length()).fold(0.5, f64::max);
    let drawn = |place: DVec2| DVec2::splat(ABOVE / 2.0) + DVec2::new(place.x, -place.y) * (0.42 * ABOVE / reach);
    let mut svg = format!("<svg width=\"{ABOVE}\" height=\"{ABOVE}\" viewBox=\"0 0 {ABOVE} {ABOVE}\">");
    for pair in &fit.pairs {
        let [a, b] = [pair.cameras.0, pair.cameras.1].map(|slot| drawn(places[slot]));
        let width = 1.0 + 5.0 * (pair.agreeing as f64 / WELL_LINKED as f64).min(1.0);
        let color = if pair.agreeing < WELL_LINKED { "#d97706" } else { "#9db8d6" };
        let _ = write!(
            svg,
            "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{color}\" stroke-width=\"{width:.1}\" stroke-opacity=\"0.6\"/>",
            a.x, a.y, b.x, b.y
        );
    }
    for ((id, camera), place) in ids.iter().zip(&fit.rig.cameras).zip(&places) {
        let forward = (camera.camera_from_world.rotation.inverse() * DVec3::Z).truncate().normalize_or_zero();
        let (at, tip) = (drawn(*place), drawn(*place + forward * (0.22 * reach)));
        let _ = write!(
            svg,
            "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"#1c2430\"/><circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"5\" \
             fill=\"#1c2430\"/><text x=\"{:.1}\" y=\"{:.1}\" font-size=\"13\">{}</text>",
            at.x,
            at.y,
            tip.x,
            tip.y,
            at.x,
            at.y,
            at.x + 8.0,
            at.y - 8.0,
            escape_html(id.as_str())
        );
    }
    svg + "</svg>"
}

/// Draws an image with its detected corners.
fn covered_image(of: &Camera, corners: &[DVec2], boards: usize) -> String {
    let scale = WIDTH / f64::from(of.intrinsics.width);
    let mut svg = cells(of, &|| corners.iter().copied());
    for corner in corners.iter().step_by(corners.len().div_ceil(MOST_ERRORS).max(1)) {
        let at = *corner * scale;
        let _ = write!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1\" fill=\"#2563a8\"/>", at.x, at.y);
    }
    let below = f64::from(of.intrinsics.height) * scale + 15.0;
    let _ = write!(
        svg,
        "<text x=\"2\" y=\"{below:.0}\" font-size=\"13\">camera {}: {boards} boards</text></svg>",
        escape_html(of.id.as_str())
    );
    svg
}

/// Begins the drawing of an image, with grey cells where no corner was detected.
fn cells<I: Iterator<Item = DVec2>>(of: &Camera, corners: &dyn Fn() -> I) -> String {
    let [width, height] = of.size().map(f64::from);
    let scale = WIDTH / width;
    let mut svg = format!(
        "<svg width=\"{WIDTH}\" height=\"{:.0}\" viewBox=\"0 0 {WIDTH} {:.0}\" style=\"margin:0 8px 8px 0\">",
        height * scale + 20.0,
        height * scale + 20.0
    );
    let seen = |column: usize, row: usize| {
        let cell = |pixel: DVec2| pixel / DVec2::new(width, height) * DVec2::new(CELLS[0] as f64, CELLS[1] as f64);
        corners().any(|pixel| cell(pixel).floor() == DVec2::new(column as f64, row as f64))
    };
    let cell = DVec2::new(WIDTH / CELLS[0] as f64, height * scale / CELLS[1] as f64);
    for (column, row) in (0..CELLS[0]).flat_map(|column| (0..CELLS[1]).map(move |row| (column, row))) {
        if !seen(column, row) {
            let _ = write!(
                svg,
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"#e3e7ec\"/>",
                column as f64 * cell.x,
                row as f64 * cell.y,
                cell.x,
                cell.y
            );
        }
    }
    svg
}

/// Draws an image with its corners and their reprojection errors.
fn image(id: &CameraId, of: &Camera, camera: &RigCamera) -> String {
    let [width, height] = of.size().map(f64::from);
    let scale = WIDTH / width;
    let mut svg = cells(of, &|| camera.corners.iter().map(|corner| corner.pixel));
    let every = camera.corners.len().div_ceil(MOST_ERRORS).max(1);
    for corner in camera.corners.iter().step_by(every) {
        let (from, to) = (corner.pixel * scale, (corner.pixel + corner.off_px * LONGER) * scale);
        let _ = write!(
            svg,
            "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"#c2410c\" stroke-width=\"0.7\"/><circle cx=\"{:.1}\" \
             cy=\"{:.1}\" r=\"1\" fill=\"#2563a8\"/>",
            from.x, from.y, to.x, to.y, from.x, from.y
        );
    }
    for (pixel, px) in camera.uncertainty.iter().flat_map(|uncertainty| &uncertainty.image_px).step_by(2) {
        let at = *pixel * scale;
        let _ = write!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"9\" fill=\"#5a6675\" text-anchor=\"middle\">{px:.2}</text>",
            at.x.clamp(12.0, WIDTH - 12.0),
            at.y.clamp(9.0, height * scale - 2.0)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"2\" y=\"{:.0}\" font-size=\"13\">camera {}: {} boards, rms {:.3} px</text></svg>",
        height * scale + 15.0,
        escape_html(id.as_str()),
        camera.views,
        camera.rms_px
    );
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_cameras_are_escaped() {
        let camera = Camera {
            id: "a<b>\"&".into(),
            time_offset_nanos: 0,
            color: ColorMatch::default(),
            intrinsics: Intrinsics::pinhole(640, 480, 500.0),
            camera_from_world: Isometry::IDENTITY,
        };
        let svg = covered_image(&camera, &[], 3);
        assert!(svg.contains("a&lt;b&gt;&quot;&amp;") && !svg.contains("a<b"), "{svg}");
    }
}
