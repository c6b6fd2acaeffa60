//! `flyrig doctor`: lists cameras, checks that they work together, and suggests fixes.

use std::{fmt::Write as _, path::Path};

use anyhow::Result;
use flyrig_capture::NokhwaDevice;
use flyrig_gpu::adapter_names;
use flyrig_takes::SourceKind;

use crate::config::Config;

const NO_CAMERA: &str = "no camera: plug one in, or simulate a rig with source.kind = \"sim\"";

/// Runs the command: prints all findings; fails only if the configuration cannot be read.
pub fn doctor(config: Option<&Path>) -> Result<()> {
    let config = config.map(Config::load_for_capture).transpose()?;
    let mut mends = Vec::new();
    print!("{}", cameras(config.as_ref(), &mut mends));
    if config.as_ref().is_some_and(|config| config.source.kind != SourceKind::Cameras) {
        // A rig that needs no camera of this computer.
        mends.retain(|mend| mend != NO_CAMERA);
    }
    println!("graphics adapters");
    let adapters = adapter_names();
    for name in &adapters {
        println!("  {name}");
    }
    if adapters.is_empty() {
        mends.push(
            "no graphics adapter: install a Vulkan driver (mesa-vulkan-drivers has one for machines without a GPU)"
                .to_owned(),
        );
    } else if adapters.iter().all(|name| name.ends_with(", software)")) {
        mends.push("only a software graphics adapter: flyrig computes on the processor; if there is a GPU, install its Vulkan driver".to_owned());
    }
    println!("problems");
    for mend in &mends {
        println!("  {mend}");
    }
    if mends.is_empty() {
        println!("  nothing");
    }
    Ok(())
}

#[cfg(target_os = "linux")]
fn cameras(config: Option<&Config>, mends: &mut Vec<String>) -> String {
    let reports = flyrig_capture::camera_reports();
    let text = describe(&reports, mends);
    missing_through_nokhwa(config, mends);
    format!("{text}{}", plan(&reports, config, mends))
}

#[cfg(not(target_os = "linux"))]
fn cameras(config: Option<&Config>, mends: &mut Vec<String>) -> String {
    let mut text = "cameras\n".to_owned();
    match flyrig_capture::nokhwa_cameras() {
        Ok(cameras) => {
            for (device, name) in &cameras {
                let _ = writeln!(text, "  {name}: nokhwa = \"{name}\", or by its {device}");
            }
            if cameras.is_empty() {
                text.push_str("  none\n");
                mends.push(NO_CAMERA.to_owned());
            }
        }
        Err(error) => mends.push(error.to_string()),
    }
    missing_through_nokhwa(config, mends);
    text
}

/// Lists the nokhwa cameras of a configuration that are missing.
fn missing_through_nokhwa(config: Option<&Config>, mends: &mut Vec<String>) {
    let sections = config.iter().flat_map(|config| &config.source.cameras).filter_map(|entry| entry.device().ok());
    let wanted: Vec<_> = sections.filter(|section| !section.nokhwa.is_empty()).collect();
    if wanted.is_empty() {
        return;
    }
    let there = flyrig_capture::nokhwa_cameras().unwrap_or_default();
    for section in wanted {
        let device = NokhwaDevice::from(section.nokhwa.as_str());
        if !there.iter().any(|(number, name)| *number == device || NokhwaDevice::Name(name.clone()) == device) {
            mends.push(format!("camera {} of the configuration ({device}) is not plugged in", section.name));
        }
    }
}

#[cfg(target_os = "linux")]
fn describe(reports: &[flyrig_capture::CameraReport], mends: &mut Vec<String>) -> String {
    let mut text = "cameras\n".to_owned();
    if reports.is_empty() {
        text.push_str("  none\n");
        mends.push(NO_CAMERA.to_owned());
    }
    for report in reports {
        let node = &report.node;
        let _ = writeln!(text, "  {}", node.names(report.bus_info.as_deref()));
        if let Some(usb) = &node.usb {
            let _ = writeln!(text, "    USB bus {}, port {}, {} Mbit/s, {}", usb.bus, usb.port, usb.speed_mbit, usb.id);
        }
        for format in report.formats.iter().filter(|format| format.choice.is_some()) {
            let modes: Vec<String> = format
                .modes
                .iter()
                .map(|(width, height, rates)| {
                    let fastest = rates.first().map_or_else(String::new, |rate| format!(" at {rate:.4}"));
                    format!("{width}x{height}{}", fastest.trim_end_matches('0').trim_end_matches('.'))
                })
                .collect();
            let _ = writeln!(text, "    {}: {}", format.code, modes.join(", "));
        }
        let unread = report.formats.iter().filter(|format| format.choice.is_none());
        let unread: Vec<&str> = unread.map(|format| format.code.as_str()).collect();
        if !unread.is_empty() {
            let _ = writeln!(text, "    not read by flyrig: {}", unread.join(", "));
        }
        if let Some(problem) = &report.problem {
            mends.push(problem.to_string());
        }
        let same =
            |other: &&flyrig_capture::CameraReport| other.node.serial == node.serial && other.node.node < node.node;
        if node.serial.is_some() && reports.iter().filter(|other| other.node.usb != node.usb).any(|other| same(&other))
        {
            mends.push(format!("{} shares its serial number with another camera: name both by path or bus", node.name));
        }
    }
    text
}

/// Lists the bandwidth that the cameras of a configuration need of each bus.
#[cfg(target_os = "linux")]
fn plan(reports: &[flyrig_capture::CameraReport], config: Option<&Config>, mends: &mut Vec<String>) -> String {
    let Some(config) = config else { return String::new() };
    let mut demands = Vec::new();
    let sections = config.source.cameras.iter().filter_map(|entry| entry.device().ok());
    for section in sections.filter(|section| section.nokhwa.is_empty()) {
        let found = reports.iter().find(|report| {
            let node = &report.node;
            let link = section.path.rsplit('/').next().unwrap_or_default();
            (!section.serial.is_empty() && node.serial.as_ref() == Some(&section.serial))
                || (!section.path.is_empty() && node.by_path.as_deref() == Some(link))
                || (!section.bus.is_empty() && report.bus_info.as_ref() == Some(&section.bus))
        });
        match found.map(|report| &report.node.usb) {
            Some(Some(usb)) => {
                let size = (section.size[0], section.size[1]);
                demands.push((section.name.as_str(), usb.bus, usb.speed_mbit, section.format, size, section.fps));
            }
            Some(None) => {}
            None => mends.push(format!("camera {} of the configuration is not plugged in", section.name)),
        }
    }
    let mut text = String::new();
    for plan in flyrig_capture::plan_buses(demands) {
        let megabytes = |bytes: u64| bytes as f64 / 1e6;
        let cameras: Vec<String> =
            plan.demands.iter().map(|(name, bytes)| format!("{name} {:.1}", megabytes(*bytes))).collect();
        let (total, capacity) = (megabytes(plan.total()), megabytes(plan.capacity));
        let _ = writeln!(
            text,
            "USB bus {} ({} Mbit/s): {total:.1} of {capacity:.0} MB/s: {}",
            plan.bus,
            plan.speed_mbit,
            cameras.join(", ")
        );
        if !plan.fits() {
            mends.push(format!(
                "USB bus {} is asked for {total:.1} MB/s and carries {capacity:.0}: set format = \"mjpeg\", lower fps, or move \
                 cameras to another controller",
                plan.bus
            ));
        }
    }
    text
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use flyrig_capture::{CameraNode, CameraReport, FormatChoice, FormatReport, UsbPlace};

    use super::*;

    fn report(number: u32, serial: &str) -> CameraReport {
        CameraReport {
            node: CameraNode {
                node: format!("/dev/video{number}").into(),
                name: "Webcam".into(),
                index: 0,
                serial: Some(serial.into()),
                by_path: Some(format!("pci-usb-0:{number}:1.0-video-index0")),
                usb: Some(UsbPlace { bus: 1, port: format!("1-{number}"), speed_mbit: 480, id: "046d:082d".into() }),
            },
            bus_info: Some(format!("usb-0000:00:14.0-{number}")),
            driver: Some("uvcvideo".into()),
            formats: vec![
                FormatReport {
                    code: "YUYV".into(),
                    choice: Some(FormatChoice::Yuyv),
                    modes: vec![(640, 360, vec![30.0, 15.0]), (1280, 720, vec![7.5])],
                },
                FormatReport { code: "H264".into(), choice: None, modes: vec![] },
            ],
            problem: None,
        }
    }

    #[test]
    fn a_camera_is_described_by_all_its_names() {
        let mut mends = Vec::new();
        let text = describe(&[report(0, "A"), report(2, "B")], &mut mends);
        for part in [
            "Webcam (/dev/video2): serial \"B\", path \"pci-usb-0:2:1.0-video-index0\", bus \"usb-0000:00:14.0-2\"",
            "USB bus 1, port 1-2, 480 Mbit/s, 046d:082d",
            "YUYV: 640x360 at 30, 1280x720 at 7.5",
            "not read by flyrig: H264\n",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert_eq!(mends, Vec::<String>::new());
        describe(&[report(0, "A"), report(2, "A")], &mut mends);
        assert_eq!(mends, ["Webcam shares its serial number with another camera: name both by path or bus"]);
        describe(&[], &mut mends);
        assert!(mends[1].starts_with("no camera: plug one in"));
    }

    #[test]
    fn a_bus_without_room_and_a_missing_camera_are_told() {
        let camera = |name: &str, serial: &str| {
            format!(
                "[[source.cameras]]\nname = \"{name}\"\nserial = \"{serial}\"\nsize = [640, 480]\nformat = \"yuyv\"\n"
            )
        };
        let tables: String = [("a", "A"), ("b", "B"), ("c", "C"), ("d", "D")].map(|(n, s)| camera(n, s)).concat();
        let tables = format!("{tables}[[source.cameras]]\nname = \"e\"\nnokhwa = \"No Such Cam\"\nsize = [640, 480]\n");
        let text = format!("[source]\nkind = \"cameras\"\npath = \"x\"\n{tables}[perception]\npose = \"estimated\"\n");
        let config = Config::parse(&text).unwrap();
        let mut mends = Vec::new();
        let text = plan(&[report(0, "A"), report(2, "B"), report(4, "C")], Some(&config), &mut mends);
        assert_eq!(text, "USB bus 1 (480 Mbit/s): 55.3 of 48 MB/s: a 18.4, b 18.4, c 18.4\n");
        assert_eq!(mends[0], "camera d of the configuration is not plugged in");
        assert!(mends[1].starts_with("USB bus 1 is asked for 55.3 MB/s and carries 48: set format"), "{mends:?}");
        missing_through_nokhwa(Some(&config), &mut mends);
        assert_eq!(mends[2], "camera e of the configuration (name \"No Such Cam\") is not plugged in");
    }
}
