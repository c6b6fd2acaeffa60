//! Interface for JavaScript. A module holds one page; lists are handed over by address in the module's own memory.
#![allow(unsafe_code, reason = "exported names are unsafe attributes; there is no unsafe block")]

use std::cell::RefCell;

use crate::page::{MAX_MESSAGE_BYTES, Page, PageMessageKind};

#[derive(Default)]
struct State {
    page: Page,
    input: Vec<u8>,
    error: String,
    floor: [f32; 12],
    moved: bool,
    recolored: bool,
}

thread_local! {
    static STATE: RefCell<State> = RefCell::default();
}

fn with<T>(work: impl FnOnce(&mut State) -> T) -> T {
    STATE.with(|state| work(&mut state.borrow_mut()))
}

/// Makes room for a message and returns its address; 0 when it is too long.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    with(|state| {
        if length > MAX_MESSAGE_BYTES {
            return std::ptr::null_mut();
        }
        state.input.resize(length, 0);
        state.input.as_mut_ptr()
    })
}

/// Ingests the message in the input. Returns 0, or 1 for one that was refused ([`error`] has the reason).
#[unsafe(no_mangle)]
pub extern "C" fn take(kind: u32, person: u32, now: f64) -> u32 {
    with(|state| {
        let input = std::mem::take(&mut state.input);
        let taken = match PageMessageKind::of(kind) {
            Some(kind) => state.page.ingest(kind, person, &input, now).map_err(|error| error.to_string()),
            None => Err(format!("message of unknown kind {kind}; load the page again")),
        };
        state.input = input;
        state.error = taken.err().unwrap_or_default();
        u32::from(!state.error.is_empty())
    })
}

/// Returns the address of the last message's error, UTF-8.
#[unsafe(no_mangle)]
pub extern "C" fn error() -> *const u8 {
    with(|state| state.error.as_ptr())
}

/// Returns the length of the last message's error, bytes.
#[unsafe(no_mangle)]
pub extern "C" fn error_length() -> usize {
    with(|state| state.error.len())
}

/// Calls [`Page::forget_people`].
#[unsafe(no_mangle)]
pub extern "C" fn forget_people() {
    with(|state| state.page.forget_people());
}

/// Calls [`Page::pose`]; returns the number of Gaussians.
#[unsafe(no_mangle)]
pub extern "C" fn pose(now: f64, interpolate: u32) -> usize {
    with(|state| {
        (state.moved, state.recolored) = state.page.pose(now, interpolate != 0);
        state.page.centers().len()
    })
}

/// Returns whether the last [`pose`] changed centres (1) and colours (2), added up.
#[unsafe(no_mangle)]
pub extern "C" fn changes() -> u32 {
    with(|state| u32::from(state.moved) | u32::from(state.recolored) << 1)
}

/// Returns the address of the centres and standard deviations, four floats per Gaussian.
#[unsafe(no_mangle)]
pub extern "C" fn centers() -> *const [f32; 4] {
    with(|state| state.page.centers().as_ptr())
}

/// Returns the address of the normals, four floats per Gaussian.
#[unsafe(no_mangle)]
pub extern "C" fn normals() -> *const [f32; 4] {
    with(|state| state.page.normals().as_ptr())
}

/// Returns the address of linear RGB and opacities, four floats per Gaussian.
#[unsafe(no_mangle)]
pub extern "C" fn colors() -> *const [f32; 4] {
    with(|state| state.page.colors().as_ptr())
}

/// Returns the address of [`Page::scales`] as of the last [`look`] or [`order`], four floats per Gaussian; 0 without an avatar.
#[unsafe(no_mangle)]
pub extern "C" fn scales() -> *const [f32; 4] {
    with(|state| address_of(state.page.scales()))
}

/// Returns the address of [`Page::rotations`], four floats per Gaussian; 0 without an avatar.
#[unsafe(no_mangle)]
pub extern "C" fn rotations() -> *const [f32; 4] {
    with(|state| address_of(state.page.rotations()))
}

fn address_of(rows: &[[f32; 4]]) -> *const [f32; 4] {
    if rows.is_empty() { std::ptr::null() } else { rows.as_ptr() }
}

/// Calls [`Page::order`] and returns the address of the result, whose length is [`order_length`].
#[unsafe(no_mangle)]
pub extern "C" fn order(width: u32, height: u32) -> *const u32 {
    with(|state| {
        let order = state.page.order(width, height);
        ORDERED.set(order.len());
        order.as_ptr()
    })
}

thread_local! {
    static ORDERED: std::cell::Cell<usize> = const { std::cell::Cell::new(0) };
}

/// Returns the number of Gaussians of the last [`order`].
#[unsafe(no_mangle)]
pub extern "C" fn order_length() -> usize {
    ORDERED.get()
}

/// Calls [`Page::look`]; returns 1 once the rig is known.
#[unsafe(no_mangle)]
pub extern "C" fn look(width: u32, height: u32) -> u32 {
    with(|state| state.page.look(width, height).is_some().into())
}

/// Returns the address of the camera of the last [`look`] or [`order`], [`crate::page::CAMERA_FLOATS`] floats.
#[unsafe(no_mangle)]
pub extern "C" fn camera() -> *const f32 {
    with(|state| state.page.camera().as_ptr())
}

/// Turns around the target, radians.
#[unsafe(no_mangle)]
pub extern "C" fn orbit(right: f64, down: f64) {
    with(|state| state.page.navigation().map(|view| view.orbit(right, down)));
}

/// Shifts the view by fractions of its height.
#[unsafe(no_mangle)]
pub extern "C" fn shift(right: f64, down: f64) {
    with(|state| state.page.navigation().map(|view| view.shift(right, down)));
}

/// Divides the distance to the target by a factor.
#[unsafe(no_mangle)]
pub extern "C" fn zoom(factor: f64) {
    with(|state| state.page.navigation().map(|view| view.zoom(factor)));
}

/// Moves along the view's axes, metres.
#[unsafe(no_mangle)]
pub extern "C" fn fly(right: f64, up: f64, forward: f64) {
    with(|state| state.page.navigation().map(|view| view.fly(right, up, forward)));
}

/// Calls [`Page::set_follows`].
#[unsafe(no_mangle)]
pub extern "C" fn follow(follows: u32) {
    with(|state| state.page.set_follows(follows != 0));
}

/// Calls [`Page::jump`].
#[unsafe(no_mangle)]
pub extern "C" fn jump(camera: usize) {
    with(|state| state.page.jump(camera));
}

/// Returns the number of people shown, and in bit 8 whether all of them have all of their colours.
#[unsafe(no_mangle)]
pub extern "C" fn people() -> u32 {
    with(|state| state.page.people_shown() as u32 | u32::from(state.page.is_complete()) << 8)
}

/// Calls [`Page::choose`].
#[unsafe(no_mangle)]
pub extern "C" fn choose(person: u32) {
    with(|state| state.page.choose(person));
}

/// Calls [`Page::reset`].
#[unsafe(no_mangle)]
pub extern "C" fn reset() {
    with(|state| state.page.reset());
}

/// Returns [`Page::person`]; -1 beyond the people shown.
#[unsafe(no_mangle)]
pub extern "C" fn person(index: usize) -> f64 {
    with(|state| state.page.person(index).map_or(-1.0, f64::from))
}

/// Returns [`Page::capture_secs`].
#[unsafe(no_mangle)]
pub extern "C" fn capture_secs() -> f64 {
    with(|state| state.page.capture_secs())
}

/// Returns the address of [`flyrig_viewing::Floor::numbers`], 12 floats; their radius is 0 before the rig is known.
#[unsafe(no_mangle)]
pub extern "C" fn floor() -> *const f32 {
    with(|state| {
        state.floor = state.page.floor().map_or([0.0; 12], flyrig_viewing::Floor::numbers);
        state.floor.as_ptr()
    })
}

/// Returns the address of [`flyrig_viewing::Floor::shadow`], [`shadow_side`] squared bytes; 0 before the rig is known.
#[unsafe(no_mangle)]
pub extern "C" fn shadow() -> *const u8 {
    with(|state| state.page.floor().map_or(std::ptr::null(), |floor| floor.shadow().as_ptr()))
}

/// Returns [`flyrig_viewing::SHADOW_SIDE`].
#[unsafe(no_mangle)]
pub extern "C" fn shadow_side() -> usize {
    flyrig_viewing::SHADOW_SIDE
}

/// Returns [`Page::frame`].
#[unsafe(no_mangle)]
pub extern "C" fn frame() -> f64 {
    with(|state| state.page.frame() as f64)
}
