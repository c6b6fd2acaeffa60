//! Cameras' names in footage and calibration.

use anyhow::{Result, bail};

/// Cameras of the footage with those of the calibration.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Matched {
    /// Slots in the footage and in the calibration.
    pub pairs: Vec<(usize, usize)>,
    /// Assumptions, and names that were left out, for the user.
    pub notes: Vec<String>,
}

/// Parses `FOOTAGE=CALIBRATION`, two names of one camera.
///
/// # Errors
/// Shows the expected form.
pub fn parse_pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((a, b)) if !a.is_empty() && !b.is_empty() => Ok((a.to_owned(), b.to_owned())),
        _ => Err(format!("'{text}' is not FOOTAGE=CALIBRATION, the camera's names in both, like left=cam0")),
    }
}

/// Finds the camera of the calibration for each one of the footage. `given` are pairs that the user states.
pub(super) fn matched(footage: &[String], calibration: &[String], given: &[(String, String)]) -> Result<Matched> {
    for (a, b) in given {
        for (name, known, place) in [(a, footage, "footage"), (b, calibration, "calibration")] {
            if !known.contains(name) {
                bail!("--name {a}={b}: the {place} has no camera {name}; it has: {}", known.join(", "));
            }
        }
    }
    let find = |name: &String| match given.iter().find(|(a, _)| a == name) {
        Some((_, b)) => calibration.iter().position(|known| known == b),
        None => same_camera(name, calibration),
    };
    let (mut pairs, mut notes) = (Vec::new(), Vec::new());
    for (slot, name) in footage.iter().enumerate() {
        let Some(known) = find(name) else { continue };
        if let Some((other, _)) = pairs.iter().find(|(_, taken)| *taken == known) {
            let other: usize = *other;
            bail!(
                "cameras {} and {name} of the footage could both be {} of the calibration; say which with --name {name}={}",
                footage[other],
                calibration[known],
                calibration[known]
            );
        }
        pairs.push((slot, known));
    }
    let loose = |all: &[String], is_taken: &dyn Fn(usize) -> bool| -> Vec<String> {
        all.iter().enumerate().filter(|(i, _)| !is_taken(*i)).map(|(_, name)| name.clone()).collect()
    };
    let without = loose(footage, &|i| pairs.iter().any(|(slot, _)| *slot == i));
    let unused = loose(calibration, &|i| pairs.iter().any(|(_, known)| *known == i));
    if !without.is_empty() && !unused.is_empty() {
        let order: Vec<String> = without.iter().zip(&unused).map(|(a, b)| format!("--name {a}={b}")).collect();
        bail!(
            "it is not sure which cameras of the footage ({}) are which of the calibration ({}); if they are in this order, add {}",
            without.join(", "),
            unused.join(", "),
            order.join(" ")
        );
    }
    if pairs.is_empty() {
        bail!("no camera of the footage is in the calibration");
    }
    if !without.is_empty() {
        notes.push(format!("left out, since the calibration does not have them: {}", without.join(", ")));
    }
    if !unused.is_empty() {
        notes.push(format!("in the calibration but not in the footage: {}", unused.join(", ")));
    }
    let renamed: Vec<String> = pairs
        .iter()
        .filter(|(slot, known)| footage[*slot] != calibration[*known])
        .map(|(slot, known)| format!("{} is {}", footage[*slot], calibration[*known]))
        .collect();
    if !renamed.is_empty() {
        notes.push(format!("cameras of footage and calibration: {}", renamed.join(", ")));
    }
    Ok(Matched { pairs, notes })
}

/// Returns the only camera that a name can mean: the same name, whatever its case; the same last number; or one name within the other.
pub(super) fn same_camera(name: &str, known: &[String]) -> Option<usize> {
    let lower = name.to_lowercase();
    let number = last_number(name);
    let rules: [&dyn Fn(&String) -> bool; 4] = [
        &|other| other == name,
        &|other| other.to_lowercase() == lower,
        &|other| number.is_some() && last_number(other) == number,
        &|other| {
            let other = other.to_lowercase();
            lower.contains(&other) || other.contains(&lower)
        },
    ];
    for rule in rules {
        let mut fitting = known.iter().enumerate().filter(|(_, other)| rule(other));
        match (fitting.next(), fitting.next()) {
            (Some((slot, _)), None) => return Some(slot),
            (Some(_), Some(_)) => return None,
            (None, _) => {}
        }
    }
    None
}

/// Returns the number that a name ends in or that stands last in it.
fn last_number(name: &str) -> Option<u64> {
    let digits = |c: char| c.is_ascii_digit();
    let end = name.rfind(digits)? + 1;
    let begin =
        name[..end].rfind(|c| !digits(c)).map_or(0, |at| at + name[at..].chars().next().map_or(1, char::len_utf8));
    name[begin..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(text: &str) -> Vec<String> {
        text.split(' ').map(str::to_owned).collect()
    }

    fn pairs(footage: &str, calibration: &str) -> Result<Vec<(usize, usize)>> {
        Ok(matched(&names(footage), &names(calibration), &[])?.pairs)
    }

    #[test]
    fn sure_matches_are_found() {
        for (footage, calibration) in [
            ("a b", "a b"),
            ("Left Right", "left right"),
            ("cam01 cam02", "1 2"),
            ("Miqus_5_23087 Miqus_6_23088", "23087 23088"),
            ("take3-left take3-right", "left right"),
            ("GX010001 GX010002", "camera_1 camera_2"),
        ] {
            let found = pairs(footage, calibration);
            if footage.starts_with("GX") {
                assert!(found.is_err(), "{found:?}");
            } else {
                assert_eq!(found.unwrap(), [(0, 0), (1, 1)], "{footage}");
            }
        }
        let more = matched(&names("c1 c2 c3"), &names("1 2"), &[]).unwrap();
        assert_eq!((more.pairs.len(), more.notes.len()), (2, 2));
    }

    #[test]
    fn unsure_matches_are_suggested_and_can_be_stated() {
        let error = pairs("front side", "0 1").unwrap_err().to_string();
        assert!(error.contains("(front, side)") && error.ends_with("--name front=0 --name side=1"), "{error}");
        let given = ["front=1", "side=0"].map(|text| parse_pair(text).unwrap());
        assert_eq!(matched(&names("front side"), &names("0 1"), &given).unwrap().pairs, [(0, 1), (1, 0)]);
        let error = matched(&names("a b"), &names("a b"), &[("x".into(), "a".into())]).unwrap_err().to_string();
        assert!(error.contains("the footage has no camera x; it has: a, b"), "{error}");
        assert!(pairs("a1 b1", "1 2").unwrap_err().to_string().contains("could both be 1"));
        assert!(parse_pair("a=").is_err() && parse_pair("ab").is_err());
        assert_eq!(last_number("ü7é"), Some(7));
        assert_eq!(last_number("99999999999999999999999"), None);
    }
}
