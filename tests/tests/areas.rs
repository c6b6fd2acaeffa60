//! Dependency direction: crates depend only on crates of their own area or of areas below it (ARCHITECTURE.md, "Areas").
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::collections::BTreeMap;
use std::path::Path;

/// Areas, each with the other areas that its crates may depend on.
const AREAS: [(&str, &[&str]); 11] = [
    ("base", &[]),
    ("capture", &["base"]),
    ("calib", &["base"]),
    ("renderer", &["base"]),
    ("transport", &["base"]),
    ("tracker", &["base", "capture", "calib"]),
    ("sim", &["base", "capture", "calib"]),
    ("viewer", &["base", "renderer", "transport"]),
    ("rig", &["base", "capture", "calib", "renderer", "transport", "tracker"]),
    ("apps", &["base", "capture", "calib", "renderer", "transport", "tracker", "sim", "viewer", "rig"]),
    ("tests", &["base", "capture", "calib", "renderer", "transport", "tracker", "sim", "viewer", "rig", "apps"]),
];

/// Returns the folder of each workspace member, relative to the root, by package name.
fn members(root: &Path) -> BTreeMap<String, String> {
    let manifest: toml::Table = std::fs::read_to_string(root.join("Cargo.toml")).unwrap().parse().unwrap();
    let folders = manifest["workspace"]["members"].as_array().unwrap();
    let folder = |value: &toml::Value| value.as_str().unwrap().to_owned();
    folders.iter().map(folder).map(|folder| (package(&read(root, &folder)), folder)).collect()
}

fn read(root: &Path, folder: &str) -> toml::Table {
    std::fs::read_to_string(root.join(folder).join("Cargo.toml")).unwrap().parse().unwrap()
}

fn package(manifest: &toml::Table) -> String {
    manifest["package"]["name"].as_str().unwrap().to_owned()
}

/// Returns the names of all dependencies: of the library, its tests, its build script and single targets.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let mut tables = vec![manifest];
    if let Some(targets) = manifest.get("target").and_then(toml::Value::as_table) {
        tables.extend(targets.values().filter_map(toml::Value::as_table));
    }
    let kinds = ["dependencies", "dev-dependencies", "build-dependencies"];
    let lists = tables.iter().flat_map(|table| kinds.iter().filter_map(|kind| table.get(*kind)?.as_table()));
    lists.flat_map(|list| list.keys().cloned()).collect()
}

fn area(folder: &str) -> &str {
    folder.split('/').next().unwrap_or(folder)
}

/// Returns the dependencies that violate the direction of the areas.
fn violations(members: &BTreeMap<String, String>, uses: impl Fn(&str) -> Vec<String>) -> Vec<String> {
    let mut found = Vec::new();
    for (name, folder) in members {
        let Some((_, allowed)) = AREAS.iter().find(|(area_name, _)| *area_name == area(folder)) else {
            found.push(format!("{folder} lies in no area"));
            continue;
        };
        for used in uses(folder) {
            let Some(target) = members.get(&used) else { continue };
            if area(target) != area(folder) && !allowed.contains(&area(target)) {
                found.push(format!("{name} ({}) depends on {used} ({})", area(folder), area(target)));
            }
        }
    }
    found
}

#[test]
fn dependencies_point_to_lower_areas() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let members = members(&root);
    assert!(members.len() > 20, "{members:?}");
    let found = violations(&members, |folder| dependencies(&read(&root, folder)));
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn a_dependency_against_the_direction_is_found() {
    let members = [("flyrig-types", "base/types"), ("flyrig-sync", "capture/sync")];
    let members = members.map(|(name, folder)| (name.to_owned(), folder.to_owned())).into();
    let uses = |folder: &str| if folder == "base/types" { vec!["flyrig-sync".to_owned()] } else { Vec::new() };
    assert_eq!(violations(&members, uses), ["flyrig-types (base) depends on flyrig-sync (capture)"]);
}
