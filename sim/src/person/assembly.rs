//! Assembly of a dressed person: all surfaces in one mesh with its textures.

use flyrig_body::{ShapeParams, Template, default_template};
use glam::{Vec2, Vec3};

use crate::clothes::cuts::{COAT_SEAM_M, inside_bottom, inside_outer, inside_top, waist_m};
use crate::clothes::fabric::gloss;
use crate::clothes::garments::{Tailor, visible_skin};
use crate::clothes::hanging::ClothTube;
use crate::clothes::loose::stiffness;
use crate::clothes::prints::{
    bottom_colour, hair_colour, hanging_colour, hat_colour, outer_colour, sole_colour, top_colour, upper_colour,
};
use crate::clothes::sheet::{Node, Sheet};
use crate::clothes::wardrobe::{Bottom, Fabric, ShoeKind};
use crate::error::SimError;
use crate::noise::{Noise, smoothstep};
use crate::person::face::{eye_colour, skin_colour};
use crate::person::hats::{hat, hat_cloth};
use crate::person::look::PersonLook;
use crate::person::shoes::{eyes, shoes};
use crate::texture::{TextureImage, UvMap};

/// Clothed body at rest.
pub(crate) struct Person {
    /// Body under the clothes.
    pub body: Template,
    /// Surface seen by the cameras, skinned by the body's joints.
    pub clothed: Template,
    /// Per vertex of the clothed surface: the body point that carries it, canonical metres.
    pub carriers: Vec<Vec3>,
    /// Per vertex: texture, and openness of the surface to the sky (0..=1).
    pub layer_and_openness: Vec<(u32, f32)>,
    /// sRGB, all of one size.
    pub textures: Vec<TextureImage>,
    /// Per vertex: free length, metres (see [`crate::clothes::loose`]).
    pub free_m: Vec<f32>,
    /// Sheets that the surface is made of.
    pub sheets: Vec<SheetRange>,
    /// Vertices of the shoes.
    #[cfg_attr(not(test), expect(dead_code, reason = "tests of motions ask where the feet stand"))]
    pub shoe_vertices: std::ops::Range<usize>,
}

/// Connected garment among a person's surfaces.
pub(crate) struct SheetRange {
    pub vertices: std::ops::Range<usize>,
    pub triangles: std::ops::Range<usize>,
    /// See [`stiffness`].
    pub stiff: f32,
    /// Whether it hangs around the body instead of lying on it.
    pub hangs: bool,
}

/// Surfaces that share a texture.
struct Layer {
    sheets: Vec<Sheet>,
    texture: TextureImage,
    stiff: f32,
    hangs: bool,
}

impl Layer {
    /// Creates a layer that lies on the body without motion of its own.
    fn held(sheets: Vec<Sheet>, texture: TextureImage) -> Self {
        Self { sheets, texture, stiff: 1.0, hangs: false }
    }

    fn worn(sheets: Vec<Sheet>, texture: TextureImage, fabric: Fabric) -> Self {
        Self { sheets, texture: texture.glossy(gloss(fabric)), stiff: stiffness(fabric), hangs: false }
    }

    fn hanging(sheets: Vec<Sheet>, texture: TextureImage, stiff: f32) -> Self {
        Self { sheets, texture, stiff, hangs: true }
    }
}

impl Person {
    pub(crate) fn new(look: &PersonLook, seed: u64, texture_px: usize, fingers: bool) -> Result<Self, SimError> {
        let mut body = default_template(&look.shape)?;
        let average = default_template(&ShapeParams::default())?;
        for (position, average) in body.positions.iter_mut().zip(&average.positions) {
            *position += look.features.moved(*average);
        }
        if fingers {
            body = body.with_fingers()?;
        }
        body.normals = Sheet::of_body(&body, &average.positions).normals(&body.positions);
        let naked = Sheet::of_body(&body, &average.positions);
        let layers = dress(look, seed, &naked, texture_px);
        Ok(assemble(body, layers))
    }
}

/// Returns all visible layers of a person; the last sheet of the last layer are the shoes.
fn dress(look: &PersonLook, seed: u64, naked: &Sheet, side: usize) -> Vec<Layer> {
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
    let mut layers = vec![Layer::held(vec![visible_skin(naked, look)], skin.glossy(0.10))];
    let top = map.paint(naked, |v, w| {
        top_colour(&look.top, noise(21), point(v, w), depth(v, w, &|node| inside_top(&look.top, node)))
    });
    layers.push(Layer::worn(vec![tailor.top(look)], top, look.top.cloth.fabric));
    match look.bottom {
        Bottom::Trousers { cloth, .. } | Bottom::Overalls { cloth, .. } => {
            let texture = map.paint(naked, |v, w| {
                let inside = depth(v, w, &|node| inside_bottom(look, node));
                let dark = 1.0 - 0.3 * smoothstep(0.004, 0.0, inside);
                bottom_colour(look, noise(22), point(v, w), inside).map(|c| c * dark)
            });
            layers.push(Layer::worn(tailor.bottom(look).into_iter().collect(), texture, cloth.fabric));
        }
        Bottom::Skirt { cloth, hem_m, flare, pleats } => {
            let top_m = waist_m(look);
            let fold_m = 0.010 + 0.055 * flare;
            let hanging = ClothTube {
                top_m,
                hem_m,
                offset_m: [0.012, 0.016],
                flare,
                pleats: f32::from(pleats),
                fold_m,
                open_rad: 0.0,
            };
            let texture = TextureImage::from_fn(side, |uv| hanging_colour(&cloth, noise(22), uv, top_m - hem_m, true));
            let (texture, stiff) = (texture.glossy(gloss(cloth.fabric)), stiffness(cloth.fabric));
            layers.push(Layer::hanging(vec![tailor.hang(&hanging)], texture, stiff));
        }
    }
    if let Some(outer) = &look.outer {
        let shine = gloss(outer.cloth.fabric);
        let texture = map.paint(naked, |v, w| {
            outer_colour(outer, noise(26), point(v, w), depth(v, w, &|node| inside_outer(outer, node)))
        });
        layers.push(Layer::worn(vec![tailor.outer(look, outer)], texture, outer.cloth.fabric));
        if outer.hem_m < 0.7 {
            let wide_m = if let Bottom::Trousers { wide_m, .. } = look.bottom { wide_m } else { 0.0 };
            let tails = ClothTube {
                top_m: COAT_SEAM_M,
                hem_m: outer.hem_m,
                // Over wide trousers.
                offset_m: [0.026, 0.030 + 0.8 * wide_m],
                flare: 0.13,
                pleats: 6.0,
                fold_m: 0.014,
                open_rad: if outer.open_m > 0.0 { outer.open_m / 0.17 } else { 0.0 },
            };
            let texture = TextureImage::from_fn(side, |uv| {
                hanging_colour(&outer.cloth, noise(26), uv, tails.top_m - tails.hem_m, false)
            });
            let stiff = stiffness(outer.cloth.fabric);
            layers.push(Layer::hanging(vec![tailor.hang(&tails)], texture.glossy(shine), stiff));
        }
    }
    let hairs: Vec<Sheet> = [tailor.hair(look, naked), tailor.beard(look)].into_iter().flatten().collect();
    if !hairs.is_empty() {
        let texture = map.paint(naked, |v, w| hair_colour(look, noise(23), point(v, w)));
        layers.push(Layer::hanging(hairs, texture.glossy(0.12), 1.6));
    }
    if let Some(cloth) = hat_cloth(&look.hat) {
        let texture = TextureImage::from_fn(side, |uv| hat_colour(cloth, noise(27), uv));
        layers.push(Layer::worn(vec![hat(&look.hat, naked, noise(28))], texture, cloth.fabric));
    }
    let leather = if look.shoes.kind == ShoeKind::Trainers { 0.08 } else { gloss(Fabric::Leather) };
    let extras = TextureImage::from_fn(side, |uv: Vec2| match (uv.x < 0.5, uv.y < 0.5) {
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
    layers.push(Layer::held(shafts, extras.glossy(leather)));
    layers
}

fn assemble(body: Template, layers: Vec<Layer>) -> Person {
    let mut clothed = Template::empty("clothed body", body.skeleton.clone());
    let (mut carriers, mut layer_and_openness, mut textures) = (Vec::new(), Vec::new(), Vec::new());
    let (mut free_m, mut ranges) = (Vec::new(), Vec::new());
    let mut shoe_vertices = 0..0;
    for (index, Layer { sheets, texture, stiff, hangs }) in (0u32..).zip(layers) {
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
                free_m.push(node.free_m);
            }
            clothed.positions.extend(positions);
            clothed.normals.extend(normals);
            let first_triangle = clothed.triangles.len();
            clothed.triangles.extend(sheet.triangles.iter().map(|t| t.map(|v| v + first as u32)));
            let (vertices, triangles) = (first..clothed.positions.len(), first_triangle..clothed.triangles.len());
            ranges.push(SheetRange { vertices, triangles, stiff, hangs });
            shoe_vertices = first..clothed.positions.len();
        }
    }
    Person { body, clothed, carriers, layer_and_openness, textures, free_m, sheets: ranges, shoe_vertices }
}
