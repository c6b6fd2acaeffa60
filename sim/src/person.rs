//! A dressed person: all surfaces in one mesh with its textures.

use flyrig_body::{ShapeParams, Template, default_template};
use glam::{Vec2, Vec3};

use crate::SimError;
use crate::face::{eye_colour, skin_colour};
use crate::garments::{Tailor, inside_bottom, inside_top, visible_skin};
use crate::look::Look;
use crate::noise::{Noise, smoothstep};
use crate::prints::{bottom_colour, hair_colour, sole_colour, top_colour, upper_colour};
use crate::sheet::{Node, Sheet};
use crate::shoes::{eyes, shoes};
use crate::texture::{Texture, UvMap};

/// Textures of [`Person::textures`], in order.
pub(crate) const SKIN: u32 = 0;
const TOP: u32 = 1;
const BOTTOM: u32 = 2;
const HAIR: u32 = 3;
const EXTRAS: u32 = 4;

/// The clothed body at rest.
pub(crate) struct Person {
    /// The body under the clothes.
    pub body: Template,
    /// The surface seen by the cameras, skinned by the body's joints.
    pub clothed: Template,
    /// Per vertex of the clothed surface: the body point that carries it, canonical metres.
    pub carriers: Vec<Vec3>,
    /// Per vertex: texture, and how open the surface is to the sky (0..=1).
    pub layer_and_openness: Vec<(u32, f32)>,
    /// sRGB, all of one size.
    pub textures: Vec<Texture>,
    /// Vertices of the shoes.
    pub shoe_vertices: std::ops::Range<usize>,
}

impl Person {
    pub(crate) fn new(look: &Look, seed: u64, texture_px: usize) -> Result<Self, SimError> {
        let body = default_template(&look.shape)?;
        let average = default_template(&ShapeParams::default())?;
        let naked = Sheet::of_body(&body, &average.positions);
        let tailor = Tailor::new(&naked, seed);
        let textures = paint(look, seed, &naked, texture_px);
        let pieces = [
            (SKIN, visible_skin(&naked, look)),
            (TOP, tailor.top(look)),
            (BOTTOM, tailor.bottom(look)),
            (HAIR, tailor.hair(look)),
            (EXTRAS, eyes(&naked)),
            (EXTRAS, shoes(&naked)),
        ];
        Ok(assemble(body, &pieces, textures))
    }
}

fn assemble(body: Template, pieces: &[(u32, Sheet)], textures: Vec<Texture>) -> Person {
    let mut clothed = Template {
        name: "clothed body".to_owned(),
        positions: Vec::new(),
        normals: Vec::new(),
        uvs: Vec::new(),
        triangles: Vec::new(),
        skin: Vec::new(),
        parts: Vec::new(),
        skeleton: body.skeleton.clone(),
    };
    let (mut carriers, mut layer_and_openness) = (Vec::new(), Vec::new());
    let mut shoe_vertices = 0..0;
    for (layer, sheet) in pieces {
        let first = clothed.positions.len();
        let positions: Vec<Vec3> = sheet.nodes.iter().map(|node| node.position).collect();
        let normals = sheet.normals(&positions);
        // A point below its smoothed surroundings lies in a crease and sees less sky.
        let around = sheet.smoothed(6);
        for (i, node) in sheet.nodes.iter().enumerate() {
            let depth = (around[i] - node.position).dot(normals[i]);
            layer_and_openness.push((*layer, 1.0 - 0.55 * smoothstep(0.0, 0.006, depth)));
            clothed.uvs.push(node.uv);
            clothed.skin.push(node.skin);
            clothed.parts.push(node.part);
            carriers.push(node.body);
        }
        clothed.positions.extend(positions);
        clothed.normals.extend(normals);
        clothed.triangles.extend(sheet.triangles.iter().map(|t| t.map(|v| v + first as u32)));
        shoe_vertices = first..clothed.positions.len();
    }
    Person { body, clothed, carriers, layer_and_openness, textures, shoe_vertices }
}

fn paint(look: &Look, seed: u64, naked: &Sheet, side: usize) -> Vec<Texture> {
    let map = UvMap::new(naked, side);
    let noise = |stream| Noise::new(seed, stream);
    let corners = |v: [u32; 3]| v.map(|v| &naked.nodes[v as usize]);
    let point = |v: [u32; 3], w: Vec3| {
        let [a, b, c] = corners(v).map(|node| node.average);
        a * w.x + b * w.y + c * w.z
    };
    let top = map.paint(naked, |v, w| {
        let inside = corners(v).map(|node: &Node| inside_top(look, node));
        top_colour(look, noise(21), point(v, w), Vec3::from(inside).dot(w))
    });
    let bottom = map.paint(naked, |v, w| {
        let inside = corners(v).map(inside_bottom);
        let dark = 1.0 - 0.3 * smoothstep(0.004, 0.0, Vec3::from(inside).dot(w));
        bottom_colour(look, noise(22), point(v, w)).map(|c| c * dark)
    });
    let extras = Texture::from_fn(side, |uv: Vec2| match (uv.x < 0.5, uv.y < 0.5) {
        (true, _) => upper_colour(look, noise(24), Vec2::new((uv.x - 0.01) / 0.48, (uv.y - 0.02) / 0.96)),
        (false, true) => sole_colour(look, noise(25), uv),
        (false, false) => eye_colour(look, (uv - 0.75) / 0.12),
    });
    vec![
        map.paint(naked, |v, w| skin_colour(look, noise(20), point(v, w))),
        top,
        bottom,
        map.paint(naked, |v, w| hair_colour(look, noise(23), point(v, w))),
        extras,
    ]
}
