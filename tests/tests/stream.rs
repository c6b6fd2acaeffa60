//! Person stream, end to end: a rig's person is recorded, played again, and drawn by a viewer as the rig draws it.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

mod support;

use std::time::{Duration, Instant};

use flyrig_capture::{CameraSource as _, VideoOptions, VideoReplay};
use flyrig_gpu::{AdapterChoice, GpuContext};
use flyrig_stream::Posed;
use flyrig_tests::{free_port, run};
use flyrig_transport::{Interests, Subscriber, TransportConfig, Views};
use flyrig_viewer::{PeopleScene, Receiver, clock_secs};
use support::{PATIENCE, Process, SMALL_SIM, small_rig, wait_for, wait_until};

const PROGRAM: &str = env!("CARGO_BIN_EXE_flyrig-under-test");

fn config(rig: &str, endpoint: &str) -> TransportConfig {
    TransportConfig { connect: vec![endpoint.to_owned()], ..TransportConfig::subscriber(rig) }
}

/// Draws the received people through a camera, once the viewer has all colours.
fn view(receiver: &Receiver, gpu: &GpuContext, camera: &flyrig_types::Camera) -> (u64, flyrig_types::RenderedView) {
    // Nobody is shown while the rig of a busy machine pauses.
    let (motion, posed, colors) = wait_for("a person with all colours", || {
        let mut state = receiver.state();
        let person = state.people.get_mut(0).filter(|person| person.is_complete())?;
        let motion = person.motion_at(clock_secs(), false)?;
        let mut posed = Posed::default();
        let colors = person.pose(&motion, &mut posed);
        Some((motion, posed, colors))
    });
    let mut scene = PeopleScene::new(&gpu.fastest()).unwrap();
    scene.set_people([(&posed, colors.as_slice())]).unwrap();
    (motion.stamp.frame, scene.draw(camera).unwrap())
}

#[test]
fn a_viewer_draws_the_person_as_the_rig_does_live_and_from_a_recording() {
    let folder = tempfile::tempdir().unwrap();
    // The person stands still, so that frames of different times look alike.
    let endpoint = small_rig("stream", folder.path(), "");
    std::fs::write(folder.path().join("sim.toml"), format!("{SMALL_SIM}motion.kind = \"still\"\n")).unwrap();
    let gpu = GpuContext::new(&AdapterChoice::Best).unwrap();

    // The viewer starts first.
    let receiver = Receiver::start(&config("stream", &endpoint), || {}).unwrap();
    assert!(receiver.state().trouble("stream", &endpoint).unwrap().contains("No rig 'stream'"));
    let mut record = Process::start(
        PROGRAM,
        &["watch", "--rig", "stream", "--connect", &endpoint, "--record", "take.mcap", "--until-end"],
        folder.path(),
        "record",
    );
    let mut rig = Process::start(PROGRAM, &["run", "rig.toml"], folder.path(), "run");
    let mut camera = wait_for("the rig's cameras", || receiver.state().rig.clone()).cameras[0].clone();
    // Request the rig's own view through the same lens.
    camera.intrinsics.lens = flyrig_types::Lens::PINHOLE;
    let (frame, ours) = view(&receiver, &gpu, &camera);
    wait_until("no more trouble", || receiver.state().trouble("stream", &endpoint).is_none());
    let pictures =
        Subscriber::open(&config("stream", &endpoint), &Interests { views: Views::None, ..Interests::default() })
            .unwrap();
    pictures.request_viewpoint(&camera, 30.0).unwrap();
    let theirs = loop {
        let deadline = Instant::now() + PATIENCE;
        if let Ok(Some(picture)) = pictures.next_view(Duration::from_millis(200)) {
            break picture.body;
        }
        assert!(Instant::now() < deadline);
    };
    assert!(theirs.frame + 1000 > frame);
    let jpeg = image::load_from_memory(&theirs.bytes).unwrap().into_rgb8();
    let ours_on_grey = flyrig_renderer::composite_over(&ours.rgba, &vec![30; ours.rgba.len() / 4 * 3]);
    let psnr = psnr(&ours_on_grey, &jpeg);
    // JPEG compression and the person's breathing remain as differences.
    assert!(psnr > 28.0, "{psnr}");
    let shown = ours.rgba.chunks_exact(4).filter(|pixel| pixel[3] > 127).count();
    assert!(shown > 300, "{shown} pixels");
    // A recording of a few seconds.
    let captured = || receiver.state().people.get(0)?.motion_at(clock_secs(), false).map(|m| m.stamp.capture_nanos);
    let start = wait_for("a motion", captured);
    wait_until("a recording longer than a refresh", || captured().is_some_and(|now| now > start + 4_000_000_000));
    rig.signal("INT");
    wait_until("the rig to end", || rig.0.try_wait().unwrap().is_some());
    wait_until("the recording to end", || record.0.try_wait().unwrap().is_some());
    assert!(record.0.wait().unwrap().success());
    drop(receiver);

    // The recording becomes a film without a rig.
    let filmed = run(PROGRAM, &["play", "take.mcap", "--orbit", "film.mp4"], folder.path()).unwrap();
    assert_eq!(filmed.code, Some(0), "{filmed:?}");
    assert!(filmed.stderr.contains("the film is film.mp4"), "{}", filmed.stderr);
    let mut film =
        VideoReplay::open(&"film".into(), &folder.path().join("film.mp4"), &VideoOptions::default()).unwrap();
    let (mut images, mut last_nanos) = (0, 0);
    while let Ok(frame) = film.next_frame(Duration::ZERO) {
        let (bytes, middle) = (frame.image.bytes(), frame.image.bytes().len() / 2 + 3 * 360);
        let person = (0..300).map(|at| bytes[middle - 150 + at].abs_diff(bytes[at])).max();
        assert!(person > Some(20), "image {images} shows nobody: {person:?}");
        (images, last_nanos) = (images + 1, frame.capture_nanos);
    }
    assert!(images > 50 && last_nanos > 7_900_000_000, "{images} images, {last_nanos} ns: less than a turn");
    // Another rig plays the same person from the file.
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let play = ["play", "take.mcap", "--rig", "again", "--listen", &endpoint, "--repeat", "--wait"];
    let _play = Process::start(PROGRAM, &play, folder.path(), "play");
    let receiver = Receiver::start(&config("again", &endpoint), || {}).unwrap();
    // The rig's cameras, and the statistics without which no age is exact, arrive by themselves, in any order.
    wait_until("the played rig's cameras and an exact age", || {
        let state = receiver.state();
        state.rig.is_some() && state.age.is_some_and(|(_, is_exact)| is_exact)
    });
    let (_, played) = view(&receiver, &gpu, &camera);
    let played = flyrig_renderer::composite_over(&played.rgba, &vec![30; played.rgba.len() / 4 * 3]);
    let psnr =
        self::psnr(&played, &ours_on_grey_image(&ours_on_grey, camera.intrinsics.width, camera.intrinsics.height));
    assert!(psnr > 28.0, "{psnr}");
    let state = receiver.state();
    assert_eq!(state.rig.as_ref().unwrap().cameras.len(), 2);
    assert!(state.age.unwrap().1, "the age of a played stream must be exact");
    assert!(state.problem.is_none(), "{:?}", state.problem);
}

fn ours_on_grey_image(rgb: &[u8], width: u32, height: u32) -> image::RgbImage {
    image::RgbImage::from_raw(width, height, rgb.to_vec()).unwrap()
}

fn psnr(ours: &[u8], theirs: &image::RgbImage) -> f64 {
    assert_eq!(ours.len(), theirs.as_raw().len());
    let sum: f64 = ours.iter().zip(theirs.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    -10.0 * (sum / ours.len() as f64 / 255.0f64.powi(2)).log10()
}
