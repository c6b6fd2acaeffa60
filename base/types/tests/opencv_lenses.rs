//! Lenses against OpenCV 5.0's `projectPoints` and `fisheye::projectPoints`; its pixels are rounded to 1e-6.
#![allow(clippy::unwrap_used)] // helpers of tests

use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3};

fn check(lens: Lens, focal: [f64; 2], points: &[[f64; 3]], pixels: &[[f64; 2]]) {
    let camera = Camera {
        id: "opencv".into(),
        intrinsics: Intrinsics {
            width: 640,
            height: 480,
            focal_px: DVec2::from(focal),
            center_px: DVec2::new(322.25, 238.5),
            lens,
        },
        camera_from_world: Isometry::IDENTITY,
        time_offset_nanos: 0,
        color: Default::default(),
    };
    for (point, expected) in points.iter().zip(pixels) {
        let (point, expected) = (DVec3::from(*point), DVec2::from(*expected));
        let pixel = camera.project(point).unwrap();
        assert!(pixel.distance(expected) < 2e-6, "{lens:?} {point}: {pixel}, OpenCV {expected}");
        // The inverse is accurate too.
        let ray = camera.ray(expected).unwrap();
        let back = camera.project(ray * 3.0).unwrap();
        assert!(back.distance(expected) < 1e-6 && ray.angle_between(point) < 1e-7, "{lens:?} {point}: {back}");
    }
}

#[test]
fn lenses_agree_with_opencv_out_to_the_corners() {
    let points = [
        [0.0, 0.0, 2.0],
        [0.6, 0.2, 2.0],
        [-1.0, 0.8, 2.0],
        [1.24, 0.92, 2.0],
        [-1.24, -0.92, 2.0],
        [1.24, -0.92, 2.0],
        [0.1, -0.94, 2.0],
        [-0.62, 0.44, 2.0],
    ];
    check(
        Lens::RadialTangential { radial: [-0.25, 0.08, -0.01], tangential: [0.002, -0.001] },
        [510.5, 505.75],
        &points,
        &[
            [322.25, 238.5],
            [471.610559, 287.941614],
            [89.033489, 423.586048],
            [599.809932, 443.341944],
            [44.461364, 35.142938],
            [598.645175, 35.719897],
            [346.283909, 13.847255],
            [169.141235, 346.241113],
        ],
    );
    check(
        Lens::Rational { radial: [0.5, 0.12, 0.01, 0.8, 0.25, 0.02], tangential: [0.002, -0.001] },
        [510.5, 505.75],
        &points,
        &[
            [322.25, 238.5],
            [470.888724, 287.703241],
            [93.215828, 420.271309],
            [592.858832, 438.232663],
            [51.412464, 40.252219],
            [591.694075, 40.829179],
            [346.03319, 16.182085],
            [170.191861, 345.502445],
        ],
    );
    check(
        Lens::Fisheye { coefficients: [0.06, -0.02, 0.004, -0.001] },
        [310.0, 308.0],
        &[[0.0, 0.0, 1.0], [1.0, 0.5, 1.0], [-2.0, 1.0, 1.0], [3.0, -2.0, 1.0], [0.01, 4.0, 1.0], [-1.2, -1.1, 1.0]],
        &[
            [322.25, 238.5],
            [563.291112, 358.243004],
            [-12.815943, 404.952114],
            [676.220859, 4.041883],
            [323.334891, 669.656751],
            [78.89783, 16.866357],
        ],
    );
}
