//! Exposure, gain, white balance and focus: set, read back, and reported where the camera deviates.

use std::io;

use v4l::v4l_sys::{
    V4L2_CID_AUTO_WHITE_BALANCE, V4L2_CID_AUTOGAIN, V4L2_CID_EXPOSURE_ABSOLUTE, V4L2_CID_EXPOSURE_AUTO,
    V4L2_CID_EXPOSURE_AUTO_PRIORITY, V4L2_CID_FOCUS_ABSOLUTE, V4L2_CID_FOCUS_AUTO, V4L2_CID_GAIN,
    V4L2_CID_WHITE_BALANCE_TEMPERATURE, V4L2_CTRL_FLAG_DISABLED,
};

use super::sys::ControlRange;
use crate::camera_options::CameraControls;

/// Unit of `V4L2_CID_EXPOSURE_ABSOLUTE`.
const EXPOSURE_UNIT_NANOS: i64 = 100_000;
const EXPOSURE_MANUAL: i32 = 1;

/// Control calls of a device; tests use a map instead.
pub(crate) trait ControlDevice {
    fn range(&self, id: u32) -> io::Result<Option<ControlRange>>;
    fn get(&self, id: u32) -> io::Result<i32>;
    fn set(&mut self, id: u32, value: i32) -> io::Result<()>;
}

/// Reason why a control was not applied.
#[derive(Debug)]
pub(crate) enum ControlError {
    /// The camera lacks the requested value.
    Refused(String),
    /// The device failed.
    Io(io::Error),
}

impl From<io::Error> for ControlError {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Applies the requested controls. Returns the exposure in effect, nanoseconds, where it is fixed and known, and
/// warnings about values that read back differently.
pub(crate) fn apply(
    controls: &CameraControls,
    device: &mut impl ControlDevice,
) -> Result<(Option<u64>, Vec<String>), ControlError> {
    let exposure = controls.exposure_secs.map(|secs| {
        let units = secs * 1e9 / EXPOSURE_UNIT_NANOS as f64;
        (units.round() as i32).max(1)
    });
    let mut warnings = Vec::new();
    // A rig needs frames at a steady rate; this control lets the camera halve it in the dark.
    if range(device, V4L2_CID_EXPOSURE_AUTO_PRIORITY)?.is_some() {
        let _ = device.set(V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0);
    }
    for (key, value, id, auto, manual) in [
        ("exposure_ms", exposure, V4L2_CID_EXPOSURE_ABSOLUTE, V4L2_CID_EXPOSURE_AUTO, EXPOSURE_MANUAL),
        ("gain", controls.gain, V4L2_CID_GAIN, V4L2_CID_AUTOGAIN, 0),
        (
            "white_balance_kelvin",
            controls.white_balance_kelvin,
            V4L2_CID_WHITE_BALANCE_TEMPERATURE,
            V4L2_CID_AUTO_WHITE_BALANCE,
            0,
        ),
        ("focus", controls.focus, V4L2_CID_FOCUS_ABSOLUTE, V4L2_CID_FOCUS_AUTO, 0),
    ] {
        let Some(value) = value else { continue };
        let Some(limits) = range(device, id)? else {
            return Err(ControlError::Refused(format!("has no control for {key}; take {key} out of its table")));
        };
        if !(limits.minimum..=limits.maximum).contains(&value) {
            let units = if key == "exposure_ms" { 1e6 / EXPOSURE_UNIT_NANOS as f64 } else { 1.0 };
            let [value, low, high] = [value, limits.minimum, limits.maximum].map(|v| f64::from(v) / units);
            return Err(ControlError::Refused(format!("has {key} from {low} to {high}, not {value}")));
        }
        if range(device, auto)?.is_some() {
            device.set(auto, manual)?;
        }
        device.set(id, value)?;
        let found = device.get(id)?;
        if found != value {
            warnings.push(format!("{key} was set to {value} and reads back as {found} (in the camera's unit)"));
        }
    }
    let is_fixed = range(device, V4L2_CID_EXPOSURE_ABSOLUTE)?.is_some()
        && range(device, V4L2_CID_EXPOSURE_AUTO)?
            .is_none_or(|_| device.get(V4L2_CID_EXPOSURE_AUTO).ok() == Some(EXPOSURE_MANUAL));
    let exposure = is_fixed.then(|| device.get(V4L2_CID_EXPOSURE_ABSOLUTE)).transpose()?;
    Ok((exposure.map(|units| (i64::from(units.max(0)) * EXPOSURE_UNIT_NANOS) as u64), warnings))
}

fn range(device: &impl ControlDevice, id: u32) -> io::Result<Option<ControlRange>> {
    Ok(device.range(id)?.filter(|range| range.flags & V4L2_CTRL_FLAG_DISABLED == 0))
}

#[cfg(test)]
pub(crate) mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// Controls by id: range, value, and offset of the value read back from the value set.
    #[derive(Debug, Default, Clone)]
    pub(crate) struct FakeControls(pub BTreeMap<u32, (i32, i32, i32)>);

    impl ControlDevice for FakeControls {
        fn range(&self, id: u32) -> io::Result<Option<ControlRange>> {
            Ok(self.0.get(&id).map(|&(minimum, maximum, _)| ControlRange { minimum, maximum, flags: 0 }))
        }

        fn get(&self, id: u32) -> io::Result<i32> {
            self.0.get(&id).map(|control| control.2).ok_or_else(|| io::Error::from_raw_os_error(libc::EINVAL))
        }

        fn set(&mut self, id: u32, value: i32) -> io::Result<()> {
            let control = self.0.get_mut(&id).ok_or_else(|| io::Error::from_raw_os_error(libc::EINVAL))?;
            // This camera's exposure goes in steps of five.
            control.2 = if id == V4L2_CID_EXPOSURE_ABSOLUTE { value / 5 * 5 } else { value };
            Ok(())
        }
    }

    fn webcam() -> FakeControls {
        FakeControls(BTreeMap::from([
            (V4L2_CID_EXPOSURE_AUTO, (0, 3, 3)),
            (V4L2_CID_EXPOSURE_ABSOLUTE, (3, 2047, 250)),
            (V4L2_CID_EXPOSURE_AUTO_PRIORITY, (0, 1, 1)),
            (V4L2_CID_GAIN, (0, 255, 0)),
        ]))
    }

    #[test]
    fn what_is_asked_for_is_set_and_the_camera_no_longer_judges_itself() {
        let mut device = webcam();
        let controls = CameraControls { exposure_secs: Some(0.008), gain: Some(12), ..CameraControls::default() };
        let (exposure, warnings) = apply(&controls, &mut device).unwrap();
        assert_eq!((exposure, warnings), (Some(8_000_000), vec![]));
        let value = |id| device.get(id).unwrap();
        assert_eq!((value(V4L2_CID_EXPOSURE_AUTO), value(V4L2_CID_GAIN)), (EXPOSURE_MANUAL, 12));
        assert_eq!(value(V4L2_CID_EXPOSURE_AUTO_PRIORITY), 0);
    }

    #[test]
    fn an_automatic_exposure_is_unknown() {
        assert_eq!(apply(&CameraControls::default(), &mut webcam()).unwrap(), (None, vec![]));
        assert_eq!(apply(&CameraControls::default(), &mut FakeControls::default()).unwrap(), (None, vec![]));
    }

    #[test]
    fn a_value_that_reads_back_differently_is_reported() {
        let controls = CameraControls { exposure_secs: Some(0.0083), ..CameraControls::default() };
        let (exposure, warnings) = apply(&controls, &mut webcam()).unwrap();
        assert_eq!(exposure, Some(8_000_000));
        assert_eq!(warnings, ["exposure_ms was set to 83 and reads back as 80 (in the camera's unit)"]);
    }

    #[test]
    fn what_the_camera_lacks_is_refused_by_name() {
        for (controls, expected) in [
            (CameraControls { focus: Some(3), ..CameraControls::default() }, "has no control for focus"),
            (CameraControls { gain: Some(256), ..CameraControls::default() }, "has gain from 0 to 255, not 256"),
            (
                CameraControls { exposure_secs: Some(1.0), ..CameraControls::default() },
                "has exposure_ms from 0.3 to 204.7, not 1000",
            ),
        ] {
            match apply(&controls, &mut webcam()).unwrap_err() {
                ControlError::Refused(text) => assert!(text.starts_with(expected), "{text}"),
                ControlError::Io(error) => panic!("{error}"),
            }
        }
    }
}
