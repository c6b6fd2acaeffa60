use flyrig_stream::{
    AvatarGaussian, AvatarSource, ColorEncoder, ColorSettings, EncodedTemplate, LIGHT_TERMS, Motion, MotionEncoder,
    Stamp, StreamJoint, TemplateSource,
};
use flyrig_types::{Camera, Intrinsics, Isometry};

use super::*;

const GAUSSIANS: usize = 60;

fn template(size: f32) -> EncodedTemplate {
    encode(size, [-1.0, -1.0], |source| source.encode())
}

/// Creates an avatar of needles in all directions, every other of which faces away from the cameras.
fn avatar() -> EncodedTemplate {
    let gaussians: Vec<AvatarGaussian> = (0..GAUSSIANS)
        .map(|i| AvatarGaussian {
            scale_m: [0.02, 0.004, 0.001 + 1e-4 * i as f32],
            opacity: 0.8,
            rotation: [(i as f32).sin(), (2.0 * i as f32).cos(), 0.3, 0.5],
            color: [0.5, 0.2, 0.1],
        })
        .collect();
    let mut light = [[0.0; 3]; LIGHT_TERMS];
    light[0] = [1.0; 3];
    encode(1.0, [-1.0, 1.0], |template| AvatarSource { template, gaussians: &gaussians, light: Some(light) }.encode())
}

/// `facing`: y of the normals of every other Gaussian.
fn encode(
    size: f32,
    facing: [f32; 2],
    finish: impl Fn(TemplateSource<'_>) -> Result<EncodedTemplate, StreamError>,
) -> EncodedTemplate {
    let rows = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let joints = [StreamJoint { parent: None, translation: [0.0; 3], joint_from_canonical: rows }];
    let center_scale: Vec<[f32; 4]> = (0..GAUSSIANS).map(|i| [size * i as f32 / 60.0, 0.0, 0.0, 0.01]).collect();
    let skin = vec![([0; 4], [1.0, 0.0, 0.0, 0.0]); GAUSSIANS];
    let normals: Vec<[f32; 3]> = (0..GAUSSIANS).map(|i| [0.0, facing[i % 2], 0.0]).collect();
    let (center_scale, normals, skin) = (&center_scale, &normals, &skin);
    finish(TemplateSource { joints: &joints, center_scale, normals, skin, node_weights: &[], nodes: &[] }).unwrap()
}

fn motion(template: &EncodedTemplate, frame: u64, x: f32) -> Vec<u8> {
    let stamp = Stamp { frame, capture_nanos: 100_000_000 * frame as i64, ..Stamp::default() };
    let rotation = vec![[0.0, 0.0, 0.0, 1.0]];
    let motion = Motion { stamp, root_translation: [x, 0.0, 1.0], joint_rotations: rotation, nodes: Vec::new() };
    MotionEncoder::new(template).encode(&motion).unwrap()
}

fn rig() -> Rig {
    let camera = |name: &str, x: f64| Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics: Intrinsics::pinhole(640, 480, 500.0),
        camera_from_world: Isometry::look_at(DVec3::new(x, -3.0, 1.0), DVec3::Z, DVec3::Z),
    };
    Rig { cameras: vec![camera("a", -1.0), camera("b", 1.0)], world_up: DVec3::Z }
}

fn page() -> Page {
    let mut page = Page::default();
    page.ingest(PageMessageKind::Rig, 0, &serde_json::to_vec(&rig()).unwrap(), 0.0).unwrap();
    page
}

#[test]
fn a_person_is_shown_once_template_motion_and_rig_are_there() {
    let encoded = template(1.0);
    let mut page = Page::default();
    assert!(page.order(640, 480).is_empty() && page.people_shown() == 0 && !page.is_complete());
    page.ingest(PageMessageKind::Motion, 2, &motion(&encoded, 1, 0.5), 0.0).unwrap();
    assert_eq!(page.pose(0.0, false), (false, false));
    page.ingest(PageMessageKind::Template, 2, &encoded.bytes, 0.0).unwrap();
    assert_eq!(page.pose(0.0, false), (true, true), "a motion that came early is applied");
    assert!((page.centers()[0][0] - 0.5).abs() < 1e-3 && page.centers().len() == GAUSSIANS);
    assert!(page.order(640, 480).is_empty(), "without a rig there is no viewpoint");
    page.ingest(PageMessageKind::Rig, 0, &serde_json::to_vec(&rig()).unwrap(), 0.0).unwrap();
    assert_eq!(page.order(640, 480).len(), GAUSSIANS);
    assert!(page.pose(0.0, false).0 && page.floor().is_some_and(|floor| floor.numbers()[3] > 0.0));

    let mut colors = ColorEncoder::new(&encoded, ColorSettings::default(), 7);
    for layer in &colors.encode(Stamp::default(), &[[0.5, 0.2, 0.1, 1.0]; GAUSSIANS]) {
        page.ingest(PageMessageKind::Colors, 2, layer, 0.0).unwrap();
    }
    assert_eq!(page.pose(0.0, false), (false, true));
    assert!(page.is_complete() && (page.colors()[5][0] - 0.5).abs() < 0.05);
    assert_eq!(page.pose(0.0, false), (false, false), "nothing is done twice");
    page.ingest(PageMessageKind::Motion, 2, &motion(&encoded, 2, 0.6), 0.1).unwrap();
    assert_eq!((page.pose(0.1, false), page.frame()), ((true, false), 2));
    // A person that is gone is not drawn.
    assert_eq!((page.pose(60.0, false), page.people_shown()), ((true, true), 0));
    page.ingest(PageMessageKind::Motion, 2, &motion(&encoded, 3, 0.6), 60.1).unwrap();
    assert!(page.pose(60.1, false).0 && !page.centers().is_empty());
    page.forget_people();
    assert_eq!(page.pose(60.1, false), (true, true));
    assert!(page.centers().is_empty());
}

#[test]
fn the_camera_is_that_of_the_window() {
    let mut page = page();
    page.jump(1);
    page.jump(99);
    page.order(320, 240);
    let expected = {
        let mut navigation = Navigation::new(&rig());
        navigation.jump(&rig().cameras[1]);
        navigation.camera(320, 240)
    };
    let found = *page.camera();
    let matrix = glam::Mat4::from_cols_slice(&found[..16]);
    for point in [DVec3::Z, DVec3::new(0.3, 0.2, 0.5)] {
        let ours = matrix.transform_point3(point.as_vec3());
        let pixel = glam::Vec2::new(found[17], found[18]) + found[16] * ours.truncate() / ours.z;
        let wanted = expected.project(point).unwrap().as_vec2();
        assert!((pixel - wanted).length() < 1e-3, "{pixel} {wanted}");
    }
}

#[test]
fn following_moves_the_viewpoint_with_the_person() {
    let (mut page, encoded) = (page(), template(1.0));
    page.ingest(PageMessageKind::Template, 0, &encoded.bytes, 0.0).unwrap();
    page.set_follows(true);
    let place = |page: &mut Page, frame: u64, x: f32| {
        page.ingest(PageMessageKind::Motion, 0, &motion(&encoded, frame, x), 0.1 * frame as f64).unwrap();
        page.pose(0.1 * frame as f64, false);
        page.order(64, 64);
        let camera = *page.camera();
        glam::Mat4::from_cols_slice(&camera[..16]).transform_point3(glam::Vec3::new(x, 0.0, 1.0))
    };
    let before = place(&mut page, 1, 0.0);
    let after = place(&mut page, 2, 0.7);
    assert!((before - after).length() < 1e-2, "{before} {after}");
    page.set_follows(false);
    let left = place(&mut page, 3, 1.4);
    assert!((left - after).length() > 0.3);
}

#[test]
fn a_person_is_chosen_and_the_start_comes_back() {
    let (mut page, encoded) = (page(), template(0.5));
    let start = page.look(64, 64).unwrap();
    for (person, x) in [(3, 0.0), (8, 1.5)] {
        page.ingest(PageMessageKind::Template, person, &encoded.bytes, 0.0).unwrap();
        page.ingest(PageMessageKind::Motion, person, &motion(&encoded, 4, x), 0.0).unwrap();
    }
    assert!(page.capture_secs() <= 0.0 && page.person(0).is_none());
    page.pose(0.0, false);
    assert_eq!([0, 1, 2].map(|index| page.person(index)), [Some(3), Some(8), None]);
    assert!((page.capture_secs() - 0.4).abs() < 1e-9);
    // A person who is not there changes nothing.
    page.choose(5);
    assert_eq!(page.look(64, 64).unwrap(), start);
    page.choose(8);
    let place = |page: &mut Page, x: f64| page.look(64, 64).unwrap().project(DVec3::new(x, 0.0, 1.0)).unwrap();
    assert!(place(&mut page, 1.5).distance(glam::DVec2::splat(31.5)) < 0.1);
    // That person is followed.
    page.set_follows(true);
    page.pose(0.0, false);
    for (person, x) in [(3, 0.4), (8, 1.9)] {
        page.ingest(PageMessageKind::Motion, person, &motion(&encoded, 5, x), 0.1).unwrap();
    }
    page.pose(0.1, false);
    assert!(place(&mut page, 1.9).distance(glam::DVec2::splat(31.5)) < 0.1);
    page.set_follows(false);
    page.reset();
    assert_eq!(page.look(64, 64).unwrap(), start);
}

#[test]
fn damaged_messages_are_refused_and_change_nothing() {
    let (mut page, encoded) = (page(), template(1.0));
    page.ingest(PageMessageKind::Template, 0, &encoded.bytes, 0.0).unwrap();
    let good = motion(&encoded, 1, 0.2);
    page.ingest(PageMessageKind::Motion, 0, &good, 0.0).unwrap();
    page.pose(0.0, false);
    let before = page.centers().to_vec();
    let mut state = 1u32;
    for kind in [PageMessageKind::Rig, PageMessageKind::Template, PageMessageKind::Motion, PageMessageKind::Colors] {
        page.ingest(kind, 0, &[], 0.0).unwrap_err();
        page.ingest(kind, 0, b"\xff\x00noise", 0.0).unwrap_err();
        let original = if kind == PageMessageKind::Template { encoded.bytes.clone() } else { good.clone() };
        for _ in 0..2000 {
            let mut bytes = original.clone();
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let at = state as usize % bytes.len();
            bytes[at] ^= 1 << (state >> 29);
            bytes.truncate(bytes.len() - (state >> 8) as usize % 3);
            // Damage that is not noticed changes numbers, never the program.
            drop(page.ingest(kind, 7, &bytes, 0.0));
        }
    }
    page.pose(0.0, false);
    assert_eq!(page.centers()[..GAUSSIANS], before[..]);
    let rig = String::from_utf8(serde_json::to_vec(&rig()).unwrap()).unwrap().replace("500.0", "-1.0");
    let error = page.ingest(PageMessageKind::Rig, 0, rig.as_bytes(), 0.0).unwrap_err().to_string();
    assert!(error.starts_with("the rig's calibration is damaged"), "{error}");
    assert_eq!(PageMessageKind::of(4), None);
}

#[test]
fn a_tracked_avatar_has_axes_and_gets_its_colors_by_messages() {
    let mut page = page();
    let gaussian =
        AvatarGaussian { scale_m: [0.02, 0.004, 0.001], opacity: 0.8, rotation: [0.1, 0.2, 0.3, 0.9], color: [0.0; 3] };
    let gaussians = [gaussian; GAUSSIANS];
    let encoded =
        encode(1.0, [-1.0, -1.0], |template| AvatarSource { template, gaussians: &gaussians, light: None }.encode());
    page.ingest(PageMessageKind::Template, 0, &encoded.bytes, 0.0).unwrap();
    page.ingest(PageMessageKind::Motion, 0, &motion(&encoded, 1, 0.5), 0.0).unwrap();
    assert_eq!(page.pose(0.0, false), (true, true));
    assert!(!page.is_complete() && page.rotations().len() == GAUSSIANS);
    let stamp = Stamp { frame: 1, capture_nanos: 1, ..Stamp::default() };
    let mut colors = ColorEncoder::new(&encoded, ColorSettings::default(), 1);
    for layer in colors.encode(stamp, &[[0.5, 0.2, 0.1, 1.0]; GAUSSIANS]) {
        page.ingest(PageMessageKind::Colors, 0, &layer, 0.0).unwrap();
    }
    assert_eq!(page.pose(0.0, false), (false, true));
    assert!(page.is_complete());
    assert!(page.colors().iter().all(|color| (color[0] - 0.5).abs() < 0.05), "{:?}", page.colors()[0]);
    // The opacity is that of the template.
    page.look(640, 480);
    assert!(page.scales().iter().all(|scale| (scale[3] - 0.8).abs() < 0.003), "{:?}", page.scales()[0]);
}

#[test]
fn an_avatar_has_the_axes_of_its_template_and_hides_what_faces_away() {
    let (mut page, encoded, plain) = (page(), avatar(), template(1.0));
    page.ingest(PageMessageKind::Template, 0, &encoded.bytes, 0.0).unwrap();
    let bytes = motion(&encoded, 1, 0.5);
    page.ingest(PageMessageKind::Motion, 0, &bytes, 0.0).unwrap();
    assert_eq!(page.pose(0.0, false), (true, true));
    assert!(page.is_complete());
    let received = Motion::decode(&bytes, &encoded.template).unwrap();
    let (mut posed, mut axes) = (Posed::default(), PosedAxes::default());
    encoded.template.pose(&received, &mut posed);
    assert!(encoded.template.pose_axes(&received, &posed, &mut axes));
    assert_eq!((page.rotations(), page.centers()), (axes.rotation.as_slice(), posed.center_scale.as_slice()));
    let mut order = page.order(640, 480).to_vec();
    order.sort_unstable();
    let toward: Vec<u32> = (0..GAUSSIANS as u32).filter(|&i| posed.normal[i as usize][1] < 0.0).collect();
    assert!(order == toward && toward.len() == GAUSSIANS / 2, "{order:?}");
    for (i, (scales, whole)) in page.scales().iter().zip(&axes.scale_opacity).enumerate() {
        let opacity = if order.contains(&(i as u32)) { whole[3] } else { 0.0 };
        let expected = [whole[0], whole[1], whole[2], opacity];
        assert_eq!(scales.map(f32::to_bits), expected.map(f32::to_bits), "{i}");
    }

    // From behind, the other half; beside a person that is no avatar, both kinds.
    let from_behind = page.navigation().map(|view| view.orbit(std::f64::consts::PI, 0.0)).and(page.look(640, 480));
    assert!(from_behind.unwrap().position().y > 1.0);
    let mut order = page.order(640, 480).to_vec();
    order.sort_unstable();
    assert!(order.len() == GAUSSIANS / 2 && order.iter().all(|i| !toward.contains(i)), "{order:?}");
    page.ingest(PageMessageKind::Template, 1, &plain.bytes, 0.0).unwrap();
    page.ingest(PageMessageKind::Motion, 1, &motion(&plain, 1, 0.5), 0.0).unwrap();
    page.ingest(PageMessageKind::Motion, 0, &motion(&encoded, 2, 0.5), 0.1).unwrap();
    let mut colors = ColorEncoder::new(&plain, ColorSettings::default(), 7);
    for layer in &colors.encode(Stamp::default(), &[[0.5, 0.2, 0.1, 1.0]; GAUSSIANS]) {
        page.ingest(PageMessageKind::Colors, 1, layer, 0.0).unwrap();
    }
    page.pose(0.1, false);
    page.look(640, 480).unwrap();
    assert!(page.rotations().len() == 2 * GAUSSIANS && page.rotations()[..GAUSSIANS] == axes.rotation[..]);
    let ([x, y, z, _], size) = (page.scales()[GAUSSIANS], page.centers()[GAUSSIANS][3]);
    assert_eq!(([x, y, z], page.rotations()[GAUSSIANS]), ([size; 3], [0.0, 0.0, 0.0, 1.0]));

    // Without the avatar nothing has axes.
    page.forget_people();
    page.ingest(PageMessageKind::Template, 1, &plain.bytes, 0.2).unwrap();
    page.ingest(PageMessageKind::Motion, 1, &motion(&plain, 2, 0.5), 0.2).unwrap();
    page.pose(0.2, false);
    page.look(640, 480).unwrap();
    assert!(!page.centers().is_empty() && page.rotations().is_empty() && page.scales().is_empty());
}
