//! Runs the tracker on an EasyMocap data set, prints residuals, mask overlap and times, and draws the result.
//!
//! ```text
//! cargo bench -p flyrig-tracker --bench fit_footage -- DATASET OUT 01,02,04 [FIRST COUNT FPS DRAW_EVERY]
//! ```
//!
//! Cameras that are not named are held out: the fitted body is drawn over their images too, and compared with the network's
//! landmarks there. Without arguments it prints its usage.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use flyrig_body::{ShapeParams, default_template, load_gltf, skin_mesh};
use flyrig_calib::load_calibration;
use flyrig_tracker::{LANDMARK_COUNT, PoseConfig, PoseEstimate, PoseEstimator, PoseNet};
use flyrig_types::{Camera, CameraId, Frame, FrameSet, Image, Mask, PixelFormat, Rig};
use glam::{DVec2, DVec3};
use image::imageops::FilterType;
use image::{Rgb, RgbImage};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Pairs of landmarks that are joined by a line.
const LANDMARK_BONES: [(usize, usize); 30] = [
    (0, 2),
    (2, 7),
    (0, 5),
    (5, 8),
    (9, 10),
    (11, 12),
    (11, 13),
    (13, 15),
    (15, 17),
    (15, 19),
    (15, 21),
    (12, 14),
    (14, 16),
    (16, 18),
    (16, 20),
    (16, 22),
    (11, 23),
    (12, 24),
    (23, 24),
    (23, 25),
    (25, 27),
    (27, 29),
    (29, 31),
    (27, 31),
    (24, 26),
    (26, 28),
    (28, 30),
    (30, 32),
    (28, 32),
    (17, 19),
];

fn main() -> Result<()> {
    // Cargo adds "--bench".
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let Some([root, out, cameras]) = arguments.first_chunk() else {
        println!("usage: DATASET OUT CAMERA,CAMERA,... [FIRST COUNT FPS DRAW_EVERY]");
        return Ok(());
    };
    let number = |index: usize, default: i64| arguments.get(index).map_or(Ok(default), |text| text.parse::<i64>());
    let (first, count, fps, draw_every) = (number(3, 0)?, number(4, 97)?, number(5, 60)?, number(6, 10)?);
    let (root, out) = (PathBuf::from(root), PathBuf::from(out));
    std::fs::create_dir_all(&out)?;

    let all = load_calibration(&root, &|id| image::image_dimensions(image_path(&root, id, first)?).ok())?;
    let wanted: Vec<CameraId> = cameras.split(',').map(CameraId::from).collect();
    let keep = |inside: bool| Rig {
        cameras: all.cameras.iter().filter(|c| wanted.contains(&c.id) == inside).cloned().collect(),
        world_up: all.world_up,
    };
    let (rig, held_out) = (keep(true), keep(false));
    let subject = root.join("subject.glb");
    let own_body = subject.exists();
    let human = if own_body { Some(load_gltf(&subject)?) } else { None };
    let template = match &human {
        Some(human) => human.template.clone(),
        None => default_template(&ShapeParams::default())?,
    };
    // A prepared subject brings its true pose.
    let truth = human.as_ref().and_then(|human| human.track.as_ref());
    let mut errors = Vec::new();
    let mut bias: Vec<Vec<[f64; 3]>> = vec![Vec::new(); 33];
    let net = PoseNet::embedded()?;
    let plates = std::env::var_os("NO_PLATES").is_none();
    let mut estimator = PoseEstimator::new(net.clone(), &template, &rig, PoseConfig::default())?;
    for (slot, camera) in rig.cameras.iter().enumerate() {
        let plate = root.join("background").join(format!("{}.png", camera.id));
        if plates && plate.exists() {
            estimator.set_plate(slot, &to_image(&image::open(plate)?.to_rgb8())?)?;
        }
    }
    if truth.is_some() {
        let r = estimator.template().skeleton.rest_pose();
        for (i, p) in estimator.landmarks(&r).ok_or("x")?.iter().enumerate() {
            println!("mark {i} {} {p:.3}", flyrig_tracker::LANDMARK_NAMES[i]);
        }
        for (j, o) in
            estimator.template().skeleton.joints().iter().zip(estimator.template().skeleton.canonical_origins())
        {
            println!("joint {} {o:.3}", j.name);
        }
    }
    let set = |index: i64, rig: &Rig| frame_set(&root, rig, first, index, fps);
    if !own_body {
        // Spread over the first second, so that the person is seen in several poses.
        let start: Vec<FrameSet> =
            (0..8).map(|i| set((first + i * 8).min(first + count - 1), &rig)).collect::<Result<_>>()?;
        println!("{:#?}", estimator.fit_shape(&start, &[])?.0);
    }
    let mut others: Vec<PoseEstimator> = Vec::new();
    for camera in &held_out.cameras {
        let alone = Rig { cameras: vec![camera.clone()], world_up: all.world_up };
        let config = PoseConfig { masks: false, ..PoseConfig::default() };
        others.push(PoseEstimator::new(net.clone(), estimator.template(), &alone, config)?);
    }
    let (mut residuals, mut held_residuals, mut per_camera) =
        (Vec::new(), Vec::new(), vec![Vec::new(); rig.cameras.len()]);
    let (mut seconds, mut lost, mut overlaps, mut agreement) = ([0.0; 4], 0, Vec::new(), Vec::new());
    for index in first..first + count {
        let frames = set(index, &rig)?;
        let estimate = match estimator.estimate(&frames) {
            Ok(estimate) => estimate,
            Err(error) => {
                println!("{index}: {error}");
                lost += 1;
                continue;
            }
        };
        let quality = &estimate.quality;
        residuals.push(quality.residual_px);
        for (view, list) in quality.views.iter().zip(&mut per_camera) {
            list.extend(view.residual_px);
            agreement.extend(view.mask_overlap);
        }
        for (sum, part) in seconds.iter_mut().zip([
            quality.seconds.net,
            quality.seconds.triangulate,
            quality.seconds.fit,
            quality.seconds.masks,
        ]) {
            *sum += part;
        }
        let marks = estimator.landmarks(&estimate.pose).ok_or("the pose does not fit its own template")?;
        if let Some(expected) = truth.and_then(|track| estimator.landmarks(&track.at(frames.master_nanos))) {
            errors.extend(marks.iter().zip(&expected).map(|(a, b)| (*a - *b).length()));
            let pose = truth.ok_or("")?.at(frames.master_nanos);
            let sk = &estimator.template().skeleton;
            let m = sk.world_from_canonical(&pose);
            for i in 0..33 {
                let side = if i % 2 == 1 { "Left" } else { "Right" };
                let name = match i {
                    0..=10 => "Head".to_owned(),
                    11 | 12 => "Spine1".to_owned(),
                    13 | 14 => format!("{side}Arm"),
                    15..=22 => format!("{side}Hand"),
                    23 | 24 => "Hips".to_owned(),
                    25 | 26 => format!("{side}UpLeg"),
                    _ => format!("{side}Foot"),
                };
                let j = sk.joint(&name).ok_or("j")?;
                if let Some(p) = estimate.points[i] {
                    let inv = m[j].inverse();
                    let d = inv.transform_point3(p) - inv.transform_point3(expected[i]);
                    bias[i].push(d.to_array());
                }
            }
        }
        for (slot, camera) in rig.cameras.iter().enumerate() {
            let truth = root.join("mask").join(camera.id.as_str()).join(format!("{index:06}.png"));
            if truth.exists() {
                let truth = image::open(truth)?.to_luma8();
                overlaps
                    .push(estimate.masks[slot].as_ref().map_or(0.0, |mask| overlap(mask.coverage(), truth.as_raw())));
            }
        }
        let mut seen_elsewhere = Vec::new();
        for (other, camera) in others.iter_mut().zip(&held_out.cameras) {
            let alone = Rig { cameras: vec![camera.clone()], world_up: all.world_up };
            let seen = other.estimate(&set(index, &alone)?).ok().and_then(|e| e.keypoints[0]);
            if let Some(seen) = &seen {
                held_residuals.extend(
                    (0..LANDMARK_COUNT)
                        .filter(|i| seen[*i].confidence > 0.5)
                        .filter_map(|i| camera.project(marks[i]).map(|p| (p - seen[i].pixel).length())),
                );
            }
            seen_elsewhere.push(seen);
        }
        if (index - first) % draw_every == 0 {
            draw(&out.join(format!("{index:06}.png")), &root, index, &rig, &held_out, &estimator, &estimate, &marks)?;
        }
    }
    let used = residuals.len().max(1) as f64;
    println!("{} frame sets, {lost} lost, median reprojection {:.2} px", residuals.len(), median(&mut residuals));
    for (camera, list) in rig.cameras.iter().zip(&mut per_camera) {
        println!("  camera {}: {:.2} px", camera.id, median(list));
    }
    println!("held out: {:.2} px to the network's own landmarks", median(&mut held_residuals));
    for (i, b) in bias.iter().enumerate() {
        let mut row = format!("{i:2} {:16} n {:3}", flyrig_tracker::LANDMARK_NAMES[i], b.len());
        for k in 0..3 {
            let mut v: Vec<f64> = b.iter().map(|p| p[k] * 1e3).collect();
            row += &format!(" {:7.1}", median(&mut v));
        }
        if truth.is_some() {
            println!("{row}");
        }
    }
    if truth.is_some() {
        println!("landmarks of the fitted body: median {:.1} mm from the true pose", median(&mut errors) * 1e3);
    }
    if !overlaps.is_empty() {
        println!("masks: mean overlap (IoU) {:.3}", overlaps.iter().sum::<f64>() / overlaps.len() as f64);
    }
    println!("fitted body and mask: median overlap (IoU) {:.3}", median(&mut agreement));
    let [net, triangulate, fit, masks] = seconds.map(|s| s / used * 1e3);
    println!("ms per frame set: net {net:.1}, triangulate {triangulate:.2}, fit {fit:.1}, masks {masks:.1}");
    Ok(())
}

fn overlap(a: &[u8], b: &[u8]) -> f64 {
    let (mut both, mut either) = (0u32, 0u32);
    for (a, b) in a.iter().zip(b) {
        both += u32::from(*a >= 128 && *b >= 128);
        either += u32::from(*a >= 128 || *b >= 128);
    }
    f64::from(both) / f64::from(either.max(1))
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn image_path(root: &Path, camera: &CameraId, index: i64) -> Option<PathBuf> {
    let folder = root.join("images").join(camera.as_str());
    ["jpg", "png"].iter().map(|ext| folder.join(format!("{index:06}.{ext}"))).find(|path| path.exists())
}

fn to_image(picture: &RgbImage) -> Result<Image> {
    Ok(Image::new(picture.width(), picture.height(), PixelFormat::Rgb8, picture.as_raw().clone())?)
}

fn frame_set(root: &Path, rig: &Rig, first: i64, index: i64, fps: i64) -> Result<FrameSet> {
    let nanos = index * 1_000_000_000 / fps;
    let frame = |camera: &Camera| -> Result<Option<Arc<Frame>>> {
        let Some(path) = image_path(root, &camera.id, index) else { return Ok(None) };
        let image = to_image(&image::open(path)?.to_rgb8())?;
        Ok(Some(Arc::new(Frame {
            camera: camera.id.clone(),
            sequence: index as u64,
            capture_nanos: nanos,
            exposure_nanos: None,
            image,
            mask: None,
        })))
    };
    let frames = rig.cameras.iter().map(frame).collect::<Result<_>>()?;
    Ok(FrameSet { index: (index - first) as u64, master_nanos: nanos, frames })
}

#[allow(clippy::too_many_arguments)]
fn draw(
    path: &Path,
    root: &Path,
    index: i64,
    rig: &Rig,
    held_out: &Rig,
    estimator: &PoseEstimator,
    estimate: &PoseEstimate,
    marks: &[DVec3; LANDMARK_COUNT],
) -> Result<()> {
    let (vertices, _) = skin_mesh(estimator.template(), &estimate.pose);
    let mut panels = Vec::new();
    for (slot, camera) in
        rig.cameras.iter().map(Some).enumerate().chain(held_out.cameras.iter().map(|c| (usize::MAX, Some(c))))
    {
        let Some(camera) = camera else { continue };
        let Some(source) = image_path(root, &camera.id, index) else { continue };
        let mut picture = image::open(source)?.to_rgb8();
        if let Some(mask) = estimate.masks.get(slot).and_then(Option::as_ref) {
            outline(&mut picture, mask);
        }
        for vertex in vertices.iter().step_by(3) {
            dot(&mut picture, camera.project(vertex.as_dvec3()), 0, [255, 230, 0]);
        }
        for (a, b) in LANDMARK_BONES {
            line(&mut picture, camera.project(marks[a]), camera.project(marks[b]), [255, 0, 0]);
        }
        if let Some(seen) = estimate.keypoints.get(slot).and_then(Option::as_ref) {
            for keypoint in seen {
                let color = if keypoint.confidence > 0.5 { [0, 255, 0] } else { [0, 120, 255] };
                dot(&mut picture, Some(keypoint.pixel), 2, color);
            }
        }
        // Only the person, at the images' own scale.
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for pixel in vertices.iter().filter_map(|v| camera.project(v.as_dvec3())) {
            (low, high) = (low.min(pixel - 25.0), high.max(pixel + 25.0));
        }
        let (low, high) = (low.max(DVec2::ZERO), high.max(DVec2::ONE));
        let [x, y, width, height] = [low.x, low.y, high.x - low.x, high.y - low.y].map(|v| v.max(1.0) as u32);
        let cut = image::imageops::crop_imm(&picture, x, y, width, height).to_image();
        panels.push(image::imageops::resize(&cut, cut.width() * 2, cut.height() * 2, FilterType::Triangle));
    }
    let height = panels.iter().map(RgbImage::height).max().unwrap_or(1);
    let mut sheet = RgbImage::new(panels.iter().map(RgbImage::width).sum(), height);
    let mut x = 0;
    for panel in &panels {
        image::imageops::replace(&mut sheet, panel, x, 0);
        x += i64::from(panel.width());
    }
    sheet.save(path)?;
    Ok(())
}

fn dot(picture: &mut RgbImage, at: Option<DVec2>, radius: i64, color: [u8; 3]) {
    let Some(at) = at else { return };
    let (x, y) = (at.x.round() as i64, at.y.round() as i64);
    for v in y - radius..=y + radius {
        for u in x - radius..=x + radius {
            if u >= 0 && v >= 0 && u < i64::from(picture.width()) && v < i64::from(picture.height()) {
                picture.put_pixel(u as u32, v as u32, Rgb(color));
            }
        }
    }
}

fn line(picture: &mut RgbImage, a: Option<DVec2>, b: Option<DVec2>, color: [u8; 3]) {
    let (Some(a), Some(b)) = (a, b) else { return };
    let steps = (b - a).length().ceil().clamp(1.0, 4000.0) as usize;
    for i in 0..=steps {
        dot(picture, Some(a.lerp(b, i as f64 / steps as f64)), 0, color);
    }
}

fn outline(picture: &mut RgbImage, mask: &Mask) {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let inside = |x: usize, y: usize| mask.coverage()[y * width + x] >= 128;
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            if inside(x, y) && !(inside(x - 1, y) && inside(x + 1, y) && inside(x, y - 1) && inside(x, y + 1)) {
                picture.put_pixel(x as u32, y as u32, Rgb([255, 0, 255]));
            }
        }
    }
}
