//! Motion from a BVH clip.

#![allow(clippy::unwrap_used)]

mod common;

use common::{simulator, small_config};
use flyrig_sim::{MotionKind, find_debian_clip};

#[test]
fn debians_clip_moves_the_person_over_the_floor_or_its_package_is_named() {
    if let Err(error) = find_debian_clip() {
        assert!(error.to_string().contains("apt-get install assimp-testmodels"), "{error}");
        return;
    }
    let mut config = small_config(1);
    config.motion.kind = MotionKind::Bvh;
    config.motion.start_secs = 1.0;
    let mut simulator = simulator(&config);
    let mut lowest = f32::INFINITY;
    let (start, end) = simulator.track().span_nanos();
    assert!(start == 0 && end > 5_000_000_000, "{start} to {end} ns");
    let farthest = simulator.track().keys().iter().map(|(_, pose)| pose.root_translation.truncate().length());
    let farthest = farthest.fold(0.0, f64::max);
    assert!((0.1..0.5001).contains(&farthest), "walks {farthest} m from the centre");
    for i in 0..12 {
        let mesh = simulator.clothed_surface(end / 12 * i);
        let (low, high) = mesh.positions.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), p| {
            assert!(p.is_finite() && p.truncate().length() < 1.8, "{p}");
            (low.min(p.z), high.max(p.z))
        });
        assert!(high > 1.2 && low < 0.6, "stands between {low} and {high} m");
        lowest = lowest.min(low);
    }
    assert!(lowest.abs() < 0.06, "the lowest sole of the clip is {lowest} m above the floor");
}
