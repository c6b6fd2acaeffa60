//! Window of the viewer.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, OnceLock},
    time::{Duration, Instant},
};

use flyrig_types::lock;

use eframe::egui;
use flyrig_gpu::{GpuContext, GpuError};
use flyrig_stream::LAYERS;
use flyrig_transport::{TransportConfig, TransportError};
use flyrig_viewing::Navigation;
use glam::DVec3;

use crate::{
    painter::{PaintedView, Painter, Request},
    receiver::{Receiver, ReceiverState},
};

/// Largest view without a graphics adapter, pixels; larger windows show it scaled.
const MOST_PIXELS_ON_PROCESSOR: f64 = 640.0 * 480.0;
/// Rotation by a drag over the height of the window, radians.
const DRAG_TURN: f64 = std::f64::consts::PI;
/// Speed of flying, distances to the target per second.
const FLY_SPEED: f64 = 0.5;
/// Time for which a problem is shown.
const SHOW_PROBLEM: Duration = Duration::from_secs(5);
/// Interval of updates while nothing arrives.
const IDLE: Duration = Duration::from_millis(250);
/// Time over which the rate of shown frames is averaged.
const RATE_OVER: Duration = Duration::from_secs(2);
/// Keys that jump to the first cameras.
const CAMERA_KEYS: [egui::Key; 9] = [
    egui::Key::Num1,
    egui::Key::Num2,
    egui::Key::Num3,
    egui::Key::Num4,
    egui::Key::Num5,
    egui::Key::Num6,
    egui::Key::Num7,
    egui::Key::Num8,
    egui::Key::Num9,
];
const HELP: &str = "drag: turn   right drag: shift   wheel: nearer   W A S D Q E: fly   1-9: camera   F: follow   R: start again   \
                    F11: whole screen   H: hide this";
const HINT: &str = "H: details and help";

/// Options of the window.
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// Name and address of the rig.
    pub transport: TransportConfig,
    /// Whether to show the newest frame at once instead of smooth motion a frame and a half later.
    pub lowest_latency: bool,
    /// Whether to follow the person from the start.
    pub follow: bool,
    /// Name of the camera to start at.
    pub camera: Option<String>,
    /// Inner size of the window, points.
    pub size: [u32; 2],
    /// Time after which the window's content is returned and the window closed, seconds; at once when a person is shown with all colours.
    pub screenshot_within: Option<f64>,
    /// Time after which the window closes, seconds.
    pub seconds: Option<f64>,
}

/// Content of the window.
#[derive(Debug, Clone, PartialEq)]
pub struct Screenshot {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// sRGB bytes, row by row.
    pub rgb: Vec<u8>,
    /// Missing part; `None` for a person with all colours.
    pub missing: Option<String>,
}

/// Error of the window.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// Error of the session.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// Error of the graphics device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Neither `DISPLAY` nor `WAYLAND_DISPLAY` is set.
    #[error("no desktop here: use flyrig watch")]
    NoDesktop,
    /// Failure to open a window.
    #[error("cannot open a window: {0}; save images without one: flyrig watch --out FOLDER")]
    Window(String),
    /// Failure to start a thread.
    #[error("cannot start a thread: {0}; end other programs, or raise the limit of processes (ulimit -u)")]
    Thread(#[from] std::io::Error),
}

/// Checks that this program can open a window.
///
/// # Errors
/// [`ViewerError::NoDesktop`] on Unix without `DISPLAY` and `WAYLAND_DISPLAY`.
pub fn check_desktop() -> Result<(), ViewerError> {
    let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let has_desktop =
        !cfg!(target_os = "linux") || ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"].iter().any(|name| is_set(name));
    if has_desktop { Ok(()) } else { Err(ViewerError::NoDesktop) }
}

/// Opens the window and shows the rig's people until it is closed. Returns the screenshot where one is requested.
///
/// # Errors
/// [`ViewerError`] without a session, device or window.
pub fn open_window(options: ViewOptions, gpu: &GpuContext) -> Result<Option<Screenshot>, ViewerError> {
    // The receiver starts first: a bad endpoint is reported without a window.
    let repaint: Arc<OnceLock<egui::Context>> = Arc::default();
    let wake = {
        let repaint = Arc::clone(&repaint);
        move || {
            if let Some(context) = repaint.get() {
                context.request_repaint();
            }
        }
    };
    let receiver = Arc::new(Receiver::start(&options.transport, wake.clone())?);
    let painter = Painter::start(gpu, Arc::clone(&receiver), wake)?;
    let shot: Arc<Mutex<Option<Screenshot>>> = Arc::default();
    let (rig, endpoint) = (options.transport.rig.clone(), options.transport.connect.join(", "));
    let [width, height] = options.size.map(|side| side as f32);
    let native = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default()
            .with_title(format!("flyrig - {rig}"))
            .with_inner_size([width, height])
            .with_min_inner_size([320.0, 240.0]),
        ..eframe::NativeOptions::default()
    };
    let view = View {
        receiver: Arc::clone(&receiver),
        painter,
        navigation: None,
        follows: options.follow,
        is_detailed: false,
        is_full: false,
        on_processor: gpu.is_on_processor(),
        texture: None,
        shown: Shown::default(),
        shot: Arc::clone(&shot),
        asked_for_shot: false,
        started: Instant::now(),
        last: Instant::now(),
        endpoint: endpoint.clone(),
        options,
    };
    let opened = eframe::run_native(
        "flyrig",
        native,
        Box::new(move |creation| {
            drop(repaint.set(creation.egui_ctx.clone()));
            Ok(Box::new(view))
        }),
    );
    opened.map_err(|error| ViewerError::Window(in_plain_words(&error)))?;
    Ok(lock(&shot).take())
}

/// Returns the error without places in the source of libraries.
fn in_plain_words(error: &eframe::Error) -> String {
    match error {
        eframe::Error::Winit(_) | eframe::Error::WinitEventLoop(_) => {
            "the desktop that DISPLAY or WAYLAND_DISPLAY names does not answer".to_owned()
        }
        error => error.to_string(),
    }
}

/// State of the screen.
#[derive(Debug, Default)]
struct Shown {
    /// Times at which new frames of the rig were shown.
    changes: VecDeque<Instant>,
    frame: u64,
    age_secs: Option<f64>,
    drawn_at: Option<Instant>,
    took: Duration,
    people: usize,
    place: Option<DVec3>,
    is_complete: bool,
    fault: Option<String>,
}

struct View {
    options: ViewOptions,
    receiver: Arc<Receiver>,
    painter: Painter,
    /// Viewpoint; `None` until the rig's cameras are known.
    navigation: Option<Navigation>,
    follows: bool,
    /// Whether details and help are shown.
    is_detailed: bool,
    is_full: bool,
    on_processor: bool,
    texture: Option<egui::TextureHandle>,
    shown: Shown,
    shot: Arc<Mutex<Option<Screenshot>>>,
    asked_for_shot: bool,
    started: Instant,
    last: Instant,
    endpoint: String,
}

impl eframe::App for View {
    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        let context = ui.ctx().clone();
        let now = Instant::now();
        let elapsed = now.duration_since(self.last).as_secs_f64();
        self.last = now;
        self.start_navigation();
        let area = ui.max_rect();
        let response = ui.allocate_rect(area, egui::Sense::click_and_drag());
        self.navigate(&context, &response, elapsed);
        self.take_drawn(&context, now);
        self.ask(area, context.pixels_per_point());
        let painter = ui.painter_at(area);
        painter.rect_filled(area, 0.0, egui::Color32::from_gray(30));
        if let Some(texture) = &self.texture {
            let whole = egui::Rect::from_min_max(egui::pos2(0.0, 0.0), egui::pos2(1.0, 1.0));
            painter.image(texture.id(), area, whole, egui::Color32::WHITE);
        }
        self.write_over(&painter, area, now);
        let is_over = self.options.seconds.is_some_and(|limit| self.started.elapsed().as_secs_f64() >= limit);
        self.take_shot(&context);
        let has_shot = lock(&self.shot).is_some();
        if is_over || has_shot {
            context.send_viewport_cmd(egui::ViewportCommand::Close);
        }
        // Interpolated motion goes on between messages; a view that would not change is not drawn again.
        let is_moving = !self.options.lowest_latency && self.shown.people > 0;
        context.request_repaint_after(if is_moving { Duration::from_millis(16) } else { IDLE });
    }
}

impl View {
    /// Creates the viewpoint as soon as the rig's cameras are known.
    fn start_navigation(&mut self) {
        if self.navigation.is_some() {
            return;
        }
        let state = self.receiver.state();
        let Some(rig) = &state.rig else { return };
        let mut navigation = Navigation::new(rig);
        let wanted = self.options.camera.as_deref();
        if let Some(camera) = rig.cameras.iter().find(|camera| Some(camera.id.as_str()) == wanted) {
            navigation.jump(camera);
        }
        self.navigation = Some(navigation);
    }

    fn navigate(&mut self, context: &egui::Context, response: &egui::Response, elapsed: f64) {
        let height = f64::from(response.rect.height()).max(1.0);
        let drag = response.drag_delta();
        let (right, down) = (f64::from(drag.x) / height, f64::from(drag.y) / height);
        let by = |button| response.dragged_by(button);
        let shifts = by(egui::PointerButton::Secondary) || by(egui::PointerButton::Middle);
        let pressed = |key| context.input(|input| input.key_pressed(key));
        let held = |key| f64::from(u8::from(context.input(|input| input.key_down(key))));
        let wheel = f64::from(context.input(|input| input.smooth_scroll_delta().y));
        self.follows ^= pressed(egui::Key::F);
        self.is_detailed ^= pressed(egui::Key::H);
        if pressed(egui::Key::F11) {
            self.is_full ^= true;
            context.send_viewport_cmd(egui::ViewportCommand::Fullscreen(self.is_full));
        }
        if pressed(egui::Key::R) {
            self.navigation = None;
            self.start_navigation();
        }
        let jump = CAMERA_KEYS
            .iter()
            .position(|key| pressed(*key))
            .and_then(|index| self.receiver.state().rig.as_ref().and_then(|rig| rig.cameras.get(index).cloned()));
        let Some(navigation) = &mut self.navigation else { return };
        if let Some(camera) = jump {
            navigation.jump(&camera);
        }
        if shifts {
            navigation.shift(right, down);
        } else if by(egui::PointerButton::Primary) {
            navigation.orbit(right * DRAG_TURN, down * DRAG_TURN);
        }
        if wheel != 0.0 {
            navigation.zoom((wheel * 0.003).exp());
        }
        let step = FLY_SPEED * navigation.distance() * elapsed.min(0.1);
        navigation.fly(
            step * (held(egui::Key::D) - held(egui::Key::A)),
            step * (held(egui::Key::E) - held(egui::Key::Q)),
            step * (held(egui::Key::W) - held(egui::Key::S)),
        );
        navigation.follow(self.shown.place.filter(|_| self.follows));
    }

    fn take_drawn(&mut self, context: &egui::Context, now: Instant) {
        let (drawn, fault) = self.painter.take();
        self.shown.fault = fault;
        let Some(PaintedView { width, height, rgb, frame, age_secs, place, people, is_complete, took }) = drawn else {
            return;
        };
        let image = egui::ColorImage::from_rgb([width as usize, height as usize], &rgb);
        match &mut self.texture {
            Some(texture) => texture.set(image, egui::TextureOptions::LINEAR),
            None => self.texture = Some(context.load_texture("view", image, egui::TextureOptions::LINEAR)),
        }
        let shown = &mut self.shown;
        if people > 0 && frame != shown.frame {
            shown.changes.push_back(now);
            shown.frame = frame;
        }
        while shown.changes.front().is_some_and(|at| now.duration_since(*at) > RATE_OVER) {
            shown.changes.pop_front();
        }
        shown.drawn_at = Some(now);
        (shown.age_secs, shown.place, shown.people, shown.is_complete, shown.took) =
            (age_secs, place, people, is_complete, took);
    }

    fn ask(&self, area: egui::Rect, pixels_per_point: f32) {
        let Some(navigation) = &self.navigation else { return };
        let pixels = f64::from(area.width() * area.height() * pixels_per_point * pixels_per_point);
        let scale = if self.on_processor { (MOST_PIXELS_ON_PROCESSOR / pixels.max(1.0)).sqrt().min(1.0) } else { 1.0 };
        let side = |points: f32| ((f64::from(points * pixels_per_point) * scale) as u32).clamp(16, 4096);
        let camera = navigation.camera(side(area.width()), side(area.height()));
        self.painter.ask(Request { camera, interpolate: !self.options.lowest_latency });
    }

    fn write_over(&self, painter: &egui::Painter, area: egui::Rect, now: Instant) {
        let state = self.receiver.state();
        let mut lines = Vec::new();
        if let Some(trouble) = state.trouble(&self.options.transport.rig, &self.endpoint) {
            lines.push((trouble, true));
        } else if self.shown.people == 0 {
            lines.push((state.absence(), true));
        } else {
            lines.push((self.summary(&state, now), false));
        }
        if self.is_detailed {
            lines.extend(self.details(&state, now).into_iter().map(|line| (line, false)));
        }
        if let Some((_, text)) = state.problem.as_ref().filter(|(at, _)| now.duration_since(*at) < SHOW_PROBLEM) {
            lines.push((text.clone(), true));
        }
        drop(state);
        lines.extend(self.shown.fault.iter().map(|fault| (fault.clone(), true)));
        for health in [self.receiver.thread(), self.painter.thread()].into_iter().filter(|health| health.has_failed) {
            let panic = health.panic.unwrap_or_default();
            lines.push((format!("the thread '{}' failed: {panic}; please report it", health.name), true));
        }
        let font = egui::FontId::proportional(15.0);
        let mut at = area.left_top() + egui::vec2(12.0, 10.0);
        for (text, is_trouble) in lines {
            let color = if is_trouble { egui::Color32::from_rgb(255, 190, 90) } else { egui::Color32::from_gray(220) };
            let galley = painter.layout(text, font.clone(), color, area.width() - 24.0);
            let height = galley.size().y;
            painter.galley(at, galley, color);
            at.y += height + 3.0;
        }
        let faint = egui::Color32::from_gray(140);
        let help = if self.is_detailed { HELP } else { HINT };
        let hint = if self.follows { format!("{help}   (following)") } else { help.to_owned() };
        let hint = painter.layout(hint, egui::FontId::proportional(12.0), faint, area.width() - 24.0);
        let bottom = area.left_bottom() + egui::vec2(12.0, -8.0 - hint.size().y);
        painter.galley(bottom, hint, faint);
    }

    /// Returns the plain line on what is shown.
    fn summary(&self, state: &ReceiverState, now: Instant) -> String {
        let age = self.shown.age_secs.map(|age| {
            // The age grows until a new frame is drawn.
            age + self.shown.drawn_at.map_or(0.0, |at| now.duration_since(at).as_secs_f64())
        });
        let mut line = age.map_or_else(|| "live".to_owned(), |age| format!("live, {age:.1} s behind"));
        if !self.shown.is_complete {
            line += ", colours are loading";
        } else if state.is_line_slow && are_colors_sent(state) {
            line += ", coarse colours: the network to the rig is slow";
        }
        line
    }

    fn details(&self, state: &ReceiverState, now: Instant) -> Vec<String> {
        let (bytes, motions) = state.rates(now);
        let shown = self.shown.changes.len() as f64 / RATE_OVER.as_secs_f64();
        let took_ms = 1e3 * self.shown.took.as_secs_f64();
        let rates = format!("{shown:.1} of {motions:.1} frames/s shown   {:.2} Mbit/s", 8e-6 * bytes);
        let mut lines = vec![rates, format!("drawn in {took_ms:.0} ms by {}", self.painter.adapter)];
        if let (None, Some((latency, _))) = (self.shown.age_secs, state.age) {
            // By another host's clock, or a recording's, only the latency is known.
            lines.push(format!("latency {:.0} ms", 1e3 * latency));
        }
        lines.extend(state.stats.iter().flat_map(|stats| &stats.subjects).map(|subject| {
            let quality =
                subject.quality.map_or_else(String::new, |quality| format!(", {:.0} % agree", 100.0 * quality));
            format!("person {}: {}{quality}", subject.person, subject.state)
        }));
        if are_colors_sent(state) && state.color_layers < LAYERS {
            let reason = if state.is_line_slow { ", as many as the network carries" } else { "" };
            lines.push(format!("colours: {} of {LAYERS} layers{reason}", state.color_layers));
        }
        lines
    }

    /// Requests a screenshot as soon as a person is shown with all colours, or the time for it is over.
    fn take_shot(&mut self, context: &egui::Context) {
        let Some(limit) = self.options.screenshot_within else { return };
        let is_late = self.started.elapsed().as_secs_f64() >= limit;
        if self.asked_for_shot || !(self.shown.is_complete || is_late) {
            return;
        }
        self.asked_for_shot = true;
        let missing = (!self.shown.is_complete).then(|| {
            let state = self.receiver.state();
            let trouble = state.trouble(&self.options.transport.rig, &self.endpoint);
            let colors = || "the colours are incomplete".to_owned();
            trouble.unwrap_or_else(|| if self.shown.people > 0 { colors() } else { state.absence() })
        });
        let (shot, repaint) = (Arc::clone(&self.shot), context.clone());
        let callback = egui::ScreenshotCallback::new(move |image| {
            let rgb = image.pixels.iter().flat_map(|pixel| [pixel.r(), pixel.g(), pixel.b()]).collect();
            let [width, height] = image.size.map(|side| side as u32);
            *lock(&shot) = Some(Screenshot { width, height, rgb, missing });
            repaint.request_repaint();
        });
        context.send_viewport_cmd(egui::ViewportCommand::Screenshot(callback));
    }
}

/// Returns whether colours are sent beside motion; an avatar that poses alone drive has its own.
fn are_colors_sent(state: &ReceiverState) -> bool {
    state.people.iter().any(|(_, person)| !person.template().has_colors())
}
