//! The page's WebAssembly as it is shipped does what this crate does.
#![allow(clippy::unwrap_used)] // a test may fail by panicking, in its helpers too

use flyrig_page::{CAMERA_FLOATS, Page, PageMessageKind};
use flyrig_stream::{
    AvatarGaussian, AvatarSource, ColorEncoder, ColorSettings, LIGHT_TERMS, Motion, MotionEncoder, Stamp, StreamJoint,
    TemplateSource,
};
use flyrig_types::{Camera, Intrinsics, Isometry, Rig};
use glam::DVec3;
use wasmi::{Engine, Instance, Linker, Module, Store, WasmParams, WasmResults};

const WASM: &[u8] = include_bytes!("../../web/assets/page.wasm");
const GAUSSIANS: usize = 3000;

struct Shipped {
    store: Store<()>,
    instance: Instance,
}

impl Shipped {
    fn new() -> Self {
        let engine = Engine::default();
        let module = Module::new(&engine, WASM).unwrap();
        let mut store = Store::new(&engine, ());
        let instance = Linker::new(&engine).instantiate_and_start(&mut store, &module).unwrap();
        Self { store, instance }
    }

    fn call<P: WasmParams, R: WasmResults>(&mut self, name: &str, parameters: P) -> R {
        let function = self.instance.get_typed_func::<P, R>(&self.store, name).unwrap();
        function.call(&mut self.store, parameters).unwrap()
    }

    fn take(&mut self, kind: u32, person: u32, bytes: &[u8], now: f64) -> u32 {
        let address: u32 = self.call("input", bytes.len() as u32);
        let memory = self.instance.get_memory(&self.store, "memory").unwrap();
        memory.write(&mut self.store, address as usize, bytes).unwrap();
        self.call("take", (kind, person, now))
    }

    fn read<T: From<[u8; 4]>>(&self, address: u32, count: usize) -> Vec<T> {
        let memory = self.instance.get_memory(&self.store, "memory").unwrap();
        let bytes = &memory.data(&self.store)[address as usize..][..4 * count];
        bytes.chunks_exact(4).map(|four| T::from([four[0], four[1], four[2], four[3]])).collect()
    }
}

#[derive(Debug, PartialEq)]
struct Bits(u32);

impl From<[u8; 4]> for Bits {
    fn from(bytes: [u8; 4]) -> Self {
        Self(u32::from_le_bytes(bytes))
    }
}

fn bits(rows: &[[f32; 4]]) -> Vec<Bits> {
    rows.iter().flatten().map(|value| Bits(value.to_bits())).collect()
}

#[test]
fn the_shipped_module_decodes_poses_and_sorts_as_this_crate_does() {
    let mut state = 3u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state as f32 / u32::MAX as f32 - 0.5
    };
    let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let joint =
        |parent: Option<u16>, up: f32| StreamJoint { parent, translation: [0.0, 0.0, up], joint_from_canonical: rows };
    let joints = [joint(None, 0.0), joint(Some(0), 0.4)];
    let center_scale: Vec<[f32; 4]> = (0..GAUSSIANS).map(|_| [random(), random(), random(), 0.01]).collect();
    let normals: Vec<[f32; 3]> = (0..GAUSSIANS).map(|_| [random(), random(), random()]).collect();
    let skin = vec![([0, 1, 0, 0], [0.5, 0.5, 0.0, 0.0]); GAUSSIANS];
    let (center_scale, normals, skin) = (&center_scale, &normals, &skin);
    let source = TemplateSource { joints: &joints, center_scale, normals, skin, node_weights: &[], nodes: &[] };
    let encoded = source.encode().unwrap();
    let gaussians: Vec<AvatarGaussian> = (0..GAUSSIANS)
        .map(|_| AvatarGaussian {
            scale_m: [0.01 * random().abs(), 0.01, 0.002],
            opacity: random().abs(),
            rotation: [random(), random(), random(), random()],
            color: [random().abs(), random().abs(), random().abs()],
        })
        .collect();
    let light = [[0.5; 3]; LIGHT_TERMS];
    let [avatar, tracked] = [Some(light), None]
        .map(|light| AvatarSource { template: source, gaussians: &gaussians, light }.encode().unwrap());
    let colors: Vec<[f32; 4]> = (0..GAUSSIANS).map(|_| [random().abs(), random().abs(), random().abs(), 1.0]).collect();
    let camera = Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: "a".into(),
        intrinsics: Intrinsics::pinhole(640, 480, 500.0),
        camera_from_world: Isometry::look_at(DVec3::new(0.5, -3.0, 1.0), DVec3::Z, DVec3::Z),
    };
    let rig = serde_json::to_vec(&Rig { cameras: vec![camera], world_up: DVec3::Z }).unwrap();

    let (mut ours, mut shipped) = (Page::default(), Shipped::new());
    let mut both = |kind: u32, bytes: &[u8], now: f64| {
        ours.ingest(PageMessageKind::of(kind).unwrap(), 1, bytes, now).unwrap();
        assert_eq!(shipped.take(kind, 1, bytes, now), 0);
    };
    both(0, &rig, 0.0);
    both(1, &encoded.bytes, 0.0);
    let (mut motions, mut layers) =
        (MotionEncoder::new(&encoded), ColorEncoder::new(&encoded, ColorSettings::default(), 1));
    for frame in 1..=3u64 {
        let stamp = Stamp { frame, capture_nanos: 40_000_000 * frame as i64, person: 1, ..Stamp::default() };
        let joint_rotations = vec![[0.0, 0.0, 0.1, 0.995], [0.1, 0.0, 0.0, 0.995]];
        let root_translation = [0.1 * frame as f32, 0.0, 1.0];
        let motion = Motion { stamp, root_translation, joint_rotations, nodes: Vec::new() };
        both(2, &motions.encode(&motion).unwrap(), 0.04 * frame as f64);
        for layer in layers.encode(stamp, &colors) {
            both(3, &layer, 0.04 * frame as f64);
        }
    }
    for (now, interpolate) in [(0.12, false), (0.13, true)] {
        ours.pose(now, interpolate);
        assert_eq!(shipped.call::<_, u32>("pose", (now, u32::from(interpolate))), GAUSSIANS as u32);
        let (centers, painted) = (shipped.call("centers", ()), shipped.call("colors", ()));
        assert_eq!(shipped.read::<Bits>(centers, 4 * GAUSSIANS), bits(ours.centers()));
        assert_eq!(shipped.read::<Bits>(painted, 4 * GAUSSIANS), bits(ours.colors()));
        let normals = shipped.call("normals", ());
        assert_eq!(shipped.read::<Bits>(normals, 4 * GAUSSIANS), bits(ours.normals()));
        shipped.call::<_, ()>("orbit", (0.3, 0.1));
        ours.navigation().unwrap().orbit(0.3, 0.1);
        let order: u32 = shipped.call("order", (640u32, 480u32));
        let length: u32 = shipped.call("order_length", ());
        let found: Vec<u32> = shipped.read::<Bits>(order, length as usize).into_iter().map(|bits| bits.0).collect();
        let expected = ours.order(640, 480).to_vec();
        assert!(expected.len() > GAUSSIANS / 4);
        // The libraries' sines differ in the last bit.
        let same = found.iter().zip(&expected).filter(|(a, b)| a == b).count();
        assert!(
            found.len().abs_diff(expected.len()) <= 2 && same * 100 > 98 * expected.len(),
            "{same} of {}",
            expected.len()
        );
        assert_eq!(shipped.call::<_, u32>("look", (320u32, 480u32)), 1);
        ours.look(320, 480).unwrap();
        let address: u32 = shipped.call("camera", ());
        let numbers = shipped.read::<Bits>(address, CAMERA_FLOATS);
        for (ours, shipped) in ours.camera().iter().zip(numbers) {
            assert!((ours - f32::from_bits(shipped.0)).abs() < 1e-4 * ours.abs().max(1.0));
        }
    }
    assert_eq!(shipped.call::<_, u32>("people", ()), 1 | 256);
    let (floor, shadow, side): (u32, u32, u32) =
        (shipped.call("floor", ()), shipped.call("shadow", ()), shipped.call("shadow_side", ()));
    assert!(shadow > 0 && side as usize == flyrig_viewing::SHADOW_SIDE);
    let numbers = shipped.read::<Bits>(floor, 12);
    for (ours, shipped) in ours.floor().unwrap().numbers().iter().zip(numbers) {
        assert!((ours - f32::from_bits(shipped.0)).abs() < 1e-4);
    }
    assert!((shipped.call::<_, f64>("capture_secs", ()) - ours.capture_secs()).abs() < 1e-9);
    assert_eq!((shipped.call::<_, f64>("person", 0u32), shipped.call::<_, f64>("person", 1u32)), (1.0, -1.0));
    assert_eq!((shipped.call::<_, u32>("rotations", ()), shipped.call::<_, u32>("scales", ())), (0, 0));

    // An avatar with its colours beside the same person, and one whose colours are messages.
    for (person, avatar) in [(2, &avatar), (3, &tracked)] {
        let stamp = Stamp { frame: 4, capture_nanos: 160_000_000, person, ..Stamp::default() };
        let joint_rotations = vec![[0.0, 0.0, 0.1, 0.995], [0.1, 0.0, 0.0, 0.995]];
        let motion = Motion { stamp, root_translation: [1.0, 0.0, 1.0], joint_rotations, nodes: Vec::new() };
        let motion = MotionEncoder::new(avatar).encode(&motion).unwrap();
        let layers = ColorEncoder::new(avatar, ColorSettings::default(), 1).encode(stamp, &colors);
        let mut messages = vec![(1, &avatar.bytes), (2, &motion)];
        if !avatar.template.has_colors() {
            messages.extend(layers.iter().map(|layer| (3, layer)));
        }
        for (kind, bytes) in messages {
            ours.ingest(PageMessageKind::of(kind).unwrap(), person, bytes, 0.16).unwrap();
            assert_eq!(shipped.take(kind, person, bytes, 0.16), 0);
        }
    }
    ours.pose(0.16, false);
    ours.look(640, 480).unwrap();
    assert_eq!(shipped.call::<_, u32>("pose", (0.16, 0u32)), 3 * GAUSSIANS as u32);
    let painted = shipped.call("colors", ());
    assert_eq!(shipped.read::<Bits>(painted, 12 * GAUSSIANS)[8 * GAUSSIANS..], bits(ours.colors())[8 * GAUSSIANS..]);
    assert_eq!(shipped.call::<_, u32>("look", (640u32, 480u32)), 1);
    let (rotations, scales) = (shipped.call("rotations", ()), shipped.call("scales", ()));
    assert_eq!(shipped.read::<Bits>(rotations, 12 * GAUSSIANS), bits(ours.rotations()));
    let (found, expected) = (shipped.read::<Bits>(scales, 12 * GAUSSIANS), bits(ours.scales()));
    // At the limit, the libraries' sines decide who faces away.
    let differ = found.iter().zip(&expected).filter(|(a, b)| a != b).count();
    assert!(differ <= 4 && expected.iter().filter(|bits| bits.0 == 0).count() > GAUSSIANS / 8, "{differ} differ");

    // What is damaged is refused in words; what is too long gets no memory.
    assert_eq!(shipped.take(2, 1, b"FLM", 0.2), 1);
    let (address, length): (u32, u32) = (shipped.call("error", ()), shipped.call("error_length", ()));
    assert!(length > 5 && address > 0);
    assert_eq!(shipped.take(9, 1, b"", 0.2), 1);
    assert_eq!(shipped.call::<_, u32>("input", u32::MAX), 0);
    shipped.call::<_, ()>("forget_people", ());
    assert_eq!(shipped.call::<_, u32>("pose", (0.3, 0u32)), 0);
}
