//! Next step of a calibration under way: the boards that are missing.

use flyrig_calib::{BoardShot, BoardView, CalibError, RigFit};
use flyrig_types::CameraId;
use glam::DVec2;

/// Shared boards from which on two cameras are well linked.
pub(super) const WELL_LINKED: usize = 12;
/// Columns and rows of the cells of an image in which corners are counted.
pub(super) const CELLS: [usize; 2] = [8, 6];
/// Number of different boards that a lens needs, and fraction of the image's cells that need corners.
const LENS_BOARDS: usize = 10;
const COVERED: f64 = 0.6;
/// Movement of the corners, as a fraction of the image's width, beyond which a board is a different one.
const MOVED: f64 = 0.03;
/// Parts of an image, by row and column.
const PARTS: [[&str; 3]; 3] = [
    ["at the top left", "at the top", "at the top right"],
    ["at the left", "in the middle", "at the right"],
    ["at the bottom left", "at the bottom", "at the bottom right"],
];

/// State of a calibration under way.
pub struct CalibrationState<'a> {
    pub ids: &'a [CameraId],
    /// Width and height of each camera's images, pixels; `None` without an image.
    pub sizes: &'a [Option<[u32; 2]>],
    /// Different boards, see [`different`].
    pub shots: &'a [BoardShot],
    /// Whether lenses are calibrated from the same boards.
    pub with_lenses: bool,
    /// Result of the last solve.
    pub solved: Option<&'a Result<RigFit, CalibError>>,
    /// Deviation in the middle of the boards that every camera must reach, millimetres.
    pub target_mm: f64,
}

/// Next step of the person with the board. Cameras are given by slot.
#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    /// A camera delivers no image.
    NoImage(usize),
    /// A camera has not seen the board.
    NoBoard(usize),
    /// A camera has seen too few boards for its lens.
    MoreBoards { camera: usize, boards: usize },
    /// A part of a camera's image has no corners.
    Cover { camera: usize, covered: f64, part: &'static str },
    /// All boards of a camera face it.
    Tilt(usize),
    /// Too few boards link two groups of cameras; these two cameras share the most.
    Link { cameras: (usize, usize), shared: usize },
    /// The boards do not determine the poses.
    More,
    /// The pose of a camera is too uncertain; `with` shares the most boards with it.
    Sharpen { camera: usize, with: usize, mm: f64 },
    /// A solve is under way.
    Wait,
    /// Every camera's position is known to this deviation, millimetres.
    Done(f64),
}

impl CalibrationState<'_> {
    /// Returns the first missing step.
    pub fn next(&self) -> Step {
        let slots = || 0..self.ids.len();
        if let Some(slot) = slots().find(|&slot| self.sizes[slot].is_none()) {
            return Step::NoImage(slot);
        }
        if let Some(slot) = slots().find(|&slot| self.boards(slot) == 0) {
            return Step::NoBoard(slot);
        }
        if self.with_lenses {
            if let Some(camera) = slots().filter(|&s| self.boards(s) < LENS_BOARDS).min_by_key(|&s| self.boards(s)) {
                return Step::MoreBoards { camera, boards: self.boards(camera) };
            }
            let worst = slots().map(|slot| (slot, self.covered(slot))).min_by(|a, b| a.1.total_cmp(&b.1));
            if let Some((camera, covered)) = worst.filter(|(_, covered)| *covered < COVERED) {
                return Step::Cover { camera, covered, part: self.emptiest_part(camera) };
            }
        }
        if let Some(link) = self.weakest_link() {
            return link;
        }
        match self.solved {
            None => Step::Wait,
            Some(Err(CalibError::LensOpen { camera } | CalibError::TooFewViews { camera, .. })) => {
                self.ids.iter().position(|id| id == camera).map_or(Step::More, Step::Tilt)
            }
            Some(Err(_)) => Step::More,
            Some(Ok(fit)) => self.sharpen(fit),
        }
    }

    fn sharpen(&self, fit: &RigFit) -> Step {
        let mm = |slot: usize| match (slot, &fit.cameras[slot].uncertainty) {
            // The reference of all others.
            (0, _) => 0.0,
            (_, Some(uncertainty)) => uncertainty.middle_mm,
            (_, None) => f64::INFINITY,
        };
        let worst = (0..fit.cameras.len()).map(|slot| (slot, mm(slot))).max_by(|a, b| a.1.total_cmp(&b.1));
        match worst {
            Some((camera, mm)) if mm > self.target_mm => {
                let others = (0..self.ids.len()).filter(|&other| other != camera);
                let with = others.max_by_key(|&other| self.shared(camera, other)).unwrap_or_default();
                Step::Sharpen { camera, with, mm }
            }
            worst => Step::Done(worst.map_or(0.0, |(_, mm)| mm)),
        }
    }

    /// Returns the number of boards that a camera saw.
    pub fn boards(&self, slot: usize) -> usize {
        self.views(slot).count()
    }

    fn views(&self, slot: usize) -> impl Iterator<Item = &BoardView> {
        self.shots.iter().filter_map(move |shot| view_of(shot, slot))
    }

    /// Formats the deviation of a camera's position, millimetres.
    pub fn known(&self, slot: usize) -> String {
        match self.solved {
            Some(Ok(_)) if slot == 0 => "reference".to_owned(),
            Some(Ok(fit)) => {
                let uncertainty = fit.cameras[slot].uncertainty.as_ref();
                uncertainty.map_or_else(|| "open".to_owned(), |uncertainty| format!("{:.1}", uncertainty.middle_mm))
            }
            _ => "-".to_owned(),
        }
    }

    /// Returns the corners that a camera saw, pixels.
    pub fn corners(&self, slot: usize) -> Vec<DVec2> {
        self.views(slot).flat_map(|view| &view.corners).map(|corner| corner.pixel).collect()
    }

    /// Returns the number of boards that two cameras saw together.
    pub fn shared(&self, a: usize, b: usize) -> usize {
        self.shots.iter().filter(|shot| view_of(shot, a).is_some() && view_of(shot, b).is_some()).count()
    }

    /// Returns the fraction of the cells of a camera's image that have corners, 0..=1.
    pub fn covered(&self, slot: usize) -> f64 {
        let cells = self.cells(slot, CELLS);
        cells.iter().filter(|count| **count > 0).count() as f64 / cells.len() as f64
    }

    /// Counts the corners in each cell of a camera's image, row by row.
    fn cells(&self, slot: usize, [columns, rows]: [usize; 2]) -> Vec<usize> {
        let mut cells = vec![0; columns * rows];
        let Some(size) = self.sizes[slot].map(|[w, h]| DVec2::new(w.into(), h.into())) else { return cells };
        for corner in self.views(slot).flat_map(|view| &view.corners) {
            let at = (corner.pixel / size * DVec2::new(columns as f64, rows as f64)).floor();
            if at.x >= 0.0 && at.y >= 0.0 && at.x < columns as f64 && at.y < rows as f64 {
                cells[at.y as usize * columns + at.x as usize] += 1;
            }
        }
        cells
    }

    /// Returns the part of a camera's image with the most empty cells.
    fn emptiest_part(&self, slot: usize) -> &'static str {
        let mut empty = [[0; 3]; 3];
        for (at, _) in
            self.cells(slot, [3 * CELLS[0], 3 * CELLS[1]]).iter().enumerate().filter(|(_, count)| **count == 0)
        {
            let (column, row) = (at % (3 * CELLS[0]), at / (3 * CELLS[0]));
            empty[row / CELLS[1]][column / CELLS[0]] += 1;
        }
        let parts = (0..9).map(|part| (part / 3, part % 3));
        parts.max_by_key(|&(row, column)| empty[row][column]).map_or("at the edges", |(row, column)| PARTS[row][column])
    }

    /// Links the cameras by their strongest pairs, and returns the pair that shares too few boards, if any.
    fn weakest_link(&self) -> Option<Step> {
        let mut joined = vec![0];
        while joined.len() < self.ids.len() {
            let open: Vec<usize> = (0..self.ids.len()).filter(|slot| !joined.contains(slot)).collect();
            let pairs = joined.iter().flat_map(|&a| open.iter().map(move |&b| (a, b)));
            let (a, b) = pairs.max_by_key(|&(a, b)| self.shared(a, b))?;
            let shared = self.shared(a, b);
            if shared < WELL_LINKED {
                return Some(Step::Link { cameras: (a, b), shared });
            }
            joined.push(b);
        }
        None
    }
}

impl Step {
    /// Returns the instruction for the person with the board.
    pub fn sentence(&self, ids: &[CameraId], target_mm: f64) -> String {
        match *self {
            Self::NoImage(slot) => {
                format!("camera {} gives no image: flyrig doctor says what is wrong with it", ids[slot])
            }
            Self::NoBoard(slot) => format!("show the board to camera {}, which has not seen it", ids[slot]),
            Self::MoreBoards { camera, boards } => format!(
                "camera {} has seen {boards} of {LENS_BOARDS} boards: show it near and far, turned to all sides",
                ids[camera]
            ),
            Self::Cover { camera, covered, part } => format!(
                "camera {} has seen the board in {:.0} % of its image: show it {part}, close to the camera",
                ids[camera],
                100.0 * covered
            ),
            Self::Tilt(slot) => format!("tilt the board before camera {} by 30 to 45 degrees, to all sides", ids[slot]),
            Self::Link { cameras: (a, b), shared } => format!(
                "{} and {} share {shared} of {WELL_LINKED} boards: show the board where both see it, low and tilted",
                ids[a], ids[b]
            ),
            Self::More => "the boards leave the poses open: show the board in more places and tilts".to_owned(),
            Self::Sharpen { camera, with, mm } if mm.is_finite() => format!(
                "camera {} is known to {mm:.1} mm, and {target_mm} are wanted: show the board where {} and {} see it, in other places and tilts",
                ids[camera], ids[camera], ids[with]
            ),
            Self::Sharpen { camera, with, .. } => format!(
                "the boards leave camera {} open: show the board where {} and {} see it, in other places and tilts",
                ids[camera], ids[camera], ids[with]
            ),
            Self::Wait => "go on showing the board; the cameras are being placed".to_owned(),
            Self::Done(mm) => format!("done: every camera is known to {mm:.1} mm"),
        }
    }
}

fn view_of(shot: &BoardShot, slot: usize) -> Option<&BoardView> {
    shot.views.iter().find(|view| view.camera == slot)
}

/// Appends to `kept` the shots after `from` whose board has moved since the last kept one of the same camera.
pub fn different(shots: &[BoardShot], from: usize, sizes: &[Option<[u32; 2]>], kept: &mut Vec<BoardShot>) {
    for shot in shots.iter().skip(from) {
        let is_new = |view: &BoardView| {
            let Some(last) = kept.iter().rev().find_map(|shot| view_of(shot, view.camera)) else { return true };
            let width = sizes.get(view.camera).copied().flatten().map_or(1.0, |[width, _]| f64::from(width));
            let common = view.corners.iter().filter_map(|corner| {
                let before = last.corners.iter().find(|before| before.index == corner.index)?;
                Some(before.pixel.distance(corner.pixel))
            });
            let (sum, count) = common.fold((0.0, 0), |(sum, count), moved| (sum + moved, count + 1));
            count == 0 || sum > MOVED * width * f64::from(count)
        };
        if shot.views.iter().any(is_new) {
            kept.push(shot.clone());
        }
    }
}

#[cfg(test)]
mod tests {
    use flyrig_calib::SeenCorner;

    use super::*;

    const SIZE: [u32; 2] = [640, 480];

    fn ids(count: usize) -> Vec<CameraId> {
        (0..count).map(|slot| CameraId::from(format!("{slot:02}"))).collect()
    }

    /// Returns a shot of a board with 24 corners, 100 pixels wide, at a position in the cameras' images.
    fn shot(cameras: &[usize], at: [f64; 2]) -> BoardShot {
        let corner = |index: usize| SeenCorner {
            index,
            pixel: DVec2::from(at) + 20.0 * DVec2::new((index % 6) as f64, (index / 6) as f64),
        };
        let view = |&camera: &usize| BoardView { camera, nanos: 0, corners: (0..24).map(corner).collect() };
        BoardShot { nanos: 0, views: cameras.iter().map(view).collect() }
    }

    /// Returns shots of boards all over the images of some cameras.
    fn everywhere(cameras: &[usize]) -> Vec<BoardShot> {
        let at = |i: usize| [(i % 6) as f64 * 105.0, (i / 6) as f64 * 95.0];
        (0..30).map(|i| shot(cameras, at(i))).collect()
    }

    fn next(
        shots: &[BoardShot],
        sizes: &[Option<[u32; 2]>],
        solved: Option<&Result<RigFit, CalibError>>,
    ) -> (Step, String) {
        let ids = ids(sizes.len());
        let progress = CalibrationState { ids: &ids, sizes, shots, with_lenses: true, solved, target_mm: 2.0 };
        let step = progress.next();
        let sentence = step.sentence(&ids, 2.0);
        (step, sentence)
    }

    #[test]
    fn the_first_thing_that_is_missing_is_asked_for() {
        let sizes = [Some(SIZE); 3];
        assert_eq!(next(&[], &[Some(SIZE), None], None).0, Step::NoImage(1));
        assert_eq!(next(&[shot(&[0, 2], [0.0; 2])], &sizes, None).0, Step::NoBoard(1));
        let (step, sentence) = next(&[shot(&[0, 1, 2], [0.0; 2])], &sizes, None);
        assert_eq!(step, Step::MoreBoards { camera: 0, boards: 1 });
        assert!(sentence.contains("camera 00 has seen 1 of 10 boards"), "{sentence}");
        // Camera 2 saw boards only at the left.
        let mut shots = everywhere(&[0, 1]);
        shots.extend((0..12).map(|i| shot(&[2], [0.0, f64::from(i) * 33.0])));
        let (step, sentence) = next(&shots, &sizes, None);
        assert!(
            matches!(
                step,
                Step::Cover { camera: 2, part: "at the right" | "at the top right" | "at the bottom right", .. }
            ),
            "{sentence}"
        );
        // Cameras 0 and 1 are linked, 2 shares three boards with 1.
        let mut shots = everywhere(&[0, 1]);
        shots.extend(everywhere(&[2]));
        shots.extend((0..3).map(|i| shot(&[1, 2], [f64::from(i) * 100.0, 50.0])));
        let (step, sentence) = next(&shots, &sizes, None);
        assert_eq!(step, Step::Link { cameras: (1, 2), shared: 3 });
        assert!(sentence.starts_with("01 and 02 share 3 of 12 boards"), "{sentence}");
    }

    #[test]
    fn results_of_a_solve_decide_at_the_end() {
        let (shots, sizes) = (everywhere(&[0, 1]), [Some(SIZE); 2]);
        assert_eq!(next(&shots, &sizes, None).0, Step::Wait);
        let open = Err(CalibError::LensOpen { camera: "01".into() });
        assert_eq!(next(&shots, &sizes, Some(&open)).0, Step::Tilt(1));
        assert_eq!(next(&shots, &sizes, Some(&Err(CalibError::RigOpen))).0, Step::More);
    }

    #[test]
    fn a_board_that_stands_still_counts_once() {
        let sizes = [Some(SIZE); 2];
        let shots = [
            shot(&[0], [10.0; 2]),
            shot(&[0], [12.0; 2]),
            shot(&[0, 1], [12.0; 2]),
            shot(&[0], [60.0; 2]),
            shot(&[1], [12.0; 2]),
        ];
        let mut kept = Vec::new();
        different(&shots, 0, &sizes, &mut kept);
        assert_eq!(kept, [shots[0].clone(), shots[2].clone(), shots[3].clone()]);
        different(&shots, 3, &sizes, &mut kept);
        assert_eq!(kept.len(), 3, "nothing new");
    }
}
