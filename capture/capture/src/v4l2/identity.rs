//! Identification of cameras by properties that survive replugging, never by the number of the node.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use super::sys::{Capability, Device};
use crate::camera_options::CameraIdentity;
use crate::error::{CaptureError, CaptureErrorKind};

/// USB device behind a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbPlace {
    /// Number of the root hub: cameras with the same number share its bandwidth.
    pub bus: u32,
    /// Ports from the root hub to the device, such as `1-3.2`.
    pub port: String,
    /// Link speed, megabits per second: 480 is USB 2, 5000 and more USB 3.
    pub speed_mbit: u32,
    /// Vendor and product number, such as `046d:082d`.
    pub id: String,
}

/// Device node of the video4linux class, as described in sysfs; nothing is opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CameraNode {
    /// Path of the node. Its number may change with every replug.
    pub node: PathBuf,
    /// Name from the driver.
    pub name: String,
    /// Index of the node within its device: 0 is the first; others are often metadata.
    pub index: u32,
    /// Serial number of the USB device, where it has one.
    pub serial: Option<String>,
    /// Link in `/dev/v4l/by-path`, where udev made one.
    pub by_path: Option<String>,
    /// USB device, for USB cameras.
    pub usb: Option<UsbPlace>,
}

/// Folders where the system describes its devices; others in tests.
#[derive(Debug, Clone)]
pub(crate) struct Roots {
    pub sys: PathBuf,
    pub dev: PathBuf,
}

impl Default for Roots {
    fn default() -> Self {
        Self { sys: "/sys".into(), dev: "/dev".into() }
    }
}

/// Lists all nodes in the order of their numbers; empty without a camera driver.
pub(crate) fn scan(roots: &Roots) -> Vec<CameraNode> {
    let Ok(entries) = fs::read_dir(roots.sys.join("class/video4linux")) else { return Vec::new() };
    let number = |name: &str| name.strip_prefix("video")?.parse::<u32>().ok();
    let mut names: Vec<(u32, String)> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            Some((number(&name)?, name))
        })
        .collect();
    names.sort_unstable();
    let links = by_path_links(&roots.dev);
    names.into_iter().map(|(_, name)| describe(roots, &name, &links)).collect()
}

fn line(path: &Path) -> Option<String> {
    fs::read_to_string(path).ok().map(|text| text.trim().to_owned()).filter(|text| !text.is_empty())
}

fn number(path: &Path) -> Option<u32> {
    line(path)?.parse().ok()
}

/// Lists links in `by-path` with the nodes that they point to.
fn by_path_links(dev: &Path) -> Vec<(String, String)> {
    let Ok(entries) = fs::read_dir(dev.join("v4l/by-path")) else { return Vec::new() };
    let mut links: Vec<(String, String)> = entries
        .flatten()
        .filter_map(|entry| {
            let target = fs::read_link(entry.path()).ok()?;
            let node = target.file_name()?.to_string_lossy().into_owned();
            Some((entry.file_name().to_string_lossy().into_owned(), node))
        })
        .collect();
    links.sort_unstable();
    links
}

fn describe(roots: &Roots, name: &str, links: &[(String, String)]) -> CameraNode {
    let class = roots.sys.join("class/video4linux").join(name);
    let device = fs::canonicalize(class.join("device")).ok();
    let top = fs::canonicalize(&roots.sys).unwrap_or_else(|_| roots.sys.clone());
    let usb_device = device
        .as_deref()
        .into_iter()
        .flat_map(Path::ancestors)
        .take_while(|folder| folder.starts_with(&top))
        .find(|folder| folder.join("idVendor").is_file());
    CameraNode {
        node: roots.dev.join(name),
        name: line(&class.join("name")).unwrap_or_else(|| name.to_owned()),
        index: number(&class.join("index")).unwrap_or(0),
        serial: usb_device.and_then(|usb| line(&usb.join("serial"))),
        by_path: links.iter().find(|(_, node)| node == name).map(|(link, _)| link.clone()),
        usb: usb_device.map(|usb| UsbPlace {
            bus: number(&usb.join("busnum")).unwrap_or(0),
            port: usb.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
            // Low speed is reported as 1.5.
            speed_mbit: line(&usb.join("speed"))
                .and_then(|text| text.parse::<f64>().ok())
                .map_or(0, |speed| speed as u32),
            id: [usb.join("idVendor"), usb.join("idProduct")].map(|path| line(&path).unwrap_or_default()).join(":"),
        }),
    }
}

impl CameraNode {
    /// Lists all identities of the camera.
    #[must_use]
    pub fn names(&self, bus_info: Option<&str>) -> String {
        let mut names = Vec::new();
        names.extend(self.serial.as_ref().map(|serial| format!("serial \"{serial}\"")));
        names.extend(self.by_path.as_ref().map(|path| format!("path \"{path}\"")));
        names.extend(bus_info.map(|bus| format!("bus \"{bus}\"")));
        if names.is_empty() {
            names.push("nothing that survives replugging".to_owned());
        }
        format!("{} ({}): {}", self.name, self.node.display(), names.join(", "))
    }
}

/// Query of an opened node's capabilities.
pub(crate) type Probe<'a> = &'a dyn Fn(&Path) -> io::Result<Capability>;

/// Opens a node and queries it.
pub(crate) fn probe(node: &Path) -> io::Result<Capability> {
    Device::open(node)?.capability()
}

/// Finds the single node of a camera.
///
/// # Errors
/// `NotFound` lists the available cameras, `Unsupported` reports that several match, `Io` that candidates cannot be
/// opened.
pub(crate) fn find(
    identity: &CameraIdentity,
    nodes: &[CameraNode],
    probe: Probe<'_>,
) -> Result<CameraNode, CaptureError> {
    let mut candidates = Vec::new();
    let mut others = Vec::new();
    let mut refused = None;
    for node in nodes {
        let matches = match identity {
            CameraIdentity::Serial(serial) => node.serial.as_ref() == Some(serial),
            CameraIdentity::Path(path) => {
                let link = path.rsplit('/').next().unwrap_or(path);
                node.by_path.as_deref() == Some(link)
            }
            // Only the driver knows it.
            CameraIdentity::Bus(_) => true,
        };
        let answer = probe(&node.node);
        let bus_info = answer.as_ref().ok().map(|answer| answer.bus_info.as_str());
        let same_bus = match identity {
            CameraIdentity::Bus(bus) => bus_info.is_none_or(|found| found == bus),
            _ => true,
        };
        match &answer {
            Ok(answer) if matches && same_bus && answer.captures => candidates.push((node, node.names(bus_info))),
            Ok(answer) if answer.captures => others.push(node.names(bus_info)),
            Ok(_) => {}
            Err(error) if matches && is_denied(error) && node.index == 0 => {
                refused.get_or_insert_with(|| denied(&node.node));
            }
            // Gone between the listing and now.
            Err(_) => {}
        }
    }
    match (candidates.as_slice(), refused) {
        ([(node, _)], _) => Ok((*node).clone()),
        ([], Some(error)) => Err(error),
        ([], None) => {
            let there = match others.as_slice() {
                [] => "No other camera is plugged in".to_owned(),
                others => format!("There is: {}", others.join("; ")),
            };
            let text = format!("there is no camera with {identity}; plug it in or correct the configuration. {there}");
            Err(CaptureError::general(CaptureErrorKind::NotFound, text))
        }
        (several, _) => {
            let names: Vec<&str> = several.iter().map(|(_, name)| name.as_str()).collect();
            let text =
                format!("{identity} fits several cameras; name it by path or bus. They are: {}", names.join("; "));
            Err(CaptureError::general(CaptureErrorKind::Unsupported, text))
        }
    }
}

pub(crate) fn is_denied(error: &io::Error) -> bool {
    error.kind() == io::ErrorKind::PermissionDenied
}

/// Explains why access to a node is denied, with the fix.
pub(crate) fn denied(node: &Path) -> CaptureError {
    let text = format!(
        "{} may not be opened by this user (permission denied); add the user to its group, usually with \
         `sudo usermod -aG video $USER` and a new login, or install packaging/70-flyrig-cameras.rules",
        node.display()
    );
    CaptureError::general(CaptureErrorKind::Io, text)
}

#[cfg(test)]
pub(crate) mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    /// Creates a tree of two equal webcams with a metadata node each, and one of the kernel's test driver.
    pub(crate) fn fixture() -> (tempfile::TempDir, Roots) {
        let folder = tempfile::tempdir().unwrap();
        let roots = Roots { sys: folder.path().join("sys"), dev: folder.path().join("dev") };
        let class = roots.sys.join("class/video4linux");
        fs::create_dir_all(&class).unwrap();
        fs::create_dir_all(roots.dev.join("v4l/by-path")).unwrap();
        let write = |path: PathBuf, text: &str| {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let add = |device: &str, node: &str, name: &str, index: &str| {
            let folder = roots.sys.join("devices").join(device).join("video4linux").join(node);
            write(folder.join("name"), &format!("{name}\n"));
            write(folder.join("index"), index);
            symlink(roots.sys.join("devices").join(device), folder.join("device")).unwrap();
            symlink(&folder, class.join(node)).unwrap();
        };
        for (port, serial, nodes) in [("1-2", "A1", ["video0", "video1"]), ("1-3", "B2", ["video10", "video11"])] {
            let usb = roots.sys.join(format!("devices/pci/usb1/{port}"));
            for (file, text) in [
                ("idVendor", "046d\n"),
                ("idProduct", "082d\n"),
                ("serial", serial),
                ("busnum", "1\n"),
                ("speed", "480\n"),
            ] {
                write(usb.join(file), text);
            }
            for (index, node) in nodes.into_iter().enumerate() {
                add(&format!("pci/usb1/{port}/{port}:1.0"), node, "Webcam", &index.to_string());
                let link = format!("pci-usb-0:{}:1.0-video-index{index}", &port[2..]);
                symlink(format!("../../{node}"), roots.dev.join("v4l/by-path").join(link)).unwrap();
            }
        }
        add("platform/vivid.0", "video2", "vivid-000-vid-cap", "0\n");
        fs::create_dir_all(class.join("v4l-subdev0")).unwrap();
        (folder, roots)
    }

    fn answer(node: &Path) -> io::Result<Capability> {
        let (bus, captures) = match node.file_name().unwrap().to_str().unwrap() {
            "video0" => ("usb-0000:00:14.0-2", true),
            "video1" => ("usb-0000:00:14.0-2", false),
            "video10" => ("usb-0000:00:14.0-3", true),
            "video11" => ("usb-0000:00:14.0-3", false),
            "video2" => ("platform:vivid-000", true),
            _ => return Err(io::Error::from_raw_os_error(libc::ENODEV)),
        };
        Ok(Capability::test(bus, captures))
    }

    fn found(identity: &CameraIdentity, nodes: &[CameraNode]) -> Result<String, CaptureError> {
        find(identity, nodes, &answer).map(|node| node.node.file_name().unwrap().to_string_lossy().into_owned())
    }

    #[test]
    fn a_tree_is_read_in_the_order_of_numbers() {
        let (_folder, roots) = fixture();
        let nodes = scan(&roots);
        let names: Vec<_> = nodes.iter().map(|node| node.node.file_name().unwrap().to_str().unwrap()).collect();
        assert_eq!(names, ["video0", "video1", "video2", "video10", "video11"]);
        let usb = UsbPlace { bus: 1, port: "1-3".into(), speed_mbit: 480, id: "046d:082d".into() };
        let expected = CameraNode {
            node: roots.dev.join("video10"),
            name: "Webcam".into(),
            index: 0,
            serial: Some("B2".into()),
            by_path: Some("pci-usb-0:3:1.0-video-index0".into()),
            usb: Some(usb),
        };
        assert_eq!(nodes[3], expected);
        assert_eq!((nodes[2].name.as_str(), &nodes[2].usb), ("vivid-000-vid-cap", &None));
        assert_eq!(scan(&Roots { sys: "/nowhere".into(), dev: "/nowhere".into() }), []);
    }

    #[test]
    fn a_camera_is_found_by_serial_path_and_bus() {
        let (_folder, roots) = fixture();
        let nodes = scan(&roots);
        assert_eq!(found(&CameraIdentity::Serial("B2".into()), &nodes).unwrap(), "video10");
        for path in ["pci-usb-0:2:1.0-video-index0", "/dev/v4l/by-path/pci-usb-0:2:1.0-video-index0"] {
            assert_eq!(found(&CameraIdentity::Path(path.into()), &nodes).unwrap(), "video0");
        }
        assert_eq!(found(&CameraIdentity::Bus("platform:vivid-000".into()), &nodes).unwrap(), "video2");
    }

    #[test]
    fn a_missing_camera_is_told_with_those_there_are() {
        let (_folder, roots) = fixture();
        let error = found(&CameraIdentity::Serial("C3".into()), &scan(&roots)).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::NotFound);
        for part in ["no camera with serial \"C3\"", "serial \"A1\"", "bus \"platform:vivid-000\"", "plug it in"] {
            assert!(error.message.contains(part), "{part}: {error}");
        }
        assert!(!error.message.contains("video1)"), "metadata nodes are no cameras: {error}");
        let none = found(&CameraIdentity::Bus("x".into()), &[]).unwrap_err();
        assert!(none.message.ends_with("No other camera is plugged in"), "{none}");
    }

    #[test]
    fn two_cameras_of_one_serial_must_be_told_apart() {
        let (_folder, roots) = fixture();
        let mut nodes = scan(&roots);
        nodes[3].serial = Some("A1".into());
        let error = found(&CameraIdentity::Serial("A1".into()), &nodes).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::Unsupported);
        assert!(error.message.contains("usb-0000:00:14.0-2") && error.message.contains("name it by path"), "{error}");
    }

    #[test]
    fn a_node_that_may_not_be_opened_is_told_with_the_mend() {
        let (_folder, roots) = fixture();
        let nodes = scan(&roots);
        let closed = |_: &Path| Err(io::Error::from_raw_os_error(libc::EACCES));
        for identity in [CameraIdentity::Serial("A1".into()), CameraIdentity::Bus("platform:vivid-000".into())] {
            let error = find(&identity, &nodes, &closed).unwrap_err();
            assert_eq!(error.kind, CaptureErrorKind::Io);
            assert!(error.message.contains("video0") && error.message.contains("usermod -aG video"), "{error}");
        }
        let error = find(&CameraIdentity::Serial("C3".into()), &nodes, &closed).unwrap_err();
        assert_eq!(error.kind, CaptureErrorKind::NotFound, "other nodes' permissions say nothing of it");
    }
}
