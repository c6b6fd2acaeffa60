use flyrig_types::{Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2};

use super::*;

const LEASE: Duration = Duration::from_secs(3);
const BUDGET: u64 = 512 * 512 * 30 * 4;

fn leases() -> Leases {
    Leases::new(8, LEASE, BUDGET)
}

fn camera(width: u32, height: u32) -> Camera {
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "mine".into(),
        intrinsics: Intrinsics {
            width,
            height,
            focal_px: DVec2::splat(500.0),
            center_px: DVec2::new(f64::from(width), f64::from(height)) / 2.0,
            lens: Lens::PINHOLE,
        },
        camera_from_world: Isometry::IDENTITY,
    }
}

/// Returns the reason of a refusal; empty when granted.
fn ask(leases: &mut Leases, who: &str, (width, height): (u32, u32), max_fps: f64, now: Instant) -> String {
    let request = ViewpointRequest { camera: Some(camera(width, height)), max_fps };
    let answer = leases.ask(who, Ok(request), now);
    assert_eq!(answer.granted, answer.reason.is_empty());
    answer.reason
}

#[test]
fn the_budget_of_pixels_is_shared_and_a_refusal_names_what_fits() {
    let (mut leases, now) = (leases(), Instant::now());
    // Four viewers of the usual size fill it to the pixel, and each may renew and move.
    for round in 0..3 {
        for who in ["a", "b", "c", "d"] {
            assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "", "{who} {round}");
        }
    }
    let full = ask(&mut leases, "e", (512, 512), 30.0, now);
    assert!(
        full.contains("512x512 at 30 per second is 7.9 Mpx/s; 0.0 of the rig's 31.5 Mpx/s are left; wait"),
        "{full}"
    );
    // One that leaves makes room; a larger one learns which sizes fit, and both of them do.
    leases.drop_subscriber("d");
    let large = ask(&mut leases, "e", (1024, 1024), 30.0, now);
    assert!(large.contains("1024x1024 at 30 per second is 31.5 Mpx/s; 7.9 of the rig's 31.5 Mpx/s"), "{large}");
    assert!(large.ends_with("ask for 512x512 or --max-fps 7"), "{large}");
    assert_eq!(ask(&mut leases, "e", (1024, 1024), 7.0, now), "");
    leases.drop_subscriber("e");
    assert_eq!(ask(&mut leases, "e", (512, 512), 30.0, now), "");
    // A subscriber that requests more keeps the granted viewpoint, and takes nothing from the others.
    assert!(!ask(&mut leases, "e", (513, 512), 30.0, now).is_empty());
    let rates: Vec<f64> = leases.viewpoints().iter().map(pixel_rate).collect();
    assert_eq!(rates, [512.0 * 512.0 * 30.0; 4]);
    for who in ["a", "b", "c"] {
        assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "");
    }
    // A lease that ends gives its pixels back.
    assert_eq!(ask(&mut leases, "f", (1024, 1024), 30.0, now + LEASE), "");
    // More than everything.
    let huge = ask(&mut leases, "f", (4096, 4096), 1000.0, now + LEASE);
    assert!(huge.contains("16777.2 Mpx/s; 31.5 of") && huge.ends_with("ask for 177x177 or --max-fps 1"), "{huge}");
    assert!(ask(&mut Leases::new(8, LEASE, 0), "a", (64, 64), 30.0, now).contains("raise viewpoint-pixels"));
}

#[test]
fn images_too_large_for_the_rig_are_refused_and_ended() {
    let (mut leases, now) = (Leases::new(8, LEASE, u64::MAX), Instant::now());
    assert_eq!(ask(&mut leases, "a", (4096, 4096), 30.0, now), "");
    assert_eq!(ask(&mut leases, "b", (2048, 1024), 30.0, now), "");
    leases.set_max_view_pixels(8 << 20);
    assert_eq!(leases.viewpoints().iter().map(|v| v.subscriber.as_str()).collect::<Vec<_>>(), ["b"]);
    let reason = ask(&mut leases, "a", (4096, 4096), 30.0, now);
    assert!(reason.ends_with("4096x4096 is 16.8 Mpx, the rig draws at most 8.4 Mpx; ask for 2896x2896"), "{reason}");
    assert_eq!(ask(&mut leases, "a", (2896, 2896), 30.0, now), "");
}

#[test]
fn what_could_not_be_drawn_is_refused_until_it_changes_or_a_minute_has_passed() {
    let (mut leases, now) = (leases(), Instant::now());
    for who in ["a", "b"] {
        assert_eq!(ask(&mut leases, who, (512, 512), 30.0, now), "");
    }
    leases.refuse("a", "out of memory\u{1b}[2J", now);
    leases.refuse("nobody", "x", now);
    assert_eq!(leases.viewpoints().len(), 1);
    for seconds in [0, 1, 59] {
        let reason = ask(&mut leases, "a", (512, 512), 30.0, now + Duration::from_secs(seconds));
        assert_eq!(reason, "viewpoint of a: out of memory\\u{1b}[2J");
        assert_eq!(ask(&mut leases, "b", (512, 512), 30.0, now + Duration::from_secs(seconds)), "");
    }
    assert_eq!(ask(&mut leases, "a", (512, 512), 30.0, now + REFUSAL), "");
    // Another size is another request, and the first one may be tried again after it.
    leases.refuse("a", "out of memory", now + REFUSAL);
    assert_eq!(ask(&mut leases, "a", (256, 256), 30.0, now + REFUSAL), "");
    assert_eq!(ask(&mut leases, "a", (512, 512), 30.0, now + REFUSAL), "");
    // Any number of refusals is remembered within bounds.
    for n in 0..1000 {
        let who = format!("n{n}");
        assert_eq!(ask(&mut leases, &who, (64, 64), 1.0, now + REFUSAL), "");
        leases.refuse(&who, "x", now + REFUSAL);
    }
    assert_eq!(leases.refusals.len(), MAX_REFUSALS);
}

/// Returns the number of images of each viewer in 20 s of a rig of `rig_fps`, whose frame sets are up to `jitter` of an interval early
/// or late.
fn pictures(rates: &[f64], rig_fps: f64, jitter: f64) -> Vec<usize> {
    let (mut leases, start) = (Leases::new(8, LEASE, u64::MAX), Instant::now());
    let mut counts = vec![0; rates.len()];
    let mut random = 7u64;
    for set in 0..(20.0 * rig_fps) as u32 {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let shift = ((random >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0) * jitter;
        let now = start + saturating_secs((f64::from(set) + 1.0 + shift) / rig_fps);
        for (n, max_fps) in rates.iter().enumerate() {
            assert_eq!(ask(&mut leases, &n.to_string(), (64, 64), *max_fps, now), "");
        }
        for viewpoint in leases.take_due(now, |_| true) {
            counts[viewpoint.subscriber.parse::<usize>().unwrap()] += 1;
        }
    }
    counts
}

#[test]
fn every_viewer_gets_its_own_rate() {
    for jitter in [0.0, 0.1, 0.3, 0.49] {
        // 20 s of a rig at 30 frame sets per second: 600.
        let counts = pictures(&[30.0, 20.0, 7.5, 1.0, 1000.0, 29.0], 30.0, jitter);
        for (count, wanted) in counts.iter().zip([600, 400, 150, 20, 600, 580]) {
            assert!(count.abs_diff(wanted) <= 2, "jitter {jitter}: {counts:?}");
        }
    }
    // A rig that is faster than asked for by any ratio.
    assert!(pictures(&[30.0], 47.0, 0.3)[0].abs_diff(600) <= 2);
}

#[test]
fn no_image_is_drawn_for_a_viewer_that_does_not_watch_or_to_make_up_for_a_pause() {
    let (mut leases, now) = (leases(), Instant::now());
    assert_eq!(ask(&mut leases, "a", (64, 64), 10.0, now), "");
    assert_eq!(ask(&mut leases, "b", (64, 64), 10.0, now), "");
    let due = |leases: &mut Leases, millis, watched: &str| -> Vec<String> {
        let now = now + Duration::from_millis(millis);
        leases.take_due(now, |view| view == watched).into_iter().map(|viewpoint| viewpoint.subscriber).collect()
    };
    assert_eq!(due(&mut leases, 0, "viewer-a"), ["a"]);
    assert!(due(&mut leases, 50, "viewer-a").is_empty());
    // Without keys, nobody but the first viewer has an image at once.
    assert!(due(&mut leases, 60, "viewer-b").is_empty());
    assert_eq!(due(&mut leases, 100, "viewer-a"), ["a"]);
    assert_eq!(due(&mut leases, 160, "viewer-b"), ["b"]);
    // After a pause of one second, the next second has ten images, without the ten that were missed.
    let taken: usize = (0..100).map(|n| due(&mut leases, 1100 + 10 * n, "viewer-a").len()).sum();
    assert!((10..=12).contains(&taken), "{taken}");
    // The lease ends, as everywhere.
    assert!(due(&mut leases, 3000, "viewer-a").is_empty());
}

#[test]
fn rates_that_are_no_rates_are_refused_in_words() {
    let (mut leases, now) = (leases(), Instant::now());
    for max_fps in [5e-324, 1e-300, 1e-30, 5e-20, 1e-3, 0.009_99, 0.0, -0.0, -1.0, 1000.1, 1e308] {
        let reason = ask(&mut leases, "a", (64, 64), max_fps, now);
        let words = format!("{max_fps:?} images per second requested, expected 0.01 to 1000");
        assert!(reason.contains(&words), "{max_fps:?}: {reason:?}");
    }
    for max_fps in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        assert!(ask(&mut leases, "a", (64, 64), max_fps, now).contains("expected 0.01 to 1000"), "{max_fps}");
    }
    assert!(leases.take_due(now, |_| true).is_empty());
    for max_fps in [0.01, 1000.0] {
        assert_eq!(ask(&mut leases, "a", (64, 64), max_fps, now), "");
    }
    // The slowest one for which the clock has room.
    assert_eq!(leases.take_due(now, |_| true).len(), 1);
}

#[test]
fn numbers_that_drawing_cannot_take_are_refused_by_name() {
    let refusal = |change: &dyn Fn(&mut Camera)| {
        let mut camera = camera(64, 64);
        change(&mut camera);
        let request = ViewpointRequest { camera: Some(camera), max_fps: 1.0 };
        leases().ask("a", Ok(request), Instant::now()).reason
    };
    let wild = [5e-324, 1e-300, 1e30, 1e300, f64::MAX, f64::NAN, f64::INFINITY];
    for value in wild {
        for (what, change) in [
            ("focal length fx", &(|camera: &mut Camera| camera.intrinsics.focal_px.x = value) as &dyn Fn(&mut Camera)),
            ("focal length fy", &|camera| camera.intrinsics.focal_px.y = value),
        ] {
            let reason = refusal(change);
            let is_named = reason.contains(what) || reason.contains("the camera matrix K is not a finite number");
            assert!(is_named, "{what} {value:?}: {reason:?}");
        }
    }
    for value in [1e30, -1e300, f64::MIN, f64::NAN, f64::NEG_INFINITY] {
        for (what, change) in [
            ("principal point", &(|camera: &mut Camera| camera.intrinsics.center_px.y = value) as &dyn Fn(&mut Camera)),
            ("distance from the origin", &|camera| camera.camera_from_world.translation.z = value),
            ("lens", &|camera| camera.intrinsics.lens = Lens::Fisheye { coefficients: [0.0, value, 0.0, 0.0] }),
        ] {
            assert!(!refusal(change).is_empty(), "{what} {value:?}");
            assert!(value.is_nan() || value.is_infinite() || refusal(change).contains(what), "{}", refusal(change));
        }
        assert!(refusal(&|camera| camera.camera_from_world.rotation.x = value).contains("rotation"));
        assert!(refusal(&|camera| camera.color.gain[1] = value).contains("color.gain"));
    }
    assert!(
        refusal(&|camera| camera.camera_from_world.rotation = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0)).contains("rot")
    );
    assert!(refusal(&|camera| camera.intrinsics.width = 0).contains("width"));
    // Denormal numbers beside usable ones are zeros.
    assert_eq!(refusal(&|camera| camera.camera_from_world.translation.x = 5e-324), "");
    // A name is checked first, and not repeated at length.
    let reason = refusal(&|camera| {
        camera.id = "A".repeat(200_000).into();
        camera.intrinsics.focal_px.x = -1.0;
    });
    assert!(reason.contains("AAA...' is too long; rename it") && reason.len() < 240, "{reason}");
}

/// Asks for a viewpoint, or gives it back with `None`.
fn want(leases: &mut Leases, who: &str, wanted: Option<(u32, f64)>, now: Instant) {
    let (camera, max_fps) = wanted.map_or((None, 1.0), |(side, max_fps)| (Some(camera(side, side)), max_fps));
    leases.ask(who, Ok(ViewpointRequest { camera, max_fps }), now);
}

/// Returns the pixels drawn in 60 s of a rig of 30 frame sets per second; `before` and `after` each frame set the viewers do as they like.
fn drawn(
    leases: &mut Leases,
    before: impl Fn(&mut Leases, u32, Instant),
    after: impl Fn(&mut Leases, u32, Instant),
) -> f64 {
    let start = Instant::now();
    let mut drawn = 0.0;
    for set in 0..1800u32 {
        let now = start + set * Duration::from_secs(1) / 30;
        before(leases, set, now);
        drawn += leases.take_due(now, |_| true).iter().map(pixels).sum::<f64>();
        after(leases, set, now);
    }
    drawn
}

#[test]
fn who_gives_a_viewpoint_back_and_asks_again_gets_no_more_than_its_share() {
    const SIDE: u32 = 2048;
    let image = f64::from(SIDE) * f64::from(SIDE);
    let again = |leases: &mut Leases, _, now| want(leases, "a", Some((SIDE, 0.01)), now);
    let back = |leases: &mut Leases, _, now| want(leases, "a", None, now);
    assert!(drawn(&mut leases(), again, back) <= image, "one image, then 0.6 of another");
    // Under ever new names without a key, or of the same key.
    for (has_keys, prefix) in [(false, "n"), (false, "ring-3."), (true, "ring-3."), (true, "n")] {
        let renamed = |leases: &mut Leases, set, now| want(leases, &format!("{prefix}{set}"), Some((SIDE, 0.01)), now);
        let gone = |leases: &mut Leases, set, _| leases.drop_subscriber(&format!("{prefix}{set}"));
        let pixels = drawn(&mut leases().with_keys(has_keys), renamed, gone);
        assert!(pixels <= image, "{prefix}: {} images", pixels / image);
    }
    // By a lease that ends, and by leaving.
    let some = |leases: &mut Leases, set: u32, now| {
        if set.is_multiple_of(91) {
            want(leases, "a", Some((SIDE, 0.01)), now);
        }
    };
    assert!(drawn(&mut leases(), some, |_, _, _| ()) <= image);
    // A small image, then a large one, again and again.
    let small = |leases: &mut Leases, set: u32, now| {
        let size = if set.is_multiple_of(2) { (SIDE, 0.01) } else { (64, 30.0) };
        want(leases, "a", Some(size), now);
    };
    let share = 64.0 * 64.0 * 30.0 * 60.0 + image * 0.6;
    let pixels = drawn(&mut leases(), small, |_, _, _| ());
    assert!(pixels <= share + image, "{} images", pixels / image);
}

#[test]
fn viewers_beside_one_that_asks_again_and_again_get_all_their_images() {
    let before = |leases: &mut Leases, set, now| {
        want(leases, &format!("n{set}"), Some((2048, 0.01)), now);
        want(leases, "honest", Some((512, 30.0)), now);
    };
    let after = |leases: &mut Leases, set, _| leases.drop_subscriber(&format!("n{set}"));
    let pixels = drawn(&mut leases(), before, after);
    assert!(pixels >= 512.0 * 512.0 * 1798.0, "{pixels}");
}

#[test]
fn what_was_earned_stays_when_size_or_rate_changes() {
    let (mut leases, now) = (leases(), Instant::now());
    let is_due =
        |leases: &mut Leases, millis| !leases.take_due(now + Duration::from_millis(millis), |_| true).is_empty();
    want(&mut leases, "a", Some((512, 0.01)), now);
    assert!(is_due(&mut leases, 0));
    // A hundred seconds were left; at 30 images per second it is a period.
    want(&mut leases, "a", Some((512, 30.0)), now);
    assert!(!is_due(&mut leases, 20) && is_due(&mut leases, 34));
    // A moved camera of the same size keeps its turn.
    want(&mut leases, "a", Some((512, 30.0)), now + Duration::from_millis(50));
    assert!(!is_due(&mut leases, 60) && is_due(&mut leases, 67));
}

#[test]
fn a_panic_of_a_schedule_ends_one_viewpoint() {
    let (mut leases, now) = (leases(), Instant::now());
    for who in ["a", "b", "c"] {
        assert_eq!(ask(&mut leases, who, (64, 64), 30.0, now), "");
    }
    let schedule = |lease: &mut Lease, first: &mut FirstImages, now| {
        assert!(lease.viewpoint.subscriber != "b", "injected");
        lease.take_due(first, now)
    };
    // The first image of each comes after a period, that of one viewer at once.
    for (millis, expected) in [(0, vec!["a"]), (40, vec!["a", "c"])] {
        let due = leases.take_due_with(now + Duration::from_millis(millis), |_| true, schedule);
        assert_eq!(due.iter().map(|of| of.subscriber.as_str()).collect::<Vec<_>>(), expected);
    }
    assert_eq!((leases.len(), leases.expired), (2, 1));
    let reason = ask(&mut leases, "b", (64, 64), 30.0, now);
    assert!(reason.contains("its schedule cannot be computed: injected"), "{reason}");
    assert_eq!(ask(&mut leases, "a", (64, 64), 30.0, now), "");
}
