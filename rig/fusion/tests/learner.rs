//! Learning of a person while the session runs: the learnt person is seen better by other cameras, and other clothes are learnt anew.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

mod support;

use flyrig_avatar::{Avatar, AvatarScene};
use flyrig_body::{DEFAULT_SIGMA2_M2, build_graph, sample_surface};
use flyrig_fusion::{
    AppearanceMode, GivenPerception, GivenPerson, Outcome, PersonId, PersonMemory, Session, SessionBuilder,
    SessionSettings,
};
use flyrig_gpu::GpuContext;
use flyrig_renderer::HarmonicOrder;
use flyrig_types::{Camera, FrameSet, Pose, PoseTrack, RenderedView};
use glam::DQuat;

use support::{SIZE, camera, frame_set, gpu, rig, settings, template};

const ME: PersonId = PersonId(0);
/// Frame sets of a full turn, at 30 per second.
const TURN: i64 = 60;

/// Returns the pose in a frame set: the person turns and sways.
fn pose(index: i64) -> Pose {
    let mut pose = support::pose(0.0);
    let angle = std::f64::consts::TAU * index as f64 / TURN as f64;
    pose.joint_rotations[0] = DQuat::from_rotation_y(angle) * pose.joint_rotations[0];
    pose
}

/// Person with a hump of eight centimetres on the back, in bands of two colours.
fn truth(colors: [[f32; 3]; 2]) -> Avatar {
    let body = template();
    let surface = sample_surface(&body, 4000, 1).unwrap();
    let graph = build_graph(&body, &surface, 60, DEFAULT_SIGMA2_M2).unwrap();
    let band = |height: f32| colors[usize::from((height * 12.0).rem_euclid(2.0) < 1.0)];
    let painted: Vec<[f32; 3]> = surface.positions.iter().map(|position| band(position.y)).collect();
    let mut avatar = Avatar::new(&body, &surface, Some(&graph), &painted, HarmonicOrder::Zero).unwrap();
    for (offset, normal) in avatar.parameters.offset.iter_mut().zip(&surface.normals) {
        if normal.z < -0.5 {
            offset[2] = -0.08;
        }
    }
    avatar
}

/// Renders a person as these cameras see it in a frame set.
fn views(scene: &mut AvatarScene, avatar: &Avatar, index: i64, cameras: &[Camera]) -> Vec<RenderedView> {
    scene.drive(avatar, &pose(index));
    cameras.iter().map(|camera| scene.draw(camera).unwrap()).collect()
}

/// Draws over grey: sRGB, and the mask.
fn photograph(view: &RenderedView) -> (Vec<u8>, Vec<u8>) {
    let over = |pixel: &[u8]| -> [u8; 3] {
        let alpha = u32::from(pixel[3]);
        [0, 1, 2].map(|k| ((u32::from(pixel[k]) * alpha + 90 * (255 - alpha)) / 255) as u8)
    };
    let rgb = view.rgba.chunks_exact(4).flat_map(over).collect();
    (rgb, view.rgba.iter().skip(3).step_by(4).copied().collect())
}

/// Returns the mean squared difference of colours times coverage, codes.
fn difference(a: &RenderedView, b: &RenderedView) -> f64 {
    let shown = |pixel: &[u8], k: usize| f64::from(pixel[k]) * f64::from(pixel[3]) / 255.0;
    let pixels = a.rgba.chunks_exact(4).zip(b.rgba.chunks_exact(4));
    let squares = pixels.flat_map(|(a, b)| [0, 1, 2].map(|k| (shown(a, k) - shown(b, k)).powi(2)));
    squares.sum::<f64>() / f64::from(3 * SIZE * SIZE)
}

fn learning() -> SessionSettings {
    let mut settings = settings(4000);
    settings.body.learn = true;
    settings
}

/// Returns a session that follows the person, and resumes it from a memory.
fn session(gpu: GpuContext, settings: SessionSettings, memory: Option<PersonMemory>) -> Session {
    let keys = (0..=TURN).map(|index| (index * support::PERIOD_NANOS, pose(index))).collect();
    let track = PoseTrack::new(keys).unwrap();
    let person = GivenPerson { person: ME, template: template(), track, repeat: true };
    // Without a search for clothes, which would change the surface.
    let perception = GivenPerception::new(&rig(), vec![person]).dressed();
    let builder = SessionBuilder::new(gpu, rig()).settings(settings).perception(perception);
    match memory {
        Some(memory) => builder.person(ME, memory).build().unwrap(),
        None => builder.build().unwrap(),
    }
}

/// Shows a person to a session in frame sets `from..to`, and returns the mean difference to a camera between the others in the last ten.
fn show(session: &mut Session, avatar: &Avatar, from: i64, to: i64) -> f64 {
    let mut scene = AvatarScene::new(session.gpu(), avatar).unwrap();
    let other = camera("45", 45.0);
    let mut sum = 0.0;
    for index in from..to {
        let images: Vec<_> = views(&mut scene, avatar, index, &rig().cameras).iter().map(photograph).collect();
        assert_eq!(session.process(&frame_set(index as u64, &images)).unwrap(), Outcome::Updated);
        if index >= to - 10 {
            let wanted = views(&mut scene, avatar, index, std::slice::from_ref(&other)).remove(0);
            sum += difference(&session.render(&other).unwrap(), &wanted) / 10.0;
        }
    }
    sum
}

/// Returns the template that viewers draw: its hash, and whether it has the axes of an avatar.
fn template_of_stream(session: &Session) -> (u64, bool) {
    let empty = (vec![90; (SIZE * SIZE * 3) as usize], vec![0; (SIZE * SIZE) as usize]);
    let frame = session.person_frame(ME, &frame_set(0, &vec![empty; 4])).unwrap().unwrap();
    let template = &frame.template().template;
    (template.hash, template.has_axes() && !template.has_colors())
}

fn count(session: &Session, name: &str) -> u64 {
    session.stages.counts().find(|(known, _)| *known == name).map_or(0, |(_, count)| count)
}

#[test]
fn a_learnt_person_is_seen_better_by_another_camera_and_reruns_are_identical() {
    let avatar = truth([[0.5, 0.05, 0.03], [0.05, 0.1, 0.5]]);
    let run = |settings: SessionSettings| {
        let mut session = session(gpu(), settings, None);
        session.set_learning_steps(25);
        let error = show(&mut session, &avatar, 0, 160);
        (error, session)
    };
    let (without, _) = run(settings(4000));
    let (with, first) = run(learning());
    assert!(count(&first, "versions of the person adopted") > 0);
    assert!(with < 0.8 * without, "{with}, without learning {without}");
    assert_eq!(count(&first, "versions of the person dropped"), 0);
    assert!(template_of_stream(&first).1, "viewers draw the avatar");
    let progress = first.learning().unwrap();
    assert_eq!(u64::from(progress.version), count(&first, "versions of the person adopted"));
    assert_eq!(u64::from(progress.rounds), count(&first, "rounds of learning"));
    assert!(progress.key_sets > 8 && progress.gain > Some(0.01) && progress.seconds > 0.0, "{progress:?}");
    let (_, second) = run(learning());
    assert_eq!(first.memory(ME).unwrap(), second.memory(ME).unwrap());

    // A saved person goes on where it was.
    let memory = first.memory(ME).unwrap();
    assert!(memory.avatar().is_some());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("me.person");
    memory.save(&path).unwrap();
    let loaded = PersonMemory::load(&path).unwrap();
    let mut resumed = session(gpu(), learning(), Some(loaded));
    show(&mut resumed, &avatar, 0, 1);
    assert_eq!(resumed.learning().unwrap().version, 1, "it is that avatar before anything is learnt");
    let error = show(&mut resumed, &avatar, 0, 15);
    let unlearnt = show(&mut session(gpu(), settings(4000), None), &avatar, 0, 15);
    assert!(resumed.memory(ME).unwrap().avatar().is_some());
    assert!(error < 0.8 * unlearnt, "{error} after it was resumed, {unlearnt} without learning");
}

#[test]
#[ignore = "minutes: run by make test-long"]
fn other_clothes_are_noticed_and_learnt_anew() {
    let (before, after) = (truth([[0.5, 0.05, 0.03], [0.05, 0.1, 0.5]]), truth([[0.02, 0.4, 0.05], [0.6, 0.5, 0.02]]));
    let mut session = session(gpu(), learning(), None);
    session.set_learning_steps(25);
    show(&mut session, &before, 0, 90);
    assert!(count(&session, "versions of the person adopted") > 0);
    // Key sets are replaced when they are twenty seconds old.
    show(&mut session, &after, 700, 700 + TURN);
    assert!(count(&session, "versions of the person dropped") > 0);
    let adopted = count(&session, "versions of the person adopted");
    show(&mut session, &after, 700 + TURN, 720 + 3 * TURN);
    assert!(count(&session, "versions of the person adopted") > adopted, "learnt anew");
}

#[test]
fn a_person_who_leaves_for_long_is_forgotten() {
    let avatar = truth([[0.5, 0.05, 0.03], [0.05, 0.1, 0.5]]);
    let mut session = session(gpu(), learning(), None);
    session.set_learning_steps(25);
    show(&mut session, &avatar, 0, 10);
    let (surface, has_axes) = template_of_stream(&session);
    assert!(!has_axes);
    show(&mut session, &avatar, 10, 90);
    let (version, has_axes) = template_of_stream(&session);
    assert!(has_axes && version != surface);
    let empty = (vec![90; (SIZE * SIZE * 3) as usize], vec![0; (SIZE * SIZE) as usize]);
    let nobody = |index| frame_set(index, &vec![empty.clone(); 4]);
    for index in 90..125 {
        session.process(&nobody(index)).unwrap();
    }
    show(&mut session, &avatar, 125, 136);
    assert!(session.memory(ME).unwrap().avatar().is_none(), "another person may have come");
    assert_eq!(template_of_stream(&session), (surface, false));
    let progress = session.learning().unwrap();
    assert!(progress.version == 0 && progress.gain.is_none() && progress.rounds > 0, "{progress:?}");
}

#[test]
fn a_thread_learns_while_frame_sets_go_on_and_ends_with_its_session() {
    let avatar = truth([[0.5, 0.05, 0.03], [0.05, 0.1, 0.5]]);
    let mut session = session(gpu(), learning(), None);
    session.use_threads();
    let is_adopted = |session: &Session| count(session, "versions of the person adopted") > 0;
    // The thread takes some seconds; a key set comes with most frame sets.
    let mut shown = 0;
    while !is_adopted(&session) && shown < 3000 {
        show(&mut session, &avatar, shown, shown + 10);
        shown += 10;
    }
    assert!(is_adopted(&session), "{:?} after {shown} frame sets", session.learning());
    // In the middle of its work.
    drop(session);
}

#[test]
fn cameras_that_do_not_see_the_person_take_no_part() {
    let avatar = truth([[0.5, 0.05, 0.03], [0.05, 0.1, 0.5]]);
    let mut session = session(gpu(), learning(), None);
    session.set_learning_steps(25);
    let mut scene = AvatarScene::new(session.gpu(), &avatar).unwrap();
    for index in 0..140 {
        let mut images: Vec<_> = views(&mut scene, &avatar, index, &rig().cameras).iter().map(photograph).collect();
        images[1..].iter_mut().for_each(|(_, mask)| mask.fill(0));
        session.process(&frame_set(index as u64, &images)).unwrap();
    }
    let progress = session.learning().unwrap();
    assert!(progress.version > 0 && progress.rounds > 1, "{progress:?}");
}

#[test]
fn nothing_is_learnt_from_empty_images_and_networks_exclude_learning() {
    let mut session = session(gpu(), learning(), None);
    session.set_learning_steps(25);
    let empty = (vec![90; (SIZE * SIZE * 3) as usize], vec![0; (SIZE * SIZE) as usize]);
    let sets: Vec<FrameSet> = (0..40).map(|index| frame_set(index, &vec![empty.clone(); 4])).collect();
    for set in &sets {
        session.process(set).unwrap();
    }
    assert_eq!(count(&session, "key sets to learn from"), 0);
    let mut settings = learning();
    settings.appearance.mode = AppearanceMode::Stfa;
    let refused = settings.validate().unwrap_err().to_string();
    assert!(refused.contains("body.learn needs"), "{refused}");
}
