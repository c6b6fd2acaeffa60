//! Passes on which form of FFmpeg's interface `ac-ffmpeg` was built for: it changed where a stream's orientation is.

fn main() {
    for feature in ac_ffmpeg_features::ffmpeg_features(true) {
        println!("cargo::rustc-check-cfg=cfg({feature})");
    }
    for feature in ac_ffmpeg_features::ffmpeg_features(false) {
        println!("cargo::rustc-cfg={feature}");
    }
    println!("cargo::rerun-if-changed=build.rs");
}
