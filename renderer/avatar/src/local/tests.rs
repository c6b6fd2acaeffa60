use flyrig_body::{ShapeParams, default_template, sample_surface};
use flyrig_renderer::HarmonicOrder;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

use super::*;
use crate::local::groups;

fn avatar(count: usize, order: HarmonicOrder) -> (Avatar, Vec<Vec2>) {
    let template = default_template(&ShapeParams::default()).unwrap();
    let surface = sample_surface(&template, count, 5).unwrap();
    let colors: Vec<[f32; 3]> = surface.positions.iter().map(|p| [0.3 + 0.1 * p.y, 0.4, 0.2]).collect();
    (Avatar::new(&template, &surface, None, &colors, order).unwrap(), surface.uvs)
}

fn settings(stages: usize) -> LocalSettings {
    LocalSettings { stages, side: 32, ..LocalSettings::default() }
}

/// Numbers at random in place of zeros, so that every layer counts.
fn shake(local: &mut Local) {
    let mut random = StdRng::seed_from_u64(3);
    let of_texture =
        local.tables.iter_mut().filter(|(name, _)| name.starts_with("texture") || name.starts_with("encoder"));
    for parameter in local.networks.values_mut().chain(of_texture.map(|(_, parameter)| parameter)) {
        parameter.values.iter_mut().for_each(|value| *value += random.random_range(-0.1f32..0.1));
    }
    let displacement = local.tables.get_mut("displacement").unwrap();
    displacement.values.iter_mut().for_each(|value| *value = random.random_range(-0.01f32..0.01));
}

type Numbers = BTreeMap<String, Vec<f64>>;

/// The lists by their definition, in f64; the shares of encoding and atlas have tests of their own.
fn reference(local: &Local, numbers: &Numbers) -> [Vec<[f64; 4]>; 4] {
    let wide = |list: &[Element]| -> Vec<[f64; 4]> { list.iter().map(|row| row.map(f64::from)).collect() };
    let mut lists = local.start.lists().map(wide);
    for (stage, Stage { groups, inputs, encoding, .. }) in local.stages.iter().enumerate() {
        let table = &numbers[&format!("stage.{stage}.hash")];
        let features = encoding_in_f64(encoding, table);
        for (branch, columns) in branches(stage) {
            let (list, first, unit) = column(branch);
            for input in 0..inputs.len() {
                let mut x = features[input * WIDTH..(input + 1) * WIDTH].to_vec();
                for layer in 0..3 {
                    let name = format!("stage.{stage}.{branch}.{layer}");
                    let (weight, bias) = (&numbers[&format!("{name}.weight")], &numbers[&format!("{name}.bias")]);
                    x = (0..bias.len())
                        .map(|to| {
                            let sum = x.iter().enumerate().map(|(from, v)| v * weight[from * bias.len() + to]);
                            bias[to] + sum.sum::<f64>()
                        })
                        .map(|v: f64| if layer < 2 { v.max(0.0) } else { v })
                        .collect();
                }
                for slot in 0..groups.slots {
                    let gaussian = groups.members[input * groups.slots + slot];
                    if gaussian != groups::NOBODY {
                        for k in 0..*columns {
                            lists[list][gaussian as usize][first + k] += f64::from(unit) * x[slot * columns + k];
                        }
                    }
                }
            }
        }
        if stage == 0 {
            for (_, gaussian) in groups.cells() {
                (0..3).for_each(|k| lists[0][gaussian][k] += numbers["displacement"][4 * gaussian + k]);
            }
        }
    }
    let (map, first_atlas) = local.atlas.as_ref().unwrap();
    let (side, coefficients) = (map.side as i64, local.start.order().coefficients());
    let mut planes = numbers["texture"].clone();
    let mut from = texture::FEATURES;
    for layer in 0..3 {
        let (weight, bias) = (&numbers[&format!("encoder.{layer}.weight")], &numbers[&format!("encoder.{layer}.bias")]);
        let to = bias.len();
        let at = |chart: usize, channel: usize, y: i64, x: i64| {
            let inside = (0..side).contains(&x) && (0..side).contains(&y);
            if inside { planes[((chart * from + channel) as i64 * side * side + y * side + x) as usize] } else { 0.0 }
        };
        let mut next = Vec::new();
        for chart in 0..map.charts {
            for out in 0..to {
                for y in 0..side {
                    for x in 0..side {
                        let mut sum = bias[out];
                        for channel in 0..from {
                            for tap in 0..9 {
                                let value = at(chart, channel, y + tap / 3 - 1, x + tap % 3 - 1);
                                sum += weight[(out * from + channel) * 9 + tap as usize] * value;
                            }
                        }
                        next.push(if layer < 2 { sum.max(0.0) } else { sum });
                    }
                }
            }
        }
        (planes, from) = (next, to);
    }
    let texels = map.texels();
    for (gaussian, taps) in map.taps.iter().enumerate() {
        for channel in 0..3 * coefficients {
            for (texel, share) in taps {
                let (chart, texel) = (*texel as usize / texels, *texel as usize % texels);
                let first = if channel < 3 { first_atlas[(chart * 3 + channel) * texels + texel] } else { 0.0 };
                let value = planes[(chart * 3 * coefficients + channel) * texels + texel] + f64::from(first);
                lists[3][gaussian * coefficients + channel / 3][channel % 3] += f64::from(*share) * value;
            }
        }
    }
    lists
}

/// Features from a table in f64.
fn encoding_in_f64(encoding: &HashEncoding, table: &[f64]) -> Vec<f64> {
    let entry = |at: usize, feature: usize| -> f64 {
        let row = |(row, share): &(u32, f32)| {
            f64::from(*share) * table[((at % LEVELS) * ROWS + *row as usize) * FEATURES + feature]
        };
        encoding.corners[at].iter().map(row).sum()
    };
    (0..encoding.corners.len() * FEATURES).map(|i| entry(i / FEATURES, i % FEATURES)).collect()
}

fn numbers(local: &Local) -> Numbers {
    let wide = |p: &Parameter| p.values.iter().map(|value| f64::from(*value)).collect();
    local.networks.iter().chain(&local.tables).map(|(name, p)| (name.clone(), wide(p))).collect()
}

#[test]
fn the_start_is_the_avatar_as_it_was_made() {
    let (avatar, uvs) = avatar(600, HarmonicOrder::One);
    for (stages, layout) in [(1, AtlasLayout::Uv), (3, AtlasLayout::FrontBack)] {
        let settings = LocalSettings { stages, layout, side: 128, ..LocalSettings::default() };
        let mut local = Local::new(&avatar, &uvs, &settings, 1).unwrap();
        assert_eq!(local.stages.len(), stages);
        let mut found = avatar.parameters.clone();
        local.evaluate(&mut found);
        assert!(found.offset == avatar.parameters.offset && found.shape == avatar.parameters.shape);
        assert!(found.rotation == avatar.parameters.rotation && found.order() == avatar.parameters.order());
        let rows = found.harmonics.iter().flatten().zip(avatar.parameters.harmonics.iter().flatten());
        let away: Vec<f32> = rows.map(|(a, b)| (a - b).abs()).collect();
        let mean = away.iter().sum::<f32>() / away.len() as f32;
        assert!(mean < 0.02, "{layout:?} {mean}");
    }
}

#[test]
fn lists_are_those_of_the_definition_and_derivatives_those_of_finite_differences() {
    let (avatar, uvs) = avatar(60, HarmonicOrder::One);
    for (stages, layout) in [(1, AtlasLayout::FrontBack), (2, AtlasLayout::Uv)] {
        let mut local = Local::new(&avatar, &uvs, &LocalSettings { layout, side: 16, ..settings(stages) }, 1).unwrap();
        shake(&mut local);
        let mut found = avatar.parameters.clone();
        local.evaluate(&mut found);
        let mut numbers = numbers(&local);
        let expected = reference(&local, &numbers);
        for (found, expected) in found.lists().iter().zip(&expected) {
            for (found, expected) in found.iter().flatten().zip(expected.iter().flatten()) {
                assert!((f64::from(*found) - expected).abs() < 1e-4 * (expected.abs() + 1.0), "{found} {expected}");
            }
        }
        let slopes: [Vec<Element>; 4] = found
            .lists()
            .map(|list| (0..list.len()).map(|i| [0.7, 1.3, 2.1, 0.4].map(|f| (f * i as f32).cos())).collect());
        let gradients = local.gradients(&slopes);
        assert!(gradients.len() == local.networks.len() + local.tables.len());
        let loss = |numbers: &Numbers| -> f64 {
            let lists = reference(&local, numbers);
            let dot = |(list, slopes): (&Vec<[f64; 4]>, &Vec<Element>)| {
                list.iter().flatten().zip(slopes.iter().flatten()).map(|(a, b)| a * f64::from(*b)).sum::<f64>()
            };
            lists.iter().zip(&slopes).map(dot).sum()
        };
        let mut errors = Vec::new();
        for (name, gradient) in &gradients {
            let largest = gradient.iter().fold(0.0f32, |most, slope| most.max(slope.abs()));
            let some: Vec<usize> = (0..gradient.len()).filter(|i| gradient[*i].abs() > 0.2 * largest).collect();
            // The unused column of displacements and unused hash rows have none.
            for &i in some.iter().step_by((some.len() / 2).max(1)) {
                let before = numbers[name][i];
                let mut at = |value: f64| {
                    numbers.get_mut(name).unwrap()[i] = value;
                    loss(&numbers)
                };
                let step = 1e-6;
                let expected = (at(before + step) - at(before - step)) / (2.0 * step);
                at(before);
                errors.push((expected - f64::from(gradient[i])).abs() / (expected.abs() + 0.01));
                assert!(errors[errors.len() - 1] < 1e-2, "{name} {i}: {expected} {}", gradient[i]);
            }
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors.len() > 40 && errors[errors.len() / 2] < 1e-5, "{:?}", errors[errors.len() / 2]);
    }
}

/// Moves all lists towards others, and returns the mean squared distance.
fn learn(local: &mut Local, wanted: &GaussianParameters, now: &mut GaussianParameters, steps: usize) -> f64 {
    let mut sum = 0.0;
    for step in 0..steps {
        local.evaluate(now);
        local.refresh(now);
        let slopes: Vec<Vec<Element>> = now
            .lists()
            .iter()
            .zip(wanted.lists())
            .map(|(now, wanted)| now.iter().zip(wanted).map(|(a, b)| std::array::from_fn(|k| a[k] - b[k])).collect())
            .collect();
        sum = slopes.iter().flatten().flatten().map(|slope| f64::from(*slope).powi(2)).sum();
        local.descend(&slopes, step as f32 / steps as f32);
    }
    local.evaluate(now);
    sum
}

#[test]
fn lists_without_networks_stay_as_they_are() {
    let (avatar, uvs) = avatar(200, HarmonicOrder::Zero);
    let mut own = avatar.parameters.clone();
    own.lists_mut().into_iter().flatten().flatten().for_each(|value| *value += 0.25);
    for (geometry, colors) in [(true, false), (false, true), (false, false)] {
        let settings = LocalSettings { geometry, colors, ..settings(2) };
        // An atlas alone needs texture coordinates.
        let mut local = Local::new(&avatar, if colors { &uvs } else { &[] }, &settings, 1).unwrap();
        let has = |part: &str| local.networks.keys().chain(local.tables.keys()).any(|name| name.contains(part));
        assert_eq!(
            [has("displacement"), has("hash"), has("stage"), has("texture")],
            [geometry, geometry, geometry, colors]
        );
        let mut now = own.clone();
        for step in 0..3 {
            local.evaluate(&mut now);
            for (list, (now, own)) in now.lists().into_iter().zip(own.lists()).enumerate() {
                assert!(local.predicts(list) || now == own, "{list}");
                let moved = now.iter().flatten().zip(own.iter().flatten()).any(|(a, b)| (a - b).abs() > 0.1);
                assert_eq!(moved, local.predicts(list), "{list}");
            }
            let slopes = now.lists().map(|list| vec![[0.1 * step as f32; 4]; list.len()]);
            local.descend(&slopes, 0.5);
        }
        assert!(now.is_finite() && flyrig_learn::is_finite(&local.networks) && flyrig_learn::is_finite(&local.tables));
    }
}

#[test]
fn what_is_wanted_is_learnt_and_the_same_seed_gives_the_same_numbers() {
    let (avatar, uvs) = avatar(300, HarmonicOrder::Zero);
    let mut wanted = avatar.parameters.clone();
    wanted.shape.iter_mut().for_each(|row| row[0] += 0.5);
    wanted.harmonics.iter_mut().for_each(|row| row[1] -= 0.3);
    wanted.offset.iter_mut().for_each(|row| row[2] += 0.004);
    let run = |seed: u64| {
        let mut local = Local::new(&avatar, &uvs, &settings(2), seed).unwrap();
        let mut now = avatar.parameters.clone();
        let first = learn(&mut local, &wanted, &mut now, 1);
        (first, learn(&mut local, &wanted, &mut now, 60), now)
    };
    let (first, last, now) = run(1);
    assert!(last < 0.1 * first, "{first} {last}");
    let again = run(1);
    assert!(again.2 == now && again.1.to_bits() == last.to_bits());
    assert!(run(2).2 != now);
}

#[test]
fn poison_spoils_no_network_and_few_gaussians_are_enough() {
    let (avatar, uvs) = avatar(50, HarmonicOrder::Two);
    let mut local = Local::new(&avatar, &uvs, &settings(2), 1).unwrap();
    let mut now = avatar.parameters.clone();
    for poison in [f32::NAN, f32::INFINITY, f32::MAX] {
        local.evaluate(&mut now);
        local.descend(&now.lists().map(|list| vec![[poison, 0.1, -0.1, poison]; list.len()]), 0.9);
        assert!(flyrig_learn::is_finite(&local.networks) && flyrig_learn::is_finite(&local.tables), "{poison}");
    }
    local.evaluate(&mut now);
    assert!(now.is_finite());
    // Without an evaluation before it, and with lists of another avatar, nothing happens.
    let before = (local.networks.clone(), local.tables.clone());
    local.tape = None;
    local.descend(&now.lists().map(<[Element]>::to_vec), 0.5);
    local.descend(&[], 0.5);
    assert!((local.networks, local.tables) == before);
    for count in [1, 2, 3] {
        let mut few = avatar.clone();
        few.places.truncate(count);
        let [offset, shape, rotation, harmonics] = now.lists().map(<[Element]>::to_vec);
        few.parameters = GaussianParameters::from_lists([
            offset[..count].to_vec(),
            shape[..count].to_vec(),
            rotation[..count].to_vec(),
            harmonics[..count * 9].to_vec(),
        ])
        .unwrap();
        let mut local = Local::new(&few, &uvs[..count], &settings(3), 1).unwrap();
        let mut now = few.parameters.clone();
        assert!(learn(&mut local, &few.parameters, &mut now, 2).is_finite() && now.is_finite());
    }
    let mut none = avatar.clone();
    none.places.clear();
    none.parameters = GaussianParameters::zeroed(0, HarmonicOrder::Zero);
    assert!(Local::new(&none, &[], &settings(1), 1).unwrap().stages.is_empty());
}

#[test]
fn higher_orders_come_later() {
    let (avatar, uvs) = avatar(50, HarmonicOrder::Two);
    let local = Local::new(&avatar, &uvs, &settings(1), 1).unwrap();
    for (progress, shown) in [(0.0, 1), (0.4, 4), (0.7, 9), (1.0, 9), (f32::NAN, 1)] {
        let mut slopes = vec![[1.0; 4]; 18];
        local.hide_orders(&mut slopes, progress);
        let rows = (0..18).filter(|i| slopes[*i][0] > 0.0);
        assert!(rows.eq((0..18).filter(|i| i % 9 < shown)), "{progress}");
    }
}
