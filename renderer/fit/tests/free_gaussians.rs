//! A fit of Gaussians that nothing holds together: the simplest model.

#![allow(clippy::unwrap_used)]

use flyrig_fit::{Element, ErrorWeights, Fit, FitError, FitSettings, Model, Step, TrainingView};
use flyrig_gpu::{GpuContext, testing::on_both};
use flyrig_learn::ColumnAdam;
use flyrig_renderer::{AnisotropicBuffers, HarmonicOrder, ViewPainter};
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DVec3, Vec3};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

const SIZE: u32 = 64;
const COUNT: usize = 40;

/// Gaussians with these lists: centres, scales with opacities, rotations, colours.
#[derive(Clone, PartialEq, Debug)]
struct Lists([Vec<Element>; 4]);

/// Model whose parameters are the lists themselves.
struct Free {
    lists: Lists,
    moments: [ColumnAdam<4>; 4],
    /// Derivatives of the last step.
    slopes: Vec<Vec<Element>>,
    frames: usize,
}

impl Free {
    fn new(lists: Lists, frames: usize) -> Self {
        let moments = lists.0.each_ref().map(|list| ColumnAdam::new(list.len()));
        Self { lists, moments, slopes: Vec::new(), frames }
    }
}

impl Model for Free {
    fn gaussians(&self) -> usize {
        self.lists.0[0].len()
    }

    fn order(&self) -> HarmonicOrder {
        HarmonicOrder::Zero
    }

    fn frames(&self) -> usize {
        self.frames
    }

    fn place(&mut self, _: usize, _: Vec3) -> [&[Element]; 4] {
        self.lists.0.each_ref().map(Vec::as_slice)
    }

    fn descend(&mut self, _: usize, slopes: &mut [Vec<Element>], step: Step) {
        self.slopes = slopes.to_vec();
        let rates = [[5e-3, 5e-3, 5e-3, 0.0], [0.0; 4], [0.0; 4], [1e-2, 1e-2, 1e-2, 0.0]];
        for (list, rates) in rates.into_iter().enumerate() {
            self.moments[list].descend(step.count, rates, &mut self.lists.0[list], &slopes[list]);
        }
    }

    fn state(&mut self) -> Vec<(String, &mut [f32])> {
        let lists = self.lists.0.iter_mut().enumerate().map(|(i, list)| (format!("list.{i}"), list.as_flattened_mut()));
        let moments = self.moments.iter_mut().enumerate().flat_map(|(i, adam)| {
            let [first, second] = adam.lists_mut();
            [(format!("first.{i}"), first.as_flattened_mut()), (format!("second.{i}"), second.as_flattened_mut())]
        });
        lists.chain(moments).collect()
    }

    fn restore(&mut self, _: u64) {}
}

/// Draws Gaussians of random places and colours in a ball around the origin.
fn random(seed: u64) -> Lists {
    let mut random = StdRng::seed_from_u64(seed);
    let mut lists = Lists(Default::default());
    for _ in 0..COUNT {
        let mut number = |low: f32, high: f32| random.random_range(low..high);
        let rows = [
            [number(-0.4, 0.4), number(-0.4, 0.4), number(-0.4, 0.4), 0.0],
            [number(0.05, 0.1), number(0.05, 0.1), number(0.05, 0.1), number(0.5, 0.9)],
            [number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0), number(0.5, 1.0)],
            [number(0.1, 0.8), number(0.1, 0.8), number(0.1, 0.8), 0.0],
        ];
        lists.0.iter_mut().zip(rows).for_each(|(list, row)| list.push(row));
        let rotation = &mut lists.0[2];
        let last = rotation.len() - 1;
        rotation[last] = glam::Quat::from_array(rotation[last]).normalize().to_array();
    }
    lists
}

fn camera(eye: DVec3) -> Camera {
    Camera {
        id: "view".into(),
        intrinsics: Intrinsics::pinhole(SIZE, SIZE, 80.0),
        camera_from_world: Isometry::look_at(eye, DVec3::ZERO, DVec3::Y),
        time_offset_nanos: 0,
        color: Default::default(),
    }
}

/// Photographs of Gaussians from three sides.
fn views(gpu: &GpuContext, lists: &Lists) -> Vec<TrainingView> {
    let count = lists.0[0].len();
    let buffers = AnisotropicBuffers::zeroed(gpu, count, HarmonicOrder::Zero).unwrap();
    let [center, scale, rotation, color] = &lists.0;
    buffers.center.write(gpu, center);
    buffers.scale_opacity.write(gpu, scale);
    buffers.rotation.write(gpu, rotation);
    buffers.harmonics.write(gpu, color);
    let mut painter = ViewPainter::new(gpu, count).unwrap();
    [DVec3::new(0.0, 0.3, 2.0), DVec3::new(1.8, 0.0, -0.6), DVec3::new(-1.5, -0.4, -1.2)]
        .into_iter()
        .map(|eye| {
            let view = painter.draw(&buffers, &camera(eye)).unwrap();
            TrainingView::cut(0, &camera(eye), &view.rgba).unwrap()
        })
        .collect()
}

/// Returns Gaussians that lie beside the true ones and are grey.
fn start(truth: &Lists) -> Lists {
    let mut lists = truth.clone();
    lists.0[0].iter_mut().for_each(|row| row[0] += 0.03);
    lists.0[3].fill([0.4, 0.4, 0.4, 0.0]);
    lists
}

#[test]
fn gaussians_find_their_images_and_the_same_steps_give_the_same_numbers() {
    on_both(|gpu| {
        let truth = random(5);
        let views = views(gpu, &truth);
        let run = |steps: u32| {
            let model = Free::new(start(&truth), 1);
            let mut fit = Fit::new(gpu, model, views.clone(), FitSettings::default()).unwrap();
            let before = fit.decibels().unwrap();
            for step in 0..steps {
                fit.step(step as f32 / steps as f32).unwrap();
            }
            assert_eq!((fit.steps(), fit.images()), (u64::from(steps), 3));
            (before, fit.decibels().unwrap(), fit.into_model().lists)
        };
        let (before, after, _) = run(150);
        assert!(after > before + 6.0, "{before} {after}");
        assert_eq!(run(9).2, run(9).2);
    });
}

#[test]
fn models_are_given_the_derivatives_of_the_reported_loss() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let mut truth = random(6);
    // A wall behind them: pixels at an outline are compared by coverage alone, and their loss has no derivative by colour.
    for (list, row) in truth.0.iter_mut().zip([
        [0.0, 0.0, -1.5, 0.0],
        [2.0, 2.0, 0.1, 0.999],
        [0.0, 0.0, 0.0, 1.0],
        [0.3, 0.5, 0.4, 0.0],
    ]) {
        list.push(row);
    }
    let views = views(&gpu, &truth)[..1].to_vec();
    // Similarity is smooth; distances are not where images agree.
    let weights = ErrorWeights { color: 0.0, structure: 1.0, coverage: 0.0, sharpness: 0.0 };
    let loss = |lists: Lists| {
        let settings = FitSettings { weights, ..FitSettings::default() };
        let mut fit = Fit::new(&gpu, Free::new(lists, 1), views.clone(), settings).unwrap();
        let loss = fit.step(0.0).unwrap().loss;
        (loss, fit.into_model().slopes)
    };
    let mut lists = truth.clone();
    lists.0[0].iter_mut().take(COUNT).for_each(|center| center[0] += 0.03);
    lists.0[3].iter_mut().take(COUNT).for_each(|color| *color = color.map(|channel| 0.2 + 0.5 * channel));
    let slopes = loss(lists.clone()).1;
    for (list, step) in [(0, 1e-3f32), (1, 1e-3), (3, 2e-2)] {
        let (mut worst, mut most) = (0.0f64, 0.0f64);
        for i in (0..COUNT).step_by(5) {
            for (k, found) in slopes[list][i].into_iter().enumerate().take(3) {
                let at = |by: f32| {
                    let mut moved = lists.clone();
                    moved.0[list][i][k] += by;
                    loss(moved).0
                };
                let expected = (at(step) - at(-step)) / f64::from(2.0 * step);
                worst = worst.max((expected - f64::from(found)).abs());
                most = most.max(expected.abs());
            }
        }
        // The loss jumps where a Gaussian's edge, cut off at an opacity of 1/255, reaches another pixel.
        assert!(most > 0.01 && worst < 0.1 * most, "list {list}: off by {worst} of up to {most}");
    }
}

#[test]
fn a_resumed_fit_ends_as_one_that_was_not_stopped_and_foreign_states_change_nothing() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let truth = random(7);
    let views = views(&gpu, &truth);
    let begin = || Fit::new(&gpu, Free::new(start(&truth), 1), views.clone(), FitSettings::default()).unwrap();
    let run = |fit: &mut Fit<Free>, steps: std::ops::Range<u32>| {
        for step in steps {
            fit.step(step as f32 / 20.0).unwrap();
        }
    };
    let mut whole = begin();
    run(&mut whole, 0..20);
    let mut killed = begin();
    run(&mut killed, 0..11);
    let state = killed.checkpoint("a take", 20).unwrap();
    let mut resumed = begin();
    let progress = resumed.resume(&state, "a take").unwrap();
    assert_eq!((progress.done, progress.total, resumed.steps()), (11, 20, 11));
    run(&mut resumed, 11..20);
    assert_eq!(whole.into_model().lists, resumed.into_model().lists);

    let mut other = begin();
    assert!(other.resume(&state, "another").unwrap_err().contains("another take"));
    assert!(other.resume(b"", "a take").unwrap_err().contains("no state"));
    assert!(other.resume(&state[..state.len() / 2], "a take").unwrap_err().contains("no state"));
    let smaller = Free::new(Lists(truth.0.clone().map(|list| list[..COUNT / 2].to_vec())), 1);
    let mut smaller = Fit::new(&gpu, smaller, views.clone(), FitSettings::default()).unwrap();
    assert!(smaller.resume(&state, "a take").unwrap_err().contains("is damaged"));
    assert_eq!(other.into_model().lists, start(&truth));
}

#[test]
fn images_that_show_nobody_and_frames_that_are_missing_are_refused() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let camera = camera(DVec3::new(0.0, 0.0, 2.0));
    let all = vec![255; SIZE as usize * SIZE as usize * 4];
    assert!(TrainingView::cut(0, &camera, &[]).is_none());
    assert!(TrainingView::cut(0, &camera, &vec![0; all.len()]).is_none());
    let refused =
        |views: Vec<TrainingView>| match Fit::new(&gpu, Free::new(random(8), 3), views, FitSettings::default()) {
            Err(FitError::Images(text)) => text,
            _ => panic!("not refused"),
        };
    assert!(refused(Vec::new()).contains("no person is in any image"));
    assert!(refused(vec![TrainingView::cut(3, &camera, &all).unwrap()]).contains("without a pose"));
}

#[test]
fn poison_in_the_model_is_no_poison_in_the_report() {
    let gpu = flyrig_gpu::testing::device().on_processor();
    let truth = random(9);
    let mut broken = start(&truth);
    broken.0[0][3] = [f32::NAN; 4];
    broken.0[1][4] = [f32::INFINITY; 4];
    broken.0[3][5] = [f32::NAN; 4];
    let mut fit = Fit::new(&gpu, Free::new(broken, 1), views(&gpu, &truth), FitSettings::default()).unwrap();
    for _ in 0..4 {
        assert!(fit.step(f32::NAN).unwrap().loss.is_finite());
    }
    let sound = |(i, row): (usize, &Element)| i == 3 || row.iter().all(|value| value.is_finite());
    assert!(fit.into_model().lists.0[0].iter().enumerate().all(sound), "the others go on");
}

/// Model of one flat Gaussian for each of 20 x 20 places on a wall that faces z, whose surface is drawn 4 mm before its centres.
struct Wall(Free);

const BELOW_M: f32 = 0.004;

impl Wall {
    fn new(z: f32) -> Self {
        let mut lists = Lists(Default::default());
        for at in 0..400 {
            let [x, y] = [at % 20, at / 20].map(|k| 0.05 * (k as f32 - 9.5));
            let turned = glam::Quat::from_rotation_y(0.2);
            for (list, row) in lists.0.iter_mut().zip([
                [x, y, z, 0.0],
                [0.04, 0.04, 0.002, 0.9],
                turned.to_array(),
                [0.5, 0.4, 0.3, 0.0],
            ]) {
                list.push(row);
            }
        }
        Self(Free::new(lists, 1))
    }
}

impl Model for Wall {
    fn gaussians(&self) -> usize {
        self.0.gaussians()
    }

    fn order(&self) -> HarmonicOrder {
        HarmonicOrder::Zero
    }

    fn frames(&self) -> usize {
        1
    }

    fn place(&mut self, frame: usize, eye: Vec3) -> [&[Element]; 4] {
        self.0.place(frame, eye)
    }

    fn below_surface_m(&self) -> f32 {
        BELOW_M
    }

    fn descend(&mut self, _: usize, slopes: &mut [Vec<Element>], step: Step) {
        let rate = 2e-3 * (1.0 - step.progress);
        let rates = [[rate; 4], [0.0; 4], [5.0 * rate; 4], [0.0; 4]];
        for (list, rates) in rates.into_iter().enumerate() {
            self.0.moments[list].descend(step.count, rates, &mut self.0.lists.0[list], &slopes[list]);
        }
    }

    fn state(&mut self) -> Vec<(String, &mut [f32])> {
        self.0.state()
    }

    fn restore(&mut self, count: u64) {
        self.0.restore(count);
    }
}

#[test]
fn a_wall_moves_to_where_depths_show_it_and_turns_as_they_do() {
    on_both(|gpu| {
        let camera = camera(DVec3::new(0.0, 0.0, 2.0));
        let whole = vec![200; SIZE as usize * SIZE as usize * 4];
        let view = TrainingView::cut(0, &camera, &whole).unwrap();
        // The wall's surface at z = 0.03, 2 m from the camera but for that.
        let depths = vec![1.97; SIZE as usize * SIZE as usize];
        let with = view.clone().with_depths(&depths);
        assert!(with.has_surface() && !view.clone().with_depths(&depths[1..]).has_surface());
        assert!(!view.clone().with_depths(&vec![f32::NAN; depths.len()]).has_surface());
        let run = |view: TrainingView| {
            let mut fit = Fit::new(gpu, Wall::new(0.0), vec![view], FitSettings::default()).unwrap();
            let reports: Vec<_> = (0..80).map(|step| fit.step(step as f32 / 80.0).unwrap()).collect();
            (reports[0].depth_m, reports[79].depth_m, fit.into_model().0.lists)
        };
        let (first, last, lists) = run(with);
        assert!((first.unwrap() - 0.026).abs() < 6e-3 && last.unwrap() < 2e-3, "{first:?} {last:?}");
        let inside = |row: &&Element| row[0].abs() < 0.3 && row[1].abs() < 0.3;
        // Hidden ones lag behind: most of them have arrived.
        let mut places: Vec<f32> = lists.0[0].iter().filter(inside).map(|row| row[2] + BELOW_M).collect();
        places.sort_by(f32::total_cmp);
        let middle = places[places.len() / 2];
        assert!((middle - 0.03).abs() < 6e-3, "{middle}");
        let rows = lists.0[2].iter().zip(&lists.0[0]).filter(|(_, center)| inside(center));
        let normals: Vec<Vec3> = rows.map(|(turn, _)| glam::Quat::from_array(*turn).normalize() * Vec3::Z).collect();
        let cosine = normals.iter().map(|normal| normal.z.abs()).sum::<f32>() / normals.len() as f32;
        assert!(cosine > 0.988, "{cosine}: 0.98 at the start");
        let (first, last, without) = run(view);
        assert_eq!((first, last), (None, None));
        let still = without.0[0].iter().filter(inside).all(|row| row[2].abs() < 0.02);
        assert!(still, "depths alone move the wall");
    });
}
