//! Independence of the ground truth: the simulator does not depend on the renderer that it evaluates.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::path::Path;

#[test]
fn the_simulator_does_not_use_the_renderer() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let lock = std::fs::read_to_string(root.join("Cargo.lock")).unwrap();
    let mut todo = vec!["flyrig-sim".to_owned()];
    let mut seen = Vec::new();
    while let Some(name) = todo.pop() {
        let Some(package) = lock.split("[[package]]").find(|p| p.contains(&format!("\nname = \"{name}\"\n"))) else {
            panic!("{name} is not in Cargo.lock");
        };
        let listed = package.split("dependencies = [").nth(1).unwrap_or_default();
        for dependency in listed.split('"').skip(1).step_by(2).filter(|d| d.starts_with("flyrig")) {
            let dependency = dependency.split(' ').next().unwrap_or_default().to_owned();
            if !seen.contains(&dependency) {
                seen.push(dependency.clone());
                todo.push(dependency);
            }
        }
    }
    assert!(seen.contains(&"flyrig-body".to_owned()), "the dependencies were not walked: {seen:?}");
    assert!(!seen.contains(&"flyrig-renderer".to_owned()), "{seen:?}");
}
