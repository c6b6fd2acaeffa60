//! Import cycles: the files of a crate do not import each other in a cycle (CONTRIBUTING.md). Re-exports and the crate's root are
//! exempt.
#![allow(clippy::unwrap_used, clippy::panic)] // a test may fail by panicking, in its helpers too

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Returns the module path of each file below `src`, such as `["deform", "track"]`, without tests and crate roots.
fn modules(src: &Path) -> BTreeMap<Vec<String>, PathBuf> {
    let mut found = BTreeMap::new();
    let mut folders = vec![src.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let inside = path.strip_prefix(src).unwrap().with_extension("");
            let mut module: Vec<String> = inside.iter().map(|part| part.to_str().unwrap().to_owned()).collect();
            let name = module.last().unwrap().clone();
            let test = name == "tests" || name.ends_with("_tests") || name.ends_with("_properties");
            let test = test || module.iter().any(|part| part == "testing");
            if path.extension().is_none_or(|kind| kind != "rs") || test || name == "lib" || name == "main" {
                continue;
            }
            if name == "mod" {
                module.pop();
            }
            found.insert(module, path);
        }
    }
    found
}

/// Returns where the inline test module of a source starts; its length without one.
fn inline_tests(text: &str) -> usize {
    let is_module = |at: usize| {
        let mut lines = text[at..].lines().skip(2).skip_while(|line| line.starts_with("#["));
        lines.next().is_some_and(|line| line.contains("mod ") && line.ends_with('{'))
    };
    let mut starts = text.match_indices("\n#[cfg(test)]\n").map(|(at, _)| at);
    starts.find(|at| is_module(*at)).unwrap_or(text.len())
}

/// Returns the source without line comments, inline tests and re-exports.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let production = &text[..inline_tests(&text)];
    let lines = production.lines().map(|line| line.split("//").next().unwrap_or_default());
    let mut code = lines.collect::<Vec<_>>().join("\n");
    for start in ["pub use ", "pub(crate) use ", "pub(super) use "] {
        while let Some(at) = code.find(start) {
            let end = code[at..].find(';').map_or(code.len(), |length| at + length);
            code.replace_range(at..end, "");
        }
    }
    code
}

/// Expands `a::{b, c::{d, e}}` at the start of `text` into its paths.
fn paths(text: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    expand(&mut text.chars().peekable(), Vec::new(), &mut found);
    found
}

fn expand(text: &mut std::iter::Peekable<std::str::Chars<'_>>, mut head: Vec<String>, found: &mut Vec<Vec<String>>) {
    loop {
        while text.next_if(|letter| letter.is_whitespace()).is_some() {}
        if text.next_if_eq(&'{').is_some() {
            loop {
                expand(text, head.clone(), found);
                while text.next_if(|letter| letter.is_whitespace()).is_some() {}
                if text.next_if_eq(&',').is_none() {
                    break;
                }
            }
            text.next_if_eq(&'}');
            return;
        }
        let mut name = String::new();
        while let Some(letter) = text.next_if(|letter| letter.is_alphanumeric() || *letter == '_') {
            name.push(letter);
        }
        // Behind a trailing comma.
        if name.is_empty() {
            return;
        }
        head.push(name);
        let mut rest = text.clone();
        if rest.next() == Some(':') && rest.next() == Some(':') {
            *text = rest;
        } else {
            found.push(head);
            return;
        }
    }
}

/// Returns the modules that `module` imports: by `crate::`, `super::`, `self::` or the name of a child.
fn imports(module: &[String], code: &str, all: &BTreeMap<Vec<String>, PathBuf>) -> BTreeSet<Vec<String>> {
    let mut starts = vec!["crate".to_owned(), "super".to_owned(), "self".to_owned()];
    starts.extend(
        all.keys().filter(|m| m.len() == module.len() + 1 && m.starts_with(module)).map(|m| m[module.len()].clone()),
    );
    let mut found = BTreeSet::new();
    for start in &starts {
        for (at, _) in code.match_indices(&format!("{start}::")) {
            if code[..at].ends_with(|letter: char| letter.is_alphanumeric() || letter == '_' || letter == ':') {
                continue;
            }
            for path in paths(&code[at..]) {
                let mut base = module.to_vec();
                let mut steps = path.as_slice();
                match steps[0].as_str() {
                    "crate" => base.clear(),
                    "super" => {}
                    "self" => {}
                    _ => base.push(steps[0].clone()),
                }
                while let Some((_, rest)) = steps.split_first().filter(|(first, _)| *first == "super") {
                    base.pop();
                    steps = rest;
                }
                if steps.len() == path.len() {
                    steps = &steps[1..];
                }
                base.extend_from_slice(steps);
                let known =
                    (1..=base.len()).rev().map(|length| base[..length].to_vec()).find(|path| all.contains_key(path));
                found.extend(known.filter(|target| target != module));
            }
        }
    }
    found
}

/// Returns the modules that reach themselves through imports.
fn in_cycles(edges: &BTreeMap<Vec<String>, BTreeSet<Vec<String>>>) -> Vec<String> {
    let reaches_itself = |start: &Vec<String>| {
        let mut seen = BTreeSet::new();
        let mut todo: Vec<_> = edges[start].iter().collect();
        while let Some(module) = todo.pop() {
            if module == start {
                return true;
            }
            if seen.insert(module) {
                todo.extend(edges[module].iter());
            }
        }
        false
    };
    edges.keys().filter(|module| reaches_itself(module)).map(|module| module.join("::")).collect()
}

#[test]
fn no_file_imports_itself_through_others() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let manifest: toml::Table = std::fs::read_to_string(root.join("Cargo.toml")).unwrap().parse().unwrap();
    let mut cycles = Vec::new();
    let mut files = 0;
    for member in manifest["workspace"]["members"].as_array().unwrap() {
        let member = member.as_str().unwrap();
        // Programs that test others are no part of what is shipped.
        if member == "tests" {
            continue;
        }
        let all = modules(&root.join(member).join("src"));
        files += all.len();
        let edges = all.iter().map(|(module, path)| (module.clone(), imports(module, &code(path), &all))).collect();
        cycles.extend(in_cycles(&edges).into_iter().map(|module| format!("{member}: {module}")));
    }
    assert!(files > 400, "too few files found: {files}");
    assert!(cycles.is_empty(), "{cycles:#?}");
}

#[test]
fn a_cycle_is_found() {
    let name = |text: &str| text.split("::").map(str::to_owned).collect::<Vec<_>>();
    let all: BTreeMap<_, _> = ["a", "b", "a::c"].map(|module| (name(module), PathBuf::new())).into();
    let sources = [
        ("a", "use crate::{\n    b::{One, Two},\n    d::Three,\n};"),
        ("b", "fn f() { crate::a::c::g() }"),
        ("a::c", "use super::{\n    Four,\n};"),
    ];
    let edges: BTreeMap<_, _> = sources.map(|(module, code)| (name(module), imports(&name(module), code, &all))).into();
    assert_eq!(edges[&name("b")], BTreeSet::from([name("a::c")]));
    assert_eq!(in_cycles(&edges), ["a", "a::c", "b"]);
}
