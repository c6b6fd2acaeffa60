//! A dressed person: all surfaces in one mesh with its textures.

use flyrig_body::{ShapeParams, Template, default_template};
use glam::{Vec2, Vec3};

use crate::SimError;
use crate::cuts::{COAT_SEAM_M, inside_bottom, inside_outer, inside_top, waist_m};
use crate::fabric::gloss;
use crate::face::{eye_colour, skin_colour};
use crate::garments::{Tailor, visible_skin};
use crate::hanging::Hanging;
use crate::hats::{hat, hat_cloth};
use crate::look::Look;
use crate::noise::{Noise, smoothstep};
use crate::prints::{
    bottom_colour, hair_colour, hanging_colour, hat_colour, outer_colour, sole_colour, top_colour, upper_colour,
};
use crate::sheet::{Node, Sheet};
use crate::shoes::{eyes, shoes};
use crate::texture::{Texture, UvMap};
use crate::wardrobe::{Bottom, Fabric, ShoeKind};

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

/// Surfaces that share a texture.
struct Layer {
    sheets: Vec<Sheet>,
    texture: Texture,
}

impl Person {
    pub(crate) fn new(look: &Look, seed: u64, texture_px: usize) -> Result<Self, SimError> {
        let body = default_template(&look.shape)?;
        let average = default_template(&ShapeParams::default())?;
        let naked = Sheet::of_body(&body, &average.positions);
        let layers = dress(look, seed, &naked, texture_px);
        Ok(assemble(body, layers))
    }
}

/// Everything seen of a person; the last sheet of the last layer are the shoes.
fn dress(look: &Look, seed: u64, naked: &Sheet, side: usize) -> Vec<Layer> {
    let tailor = Tailor::new(naked, seed);
    let map = UvMap::new(naked, side);
    let noise = |stream| Noise::new(seed, stream);
    let corners = |v: [u32; 3]| v.map(|v| &naked.nodes[v as usize]);
    let point = |v: [u32; 3], w: Vec3| {
        let [a, b, c] = corners(v).map(|node| node.average);
        a * w.x + b * w.y + c * w.z
    };
    let depth = |v: [u32; 3], w: Vec3, inside: &dyn Fn(&Node) -> f32| Vec3::from(corners(v).map(inside)).dot(w);

    let skin = map.paint(naked, |v, w| skin_colour(look, noise(20), point(v, w)));
    let mut layers = vec![Layer { sheets: vec![visible_skin(naked, look)], texture: skin.glossy(0.10) }];
    let top = map.paint(naked, |v, w| {
        top_colour(&look.top, noise(21), point(v, w), depth(v, w, &|node| inside_top(&look.top, node)))
    });
    layers.push(Layer { sheets: vec![tailor.top(look)], texture: top.glossy(gloss(look.top.cloth.fabric)) });
    match look.bottom {
        Bottom::Trousers { cloth, .. } | Bottom::Overalls { cloth, .. } => {
            let texture = map.paint(naked, |v, w| {
                let inside = depth(v, w, &|node| inside_bottom(look, node));
                let dark = 1.0 - 0.3 * smoothstep(0.004, 0.0, inside);
                bottom_colour(look, noise(22), point(v, w), inside).map(|c| c * dark)
            });
            layers.push(Layer {
                sheets: tailor.bottom(look).into_iter().collect(),
                texture: texture.glossy(gloss(cloth.fabric)),
            });
        }
        Bottom::Skirt { cloth, hem_m, flare, pleats } => {
            let top_m = waist_m(look);
            let fold_m = 0.010 + 0.055 * flare;
            let hanging = Hanging {
                top_m,
                hem_m,
                offset_m: [0.012, 0.016],
                flare,
                pleats: f32::from(pleats),
                fold_m,
                open_rad: 0.0,
            };
            let texture = Texture::from_fn(side, |uv| hanging_colour(&cloth, noise(22), uv, top_m - hem_m, true));
            layers.push(Layer { sheets: vec![tailor.hang(&hanging)], texture: texture.glossy(gloss(cloth.fabric)) });
        }
    }
    if let Some(outer) = &look.outer {
        let shine = gloss(outer.cloth.fabric);
        let texture = map.paint(naked, |v, w| {
            outer_colour(outer, noise(26), point(v, w), depth(v, w, &|node| inside_outer(outer, node)))
        });
        layers.push(Layer { sheets: vec![tailor.outer(look, outer)], texture: texture.glossy(shine) });
        if outer.hem_m < 0.7 {
            let tails = Hanging {
                top_m: COAT_SEAM_M,
                hem_m: outer.hem_m,
                offset_m: [0.030, 0.042],
                flare: 0.16,
                pleats: 6.0,
                fold_m: 0.014,
                open_rad: if outer.open_m > 0.0 { outer.open_m / 0.17 } else { 0.0 },
            };
            let texture = Texture::from_fn(side, |uv| {
                hanging_colour(&outer.cloth, noise(26), uv, tails.top_m - tails.hem_m, false)
            });
            layers.push(Layer { sheets: vec![tailor.hang(&tails)], texture: texture.glossy(shine) });
        }
    }
    let hairs: Vec<Sheet> = [tailor.hair(look, naked), tailor.beard(look)].into_iter().flatten().collect();
    if !hairs.is_empty() {
        let texture = map.paint(naked, |v, w| hair_colour(look, noise(23), point(v, w)));
        layers.push(Layer { sheets: hairs, texture: texture.glossy(0.12) });
    }
    if let Some(cloth) = hat_cloth(&look.hat) {
        let texture = Texture::from_fn(side, |uv| hat_colour(cloth, noise(27), uv));
        layers.push(Layer {
            sheets: vec![hat(&look.hat, naked, noise(28))],
            texture: texture.glossy(gloss(cloth.fabric)),
        });
    }
    let leather = if look.shoes.kind == ShoeKind::Trainers { 0.08 } else { gloss(Fabric::Leather) };
    let extras = Texture::from_fn(side, |uv: Vec2| match (uv.x < 0.5, uv.y < 0.5) {
        (true, _) => upper_colour(look, noise(24), Vec2::new((uv.x - 0.01) / 0.48, (uv.y - 0.02) / 0.96)),
        (false, true) => sole_colour(look, noise(25), uv),
        (false, false) => eye_colour(look, (uv - 0.75) / 0.12),
    });
    let mut shafts: Vec<Sheet> = tailor.boot_shafts(look).into_iter().collect();
    // Plain leather of the upper's side.
    for node in shafts.iter_mut().flat_map(|sheet| &mut sheet.nodes) {
        node.uv = Vec2::new(0.30 + 0.02 * node.uv.x, 0.25 + 0.05 * node.uv.y);
    }
    shafts.extend([eyes(naked), shoes(naked)]);
    layers.push(Layer { sheets: shafts, texture: extras.glossy(leather) });
    layers
}

fn assemble(body: Template, layers: Vec<Layer>) -> Person {
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
    let (mut carriers, mut layer_and_openness, mut textures) = (Vec::new(), Vec::new(), Vec::new());
    let mut shoe_vertices = 0..0;
    for (index, Layer { sheets, texture }) in (0u32..).zip(layers) {
        textures.push(texture);
        for sheet in &sheets {
            let first = clothed.positions.len();
            let positions: Vec<Vec3> = sheet.nodes.iter().map(|node| node.position).collect();
            let normals = sheet.normals(&positions);
            // A point below its smoothed surroundings lies in a crease and sees less sky.
            let around = sheet.smoothed(6);
            for (i, node) in sheet.nodes.iter().enumerate() {
                let depth = (around[i] - node.position).dot(normals[i]);
                layer_and_openness.push((index, 1.0 - 0.55 * smoothstep(0.0, 0.006, depth)));
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
    }
    Person { body, clothed, carriers, layer_and_openness, textures, shoe_vertices }
}
