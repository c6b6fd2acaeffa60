//! Alone in its process: OpenCV must not add its own words to a refused file.

use std::{fs, process::Command};

use flyrig_calib::load_easymocap;

#[test]
fn opencv_is_silent_about_what_we_report() {
    const CHILD: &str = "FLYRIG_TEST_CHILD";
    if std::env::var_os(CHILD).is_some() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("intri.yml"), "%YAML:1.0\n---\nK_00: !!opencv-matrix\n  rows: [\n").unwrap();
        fs::write(dir.path().join("extri.yml"), "%YAML:1.0\n---\nT_00: 1\n").unwrap();
        assert!(load_easymocap(dir.path(), &|_| Some((4, 4))).is_err());
        return;
    }
    let child = Command::new(std::env::current_exe().unwrap()).args(["--nocapture"]).env(CHILD, "1").output().unwrap();
    let stderr = String::from_utf8_lossy(&child.stderr);
    assert!(child.status.success(), "{stderr}");
    assert_eq!(stderr, "");
}
