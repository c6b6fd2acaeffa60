//! Constants of the shaders, in the shaders' memory layouts.

use bytemuck::{Pod, Zeroable};
use flyrig_types::{Camera, Lens};

use crate::camera::optics::SubFrame;
use crate::draw::gpu_parts::SAMPLES;
use crate::draw::moment::{Bound, Moment, ShadeCapsule};
use crate::draw::plates::{GRID_CELL_PX, grid_columns};
use crate::room::lamps::{LAMP_NEAR_M, cone_cosines};
use crate::room::scene::Scene;
use crate::room::scene_config::MAX_LAMPS;

/// Near plane of the cameras, metres.
pub(crate) const NEAR_M: f32 = 0.1;
/// Most capsules of all people.
const MAX_CAPSULES: usize = 64;
/// Iterations that find the row in which a moving point is exposed.
const ROW_STEPS: u32 = 5;
/// Samples of a soft shadow.
const SHADOW_TAPS: u32 = 12;
/// Largest light that a plate's layer represents.
const PLATE_WHITE: f32 = 4.0;

/// Returns the WGSL of all passes, for a number of lamps.
pub(crate) fn shader_sources(lamps: usize) -> [(&'static str, String); 5] {
    let constants = format!(
        "const NEAR_M: f32 = {NEAR_M:?};\nconst LAMP_NEAR_M: f32 = {LAMP_NEAR_M:?};\nconst SAMPLES: i32 = {SAMPLES};\n\
         const LAMPS: u32 = {lamps}u;\nconst MAX_LAMPS: u32 = {MAX_LAMPS}u;\nconst MAX_CAPSULES: u32 = {MAX_CAPSULES}u;\nconst ROW_STEPS: i32 = \
         {ROW_STEPS};\nconst PLATE_WHITE: f32 = {PLATE_WHITE:?};\n"
    );
    let (view, light, points) = (include_str!("view.wgsl"), include_str!("light.wgsl"), include_str!("points.wgsl"));
    [
        ("simulated people", [&constants, view, light, points, include_str!("person.wgsl")].concat()),
        ("shade on simulated people", [&constants, view, light, points, include_str!("shade.wgsl")].concat()),
        ("simulated room", [&constants, view, light, include_str!("room.wgsl")].concat()),
        ("simulated plate", [&constants, view, include_str!("plate.wgsl")].concat()),
        ("simulated image", [&constants, view, light, include_str!("compose.wgsl")].concat()),
    ]
}

/// Mirror of `struct View` of view.wgsl without its rows.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct ViewHead {
    camera_from_world: [[f32; 4]; 4],
    eye: [f32; 4],
    focal_px: [f32; 2],
    center_px: [f32; 2],
    size_px: [f32; 2],
    grid: [f32; 2],
    radial: [f32; 4],
    tangential: [f32; 4],
    fisheye: [f32; 4],
    lens_point: [f32; 4],
    pub moment: [f32; 4],
    pub keys: [f32; 4],
    pub sum: [f32; 4],
}

impl ViewHead {
    pub(crate) fn new(camera: &Camera, focus_m: f64, frame: SubFrame) -> Self {
        let i = &camera.intrinsics;
        let valid = i.lens.valid_radius() as f32;
        let mut view = Self::zeroed();
        match i.lens {
            Lens::Fisheye { coefficients } => {
                view.radial[3] = valid;
                view.tangential[2] = 1.0;
                view.fisheye = coefficients.map(|k| k as f32);
            }
            lens @ (Lens::RadialTangential { .. } | Lens::Rational { .. }) => {
                let (radial, [p1, p2]) = lens.rational().unwrap_or_default();
                let [k1, k2, k3, k4, k5, k6] = radial.map(|k| k as f32);
                view.radial = [k1, k2, k3, valid];
                view.fisheye = [k4, k5, k6, 0.0];
                view.tangential = [p1 as f32, p2 as f32, 0.0, 0.0];
            }
        }
        view.camera_from_world = camera.camera_from_world.to_matrix().as_mat4().to_cols_array_2d();
        view.eye = camera.position().as_vec3().extend(0.0).to_array();
        view.focal_px = i.focal_px.as_vec2().to_array();
        view.center_px = i.center_px.as_vec2().to_array();
        view.size_px = [i.width as f32, i.height as f32];
        view.grid = [grid_columns(i.width) as f32, GRID_CELL_PX as f32];
        view.lens_point = [frame.lens_point.x, frame.lens_point.y, (1.0 / focus_m) as f32, 0.0];
        view.moment[0] = frame.secs as f32;
        view
    }
}

const NOBODY: Bound = Bound { center: [0.0; 2], radius: -1e4, top: -1e4 };

#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct LampBlock {
    room_from_world: [[f32; 4]; 4],
    people_from_world: [[f32; 4]; 4],
    place: [f32; 4],
    axis: [f32; 4],
    color: [f32; 4],
    tangents: [f32; 4],
}

/// Mirror of `struct Light` of light.wgsl.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct LightBlock {
    lamps: [LampBlock; MAX_LAMPS],
    sky: [f32; 4],
    ground: [f32; 4],
    people: [Bound; 2],
    counts: [u32; 4],
    capsules: [ShadeCapsule; MAX_CAPSULES],
}

impl LightBlock {
    /// Fills the block with the scene's lamps, and people within a ball.
    pub(crate) fn new(scene: &Scene, glows: bool, moment: &Moment) -> Self {
        let Moment { ball: (center, radius), bounds, capsules, .. } = moment;
        let mut block = Self::zeroed();
        for (to, lamp) in block.lamps.iter_mut().zip(&scene.lamps) {
            let (room, room_tangent) = lamp.room_view();
            let (people, people_tangent) = lamp.ball_view(*center, *radius);
            let [end, begin] = cone_cosines();
            *to = LampBlock {
                room_from_world: room.to_cols_array_2d(),
                people_from_world: people.to_cols_array_2d(),
                place: lamp.place.extend(lamp.size_m).to_array(),
                axis: lamp.axis.extend(end).to_array(),
                color: lamp.power.extend(begin).to_array(),
                tangents: [room_tangent, people_tangent, 0.0, 0.0],
            };
        }
        block.sky = scene.sky.extend(0.0).to_array();
        block.ground = scene.ground.extend(0.0).to_array();
        block.people = [NOBODY; 2];
        for (to, bound) in block.people.iter_mut().zip(bounds) {
            *to = *bound;
        }
        for (to, capsule) in block.capsules.iter_mut().zip(capsules) {
            *to = *capsule;
        }
        block.counts = [capsules.len().min(MAX_CAPSULES) as u32, glows.into(), 0, SHADOW_TAPS];
        block
    }
}

/// Blocks of constants in one buffer, each at a bindable offset.
#[derive(Debug, Default)]
pub(crate) struct Blocks {
    pub bytes: Vec<u8>,
}

impl Blocks {
    /// Offset alignment that every adapter supports.
    const ALIGNMENT: usize = 256;

    /// Appends a block and returns its offset.
    pub(crate) fn push(&mut self, parts: &[&[u8]]) -> u32 {
        let offset = self.bytes.len();
        for part in parts {
            self.bytes.extend_from_slice(part);
        }
        self.bytes.resize(self.bytes.len().next_multiple_of(Self::ALIGNMENT), 0);
        offset as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shaders_are_valid_and_their_structures_are_ours() {
        for (name, source) in (1..=MAX_LAMPS).flat_map(shader_sources) {
            assert!(!source.contains("var<uniform>"), "{name}: leaks on Mesa's software adapter");
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&source)));
            let capabilities = naga::valid::Capabilities::SHADER_FLOAT16_IN_FLOAT32;
            let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities);
            validator.validate(&module).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&source)));
            let span = |wanted: &str| {
                module.types.iter().find_map(|(_, ty)| match ty.inner {
                    naga::TypeInner::Struct { span, .. } if ty.name.as_deref() == Some(wanted) => Some(span as usize),
                    _ => None,
                })
            };
            // One row.
            assert_eq!(span("View").unwrap(), size_of::<ViewHead>() + 32, "{name}");
            assert_eq!(span("Light").unwrap_or(size_of::<LightBlock>()), size_of::<LightBlock>(), "{name}");
        }
    }
}
