//! Report of connected cameras and of the bandwidth of their buses, for `flyrig doctor`.

use std::collections::BTreeMap;

use super::{
    CameraNode,
    format::fourcc_text,
    identity::{self, Roots},
    modes,
    sys::{Device, SizeRange},
};
use crate::camera_options::FormatChoice;
use crate::error::CaptureError;

/// Most sizes per format that are queried for their rates: a driver may list dozens.
const REPORTED_SIZES: usize = 24;

/// Pixel format of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct FormatReport {
    /// FourCC of the driver.
    pub code: String,
    /// Equivalent in a configuration; `None` for an unsupported format.
    pub choice: Option<FormatChoice>,
    /// Width, height, frames per second from the fastest to the slowest.
    pub modes: Vec<(u32, u32, Vec<f64>)>,
}

/// Report of one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraReport {
    /// Device node.
    pub node: CameraNode,
    /// V4L2 bus information, when the camera could be opened.
    pub bus_info: Option<String>,
    /// Driver, when the camera could be opened.
    pub driver: Option<String>,
    /// Available formats.
    pub formats: Vec<FormatReport>,
    /// Reason why the camera is unusable.
    pub problem: Option<CaptureError>,
}

/// Reports every camera of this computer; nodes without images, such as metadata, are omitted.
#[must_use]
pub fn camera_reports() -> Vec<CameraReport> {
    identity::scan(&Roots::default()).into_iter().filter_map(report).collect()
}

fn report(node: CameraNode) -> Option<CameraReport> {
    let path = node.node.clone();
    let mut report = CameraReport { node, bus_info: None, driver: None, formats: Vec::new(), problem: None };
    let failed = |error: std::io::Error| super::causes::explain(&error, "cannot be asked", &path);
    let device = match Device::open(&path) {
        Ok(device) => device,
        Err(error) => {
            report.problem = Some(failed(error));
            return Some(report);
        }
    };
    match device.capability() {
        Ok(capability) if !capability.captures => return None,
        Ok(capability) => (report.bus_info, report.driver) = (Some(capability.bus_info), Some(capability.driver)),
        Err(error) => report.problem = Some(failed(error)),
    }
    match formats(&device) {
        Ok(formats) => report.formats = formats,
        Err(error) => report.problem = Some(failed(error)),
    }
    Some(report)
}

fn formats(device: &Device) -> std::io::Result<Vec<FormatReport>> {
    let mut formats = Vec::new();
    for fourcc in device.formats()? {
        let mut modes = Vec::new();
        for size in device.sizes(fourcc)?.into_iter().take(REPORTED_SIZES) {
            let (width, height) = match size {
                SizeRange::One(width, height) => (width, height),
                SizeRange::Steps([_, width, _], [_, height, _]) => (width, height),
            };
            let mut rates = device.rates(fourcc, width, height)?;
            rates.sort_by(|a, b| b.total_cmp(a));
            modes.push((width, height, rates));
        }
        formats.push(FormatReport { code: fourcc_text(fourcc), choice: FormatChoice::of_fourcc(fourcc), modes });
    }
    Ok(formats)
}

/// Bandwidth demands on one USB bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusPlan {
    /// Number of the root hub.
    pub bus: u32,
    /// Slowest link among its cameras, megabits per second.
    pub speed_mbit: u32,
    /// Bytes per second that can be guaranteed to all of them together.
    pub capacity: u64,
    /// Cameras with the bytes per second that each requests.
    pub demands: Vec<(String, u64)>,
}

impl BusPlan {
    /// Returns the bytes per second of all cameras together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.demands.iter().map(|(_, bytes)| bytes).sum()
    }

    /// Returns whether the bandwidth suffices for all.
    #[must_use]
    pub fn fits(&self) -> bool {
        self.total() <= self.capacity
    }
}

/// Plans the buses for cameras of `(name, USB bus, speed in Mbit/s, format, width, height, frames per second)`.
#[must_use]
pub fn plan_buses<'a>(
    cameras: impl IntoIterator<Item = (&'a str, u32, u32, FormatChoice, (u32, u32), f64)>,
) -> Vec<BusPlan> {
    let mut plans: BTreeMap<u32, BusPlan> = BTreeMap::new();
    for (name, bus, speed_mbit, format, (width, height), fps) in cameras {
        let plan = plans.entry(bus).or_insert(BusPlan { bus, speed_mbit, capacity: 0, demands: Vec::new() });
        plan.speed_mbit = plan.speed_mbit.min(speed_mbit);
        plan.capacity = modes::usb_capacity(plan.speed_mbit).0;
        let mut bytes = modes::bytes_per_second(format, fps, width, height);
        if format == FormatChoice::Auto && bytes > modes::usb_capacity(speed_mbit).1 {
            bytes = modes::bytes_per_second(FormatChoice::Mjpeg, fps, width, height);
        }
        plan.demands.push((name.to_owned(), bytes));
    }
    plans.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_of_one_bus_share_its_room() {
        let camera = |name, bus, format| (name, bus, 480, format, (640, 480), 30.0);
        let plans = plan_buses([
            camera("a", 1, FormatChoice::Yuyv),
            camera("b", 2, FormatChoice::Yuyv),
            camera("c", 1, FormatChoice::Yuyv),
            camera("d", 1, FormatChoice::Yuyv),
        ]);
        assert_eq!(plans.iter().map(|plan| (plan.bus, plan.fits())).collect::<Vec<_>>(), [(1, false), (2, true)]);
        assert_eq!(plans[0].total(), 3 * 640 * 480 * 2 * 30);
        let compressed = plan_buses(["a", "b", "c"].map(|name| camera(name, 1, FormatChoice::Mjpeg)));
        assert!(compressed[0].fits());
        let large = plan_buses([("a", 1, 480, FormatChoice::Auto, (1920, 1080), 30.0)]);
        assert!(large[0].fits(), "compressed images are taken by themselves");
    }

    #[test]
    fn a_computer_without_cameras_has_no_reports() {
        if !std::path::Path::new("/sys/class/video4linux").exists() {
            assert_eq!(camera_reports(), []);
        }
    }
}
