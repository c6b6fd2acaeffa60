//! The example runs, depends on `flyrig-fusion` alone, and its output is as promised to embedding programs.
#![allow(clippy::unwrap_used)] // a test may fail by panicking

/// Source of the example.
const SOURCE: &str = include_str!("../examples/embed.rs");

#[path = "../examples/embed.rs"]
#[allow(dead_code)]
mod embed;

#[test]
fn an_embedding_program_depends_on_fusion_alone() {
    let uses: Vec<&str> = SOURCE.lines().filter(|line| line.starts_with("use ")).collect();
    assert!(
        uses.iter().all(|line| ["use std::", "use flyrig_fusion::"].iter().any(|start| line.starts_with(start))),
        "{uses:?}"
    );
    assert_eq!(SOURCE.matches("flyrig_").count(), 1, "in the import, and nowhere else");
    let guide = include_str!("../../../docs/guide/embedding.md");
    let crates = guide.lines().filter(|line| line.contains("flyrig_") && !line.contains("flyrig_fusion"));
    assert_eq!(crates.collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn images_with_timestamps_become_gaussians_and_a_view() {
    let (splats, view) = embed::run().unwrap();
    assert_eq!(splats.len(), 12_000);
    assert!(splats.iter().all(|s| s.position.iter().chain(&s.color).all(|v| v.is_finite())));
    // Of the front camera's image the left half is red: the person's right side.
    let mean = |of: &dyn Fn(f32) -> bool, channel: usize| {
        let colors = splats.iter().filter(|s| of(s.position[0]) && s.normal[2] > 0.7).map(|s| s.color[channel]);
        let (sum, count) = colors.fold((0.0, 0), |(sum, count), c| (sum + c, count + 1));
        sum / count as f32
    };
    let (left, right) = (|x: f32| x < -0.05, |x: f32| x > 0.05);
    assert!(mean(&left, 0) > 2.0 * mean(&right, 0), "red: {} and {}", mean(&left, 0), mean(&right, 0));
    assert!(mean(&right, 2) > 2.0 * mean(&left, 2), "blue: {} and {}", mean(&left, 2), mean(&right, 2));
    assert_eq!(view.rgba.len(), 4 * 160 * 160);
    let covered = view.rgba.chunks_exact(4).filter(|p| p[3] > 127).count();
    assert!((1000..12_000).contains(&covered), "{covered} pixels");
}
