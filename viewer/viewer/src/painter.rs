//! Painter: draws the people on a thread of its own, so that the window responds at once.

use std::{
    sync::{Arc, Condvar, Mutex, MutexGuard},
    time::{Duration, Instant},
};

use flyrig_gpu::GpuContext;
use flyrig_renderer::composite_over;
use flyrig_stream::{Posed, PosedAxes, Stamp};
use flyrig_types::{Camera, Rig, SupervisedThread, ThreadHealth, lock, wait};
use flyrig_viewing::{Floor, StreamPerson};
use glam::DVec3;

use crate::{
    receiver::{Receiver, clock_secs},
    scene::PeopleScene,
    shown_person::ShownPerson,
};

/// Grey of the background, sRGB.
const BACKDROP: u8 = 30;

/// View to draw.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Request {
    pub camera: Camera,
    pub interpolate: bool,
}

/// View that was drawn.
#[derive(Debug)]
pub(crate) struct PaintedView {
    pub width: u32,
    pub height: u32,
    pub rgb: Vec<u8>,
    /// Frame number of the rig.
    pub frame: u64,
    /// Age of the frame when it was drawn, seconds; `None` where no clock of this host is known for it.
    pub age_secs: Option<f64>,
    /// Root of the first person shown, world, metres.
    pub place: Option<DVec3>,
    /// Number of people shown.
    pub people: usize,
    /// Whether all colours of all people have arrived.
    pub is_complete: bool,
    /// Run time of the drawing.
    pub took: Duration,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    request: Option<Request>,
    drawn: Option<PaintedView>,
    fault: Option<String>,
    is_ended: bool,
}

/// Drawing thread.
pub(crate) struct Painter {
    shared: Arc<Shared>,
    thread: SupervisedThread,
    pub adapter: String,
}

impl Painter {
    /// Starts the thread; `finished` is called after each view.
    pub fn start(
        gpu: &GpuContext,
        receiver: Arc<Receiver>,
        finished: impl Fn() + Send + 'static,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let (of_thread, gpu) = (Arc::clone(&shared), gpu.clone());
        let adapter = gpu.adapter_name();
        let work = move || {
            let (mut stage, mut posed, mut last) = (Stage::default(), Vec::new(), None);
            while let Some(request) = of_thread.next() {
                let drawn = draw(&gpu, &mut stage, &mut posed, &receiver, &request, &mut last);
                let mut state = of_thread.lock();
                match drawn {
                    Ok(None) => continue,
                    Ok(Some(drawn)) => (state.drawn, state.fault) = (Some(drawn), None),
                    // A lost device is not opened again here: the window reports it.
                    Err(error) => {
                        last = None;
                        state.fault = Some(error.to_string());
                    }
                }
                drop(state);
                finished();
            }
        };
        Ok(Self { shared, thread: SupervisedThread::start("draw", work)?, adapter })
    }

    /// Requests a view, which replaces a waiting one.
    pub fn ask(&self, request: Request) {
        self.shared.lock().request = Some(request);
        self.shared.changed.notify_all();
    }

    /// Takes the last view, once, and returns the fault that prevents drawing.
    pub fn take(&self) -> (Option<PaintedView>, Option<String>) {
        let mut state = self.shared.lock();
        (state.drawn.take(), state.fault.clone())
    }

    pub fn thread(&self) -> ThreadHealth {
        self.thread.health()
    }
}

impl Drop for Painter {
    fn drop(&mut self) {
        self.shared.lock().is_ended = true;
        self.shared.changed.notify_all();
        self.thread.join();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Waits for the next request; `None` at the end.
    fn next(&self) -> Option<Request> {
        let mut state = self.lock();
        loop {
            if state.is_ended {
                return None;
            }
            if let Some(request) = state.request.take() {
                return Some(request);
            }
            state = wait(&self.changed, state);
        }
    }
}

/// Content of a view: the request, and the number, stamp and colour count of each person. Equal content need not be drawn again.
type Content = (Request, Vec<(u32, Stamp, u64)>);

/// Target of the drawing: the people, and the floor of the rig under them.
#[derive(Debug, Default)]
struct Stage {
    scene: Option<PeopleScene>,
    floor: Option<(Rig, Floor)>,
}

/// Posed person; memory is kept from one view to the next.
#[derive(Debug, Default)]
struct PosedPerson {
    posed: Posed,
    axes: PosedAxes,
    /// Whether the person is an avatar, so that `axes` is valid.
    is_avatar: bool,
    colors: Arc<Vec<[f32; 4]>>,
}

/// Draws a view, unless it would equal the `last` one.
fn draw(
    gpu: &GpuContext,
    Stage { scene, floor }: &mut Stage,
    posed: &mut Vec<PosedPerson>,
    receiver: &Receiver,
    request: &Request,
    last: &mut Option<Content>,
) -> Result<Option<PaintedView>, flyrig_gpu::GpuError> {
    let (start, now) = (Instant::now(), clock_secs());
    let (mut shown, mut place, mut is_complete, mut stamp) = (0, None, true, None);
    {
        let mut state = receiver.state();
        let motions: Vec<_> = state
            .people
            .iter()
            .filter_map(|(number, person)| Some((number, person.motion_at(now, request.interpolate)?)))
            .collect();
        let version = |number: &u32| state.people.get(*number).map_or(0, StreamPerson::color_changes);
        let people = motions.iter().map(|(number, motion)| (*number, motion.stamp, version(number))).collect();
        let content = (request.clone(), people);
        if last.as_ref() == Some(&content) {
            return Ok(None);
        }
        *last = Some(content);
        let known = floor.as_ref().map(|(rig, _)| rig);
        if let Some(rig) = state.rig.as_ref().filter(|rig| known != Some(*rig)) {
            *floor = Some((rig.clone(), Floor::new(rig)));
        }
        for (number, motion) in motions {
            let Some(person) = state.people.get_mut(number) else { continue };
            if posed.len() <= shown {
                posed.push(PosedPerson::default());
            }
            let drawn = &mut posed[shown];
            drawn.colors = person.pose(&motion, &mut drawn.posed);
            drawn.is_avatar = person.pose_axes(&motion, &drawn.posed, &mut drawn.axes);
            shown += 1;
            is_complete &= person.is_complete();
            place = place.or_else(|| Some(DVec3::from(motion.root_translation.map(f64::from))));
            stamp = stamp.or(Some(motion.stamp));
        }
    }
    let scene = match scene {
        Some(scene) => scene,
        none => none.insert(PeopleScene::new(gpu)?),
    };
    scene.set_people(posed[..shown].iter().map(|PosedPerson { posed, axes, is_avatar, colors }| ShownPerson {
        posed,
        colors,
        axes: is_avatar.then_some(axes),
    }))?;
    let view = scene.draw(&request.camera)?;
    let backdrop = match floor {
        Some((_, floor)) if shown > 0 => {
            let centers: Vec<[f32; 4]> =
                posed[..shown].iter().flat_map(|person| person.posed.center_scale.iter().copied()).collect();
            floor.update(&centers);
            floor.backdrop(&request.camera, BACKDROP)
        }
        _ => vec![BACKDROP; view.width as usize * view.height as usize * 3],
    };
    Ok(Some(PaintedView {
        width: view.width,
        height: view.height,
        rgb: composite_over(&view.rgba, &backdrop),
        frame: stamp.map_or(0, |stamp| stamp.frame),
        age_secs: stamp.and_then(|stamp| receiver.state().age_of(stamp.capture_nanos)),
        place,
        people: shown,
        is_complete: is_complete && shown > 0,
        took: start.elapsed(),
    }))
}
