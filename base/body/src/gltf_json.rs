//! JSON part of glTF files, reduced to skinned meshes and their motion: whatever extensions add elsewhere cannot fail the import.

use std::path::Path;

use gltf::json::Root;
use serde_json::{Map, Value, json};

/// Compressions of data; nothing can be read without unpacking them.
const COMPRESSED: [&str; 3] = ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"];

/// Required extensions that change nothing about bodies and motion: looks, lights, data about the file, avatars' own systems.
const IGNORED: [&str; 22] = [
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "KHR_xmp",
    "KHR_mesh_quantization",
    "KHR_animation_pointer",
    "KHR_node_",
    "KHR_audio",
    "KHR_interactivity",
    "KHR_accessor_float",
    "KHR_techniques_webgl",
    "KHR_physics_",
    "EXT_texture_",
    "EXT_lights_",
    "EXT_materials_",
    "EXT_mesh_manifold",
    "MSFT_texture_",
    "MSFT_lod",
    "MSFT_packing_",
    "ADOBE_materials_",
    "VRM",
    "FB_ngon_encoding",
];

/// Names of other extensions that an error lists.
const SHOWN: usize = 100;

/// Parses the JSON part and keeps the fields that the import reads.
///
/// # Errors
/// Says what is wrong: JSON that is none, another version, a required extension that is not read, with the command that
/// unpacks compressed data.
pub(crate) fn read(text: &[u8], path: &Path) -> Result<Root, String> {
    let invalid = |error: &dyn std::fmt::Display| format!("not a valid glTF 2.0 file: {error}");
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
    let mut whole: Value = serde_json::from_slice(text).map_err(|error| invalid(&error))?;
    if let Some(version) = whole["asset"]["version"].as_str().filter(|version| !version.starts_with("2.")) {
        return Err(format!("glTF version {}; version 2.0 is read", shown(version)));
    }
    for extension in whole["extensionsRequired"].as_array().into_iter().flatten().filter_map(Value::as_str) {
        if COMPRESSED.contains(&extension) {
            return Err(compressed(extension, path));
        }
        if !IGNORED.iter().any(|known| extension.starts_with(known)) {
            let extension = shown(extension);
            return Err(format!("the file requires the extension {extension}, which is not read; export it without"));
        }
    }
    // A file may hold compressed data beside plain data, or instead of it without saying so.
    for buffer in whole["buffers"].as_array().into_iter().flatten().filter(|buffer| buffer["uri"].is_null()) {
        let is_fallback = |name: &&str| buffer["extensions"][name]["fallback"] == json!(true);
        if let Some(extension) = COMPRESSED.iter().find(|name| is_fallback(name)) {
            return Err(compressed(extension, path));
        }
    }
    let has_data = |index: &Value| {
        let accessor = index.as_u64().and_then(|index| whole["accessors"].get(index as usize));
        accessor.is_some_and(|accessor| !accessor["bufferView"].is_null() || !accessor["sparse"].is_null())
    };
    let primitives = whole["meshes"].as_array().into_iter().flatten().filter_map(|mesh| mesh["primitives"].as_array());
    for primitive in primitives.flatten() {
        let extension = COMPRESSED.iter().find(|name| !primitive["extensions"][name].is_null());
        if let Some(extension) = extension.filter(|_| !has_data(&primitive["attributes"]["POSITION"])) {
            return Err(compressed(extension, path));
        }
    }
    let root = json!({
        "asset": { "version": "2.0" },
        "buffers": items(&mut whole, "buffers", |buffer| keep(buffer, &["byteLength", "uri"])),
        "bufferViews": items(&mut whole, "bufferViews", |view| {
            keep(view, &["buffer", "byteOffset", "byteLength", "byteStride"]);
        }),
        "accessors": items(&mut whole, "accessors", accessor),
        "meshes": items(&mut whole, "meshes", mesh),
        "nodes": items(&mut whole, "nodes", |node| {
            keep(node, &["name", "children", "matrix", "translation", "rotation", "scale", "mesh", "skin"]);
        }),
        "skins": items(&mut whole, "skins", |skin| keep(skin, &["name", "joints", "inverseBindMatrices"])),
        "animations": items(&mut whole, "animations", animation),
    });
    gltf::json::deserialize::from_value(root).map_err(|error| invalid(&error))
}

fn compressed(extension: &str, path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    format!(
        "its data is compressed ({extension}), which is not read; export it without compression, or unpack it: npx \
         @gltf-transform/cli copy {name:?} unpacked.glb"
    )
}

/// Shortens and escapes text of the file.
pub(crate) fn shown(text: &str) -> String {
    text.chars().take(SHOWN).collect::<String>().escape_debug().to_string()
}

/// Takes the array of this name and changes its items; something else than an array is left to the parser.
fn items(whole: &mut Value, name: &str, change: impl Fn(&mut Map<String, Value>)) -> Value {
    let mut list = match whole.get_mut(name) {
        Some(list) => list.take(),
        None => return json!([]),
    };
    list.as_array_mut().into_iter().flatten().filter_map(Value::as_object_mut).for_each(change);
    list
}

fn keep(object: &mut Map<String, Value>, fields: &[&str]) {
    object.retain(|name, value| fields.contains(&name.as_str()) && !value.is_null());
}

fn accessor(accessor: &mut Map<String, Value>) {
    keep(accessor, &["bufferView", "byteOffset", "componentType", "normalized", "count", "type", "sparse"]);
    if let Some(sparse) = accessor.get_mut("sparse").and_then(Value::as_object_mut) {
        keep(sparse, &["count", "indices", "values"]);
        for part in ["indices", "values"] {
            if let Some(part) = sparse.get_mut(part).and_then(Value::as_object_mut) {
                keep(part, &["bufferView", "byteOffset", "componentType"]);
            }
        }
    } else if !accessor.contains_key("bufferView") {
        // All zeros by the specification; the parser wants data or differences.
        let view = json!({ "bufferView": 0, "componentType": 5121 });
        accessor.insert("sparse".to_owned(), json!({ "count": 0, "indices": view, "values": view }));
    }
    // The parser requires bounds of positions, which quantised and hand-made files give in other forms.
    if accessor.get("type") == Some(&json!("VEC3")) {
        for bound in ["min", "max"] {
            accessor.insert(bound.to_owned(), json!([0, 0, 0]));
        }
    }
}

fn mesh(mesh: &mut Map<String, Value>) {
    keep(mesh, &["name", "primitives"]);
    let primitives = mesh.get_mut("primitives").and_then(Value::as_array_mut);
    for primitive in primitives.into_iter().flatten().filter_map(Value::as_object_mut) {
        keep(primitive, &["attributes", "indices", "mode"]);
        if let Some(attributes) = primitive.get_mut("attributes").and_then(Value::as_object_mut) {
            attributes.retain(|name, index| {
                let set = name.strip_prefix("JOINTS_").or_else(|| name.strip_prefix("WEIGHTS_"));
                let is_read = ["POSITION", "NORMAL", "TEXCOORD_0"].contains(&name.as_str());
                (is_read || set.is_some_and(|set| set.parse::<u32>().is_ok())) && !index.is_null()
            });
        }
    }
}

fn animation(animation: &mut Map<String, Value>) {
    keep(animation, &["name", "channels", "samplers"]);
    let samplers = animation.get_mut("samplers").and_then(Value::as_array_mut);
    samplers.into_iter().flatten().filter_map(Value::as_object_mut).for_each(|sampler| {
        keep(sampler, &["input", "output", "interpolation"]);
    });
    let Some(channels) = animation.get_mut("channels").and_then(Value::as_array_mut) else { return };
    // Morph targets, and properties that extensions animate, move no joint.
    channels.retain_mut(|channel| {
        let Some(channel) = channel.as_object_mut() else { return true };
        keep(channel, &["sampler", "target"]);
        let Some(target) = channel.get_mut("target").and_then(Value::as_object_mut) else { return true };
        if let Some([node, property]) = pointed(target) {
            *target = Map::from_iter([("node".to_owned(), node), ("path".to_owned(), property)]);
        }
        keep(target, &["node", "path"]);
        let moves = ["translation", "rotation", "scale"].map(Value::from);
        target.contains_key("node") && target.get("path").is_some_and(|path| moves.contains(path))
    });
}

/// Returns node and property that KHR_animation_pointer animates, if it is the transform of a node.
fn pointed(target: &Map<String, Value>) -> Option<[Value; 2]> {
    let pointer = target.get("extensions")?["KHR_animation_pointer"]["pointer"].as_str()?;
    let (node, property) = pointer.strip_prefix("/nodes/")?.split_once('/')?;
    Some([json!(node.parse::<u32>().ok()?), json!(property)])
}
