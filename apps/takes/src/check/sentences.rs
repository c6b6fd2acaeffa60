//! Faults of a calibration in a few sentences.

use flyrig_types::{ColorMatch, Rig};

use super::{colors::ColorFinding, geometry::Finding};

/// Weights of red, green and blue in the light that a person sees.
const LUMA: [f64; 3] = [0.2126, 0.7152, 0.0722];
/// Least rotation, degrees, and difference of light or tint, as a fraction, that is mentioned.
const LEAST_DEG: f64 = 0.1;
const LEAST_LIGHT: f64 = 0.05;

/// Returns a sentence on times and poses, one on colours, and one on the agreement that was reached. `old` is the calibration before.
pub(super) fn sentences(old: &Rig, finding: &Finding, colors: &ColorFinding) -> Vec<String> {
    let mut sentences = Vec::new();
    let wrong: Vec<String> = (0..old.cameras.len())
        .filter_map(|slot| {
            let late = late(finding.lags_s[slot]).filter(|_| finding.adopts_lags);
            let off = finding.adopts_poses.then(|| finding.fit.cameras[slot].moved.0).filter(|deg| *deg >= LEAST_DEG);
            let off = off.map(|deg| format!("{deg:.1} degrees off"));
            let all: Vec<String> = late.into_iter().chain(off).collect();
            (!all.is_empty()).then(|| format!("camera {} is {}", old.cameras[slot].id, all.join(" and ")))
        })
        .collect();
    if !wrong.is_empty() {
        sentences.push(format!("{}.", wrong.join("; ")));
    }
    let tints: Vec<String> = old
        .cameras
        .iter()
        .zip(&colors.colors)
        .filter(|_| colors.is_adopted)
        .filter_map(|(camera, new)| Some(format!("camera {} is {}", camera.id, light(&camera.color, new)?)))
        .collect();
    if colors.is_adopted {
        let all = if tints.is_empty() { "the cameras' colours differ a little".to_owned() } else { tints.join("; ") };
        sentences.push(format!("{all}."));
    }
    let outlines = match (finding.fit.planes_rad, finding.adopts_lags || finding.adopts_poses) {
        (Some((before, after)), true) => {
            Some(format!("outlines that disagreed by {:.1} mrad now disagree by {:.1}", 1e3 * before, 1e3 * after))
        }
        _ => None,
    };
    let shades = colors.difference.filter(|_| colors.is_adopted).map(|(before, after)| {
        format!("colours that differed by {:.0} % now differ by {:.0} %", 100.0 * before, 100.0 * after)
    });
    let gained: Vec<String> = outlines.into_iter().chain(shades).collect();
    if gained.is_empty() {
        sentences.push("the calibration agrees with the person in the take and is kept.".to_owned());
    } else {
        sentences.push(format!("corrected in calibration.toml: {}.", gained.join("; ")));
    }
    sentences
}

/// Says how late timestamps are.
fn late(lag_s: f64) -> Option<String> {
    let ms = 1e3 * lag_s.abs();
    (ms > 0.0).then(|| format!("{ms:.0} ms {}", if lag_s > 0.0 { "late" } else { "early" }))
}

/// Says what was wrong with a camera's light, from its corrections before and now.
fn light(old: &ColorMatch, new: &ColorMatch) -> Option<String> {
    let ratio = |k: usize| new.gain[k] / old.gain[k];
    let all: f64 = (0..3).map(|k| LUMA[k] * ratio(k)).sum();
    let share = 1.0 / all - 1.0;
    let shade = (share.abs() >= LEAST_LIGHT)
        .then(|| format!("{} too {}", fraction(share.abs()), if share < 0.0 { "dark" } else { "bright" }));
    let names = ["red", "green", "blue"];
    let tint = (0..3).map(|k| (all / ratio(k) - 1.0, names[k])).max_by(|a, b| a.0.total_cmp(&b.0));
    let tint = tint.filter(|(excess, _)| *excess >= LEAST_LIGHT).map(|(_, name)| format!("too {name}"));
    let words: Vec<String> = shade.into_iter().chain(tint).collect();
    (!words.is_empty()).then(|| words.join(" and "))
}

/// Returns a fraction in words where there is one, in percent otherwise.
fn fraction(share: f64) -> String {
    let known = [(0.1, "a tenth"), (0.2, "a fifth"), (0.25, "a quarter"), (1.0 / 3.0, "a third"), (0.5, "half")];
    let near = known.into_iter().find(|(value, _)| (share - value).abs() < 0.02);
    near.map_or_else(|| format!("{:.0} %", 100.0 * share), |(_, word)| word.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_wrong_is_said_in_words() {
        let gain = |r: f64, g: f64, b: f64| ColorMatch { gain: [r, g, b], ..ColorMatch::NONE };
        let said = |color: ColorMatch| light(&ColorMatch::NONE, &color);
        assert_eq!(said(gain(1.5, 1.5, 1.5)).unwrap(), "a third too dark");
        assert_eq!(said(gain(0.8, 0.8, 0.8)).unwrap(), "a quarter too bright");
        assert_eq!(said(gain(1.0, 1.0, 0.8)).unwrap(), "too blue");
        assert_eq!(said(gain(1.01, 1.0, 1.0)), None);
        assert_eq!((late(0.045).unwrap().as_str(), late(-0.08).unwrap().as_str()), ("45 ms late", "80 ms early"));
        assert_eq!(fraction(0.42), "42 %");
    }
}
