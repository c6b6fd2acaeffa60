//! Page of a mesh: pictures from four sides, counts and seconds.

use std::path::Path;

use anyhow::Result;
use flyrig_mesh::{DrawnMesh, draw_textured};
use flyrig_report::{ContactRow, Report, Table, png};
use flyrig_types::{Camera, Intrinsics, Isometry};
use glam::{DVec3, Vec2, Vec3};
use serde_json::Value;

/// Size of a picture, pixels.
const SIZE: [u32; 2] = [360, 640];
/// Name of each side, and the direction from which it is seen: y is up, the person faces z.
const SIDES: [(&str, DVec3); 4] =
    [("front", DVec3::Z), ("left side", DVec3::X), ("back", DVec3::NEG_Z), ("right side", DVec3::NEG_X)];
/// Files of a folder, and what they are for.
const FILES: [(&str, &str); 5] = [
    ("mesh.glb", "mesh.glb: glTF for Blender, game engines and browsers"),
    ("mesh.usdz", "mesh.usdz: USD"),
    ("mesh.obj", "mesh.obj: OBJ with mesh.mtl and mesh.png"),
    ("mesh.3mf", "mesh.3mf: for slicers, millimetres"),
    ("metrics.json", "metrics.json: all numbers of this page"),
];

/// Mesh in the rest pose: metres, y up, facing z. Lists of vertices have the same length.
pub(super) struct ShownMesh<'a> {
    pub positions: &'a [Vec3],
    /// Unit normals.
    pub normals: &'a [Vec3],
    pub uvs: &'a [Vec2],
    pub triangles: &'a [[u32; 3]],
    /// sRGB texels, and their number along a side.
    pub texture: (&'a [u8], u32),
}

/// Writes `index.html` of a folder. Numbers and texts of `metrics` become rows of tables, one table for each object
/// in it.
///
/// # Errors
/// The page cannot be written.
pub(super) fn write_page(
    folder: &Path,
    title: String,
    sentences: Vec<String>,
    metrics: &Value,
    mesh: &ShownMesh<'_>,
) -> Result<()> {
    let text = |value: &Value| match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(match number.as_f64() {
            Some(real) if number.is_f64() => format!("{real:.3}"),
            _ => number.to_string(),
        }),
        Value::Bool(is_true) => Some(if *is_true { "yes" } else { "no" }.to_owned()),
        _ => None,
    };
    let rows = |values: &Value| -> Vec<(String, String)> {
        let entries = values.as_object().into_iter().flatten();
        entries.filter_map(|(name, value)| Some((name.replace('_', " "), text(value)?))).collect()
    };
    let nested = |values: &Value| -> Vec<Vec<String>> {
        let groups = values.as_object().into_iter().flatten().filter(|(_, value)| value.is_object());
        let inner = groups.flat_map(|(group, value)| {
            rows(value)
                .into_iter()
                .map(move |(name, value)| vec![format!("{}, {name}", group.replace('_', " ")), value])
        });
        rows(values).into_iter().map(|(name, value)| vec![name, value]).chain(inner).collect()
    };
    let objects = metrics.as_object().into_iter().flatten().filter(|(_, value)| value.is_object());
    let tables = objects.map(|(name, value)| Table {
        title: name.replace('_', " "),
        head: vec![String::new(), String::new()],
        rows: nested(value),
    });
    let links = FILES.map(|(file, what)| (what.to_owned(), file.to_owned()));
    let report = Report {
        title,
        sentences,
        links: links.to_vec(),
        facts: rows(metrics),
        tables: tables.collect(),
        contact: four_sides(mesh)?,
        ..Report::default()
    };
    report.save(&folder.join("index.html"))
}

/// Draws a mesh with its texture, and in grey, from four sides.
fn four_sides(mesh: &ShownMesh<'_>) -> Result<Vec<ContactRow>> {
    let cameras = cameras(mesh.positions);
    let row = |label: &str, draw: &dyn Fn(&Camera, DVec3) -> flyrig_types::RenderedView| -> Result<ContactRow> {
        let pictures = cameras.iter().zip(SIDES).map(|(camera, (side, from))| {
            let view = draw(camera, from);
            Ok((side.to_owned(), png::encode_rgba(&view)?))
        });
        Ok(ContactRow { label: label.to_owned(), pictures: pictures.collect::<Result<_>>()? })
    };
    let drawn = DrawnMesh {
        positions: mesh.positions,
        shades: None,
        uvs: mesh.uvs,
        triangles: mesh.triangles,
        rgb: mesh.texture.0,
        side: mesh.texture.1,
    };
    let grey = |camera: &Camera, from: DVec3| {
        // A lamp above the camera, and some light from everywhere.
        let lamp = (from + 0.5 * DVec3::Y).normalize().as_vec3();
        let shade = |normal: &Vec3| Vec3::splat(0.08 + 0.6 * normal.dot(lamp).max(0.0));
        let shades: Vec<Vec3> = mesh.normals.iter().map(shade).collect();
        draw_textured(&DrawnMesh { shades: Some(&shades), rgb: &[255; 3], side: 1, ..drawn }, camera)
    };
    Ok(vec![row("texture", &|camera, _| draw_textured(&drawn, camera))?, row("surface", &grey)?])
}

/// Returns cameras around a mesh that show all of it.
fn cameras(positions: &[Vec3]) -> [Camera; 4] {
    let finite = || positions.iter().filter(|position| position.is_finite());
    let low = finite().fold(Vec3::INFINITY, |low, position| low.min(*position)).as_dvec3();
    let high = finite().fold(Vec3::NEG_INFINITY, |high, position| high.max(*position)).as_dvec3();
    let (center, extent) = if low.is_finite() { (0.5 * (low + high), high - low) } else { (DVec3::ZERO, DVec3::ONE) };
    let [width, height] = SIZE.map(f64::from);
    let wide = extent.x.max(extent.z);
    let distance = 4.0 * extent.max_element().max(1e-3);
    // The nearest parts are half an extent nearer than the centre.
    let focal_px = 0.95 * (distance - 0.5 * wide) * (width / wide.max(1e-3)).min(height / extent.y.max(1e-3));
    SIDES.map(|(side, from)| {
        let camera_from_world = Isometry::look_at(center + from * distance, center, DVec3::Y);
        Camera::new(side, Intrinsics::pinhole(SIZE[0], SIZE[1], focal_px), camera_from_world)
    })
}

#[cfg(test)]
mod tests {
    use flyrig_body::{ShapeParams, default_template};
    use serde_json::json;

    use super::*;

    #[test]
    fn the_page_shows_the_whole_person_and_every_number() {
        let body = default_template(&ShapeParams::default()).unwrap();
        let mesh = ShownMesh {
            positions: &body.positions,
            normals: &body.normals,
            uvs: &vec![Vec2::ZERO; body.positions.len()],
            triangles: &body.triangles,
            texture: (&[200, 40, 40], 1),
        };
        for camera in cameras(mesh.positions) {
            let [width, height] = camera.size().map(f64::from);
            for position in &body.positions {
                let pixel = camera.project(position.as_dvec3()).unwrap();
                assert!((0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y), "{} {pixel}", camera.id);
            }
        }
        let rows = four_sides(&mesh).unwrap();
        assert_eq!(rows.iter().map(|row| row.pictures.len()).collect::<Vec<_>>(), [4, 4]);
        let colors = |row: usize| {
            let image = image::load_from_memory(&rows[row].pictures[0].1).unwrap().into_rgba8();
            let shown: Vec<_> = image.pixels().filter(|pixel| pixel.0[3] == 255).map(|pixel| pixel.0).collect();
            assert!(shown.len() > 10_000, "{} pixels", shown.len());
            shown
        };
        assert!(colors(0).iter().all(|pixel| pixel[..3] == [200, 40, 40]));
        let grey = colors(1);
        assert!(grey.iter().all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]));
        let [least, most] = [grey.iter().min(), grey.iter().max()].map(|pixel| pixel.unwrap()[0]);
        assert!(most > least + 60, "shaded from {least} to {most}");

        let folder = tempfile::tempdir().unwrap();
        let metrics = json!({ "triangles": 12, "area_m2": 1.5, "closed": true, "seconds": { "fusion": 0.25 }, "held_out": { "mesh": { "psnr_db": 30.5 } }, "none": null });
        write_page(folder.path(), "Mesh".to_owned(), vec!["a sentence".to_owned()], &metrics, &mesh).unwrap();
        let html = std::fs::read_to_string(folder.path().join("index.html")).unwrap();
        for expected in [
            "a sentence",
            "<td>area m2<td",
            "1.500",
            "yes",
            "<h2>seconds</h2>",
            "<td>fusion<td>0.250",
            "<td>mesh, psnr db<td>30.500",
            "mesh.glb",
            "back",
        ] {
            assert!(html.contains(expected), "{expected}");
        }
    }

    #[test]
    fn a_poisoned_mesh_gives_a_page() {
        let nan = [Vec3::splat(f32::NAN); 3];
        for positions in [&nan[..], &[]] {
            let uvs = vec![Vec2::ZERO; positions.len()];
            let mesh =
                ShownMesh { positions, normals: positions, uvs: &uvs, triangles: &[[0, 1, 2]], texture: (&[], 0) };
            assert_eq!(four_sides(&mesh).unwrap().len(), 2);
        }
    }
}
