//! Calibration reaches all subscribers, whenever they start.

use std::time::Duration;

use flyrig_transport::{
    Interests, TransportErrorKind, decode_calibration, decode_transforms, encode_calibration, encode_transforms,
};
use flyrig_types::{Camera, Isometry};
use glam::DVec3;

use crate::support::*;

#[test]
fn late_joiners_get_the_calibration_and_its_changes() {
    let publisher = open_publisher(|_| {});
    publisher.set_calibration(&rig()).unwrap();
    let early = open_subscriber(&publisher, &Interests::default());
    assert_same_rig(&early.rig(PATIENCE).unwrap().expect("the rig"), &rig());
    let late = open_subscriber(&publisher, &Interests::default());
    assert_same_rig(&late.rig(PATIENCE).unwrap().expect("the rig"), &rig());

    let mut moved = rig();
    moved.cameras.pop();
    moved.cameras[0].camera_from_world = Isometry::look_at(DVec3::new(2.0, 0.0, 1.0), DVec3::ZERO, DVec3::Z);
    publisher.set_calibration(&moved).unwrap();
    for subscriber in [&early, &late] {
        wait_until("the new calibration", || {
            subscriber.rig(Duration::ZERO).unwrap().is_some_and(|rig| rig.cameras.len() == moved.cameras.len())
        });
        assert_same_rig(&subscriber.rig(PATIENCE).unwrap().unwrap(), &moved);
    }
}

#[test]
fn every_lens_survives_and_poisoned_cameras_are_refused() {
    for camera in &rig().cameras {
        let (id, intrinsics) = decode_calibration(&encode_calibration(camera).unwrap()).unwrap();
        assert_eq!((id, intrinsics), (camera.id.clone(), camera.intrinsics));
    }
    let places = decode_transforms(&encode_transforms(&rig()).unwrap()).unwrap();
    assert_eq!(places.camera_from_world[0].0.as_str(), "zeta");

    let mut poisoned = rig();
    poisoned.cameras[1].intrinsics.focal_px.x = f64::NAN;
    assert_eq!(encode_calibration(&poisoned.cameras[1]).unwrap_err().kind, TransportErrorKind::Config);
    assert!(encode_transforms(&poisoned).unwrap_err().to_string().contains("camera alpha"));
    let publisher = open_publisher(|_| {});
    assert!(publisher.set_calibration(&poisoned).is_err());
    let mut named = rig();
    named.cameras[0] = Camera { id: "a/b".into(), ..named.cameras[0].clone() };
    assert!(publisher.set_calibration(&named).unwrap_err().to_string().contains("a/b"));
    let mut floating = rig();
    floating.world_up = DVec3::ZERO;
    assert!(encode_transforms(&floating).unwrap_err().to_string().contains("world_up"));
}
