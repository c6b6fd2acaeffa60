//! Choice of a camera's mode, and of fallbacks when the bus lacks bandwidth.

use crate::camera_options::FormatChoice;

/// Bytes per second that are guaranteed to one USB 2 camera: three packets of 1024 bytes in each of 8000 microframes.
const USB2_CAMERA_BYTES: u64 = 24_576_000;
/// Slowest fallback rate, frames per second.
const SLOWEST_FPS: f64 = 5.0;
/// Fractions of the requested rate that are tried where the driver lists no rates.
const SLOWER: [f64; 3] = [2.0 / 3.0, 0.5, 1.0 / 3.0];
/// Relative tolerance within which two rates are equal.
pub(crate) const SAME_RATE: f64 = 0.02;

/// Format that a camera offers at the requested size.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Offer {
    pub fourcc: [u8; 4],
    /// Frames per second; empty where the driver does not report them.
    pub rates: Vec<f64>,
}

/// Format and rate of a camera; the size never changes, since the calibration depends on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Mode {
    pub choice: FormatChoice,
    pub fourcc: [u8; 4],
    pub fps: f64,
}

/// Returns the bytes per second that isochronous transfers may use: of a bus by its speed in megabits per second, and
/// of one camera on it.
pub(crate) fn usb_capacity(speed_mbit: u32) -> (u64, u64) {
    match speed_mbit {
        0..=12 => (1_000_000, 1_000_000),
        // 80 % of the microframes.
        13..=480 => (48_000_000, USB2_CAMERA_BYTES),
        481..=5000 => (400_000_000, 390_000_000),
        _ => (900_000_000, 850_000_000),
    }
}

/// Lists the modes to try, best first: the requested one, compressed images at the same rate, then slower rates. Each
/// needs fewer bytes per second than the one before.
///
/// # Errors
/// Text that names what the camera lacks and what it offers.
pub(crate) fn ladder(
    wanted: FormatChoice,
    fps: f64,
    (width, height): (u32, u32),
    offers: &[Offer],
    camera_bytes: Option<u64>,
) -> Result<Vec<Mode>, String> {
    let of = |choice: FormatChoice| {
        let offer = choice.fourccs().iter().find_map(|code| offers.iter().find(|offer| offer.fourcc == *code))?;
        Some((choice, offer))
    };
    let available: Vec<(FormatChoice, &Offer)> = FormatChoice::ORDER.into_iter().filter_map(of).collect();
    let list = || {
        let names: Vec<String> = offers.iter().map(|offer| super::format::fourcc_text(offer.fourcc)).collect();
        if names.is_empty() { "none".to_owned() } else { names.join(", ") }
    };
    let first = match wanted {
        FormatChoice::Auto => {
            let fits = |choice: FormatChoice| {
                let bytes = bytes_per_second(choice, fps, width, height);
                camera_bytes.is_none_or(|most| bytes <= most)
            };
            let fitting = available.iter().find(|(choice, offer)| fits(*choice) && has_rate(offer, fps));
            let rated = || available.iter().find(|(_, offer)| has_rate(offer, fps));
            fitting.or_else(rated).or(available.first())
        }
        choice => available.iter().find(|(found, _)| *found == choice),
    };
    let Some(&(choice, offer)) = first else {
        return Err(format!("has no {wanted:?} images of {width}x{height}; its formats at that size: {}", list()));
    };
    if !has_rate(offer, fps) {
        let rates: Vec<String> = offer.rates.iter().map(|rate| format!("{rate:.4}")).collect();
        return Err(format!(
            "has no {fps} frames per second at {choice:?} {width}x{height}; it has {}; set fps to one of them",
            rates.iter().map(|rate| rate.trim_end_matches('0').trim_end_matches('.')).collect::<Vec<_>>().join(", ")
        ));
    }
    let mut rates: Vec<f64> = offer.rates.iter().copied().filter(|rate| *rate < fps * (1.0 - SAME_RATE)).collect();
    if rates.is_empty() {
        rates = SLOWER.map(|share| fps * share).to_vec();
    }
    rates.retain(|rate| *rate >= SLOWEST_FPS);
    rates.sort_by(|a, b| b.total_cmp(a));
    rates.insert(0, fps);
    let mut modes: Vec<Mode> = Vec::new();
    for rate in rates {
        let compressed = available.iter().copied().find(|(choice, _)| *choice == FormatChoice::Mjpeg);
        for (choice, offer) in [Some((choice, offer)), compressed].into_iter().flatten() {
            let bytes = |mode: &Mode| bytes_per_second(mode.choice, mode.fps, width, height);
            let mode = Mode { choice, fourcc: offer.fourcc, fps: rate };
            if has_rate(offer, rate) && modes.last().is_none_or(|last| bytes(&mode) < bytes(last)) {
                modes.push(mode);
            }
        }
    }
    Ok(modes)
}

/// Returns the bytes per second on the bus.
pub(crate) fn bytes_per_second(choice: FormatChoice, fps: f64, width: u32, height: u32) -> u64 {
    (choice.bytes_per_frame(width, height) as f64 * fps.clamp(0.0, 1e6)) as u64
}

/// Returns whether a rate is listed, or lies between two listed ones: some drivers list only the ends of a range.
fn has_rate(offer: &Offer, fps: f64) -> bool {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for &rate in &offer.rates {
        (low, high) = (low.min(rate), high.max(rate));
    }
    offer.rates.is_empty() || (low * (1.0 - SAME_RATE)..=high * (1.0 + SAME_RATE)).contains(&fps)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (u32, u32) = (640, 360);

    fn offers() -> Vec<Offer> {
        vec![
            Offer { fourcc: *b"MJPG", rates: vec![30.0, 15.0] },
            Offer { fourcc: *b"YUYV", rates: vec![30.0, 20.0, 10.0, 2.0] },
        ]
    }

    fn steps(modes: &[Mode]) -> Vec<(FormatChoice, f64)> {
        modes.iter().map(|mode| (mode.choice, mode.fps)).collect()
    }

    #[test]
    fn each_step_takes_less_than_the_one_before_and_keeps_the_size() {
        let modes = ladder(FormatChoice::Yuyv, 30.0, SIZE, &offers(), None).unwrap();
        assert_eq!(
            steps(&modes),
            [(FormatChoice::Yuyv, 30.0), (FormatChoice::Mjpeg, 30.0), (FormatChoice::Mjpeg, 20.0)]
        );
        let only = [Offer { fourcc: *b"YUYV", rates: vec![30.0, 20.0, 10.0, 2.0] }];
        let modes = ladder(FormatChoice::Yuyv, 30.0, SIZE, &only, None).unwrap();
        assert_eq!(steps(&modes), [30.0, 20.0, 10.0].map(|fps| (FormatChoice::Yuyv, fps)));
        let silent = [Offer { fourcc: *b"GREY", rates: vec![] }];
        let modes = ladder(FormatChoice::Auto, 30.0, SIZE, &silent, None).unwrap();
        assert_eq!(modes.iter().map(|mode| mode.fps).collect::<Vec<_>>(), [30.0, 20.0, 15.0, 10.0]);
    }

    #[test]
    fn compressed_comes_first_where_uncompressed_does_not_fit_the_bus() {
        let auto = |size, bytes| ladder(FormatChoice::Auto, 30.0, size, &offers(), bytes).unwrap()[0].choice;
        assert_eq!(auto(SIZE, None), FormatChoice::Yuyv);
        assert_eq!(auto(SIZE, Some(usb_capacity(480).1)), FormatChoice::Yuyv, "13.8 MB/s fit into 24.6");
        assert_eq!(auto((1280, 720), Some(usb_capacity(480).1)), FormatChoice::Mjpeg);
        assert_eq!(auto((1280, 720), Some(usb_capacity(5000).1)), FormatChoice::Yuyv);
    }

    #[test]
    fn what_the_camera_lacks_is_told_with_what_it_has() {
        let error = ladder(FormatChoice::Nv12, 30.0, SIZE, &offers(), None).unwrap_err();
        assert_eq!(error, "has no Nv12 images of 640x360; its formats at that size: MJPG, YUYV");
        let error = ladder(FormatChoice::Mjpeg, 60.0, SIZE, &offers(), None).unwrap_err();
        assert_eq!(error, "has no 60 frames per second at Mjpeg 640x360; it has 30, 15; set fps to one of them");
        assert!(ladder(FormatChoice::Auto, 30.0, SIZE, &[], None).unwrap_err().ends_with("none"));
    }
}
