//! Board corners as seen by a simulated ring of cameras.

use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3};

use crate::board::Board;
use crate::bundle::{BoardShot, BoardView};
use crate::detect::SeenCorner;

/// Size of every image, pixels.
const SIZE: [u32; 2] = [1280, 720];

/// Repeatable random numbers.
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    /// Returns a number in 0..1.
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a number between two others.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Returns a sample of the standard normal distribution.
    pub fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// Returns three samples of [`Self::normal`].
    pub fn vector(&mut self) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal())
    }
}

fn intrinsics(random: &mut Random) -> Intrinsics {
    Intrinsics {
        width: SIZE[0],
        height: SIZE[1],
        focal_px: DVec2::new(random.between(850.0, 1000.0), 0.0) + DVec2::Y * random.between(850.0, 1000.0),
        center_px: DVec2::new(639.5, 359.5) + DVec2::new(random.normal(), random.normal()) * 8.0,
        lens: Lens::RadialTangential { radial: [random.between(-0.3, -0.1), 0.08, 0.0], tangential: [0.0008, -0.0006] },
    }
}

/// Places cameras on a ring of 3.2 m that face its centre, z up.
#[must_use]
pub fn ring(random: &mut Random, count: usize) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let angle = std::f64::consts::TAU * i as f64 / count as f64 + 0.1 * random.normal();
            let eye = DVec3::new(3.2 * angle.cos(), 3.2 * angle.sin(), random.between(1.2, 2.4));
            Camera {
                time_offset_nanos: 0,
                color: Default::default(),
                id: format!("{i:02}").into(),
                intrinsics: intrinsics(random),
                camera_from_world: Isometry::look_at(eye, DVec3::Z * 0.8 + random.vector() * 0.1, DVec3::Z),
            }
        })
        .collect()
}

/// Projects a board at `world_from_board` into the image of a camera, with noise; `None` from behind, from the edge,
/// and outside the image.
#[must_use]
pub fn view(
    random: &mut Random,
    board: &Board,
    camera: &Camera,
    slot: usize,
    world_from_board: &Isometry,
    noise_px: f64,
) -> Option<BoardView> {
    bent_view(random, (board, 0.0), camera, slot, world_from_board, noise_px)
}

/// Projects as [`view`] a board whose left and right edges lie this many metres behind its middle, on a parabola.
fn bent_view(
    random: &mut Random,
    (board, bend_m): (&Board, f64),
    camera: &Camera,
    slot: usize,
    world_from_board: &Isometry,
    noise_px: f64,
) -> Option<BoardView> {
    let normal = world_from_board.rotation * DVec3::Z;
    let sight = world_from_board.transform_point(board.middle()) - camera.position();
    if normal.dot(sight.normalize()) < 0.25 {
        return None;
    }
    let inside = |p: DVec2| p.x > 5.0 && p.y > 5.0 && p.x < f64::from(SIZE[0]) - 6.0 && p.y < f64::from(SIZE[1]) - 6.0;
    let corners: Vec<SeenCorner> = (0..board.corner_count())
        .filter_map(|index| {
            let (corner, middle) = (board.corner(index), board.middle());
            let bent = corner + DVec3::Z * bend_m * ((corner.x - middle.x) / middle.x).powi(2);
            let pixel = camera.project(world_from_board.transform_point(bent))?;
            let pixel = pixel + DVec2::new(random.normal(), random.normal()) * noise_px;
            inside(pixel).then_some(SeenCorner { index, pixel })
        })
        .collect();
    (corners.len() == board.corner_count()).then_some(BoardView { camera: slot, nanos: 0, corners })
}

/// Returns a random pose around the ring's centre.
fn board_pose(random: &mut Random, board: &Board) -> Isometry {
    let rotation = DQuat::from_scaled_axis(random.vector().normalize() * random.between(0.0, 3.1));
    let middle = DVec3::new(random.normal(), random.normal(), random.normal() + 2.3) * 0.35;
    Isometry::new(rotation, middle - rotation * board.middle())
}

/// Simulates shots of random boards that at least two cameras see.
#[must_use]
pub fn shots(random: &mut Random, board: &Board, cameras: &[Camera], count: usize, noise_px: f64) -> Vec<BoardShot> {
    bent_shots(random, (board, 0.0), cameras, count, noise_px)
}

/// Simulates as [`shots`] a board whose left and right edges lie this many metres behind its middle.
#[must_use]
pub fn bent_shots(
    random: &mut Random,
    (board, bend_m): (&Board, f64),
    cameras: &[Camera],
    count: usize,
    noise_px: f64,
) -> Vec<BoardShot> {
    let mut shots = Vec::new();
    while shots.len() < count {
        let pose = board_pose(random, board);
        let nanos = shots.len() as i64 * 1_000_000_000;
        let mut views: Vec<BoardView> = cameras
            .iter()
            .enumerate()
            .filter_map(|(slot, camera)| bent_view(random, (board, bend_m), camera, slot, &pose, noise_px))
            .collect();
        views.iter_mut().for_each(|view| view.nanos = nanos);
        if views.len() > 1 {
            shots.push(BoardShot { nanos, views });
        }
    }
    shots
}

/// Returns the errors of orientation (degrees) and position (millimetres) of each camera relative to the first one.
#[must_use]
pub fn pose_errors(found: &[Camera], truth: &[Camera]) -> Vec<(f64, f64)> {
    let relative = |cameras: &[Camera], i: usize| {
        let (first, other) = (cameras[0].camera_from_world, cameras[i].camera_from_world);
        let rotation = other.rotation * first.rotation.inverse();
        (rotation, first.transform_point(cameras[i].position()))
    };
    (1..truth.len())
        .map(|i| {
            let ((ra, pa), (rb, pb)) = (relative(found, i), relative(truth, i));
            (ra.angle_between(rb).to_degrees(), 1e3 * pa.distance(pb))
        })
        .collect()
}
