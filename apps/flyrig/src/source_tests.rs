//! Tests of `[source]` as part of a whole configuration.

use flyrig_capture::{CameraIdentity, DeviceOptions, FormatChoice, NokhwaDevice};

use crate::config::Config;

const RIG: &str = "[source]\nkind = \"v4l2\"\npath = \"calib\"\n[perception]\npose = \"estimated\"\n";

fn parse(cameras: &str) -> Result<Config, String> {
    let text = RIG.replace("[perception]", &format!("{cameras}\n[perception]"));
    Config::parse(&text).map_err(|error| format!("{error:#}"))
}

#[test]
fn a_table_becomes_options() {
    let table = "[[source.cameras]]\nname = \"left\"\nserial = \"A1\"\nsize = [1280, 720]\nfps = 60\nformat = \"mjpeg\"\n\
                     exposure_ms = 8\ngain = 3\nlag_ms = 2.5\n";
    let config = parse(table).unwrap();
    let DeviceOptions::V4l2(options) = config.source.cameras[0].device().unwrap().options().unwrap() else { panic!() };
    assert_eq!(options.identity, CameraIdentity::Serial("A1".into()));
    assert_eq!((options.width, options.height, options.fps), (1280, 720, 60.0));
    assert_eq!((options.format, options.buffers), (FormatChoice::Mjpeg, 6));
    assert_eq!((options.controls.exposure_secs, options.controls.gain), (Some(0.008), Some(3)));
    assert!((options.lag_secs - 0.0025).abs() < 1e-12);
    let table = "[[source.cameras]]\nname = \"left\"\nnokhwa = \"FaceTime HD Camera\"\nsize = [1280, 720]\n";
    let nokhwa = parse(table).unwrap().source.cameras[0].device().unwrap().options().unwrap();
    let DeviceOptions::Nokhwa(nokhwa) = nokhwa else { panic!() };
    assert_eq!(nokhwa.device, NokhwaDevice::Name("FaceTime HD Camera".into()));
    assert_eq!((nokhwa.width, nokhwa.height, nokhwa.fps), (1280, 720, 30.0));
    // A round trip through TOML changes nothing.
    let again = Config::parse(&toml::to_string(&config).unwrap()).unwrap();
    assert_eq!(again, config);
}

#[test]
fn mistakes_name_camera_key_and_mend() {
    let table =
        |keys: &str| parse(&format!("[[source.cameras]]\nname = \"left\"\nsize = [640, 360]\n{keys}\n")).unwrap_err();
    for (keys, expected) in [
        ("", "camera left: serial, path, bus and nokhwa are all empty; set one"),
        ("serial = \"a\"\nbus = \"b\"", "by one of serial, path, bus and nokhwa, not by several"),
        ("nokhwa = \"0\"\ngain = 3", "camera left: gain cannot be set through nokhwa; leave it out"),
        ("nokhwa = \"0\"\nformat = \"uyvy\"", "format \"uyvy\" is not available through nokhwa"),
        ("serial = \"a\"\nfps = 0", "camera left: fps is 0, it must lie between 0.1 and 1000"),
        ("serial = \"a\"\nexposure_ms = nan", "camera left: exposure_ms is NaN"),
        ("serial = \"a\"\nbuffers = 1", "camera left: buffers is 1, it must lie between 3 and 32"),
        ("serial = \"a\"\nexposure = 3", "unknown field `exposure`"),
        ("serial = \"a\"\nformat = \"h264\"", "unknown variant `h264`"),
    ] {
        let error = table(keys);
        assert!(error.contains(expected), "{keys}: {error}");
    }
    assert!(table("serial = \"a\"\nexposure = 3").ends_with("did you mean `exposure_ms`?"));
    let error = parse("cameras = [\"left\"]").unwrap_err();
    assert!(error.contains("camera left of source.cameras is only a name"), "{error}");
    let error = parse("cameras = [3]").unwrap_err();
    assert!(error.contains("the name of a camera, or a table"), "{error}");
    let twice = "[[source.cameras]]\nname = \"a\"\nsize = [64, 64]\nbus = \"x\"\n".repeat(2);
    assert!(parse(&twice).unwrap_err().contains("camera a is listed twice"));
    assert!(parse("").unwrap_err().contains("is only a name"), "the default names are those of the simulated rig");
    let error = Config::parse("[[source.cameras]]\nname = \"a\"\nsize = [64, 64]\nbus = \"x\"\n").unwrap_err();
    assert!(error.to_string().contains("source.kind is not \"cameras\""), "{error}");
}
