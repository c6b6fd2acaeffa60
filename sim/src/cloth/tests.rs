//! Loose cloth swings, settles, stays out of the body, and depends on time alone.

use flyrig_body::{Part, skin_mesh};
use flyrig_types::PoseTrack;
use glam::{DQuat, DVec3, Vec3};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::solver::{Particle, ParticleLink, Particles, SkinnedParticle, State, pull, step};
use super::*;
use crate::clothes::wardrobe::{Bottom, HairCut};
use crate::config::{MotionKind, SimConfig};
use crate::person::actor::{Actor, ActorShape};
use crate::person::describe::describe_person;
use crate::person::look::PersonLook;

/// Seeds of a person in a coat, and of one in a skirt.
const COAT: u64 = 16;
const SKIRT: u64 = 5;

fn actor(seed: u64, kind: MotionKind, speed: f64) -> Actor {
    let mut config = SimConfig { seed, texture_px: 64, ..SimConfig::default() };
    (config.motion.kind, config.motion.speed) = (kind, speed);
    Actor::new(&config).unwrap()
}

fn largest(shape: &ActorShape) -> f32 {
    shape.displacement.iter().map(|d| d.length()).fold(0.0, f32::max)
}

/// Returns the largest displacement over eight seconds.
fn swing(actor: &mut Actor) -> f32 {
    (0..40).map(|i| largest(&actor.shape(1_000_000_000 + i * 200_000_000))).fold(0.0, f32::max)
}

#[test]
fn a_coat_swings_the_more_the_faster_its_wearer_turns_and_rests_when_still() {
    assert!(describe_person(&SimConfig { seed: COAT, ..SimConfig::default() }).contains("coat"));
    // Standing still it comes to rest, whatever it takes to get there.
    let mut resting = actor(COAT, MotionKind::Still, 1.0);
    let pose = resting.pose(0);
    resting.track = PoseTrack::new(vec![(0, pose.clone()), (8_000_000_000, pose)]).unwrap();
    let rests: Vec<ActorShape> = (0..16).map(|i| resting.shape(i * 500_000_000)).collect();
    let drift = |shape: &ActorShape| {
        shape.positions.iter().zip(&rests[0].positions).map(|(a, b)| a.distance(*b)).fold(0.0f32, f32::max)
    };
    let still = rests.iter().map(drift).fold(0.0, f32::max);
    let swings = [0.5, 1.0, 2.0].map(|speed| swing(&mut actor(COAT, MotionKind::Turn, speed)));
    println!("coat: still {:.1} mm, turning {:?} mm", still * 1e3, swings.map(|s| s * 1e3));
    assert!(still < 0.004, "{still}");
    assert!(swings[1] > 0.020, "{swings:?}");
    assert!(swings[0] < swings[1] && swings[1] < swings[2] && swings[2] < 0.5, "{swings:?}");
}

#[test]
fn a_skirt_swings_as_its_wearer_walks_and_dances_and_stays_out_of_the_body() {
    for kind in [MotionKind::Walk, MotionKind::Dance, MotionKind::Sit] {
        let mut actor = actor(SKIRT, kind, 1.0);
        let far = swing(&mut actor);
        let mut inside = Vec::new();
        for i in 0..6 {
            inside.push(share_inside(&mut actor, i * 731_000_000));
        }
        println!("{kind:?}: {:.0} mm, shares inside {inside:.4?}", far * 1e3);
        assert!((0.03..0.7).contains(&far), "{kind:?}: {far}");
        assert!(inside.iter().all(|share| *share < 0.01), "{kind:?}: {inside:?}");
    }
}

/// Returns the fraction of the skirt's points that are more than 4 mm below the skin of the nearest part of the legs.
fn share_inside(actor: &mut Actor, nanos: i64) -> f64 {
    let shape = actor.shape(nanos);
    let body = &actor.person.body;
    let (skin, normals) = skin_mesh(body, &actor.pose(nanos));
    let legs: Vec<usize> =
        (0..skin.len()).filter(|&v| matches!(body.parts[v], Part::LeftLeg | Part::RightLeg)).collect();
    let skirt = actor.person.sheets.iter().find(|sheet| sheet.hangs).unwrap().vertices.clone();
    let (mut inside, mut count) = (0, 0);
    for v in skirt.step_by(7) {
        let p = shape.positions[v];
        let nearest = legs.iter().min_by(|&&a, &&b| skin[a].distance(p).total_cmp(&skin[b].distance(p))).unwrap();
        let depth = -(p - skin[*nearest]).dot(normals[*nearest]);
        count += 1;
        inside += usize::from(depth > 0.004 && skin[*nearest].distance(p) < 0.06);
    }
    f64::from(inside as u32) / f64::from(count)
}

#[test]
fn the_order_of_asking_does_not_matter_and_nothing_pops() {
    let times: Vec<i64> = (0..12).map(|i| i * 1_234_567_891 % 23_000_000_000 - 3_000_000_000).collect();
    let mut forwards = actor(SKIRT, MotionKind::Turn, 1.3);
    let shapes: Vec<ActorShape> = times.iter().map(|&t| forwards.shape(t)).collect();
    let mut backwards = actor(SKIRT, MotionKind::Turn, 1.3);
    for (i, &t) in times.iter().enumerate().rev() {
        let again = backwards.shape(t);
        assert!(again.positions == shapes[i].positions && again.normals == shapes[i].normals, "at {t} ns");
        assert_eq!(again.displacement, shapes[i].displacement);
    }
    // Through windows and over the seam: offsets bend, they do not jump.
    let round = forwards.track.span_nanos().1;
    let offsets: Vec<Vec<Vec3>> =
        (0..900).map(|i| forwards.shape(round - 2_000_000_000 + i * 1_000_000_000 / 120).displacement).collect();
    let mut worst = 0.0f32;
    for three in offsets.windows(3) {
        for ((a, b), c) in three[0].iter().zip(&three[1]).zip(&three[2]).step_by(5) {
            worst = worst.max((*a - 2.0 * *b + *c).length());
        }
    }
    println!("at most {:.2} mm of bend from step to step", worst * 1e3);
    assert!(worst < 0.004, "{worst}");
}

#[test]
fn a_teleporting_wearer_is_followed() {
    let mut actor = actor(COAT, MotionKind::Still, 1.0);
    let pose = actor.pose(0);
    let mut far = pose.clone();
    far.root_translation += DVec3::new(30.0, -7.0, 0.0);
    far.joint_rotations[0] = (DQuat::from_rotation_z(2.9) * far.joint_rotations[0]).normalize();
    let mut upside_down = pose.clone();
    upside_down.joint_rotations[0] = DQuat::from_rotation_x(3.0);
    let secs = |s: f64| (s * 1e9) as i64;
    actor.track = PoseTrack::new(vec![
        (0, pose.clone()),
        (secs(0.7), pose.clone()),
        (secs(0.701), far.clone()),
        (secs(1.5), far),
        (secs(1.502), upside_down),
        (secs(1.504), pose),
    ])
    .unwrap();
    for i in 0..60 {
        let shape = actor.shape(i * 25_000_000);
        assert!(shape.positions.iter().chain(&shape.normals).all(|p| p.is_finite()));
        assert!(largest(&shape) < 0.9, "{}", largest(&shape));
    }
}

#[test]
fn tight_clothes_cost_nothing() {
    let config = SimConfig::default();
    let mut look = PersonLook::new(&config);
    look.cut = HairCut::Crop;
    look.outer = None;
    (look.top.offset_m, look.top.tucked, look.top.sleeve_m) = (0.006, true, 0.465);
    if let Bottom::Trousers { wide_m, .. } = &mut look.bottom {
        *wide_m = 0.0;
    }
    assert!(matches!(look.bottom, Bottom::Trousers { .. }));
    let person = Person::new(&look, 1, 64, false).unwrap();
    assert!(Cloth::new(&person).is_none());
    assert!(Cloth::new(&actor(SKIRT, MotionKind::Still, 1.0).person).unwrap().particle_count() > 100);
}

/// Returns a chain hanging from its first particle, with an obstacle.
fn chain(count: usize) -> (Particles, Vec<SkinnedParticle>) {
    let free = |i: usize| i as f32 * 0.05;
    let points = (0..count)
        .map(|i| Particle {
            free_m: free(i),
            stiff: 1.0,
            backstop_m: if i % 3 == 2 { 0.02 } else { 0.5 },
            inside_m: Some(0.001),
        })
        .collect();
    let link = |a: usize, b: usize, soft| ParticleLink { ends: [a as u32, b as u32], rest_m: free(b) - free(a), soft };
    let links = (1..count).map(|i| link(i - 1, i, 1.0)).chain((2..count).map(|i| link(i - 2, i, 12.0))).collect();
    let carried = (0..count)
        .map(|i| SkinnedParticle { place: Vec3::new(0.0, 0.0, 1.0 - free(i)), up: Vec3::Z, normal: Vec3::X })
        .collect();
    (Particles { points, links }, carried)
}

/// Performs the step in f64, written independently from its description.
fn plain_step(
    particles: &Particles,
    carried: &[SkinnedParticle],
    capsule: &colliders::Capsule,
    state: &State,
) -> Vec<DVec3> {
    let (dt, gravity) = (1.0 / 120.0, 9.81);
    let d = |v: Vec3| v.as_dvec3();
    let held = |i: usize| particles.points[i].free_m == 0.0;
    let mut x: Vec<DVec3> = (0..carried.len())
        .map(|i| {
            let (now, was) = (d(carried[i].place), d(state.carried[i]));
            if held(i) {
                return now;
            }
            let up = d(carried[i].up);
            let wearer = (now - was) / dt;
            let v = (d(state.speeds[i]) + dt * gravity * (up * up.z.max(0.0) - DVec3::Z)) / (1.0 + 0.9 * dt);
            let v = wearer + (v - wearer) / (1.0 + 1.6 * dt);
            let k = f64::from(pull(&particles.points[i])) * dt * dt;
            let p = d(state.places[i]) + dt * v;
            (p + k * now) / (1.0 + k)
        })
        .collect();
    for link in &particles.links {
        let [a, b] = link.ends.map(|e| e as usize);
        let (wa, wb) = (if held(a) { 0.0 } else { 1.0 }, if held(b) { 0.0 } else { 1.0 });
        let n = (x[b] - x[a]).normalize();
        let c = x[b].distance(x[a]) - f64::from(link.rest_m);
        let alpha = f64::from(link.soft) * if c > 0.0 { 1e-5 } else { 4e-4 };
        let lambda = -c / (wa + wb + alpha / (dt * dt));
        x[a] -= wa * lambda * n;
        x[b] += wb * lambda * n;
    }
    for i in (0..x.len()).filter(|&i| !held(i)) {
        let (now, wearer) = (d(carried[i].place), d(carried[i].place) - d(state.carried[i]));
        let keep = f64::from(particles.points[i].backstop_m);
        let normal = d(carried[i].normal);
        let above = keep + (x[i] - now).dot(normal);
        x[i] += normal * (-above).max(0.0);
        let [a, b] = capsule.ends.map(d);
        let t = ((x[i] - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
        let radius = f64::from(capsule.radii[0]) * (1.0 - t) + f64::from(capsule.radii[1]) * t;
        let away = x[i] - a.lerp(b, t);
        let allowed = f64::from(particles.points[i].inside_m.unwrap());
        if radius - away.length() > allowed {
            let n = away.normalize();
            x[i] += n * (radius - away.length() - allowed);
            let slid = x[i] - d(state.places[i]) - wearer;
            x[i] -= 0.25 * (slid - n * slid.dot(n));
        }
        x[i].z = x[i].z.max(0.004);
        x[i] = now + (x[i] - now).clamp_length_max(1.3 * f64::from(particles.points[i].free_m));
    }
    x
}

#[test]
fn a_step_agrees_with_a_plain_one_in_double_precision() {
    let mut dice = StdRng::seed_from_u64(3);
    let (particles, mut carried) = chain(9);
    let capsule =
        colliders::Capsule { ends: [Vec3::new(-0.2, 0.01, 0.72), Vec3::new(0.2, 0.0, 0.70)], radii: [0.04, 0.06] };
    let mut state = State::at_rest(&carried);
    let mut touched = 0;
    for round in 0..300 {
        let mut shake = || Vec3::from(std::array::from_fn(|_| dice.random_range(-0.01f32..0.01)));
        let moved = Vec3::X * 0.02 * (round as f32 * 0.1).sin() + shake();
        for c in &mut carried {
            c.place += moved;
            c.up = (Vec3::Z + 20.0 * shake()).normalize();
            c.normal = (Vec3::X + 20.0 * shake()).normalize();
        }
        let expected = plain_step(&particles, &carried, &capsule, &state);
        touched += usize::from(state.places.iter().any(|p| capsule.depth(*p).is_some()));
        step(&particles, &carried, &[capsule], &mut state);
        for (place, expected) in state.places.iter().zip(expected) {
            assert!(place.as_dvec3().distance(expected) < 2e-6, "round {round}: {place} is not {expected}");
        }
    }
    assert!(touched > 10, "the capsule was touched in {touched} rounds");
}

#[test]
fn energy_only_falls_over_a_minute() {
    let (particles, carried) = chain(12);
    let mut state = State::at_rest(&carried);
    for (i, speed) in state.speeds.iter_mut().enumerate().skip(1) {
        *speed = Vec3::new(1.5, if i % 2 == 0 { 1.0 } else { -1.0 }, 0.3);
    }
    let energy = |state: &State| -> f64 {
        (0..carried.len())
            .map(|i| {
                let spring = f64::from(pull(&particles.points[i]) * state.places[i].distance_squared(carried[i].place));
                0.5 * (f64::from(state.speeds[i].length_squared()) + if i > 0 { spring } else { 0.0 })
            })
            .sum()
    };
    let start = energy(&state);
    let mut before = start;
    for second in 0..60 {
        for _ in 0..120 {
            step(&particles, &carried, &[], &mut state);
        }
        let now = energy(&state);
        assert!(now <= before + 1e-9, "second {second}: {now} after {before}");
        before = now;
    }
    assert!(before < 1e-6 * start, "{before} of {start}");
}

#[test]
fn poisoned_particles_return_to_the_body() {
    let (particles, mut carried) = chain(6);
    let mut state = State::at_rest(&carried);
    state.places[2] = Vec3::splat(f32::NAN);
    state.speeds[3] = Vec3::splat(f32::INFINITY);
    state.carried[4] = Vec3::splat(f32::NAN);
    carried[5].place = Vec3::splat(f32::NAN);
    step(&particles, &carried, &[], &mut state);
    carried[5].place = Vec3::new(0.0, 0.0, 0.75);
    for _ in 0..60 {
        step(&particles, &carried, &[], &mut state);
    }
    for (place, c) in state.places.iter().zip(&carried) {
        assert!(place.is_finite() && place.distance(c.place) < 0.35, "{place}");
    }
}
