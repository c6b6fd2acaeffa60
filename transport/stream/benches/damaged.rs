//! Run time of each decoder on damaged messages against that on a valid message, by the thread's processor time.
//!
//!     cargo bench -p flyrig-stream --bench damaged [-- INPUTS [GAUSSIANS]]
//!
//! Ends with an error when a decoder panics, or takes more than four times as long as for the slowest valid message.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    process::ExitCode,
    time::Duration,
};

use flyrig_stream::{
    ColorDecoder, ColorEncoder, ColorSettings, EncodedTemplate, Motion, MotionEncoder, Stamp, StreamJoint,
    StreamTemplate, TemplateSource,
};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

/// Largest run time, as a multiple of that of a valid message.
const MOST_TIMES: u32 = 4;
/// Attempts at a slow input, of which the fastest counts: an attempt may be interrupted.
const ATTEMPTS: usize = 5;
const JOINTS: usize = 24;
const MESSAGES: u64 = 16;

fn cpu_time() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

fn time(work: &mut impl FnMut(&[u8]), input: &[u8]) -> Duration {
    let start = cpu_time();
    work(input);
    cpu_time().saturating_sub(start)
}

/// Builds a tube of joints with as many graph nodes per Gaussian as a real person has.
fn template(gaussians: usize, random: &mut StdRng) -> Result<EncodedTemplate, Box<dyn std::error::Error>> {
    let nodes: Vec<[f32; 3]> = (0..gaussians / 70 + 1).map(|_| random.random()).collect();
    let joints: Vec<StreamJoint> = (0..JOINTS)
        .map(|i| StreamJoint {
            parent: i.checked_sub(1).map(|parent| parent as u16),
            translation: [0.0, 0.07, 0.0],
            joint_from_canonical: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -0.07 * i as f32], [0.0, 0.0, 1.0, 0.0]],
        })
        .collect();
    let mut influences = |count: usize, _: usize| {
        let index = [0; 4].map(|_| random.random_range(0..count as u32));
        (index, random.random::<[f32; 4]>())
    };
    let skin: Vec<_> = (0..gaussians).map(|i| influences(JOINTS, i)).collect();
    let node_weights: Vec<_> = (0..gaussians).map(|i| influences(nodes.len(), i)).collect();
    let place = |i: usize| (i as f32 * 2.4, i as f32 * 1.7 / gaussians as f32);
    let center_scale: Vec<[f32; 4]> = (0..gaussians)
        .map(|i| {
            let (angle, y) = place(i);
            [0.2 * angle.cos(), y, 0.2 * angle.sin(), 0.003]
        })
        .collect();
    let normals: Vec<[f32; 3]> = (0..gaussians).map(|i| [place(i).0.cos(), 0.0, place(i).0.sin()]).collect();
    let (center_scale, normals, skin) = (&center_scale, &normals, &skin);
    let (joints, node_weights, nodes) = (&joints, &node_weights, &nodes);
    Ok(TemplateSource { joints, center_scale, normals, skin, node_weights, nodes }.encode()?)
}

/// Damages a message: flips bits, sets bytes and numbers to extremes, cuts, doubles and mixes.
fn damage(valid: &[Vec<u8>], random: &mut StdRng, input: &mut Vec<u8>) {
    let pick = |random: &mut StdRng| &valid[random.random_range(0..valid.len())];
    input.clear();
    input.extend(pick(random));
    for _ in 0..random.random_range(1..6) {
        let len = input.len().max(1);
        // Half of the changes hit the head, where the numbers are.
        let at = if random.random() { random.random_range(0..len.min(96)) } else { random.random_range(0..len) };
        match random.random_range(0..7) {
            0 => input.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= 1 << random.random_range(0..8)),
            1 => input.iter_mut().skip(at).take(1).for_each(|byte| *byte = random.random()),
            2 => {
                let number: [u8; 4] = [0u32, 1, 0x7fff_ffff, u32::MAX, 0x7f80_0000, 0x7fc0_0000, 0x10_0000]
                    [random.random_range(0..7)]
                .to_le_bytes();
                input.iter_mut().skip(at).zip(number).for_each(|(byte, new)| *byte = new);
            }
            3 => input.truncate(at),
            4 => {
                let end = (at + random.random_range(0..64)).min(input.len());
                let part = input.get(at..end).unwrap_or_default().to_vec();
                input.extend(part);
            }
            5 => {
                let other = pick(random);
                input.truncate(at);
                input.extend(other.iter().skip(at));
            }
            _ => {
                let end = (at + random.random_range(0..256)).min(input.len());
                input.iter_mut().take(end).skip(at).for_each(|byte| *byte = random.random());
            }
        }
    }
}

/// Feeds a decoder, prints a row, and returns whether the bound held.
fn run(name: &str, inputs: u64, valid: &[Vec<u8>], mut decode: impl FnMut(&[u8])) -> bool {
    let mut slowest_valid = Duration::ZERO;
    for message in valid {
        let fastest = (0..ATTEMPTS).map(|_| time(&mut decode, message)).min();
        slowest_valid = slowest_valid.max(fastest.unwrap_or_default());
    }
    let bound = slowest_valid * MOST_TIMES;
    let mut random = StdRng::seed_from_u64(5);
    let (mut slowest, mut input, mut total) = (Duration::ZERO, Vec::new(), Duration::ZERO);
    for i in 0..inputs {
        damage(valid, &mut random, &mut input);
        let took = catch_unwind(AssertUnwindSafe(|| {
            let mut took = time(&mut decode, &input);
            for _ in 1..ATTEMPTS {
                if took > slowest {
                    took = took.min(time(&mut decode, &input));
                }
            }
            took
        }));
        let Ok(took) = took else {
            println!("{name}: input {i} panicked: {input:02x?}");
            return false;
        };
        slowest = slowest.max(took);
        total += took;
    }
    let times = slowest.as_secs_f64() / slowest_valid.as_secs_f64().max(1e-9);
    println!(
        "| {name} | {inputs} | {:.3} | {:.3} | {:.3} | {times:.2} |",
        1e3 * slowest_valid.as_secs_f64(),
        1e3 * total.as_secs_f64() / inputs.max(1) as f64,
        1e3 * slowest.as_secs_f64()
    );
    slowest <= bound
}

fn main() -> Result<ExitCode, Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let number = |n: usize| arguments.get(n).map(|text| text.parse::<u64>()).transpose();
    let (inputs, gaussians) = (number(0)?.unwrap_or(1_000_000), number(1)?.unwrap_or(400) as usize);
    let mut random = StdRng::seed_from_u64(3);
    let encoded = template(gaussians, &mut random)?;
    let others: Vec<Vec<u8>> = [gaussians / 2, gaussians / 3]
        .iter()
        .map(|count| Ok(template(*count, &mut random)?.bytes))
        .collect::<Result<_, Box<dyn std::error::Error>>>()?;
    let known = &encoded.template;
    let (mut motions, mut layers) = (Vec::new(), Vec::new());
    let mut motion_encoder = MotionEncoder::new(&encoded);
    let mut color_encoder = ColorEncoder::new(&encoded, ColorSettings::default(), 7);
    for frame in 0..MESSAGES {
        let stamp = Stamp { frame, capture_nanos: 33_333_333 * frame as i64, ..Stamp::default() };
        let turns: Vec<f32> = (0..JOINTS).map(|_| random.random_range(-0.4..0.4)).collect();
        let joint_rotations = turns.iter().map(|x| [*x, 0.0, 0.0, (1.0 - x * x).sqrt()]);
        let nodes = (0..known.nodes()).map(|_| [0; 3].map(|_| random.random_range(-0.02..0.02))).collect();
        let motion =
            Motion { stamp, root_translation: [0.1, 0.2, 0.3], joint_rotations: joint_rotations.collect(), nodes };
        motions.push(motion_encoder.encode(&motion)?);
        let colors: Vec<[f32; 4]> = (0..gaussians).map(|_| random.random()).collect();
        layers.extend(color_encoder.encode(stamp, &colors));
    }
    println!("{gaussians} Gaussians\n");
    println!("| decoder | damaged inputs | slowest valid ms | mean ms | slowest ms | times the valid one |");
    println!("|---|---|---|---|---|---|");
    let mut templates = vec![encoded.bytes.clone()];
    templates.extend(others);
    let mut is_good = run("template", inputs, &templates, |bytes| drop(StreamTemplate::decode(bytes)));
    is_good &= run("motion", inputs, &motions, |bytes| drop(Motion::decode(bytes, known)));
    let mut decoder = ColorDecoder::new(known);
    is_good &= run("colours", inputs, &layers, |bytes| drop(decoder.ingest(bytes)));
    Ok(if is_good { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
