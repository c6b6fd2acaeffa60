//! Sessions on loopback, made-up messages, waiting with an end.

use std::{
    net::TcpListener,
    sync::atomic::{AtomicU32, Ordering},
    time::{Duration, Instant},
};

use flyrig_model::SplitMix64;
use flyrig_transport::{
    ImageFormat, Interests, Publisher, Received, SplatState, Subscriber, TransportConfig, ViewFrame, Views,
};
use flyrig_types::{Camera, Intrinsics, Isometry, Lens, Rig};
use glam::{DVec2, DVec3};

/// No wait of a test is longer.
pub const PATIENCE: Duration = Duration::from_secs(90);

/// Time between two looks.
pub const TURN: Duration = Duration::from_millis(5);

/// Asks again until `ready` says something.
pub fn wait_for<T>(what: &str, mut ready: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + PATIENCE;
    loop {
        if let Some(value) = ready() {
            return value;
        }
        assert!(Instant::now() < end, "waited in vain for {what}");
        std::thread::sleep(TURN);
    }
}

pub fn wait_until(what: &str, mut ready: impl FnMut() -> bool) {
    wait_for(what, || ready().then_some(()));
}

/// Waits as [`wait_until`]; returns the time by the turns that this thread had. A machine that pauses or is busy has fewer of them.
pub fn turns_until(what: &str, mut ready: impl FnMut() -> bool) -> Duration {
    let mut turns = 0;
    wait_until(what, || {
        turns += 1;
        ready()
    });
    turns * TURN
}

/// Waits until what is counted has been the same at forty looks: nothing is on its way any more.
pub fn wait_until_settled<T: PartialEq>(what: &str, mut count: impl FnMut() -> T) {
    let (mut last, mut looks) = (count(), 0);
    wait_until(what, || {
        let now = count();
        looks = if now == last { looks + 1 } else { 0 };
        last = now;
        looks >= 40
    });
}

/// Returns a port that is free, as is its successor, and that no other test gets. The system gives those from 32768 on to whoever asks for any.
pub fn free_port() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    wait_for("two free ports", || {
        // Tests of other processes begin at other ports.
        let turn = std::process::id().wrapping_mul(97).wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed));
        let port = (20_000 + 2 * (turn % 6000)) as u16;
        [port, port + 1].iter().all(|port| TcpListener::bind(("0.0.0.0", *port)).is_ok()).then_some(port)
    })
}

pub fn free_endpoint() -> String {
    format!("tcp/127.0.0.1:{}", free_port())
}

pub fn open_publisher(change: impl FnOnce(&mut TransportConfig)) -> Publisher {
    let mut config = TransportConfig { listen: vec!["tcp/127.0.0.1:0".into()], ..TransportConfig::publisher("test") };
    change(&mut config);
    // The port of one that was closed may be free a moment later.
    wait_for("a publisher", || Publisher::open(&config).inspect_err(|error| println!("{error}")).ok())
}

pub fn subscriber_config(endpoints: &[String]) -> TransportConfig {
    TransportConfig { connect: endpoints.to_vec(), ..TransportConfig::subscriber("test") }
}

pub fn open_subscriber(publisher: &Publisher, interests: &Interests) -> Subscriber {
    Subscriber::open(&subscriber_config(publisher.endpoints()), interests).unwrap()
}

pub fn all_views() -> Interests {
    Interests { views: Views::All, ..Interests::default() }
}

pub fn view(frame: u64, len: usize) -> ViewFrame {
    ViewFrame {
        width: 64,
        height: 48,
        format: ImageFormat::Jpeg,
        bytes: vec![frame as u8; len].into(),
        frame,
        capture_nanos: 1_000_000 * frame as i64,
    }
}

pub fn splats(frame: u64, count: usize) -> SplatState {
    let mut random = SplitMix64(frame + 1);
    let mut unit = || (random.next_u64() >> 40) as f32 / (1u64 << 24) as f32;
    let mut vector = |low: f32, high: f32| -> [f32; 4] { std::array::from_fn(|_| low + (high - low) * unit()) };
    let center_scale = (0..count).map(|_| vector(-1.0, 1.0).map(f32::abs)).collect();
    let color = (0..count).map(|_| vector(0.0, 1.0)).collect();
    SplatState { person: 0, frame, capture_nanos: -7, center_scale, color, invalid: 0 }
}

/// Publishes frames of one view, with growing numbers, until the subscriber has one of them.
pub fn publish_until_seen(
    publisher: &Publisher,
    subscriber: &Subscriber,
    name: &str,
    frame: &mut u64,
) -> Received<ViewFrame> {
    wait_for(&format!("an image of {name}"), || {
        *frame += 1;
        publisher.publish_view(name, view(*frame, 5000)).unwrap();
        subscriber.next_view(Duration::from_millis(20)).unwrap().filter(|received| received.topic == name)
    })
}

pub fn camera(name: &str, lens: Lens) -> Camera {
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics: Intrinsics {
            width: 640,
            height: 480,
            focal_px: DVec2::new(500.25, 510.5),
            center_px: DVec2::new(319.5, 240.125),
            lens,
        },
        camera_from_world: Isometry::look_at(DVec3::new(0.3, -3.0, 1.2), DVec3::new(0.0, 0.1, 1.0), DVec3::Z),
    }
}

pub fn rig() -> Rig {
    let brown = Lens::RadialTangential { radial: [-0.3, 0.1, -0.02], tangential: [0.001, -0.002] };
    let rational = Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] };
    let fisheye = Lens::Fisheye { coefficients: [0.05, -0.01, 0.002, -0.0005] };
    Rig {
        cameras: vec![camera("zeta", brown), camera("alpha", fisheye), camera("mid", rational)],
        world_up: DVec3::new(0.1, -0.9, 0.2).normalize(),
    }
}

/// Asserts equal cameras in equal order, up to rounding of the inverse matrices.
pub fn assert_same_rig(a: &Rig, b: &Rig) {
    assert!((a.world_up - b.world_up).length() < 1e-12, "{} {}", a.world_up, b.world_up);
    assert_eq!(a.cameras.len(), b.cameras.len());
    for (a, b) in a.cameras.iter().zip(&b.cameras) {
        assert_eq!((&a.id, a.intrinsics), (&b.id, b.intrinsics));
        let between = a.camera_from_world * b.camera_from_world.inverse();
        assert!(between.translation.length() < 1e-9 && between.rotation.w.abs() > 1.0 - 1e-12, "{between:?}");
    }
}

pub fn random_bytes(random: &mut SplitMix64, len: usize) -> Vec<u8> {
    (0..len).map(|_| random.next_u64() as u8).collect()
}
