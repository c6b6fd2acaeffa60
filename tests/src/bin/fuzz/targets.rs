//! Fuzz targets with the keywords of their formats. A target describes the outcome of an input; the fuzzer keeps inputs with
//! new descriptions.

use std::{cell::RefCell, fs, path::Path, time::Duration};

use flyrig_body::{
    BodyError, Joint, MotionClip, RetargetOptions, Skeleton, Template, load_gltf, load_gltf_motion, parse_bvh,
};
use flyrig_calib::load_easymocap;
use flyrig_capture::{
    CameraSource as _, FolderOptions, FolderReplay, McapReplay, RecordedCamera, foreign_cameras, recorded_notes,
    to_rgb8,
};
use flyrig_page::{Page, PageMessageKind};
use flyrig_renderer::{PlyError, SplatFile};
use flyrig_transport::{
    CameraStatus, FRAME_HEADER_BYTES, FrameHeader, HEADER_BYTES, Header, RigStats, SplatState, ViewFrame,
    decode_calibration, decode_transforms,
};
use flyrig_types::{Image, PixelFormat};
use glam::{DMat4, DQuat, DVec3};

/// Decoder under test.
pub struct Target {
    pub name: &'static str,
    pub words: &'static [&'static str],
    pub run: fn(&[u8]) -> Result<String, String>,
}

pub const TARGETS: [Target; 12] = [
    Target { name: "pixels", words: &[], run: pixels },
    Target { name: "jpeg", words: &["\u{fffd}\u{fffd}", "JFIF", "Exif", "Adobe"], run: jpeg },
    Target { name: "image", words: &["IHDR", "IDAT", "IEND", "PLTE", "tRNS"], run: picture },
    Target { name: "mcap", words: &["foxglove.RawImage", "camera/a", "protobuf", "\u{89}MCAP0\r\n"], run: mcap },
    Target { name: "calibration", words: CALIBRATION_WORDS, run: calibration },
    Target { name: "config", words: CONFIG_WORDS, run: config },
    Target { name: "wire", words: &["schema_version", "FLYR", "null", "{", "[", "1e999"], run: wire },
    Target { name: "network-frame", words: &["FLYR"], run: network_frame },
    Target { name: "splats", words: &[], run: splats },
    Target { name: "ply", words: PLY_WORDS, run: ply },
    Target { name: "stream", words: &["FLT", "FLA", "FLE", "FLM", "FLC", "cameras", "world_up", "1e999"], run: stream },
    Target {
        name: "motion",
        words: &["JOINT", "OFFSET", "CHANNELS", "End Site", "MOTION", "Frames:", "{", "}"],
        run: motion,
    },
];

const CALIBRATION_WORDS: &[&str] = &[
    "%YAML:1.0\n---\n",
    "!!opencv-matrix",
    "rows: ",
    "cols: ",
    "dt: d",
    "data: [",
    "names:",
    "K_a",
    "R_a",
    "T_a",
    "dist_a",
    "H_a",
];
const CONFIG_WORDS: &[&str] = &[
    "[[source.cameras]]\n",
    "[source]\n",
    "kind = ",
    "\"v4l2\"",
    "\"network\"",
    "size = [",
    "fps = ",
    "[sim]\n",
    "[sync]\n",
    "= true",
    "= [",
    "{ ",
    "'''",
    "[faults]\n",
    "0x",
    "1979-05-27T07:32:00Z",
];

const PLY_WORDS: &[&str] = &[
    "ply\n",
    "format binary_little_endian 1.0\n",
    "element vertex ",
    "element face 1\n",
    "property float ",
    "property list uchar int ",
    "comment ",
    "f_rest_",
    "end_header\n",
];

/// Describes the result of a decoder: `ok`, or the text of the error.
fn outcome_of<T, E: std::fmt::Display>(result: Result<T, E>, ok: &str) -> Result<String, String> {
    result.map(|_| ok.to_owned()).map_err(|error| error.to_string())
}

const FORMATS: [PixelFormat; 12] = [
    PixelFormat::Rgb8,
    PixelFormat::Bgr8,
    PixelFormat::Rgba8,
    PixelFormat::Gray8,
    PixelFormat::Yuyv,
    PixelFormat::Uyvy,
    PixelFormat::Nv12,
    PixelFormat::BayerRggb8,
    PixelFormat::BayerGrbg8,
    PixelFormat::BayerGbrg8,
    PixelFormat::BayerBggr8,
    PixelFormat::Mjpeg,
];

/// Converts pixels to RGB. The first bytes give format, width, height, and whether the pixels are padded to that size.
fn pixels(input: &[u8]) -> Result<String, String> {
    let [format, width, height, exact, bytes @ ..] = input else { return Err("short".into()) };
    let format = FORMATS[usize::from(*format) % FORMATS.len()];
    let (width, height) = (u32::from(*width) % 70, u32::from(*height) % 70);
    let mut bytes = bytes.to_vec();
    if let Some(needed) = format.byte_len(width, height).filter(|_| exact % 4 != 0) {
        bytes.resize(needed, 77);
    }
    let image = Image::new(width, height, format, bytes).map_err(|error| error.to_string())?;
    let rgb = to_rgb8(&image).map_err(|error| format!("{format:?} {error}"))?;
    assert_eq!(rgb.len(), width as usize * height as usize * 3, "wrong number of RGB bytes");
    Ok(format!("{format:?}"))
}

fn jpeg(input: &[u8]) -> Result<String, String> {
    let image = Image::new(48, 32, PixelFormat::Mjpeg, input.to_vec()).map_err(|error| error.to_string())?;
    let rgb = to_rgb8(&image).map_err(|error| error.to_string())?;
    assert_eq!(rgb.len(), 48 * 32 * 3, "wrong number of RGB bytes");
    Ok("an image".into())
}

thread_local! {
    static FOLDER: RefCell<Option<tempfile::TempDir>> = const { RefCell::new(None) };
}

/// Writes files into a folder that all inputs share, and calls `read` with its path.
fn with_files<T>(files: &[(&str, &[u8])], read: impl FnOnce(&Path) -> T) -> Result<T, String> {
    FOLDER.with(|folder| {
        let mut folder = folder.borrow_mut();
        if folder.is_none() {
            // A file system in memory where there is one.
            let memory = Path::new("/dev/shm");
            let made = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
            *folder = Some(made.map_err(|error| error.to_string())?);
        }
        let Some(folder) = folder.as_ref() else { return Err("no folder".to_owned()) };
        for (name, bytes) in files {
            let path = folder.path().join(name);
            let write = || -> std::io::Result<()> {
                if let Some(parent) = path.parent() {
                    fs::create_dir_all(parent)?;
                }
                fs::write(&path, bytes)
            };
            write().map_err(|error| error.to_string())?;
        }
        Ok(read(folder.path()))
    })
}

fn picture(input: &[u8]) -> Result<String, String> {
    let name = if input.starts_with(&[0x89]) { "images/a/000000.png" } else { "images/b/000000.jpg" };
    let camera = if name.contains("/a/") { "a" } else { "b" };
    with_files(&[(name, input)], |root| {
        let sources = FolderReplay::open(root, Some(&[camera.into()]), &FolderOptions::default());
        let mut sources = sources.map_err(|error| error.to_string())?;
        let source = sources.first_mut().ok_or("no source")?;
        outcome_of(source.next_frame(Duration::ZERO), "a frame")
    })?
}

fn mcap(input: &[u8]) -> Result<String, String> {
    with_files(&[("take.mcap", input)], |root| {
        let path = root.join("take.mcap");
        let notes = recorded_notes(&path).map_err(|error| error.to_string())?;
        for (_, note) in &notes {
            let _ = (decode_calibration(note), decode_transforms(note));
        }
        // A file without cameras of flyrig's may be one of another program.
        let foreign = foreign_cameras(&path).map(|found| found.cameras).unwrap_or_default();
        let own = ["a", "b"].map(|camera| RecordedCamera::new(camera.into()));
        let mut frames = 0;
        for camera in foreign.into_iter().map(|camera| camera.images).chain(own) {
            let mut replay = McapReplay::open_camera(&camera, &path).map_err(|error| error.to_string())?;
            // More frames than a recording of a few kilobytes can hold.
            for _ in 0..10_000 {
                match replay.next_frame(Duration::ZERO) {
                    Ok(frame) => {
                        let _ = to_rgb8(&frame.image);
                        frames += 1;
                    }
                    Err(error) if error.kind.is_recoverable() => {}
                    Err(_) => break,
                }
            }
        }
        Ok(format!("frames {}", if frames > 0 { "some" } else { "none" }))
    })?
}

/// Loads a calibration from both YAML files, separated by a NUL byte.
fn calibration(input: &[u8]) -> Result<String, String> {
    let cut = input.iter().position(|b| *b == 0).unwrap_or(input.len());
    let (intri, extri) = (&input[..cut], input.get(cut + 1..).unwrap_or_default());
    with_files(&[("intri.yml", intri), ("extri.yml", extri)], |root| {
        let rig = load_easymocap(root, &|_| Some((640, 480)))
            .map_err(|error| error.to_string().replace(&root.display().to_string(), ""))?;
        assert!(rig.validate().is_ok(), "an invalid rig was accepted");
        Ok("a rig".to_owned())
    })?
}

fn config(input: &[u8]) -> Result<String, String> {
    let text = String::from_utf8_lossy(input);
    let rig = outcome_of(flyrig::check_config(&text), "a configuration");
    rig.or_else(|error| flyrig::check_simulator(&text).map(|()| "a simulated rig".to_owned()).map_err(|_| error))
}

/// Decodes the message whose type the first byte selects.
fn wire(input: &[u8]) -> Result<String, String> {
    let (choice, bytes) = input.split_first().ok_or("short")?;
    match choice % 6 {
        0 => outcome_of(Header::decode("x", bytes), "header"),
        1 => outcome_of(CameraStatus::decode(bytes), "status"),
        2 => outcome_of(RigStats::decode(bytes), "stats"),
        3 => outcome_of(decode_calibration(bytes), "calibration"),
        4 => outcome_of(decode_transforms(bytes), "transforms"),
        _ => {
            let (head, payload) = bytes.split_at(bytes.len().min(HEADER_BYTES));
            let header = Header::decode("x", head).map_err(|error| error.to_string())?;
            outcome_of(ViewFrame::decode("x", &header, payload.to_vec().into()), "view")
        }
    }
}

fn network_frame(input: &[u8]) -> Result<String, String> {
    let (head, payload) = input.split_at(input.len().min(FRAME_HEADER_BYTES));
    let header = FrameHeader::decode("x", head).map_err(|error| error.to_string())?;
    let frame = header.frame("x", &"a".into(), payload.to_vec()).map_err(|error| error.to_string())?;
    // A JPEG of a few bytes may declare any size; the rig checks the declared size before it decodes.
    if frame.image.width() > 4096 || frame.image.height() > 4096 {
        return Err("large".into());
    }
    outcome_of(to_rgb8(&frame.image), &format!("{:?}", frame.image.format()))
}

fn ply(bytes: &[u8]) -> Result<String, String> {
    let file = SplatFile::parse(bytes).map_err(|error| match error {
        // These messages quote the input, so each would be a new outcome.
        PlyError::Header(_) => "a header of something else".to_owned(),
        PlyError::Short { .. } => "cut off".to_owned(),
        other => other.to_string(),
    })?;
    let SplatFile { splats, degree, is_flat, filter, .. } = file;
    Ok(format!("{} Gaussians of degree {degree}, flat {is_flat}, {filter:?}", splats.count()))
}

fn splats(input: &[u8]) -> Result<String, String> {
    let state = SplatState::decode(input).map_err(|error| error.to_string())?;
    assert!(state.center_scale.iter().flatten().all(|value| value.is_finite()), "a non-finite number was accepted");
    Ok("splats".into())
}

/// Decodes a message of the person stream as a browser does, for a known person. The first byte selects its kind.
fn stream(input: &[u8]) -> Result<String, String> {
    const TEMPLATE: &[u8] = include_bytes!("../../../corpus/stream/template");
    const RIG: &[u8] = include_bytes!("../../../corpus/stream/rig");
    let (kind, bytes) = input.split_first().ok_or("short")?;
    let mut page = Page::default();
    for known in [RIG, TEMPLATE] {
        let kind = PageMessageKind::of(known[0].into()).ok_or("no kind")?;
        page.ingest(kind, 0, &known[1..], 0.0).map_err(|error| error.to_string())?;
    }
    let kind = PageMessageKind::of(u32::from(kind % 4)).ok_or("no kind")?;
    let taken = page.ingest(kind, 0, bytes, 0.1).map_err(|error| error.to_string());
    page.pose(0.1, true);
    let shown = page.order(64, 64).len();
    taken.map(|()| format!("{kind:?} {}", if shown > 0 { "shown" } else { "hidden" }))
}

/// Parses BVH text or a binary glTF file and transfers its motion to a skeleton of the legs.
fn motion(input: &[u8]) -> Result<String, String> {
    let retarget = |clip: MotionClip| clip.retarget(&Template::empty("legs", legs()?), &RetargetOptions::default());
    if input.starts_with(b"glTF") {
        return with_files(&[("body.glb", input)], |root| {
            let path = root.join("body.glb");
            outcome_of(load_gltf(&path).and_then(|_| load_gltf_motion(&path)).and_then(retarget), "a body")
        })?;
    }
    let text = String::from_utf8_lossy(input);
    outcome_of(parse_bvh(&text, Path::new("x.bvh")).and_then(|clip| retarget(clip.motion())), "a clip")
}

/// Returns a skeleton of hips, a head and two legs.
fn legs() -> Result<Skeleton, BodyError> {
    let joint = |name: &str, parent: Option<usize>, at: [f64; 3], origin: [f64; 3]| Joint {
        name: name.to_owned(),
        parent,
        rest_translation: DVec3::from(at),
        rest_rotation: DQuat::IDENTITY,
        joint_from_canonical: DMat4::from_translation(-DVec3::from(origin)),
    };
    let mut joints = vec![joint("Hips", None, [0.0, 0.9, 0.0], [0.0, 0.9, 0.0])];
    joints.push(joint("Head", Some(0), [0.0, 0.7, 0.0], [0.0, 1.6, 0.0]));
    for (side, x) in [("Left", 0.1), ("Right", -0.1)] {
        let hip = joints.len();
        joints.push(joint(&format!("{side}UpLeg"), Some(0), [x, 0.0, 0.0], [x, 0.9, 0.0]));
        joints.push(joint(&format!("{side}Leg"), Some(hip), [0.0, -0.4, 0.0], [x, 0.5, 0.0]));
        joints.push(joint(&format!("{side}Foot"), Some(hip + 1), [0.0, -0.4, 0.0], [x, 0.1, 0.0]));
        joints.push(joint(&format!("{side}ToeBase"), Some(hip + 2), [0.0, -0.1, 0.1], [x, 0.0, 0.1]));
    }
    Skeleton::new(joints)
}
