//! Small images of an avatar: with all Gaussians, and with level of detail.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use anyhow::Result;
use flyrig_avatar::{Avatar, DetailedScene};
use flyrig_gpu::GpuContext;
use flyrig_types::{Camera, Pose, RenderedView};
use glam::DVec3;
use serde::Serialize;

/// Largest number of halvings of the image size.
const MOST_HALVINGS: u32 = 4;

/// Result for one image size.
#[derive(Debug, Serialize)]
pub struct SmallViews {
    /// Height of the images of the first camera, pixels.
    height: u32,
    /// Mean Gaussians per view without and with level of detail.
    gaussians: [f64; 2],
    /// Milliseconds of posing and rendering a view, without and with level of detail.
    view_ms: [f64; 2],
    /// PSNR against the averaged full-size view, without and with level of detail, decibels.
    psnr_db: [f64; 2],
}

/// Renders an avatar in some frames at ever smaller image sizes.
pub fn small_views(
    gpu: &GpuContext,
    avatar: &Avatar,
    frames: &[(&Pose, &[DVec3])],
    cameras: &[Camera],
) -> Result<Vec<SmallViews>> {
    let mut whole = DetailedScene::new(gpu, avatar.clone(), false)?;
    let mut scenes = [DetailedScene::new(gpu, avatar.clone(), false)?, DetailedScene::new(gpu, avatar.clone(), true)?];
    let mut rows = Vec::new();
    for level in 0..=MOST_HALVINGS {
        let (mut gaussians, mut spent, mut squares) = ([0; 2], [Duration::ZERO; 2], [0.0; 2]);
        let (mut views, mut numbers) = (0u32, 0);
        // The first view of each scene is one of a size that was not drawn before: it is not counted.
        for (turn, (pose, translations)) in frames.iter().take(1).chain(frames).enumerate() {
            whole.pose(pose, Some(translations));
            for camera in cameras {
                let reference = average(&whole.draw(camera)?, 1 << level);
                let small = camera.halved(level);
                for (k, scene) in scenes.iter_mut().enumerate() {
                    let start = Instant::now();
                    scene.pose(pose, Some(translations));
                    let view = scene.draw(&small)?;
                    if turn > 0 {
                        spent[k] += start.elapsed();
                        gaussians[k] += scene.drawn().0;
                        let (sum, count) = difference(&average(&view, 1), &reference);
                        squares[k] += sum;
                        numbers += if k == 0 { count } else { 0 };
                    }
                }
                views += u32::from(turn > 0);
            }
        }
        let per_view = |value: f64| value / f64::from(views.max(1));
        rows.push(SmallViews {
            height: cameras.first().map_or(0, |camera| camera.intrinsics.height >> level),
            gaussians: gaussians.map(|count| per_view(count as f64)),
            view_ms: spent.map(|time| per_view(1e3 * time.as_secs_f64())),
            psnr_db: squares.map(|sum| -10.0 * (sum / numbers.max(1) as f64).max(1e-10).log10()),
        });
    }
    Ok(rows)
}

/// Formats the rows as a table.
pub fn table(rows: &[SmallViews]) -> String {
    let mut text = String::from(
        "| image height | Gaussians | a view ms | PSNR to the large view dB | with all Gaussians: a view ms | PSNR dB |\n|---|---|---|---|---|---|\n",
    );
    for SmallViews { height, gaussians: [_, some], view_ms, psnr_db } in rows {
        let _ = writeln!(
            text,
            "| {height} | {some:.0} | {:.1} | {:.1} | {:.1} | {:.1} |",
            view_ms[1], psnr_db[1], view_ms[0], psnr_db[0]
        );
    }
    text
}

/// Averages sRGB times coverage, and coverage, over squares of `side` pixels; 0..=1.
fn average(view: &RenderedView, side: usize) -> Vec<[f64; 4]> {
    let (width, height) = (view.width as usize, view.height as usize);
    let pixel = |x: usize, y: usize| -> [f64; 4] {
        let at = (y * width + x) * 4;
        let [r, g, b, a] = [0, 1, 2, 3].map(|k| view.rgba.get(at + k).map_or(0.0, |code| f64::from(*code) / 255.0));
        [r * a, g * a, b * a, a]
    };
    let mut means = Vec::with_capacity(width * height / (side * side));
    for y in 0..height / side {
        for x in 0..width / side {
            let mut sum = [0.0; 4];
            for at in 0..side * side {
                let found = pixel(x * side + at % side, y * side + at / side);
                (0..4).for_each(|k| sum[k] += found[k]);
            }
            means.push(sum.map(|sum| sum / (side * side) as f64));
        }
    }
    means
}

/// Returns the sum of squared differences where either image shows a person, and their number.
fn difference(found: &[[f64; 4]], wanted: &[[f64; 4]]) -> (f64, usize) {
    let (mut sum, mut count) = (0.0, 0);
    for (a, b) in found.iter().zip(wanted).filter(|(a, b)| a[3] > 0.0 || b[3] > 0.0) {
        sum += (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
        count += 3;
    }
    (sum, count)
}

#[cfg(test)]
mod tests {
    use flyrig_types::{CameraId, Intrinsics, Isometry};

    use super::*;

    #[test]
    fn averages_are_those_of_squares() {
        let mut rgba = vec![255; 4 * 6 * 4];
        rgba[3] = 0;
        let view = RenderedView { rgba, width: 6, height: 4 };
        let means = average(&view, 2);
        assert_eq!(means.len(), 6);
        assert!((means[0][0] - 0.75).abs() < 1e-12 && (means[1][3] - 1.0).abs() < 1e-12);
        let (sum, count) = difference(&means, &[[1.0; 4]; 6]);
        assert!((sum - 3.0 * 0.0625).abs() < 1e-12 && count == 18);
    }

    #[test]
    fn a_halved_camera_sees_the_mean_of_four_pixels() {
        let camera = Camera {
            id: CameraId::from("a"),
            intrinsics: Intrinsics::pinhole(64, 48, 80.0),
            camera_from_world: Isometry::IDENTITY,
            time_offset_nanos: 0,
            color: Default::default(),
        };
        let place = DVec3::new(0.3, -0.2, 2.0);
        let (large, small) = (camera.project(place).unwrap(), camera.halved(1).project(place).unwrap());
        assert!((small - (large - 0.5) / 2.0).length() < 1e-12);
    }
}
