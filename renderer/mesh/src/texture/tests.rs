use flyrig_avatar::{Atlas, Light};
use flyrig_model::srgb;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DVec2, DVec3, Vec2, Vec3};

use super::texels::{Texel, texels};
use super::view::{PhotoView, PosedMesh};
use super::*;
use crate::{AtlasSettings, MeshAtlas, TriMesh, mesh_atlas, shapes};
use flyrig_avatar::srgb_bytes as encode;

const SIDE: u32 = 128;
const GREY: [u8; 3] = [120, 120, 120];
const RED: [u8; 3] = [255, 0, 0];

/// Camera with a lens at `eye`, looking at the shape.
fn camera(eye: DVec3) -> Camera {
    let mut intrinsics = Intrinsics::pinhole(120, 120, 160.0);
    intrinsics.lens = Lens::RadialTangential { radial: [-0.1, 0.02, 0.0], tangential: [0.001, -0.002] };
    Camera::new("a", intrinsics, Isometry::look_at(eye, DVec3::new(0.0, 0.9, 0.0), DVec3::Y))
}

fn cameras() -> Vec<Camera> {
    [DVec3::new(0.3, 1.0, 2.5), DVec3::new(2.0, 1.4, 1.4), DVec3::new(-1.6, 0.4, 1.8)].map(camera).to_vec()
}

/// Mesh with texture coordinates.
struct Shape {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    atlas: MeshAtlas,
}

impl Shape {
    fn new(mesh: &TriMesh) -> Self {
        let atlas = mesh_atlas(mesh, AtlasSettings { side: SIDE, gutter: 2 }).unwrap();
        Self { positions: atlas.split(&mesh.positions), normals: atlas.split(&shapes::normals(mesh)), atlas }
    }

    fn bumpy() -> Self {
        Self::new(&shapes::bumpy_sphere(16))
    }

    /// A ball of 0.4 m at the origin of the view, and one of 0.1 m in front of it.
    fn two_balls() -> Self {
        let ball = |mesh: &TriMesh, radius: f32, center: Vec3| -> Vec<Vec3> {
            let unit = |p: &Vec3| (*p - Vec3::new(0.0, 0.9, 0.0)).normalize();
            mesh.positions.iter().map(|p| center + radius * unit(p)).collect()
        };
        let (large, small) = (shapes::bumpy_sphere(16), shapes::bumpy_sphere(8));
        let mut mesh = TriMesh { positions: ball(&large, 0.4, Vec3::new(0.0, 0.9, 0.0)), ..large };
        let base = mesh.positions.len() as u32;
        mesh.positions.extend(ball(&small, 0.1, Vec3::new(0.05, 0.9, 0.7)));
        mesh.triangles.extend(small.triangles.iter().map(|t| t.map(|i| i + base)));
        Self::new(&mesh)
    }

    fn textured(&self) -> TexturedMesh<'_> {
        TexturedMesh { positions: &self.positions, uvs: &self.atlas.uvs, triangles: &self.atlas.triangles }
    }

    /// Nearest hit of a ray, f64: distance, triangle and weights, by a search through all triangles.
    fn hit(&self, from: DVec3, ray: DVec3) -> Option<(f64, usize, [f64; 3])> {
        let mut best: Option<(f64, usize, [f64; 3])> = None;
        for (t, triangle) in self.atlas.triangles.iter().enumerate() {
            let [a, b, c] = triangle.map(|i| self.positions[i as usize].as_dvec3());
            let (ab, ac) = (b - a, c - a);
            let p = ray.cross(ac);
            let det = ab.dot(p);
            if det.abs() < 1e-15 {
                continue;
            }
            let s = from - a;
            let v = s.dot(p) / det;
            let q = s.cross(ab);
            let (w, far) = (ray.dot(q) / det, ac.dot(q) / det);
            if v >= -1e-9 && w >= -1e-9 && v + w <= 1.0 + 1e-9 && far > 1e-6 && best.is_none_or(|(d, ..)| far < d) {
                best = Some((far, t, [1.0 - v - w, v, w]));
            }
        }
        best
    }

    /// Photograph by one ray per pixel: `paint` gives the linear colour at a triangle, position and normal.
    fn photograph(&self, camera: &Camera, paint: impl Fn(usize, DVec3, Vec3) -> Vec3) -> Vec<u8> {
        let [width, height] = camera.size();
        let mut rgba = Vec::new();
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            let ray = camera.ray(DVec2::new(f64::from(x), f64::from(y))).unwrap();
            let Some((far, t, weights)) = self.hit(camera.position(), ray) else {
                rgba.extend([RED[0], RED[1], RED[2], 0]);
                continue;
            };
            let corners = self.atlas.triangles[t];
            let normal: Vec3 =
                corners.iter().zip(weights).map(|(i, w)| self.normals[*i as usize] * w as f32).sum::<Vec3>();
            rgba.extend(encode(paint(t, camera.position() + ray * far, normal.normalize())));
            rgba.push(255);
        }
        rgba
    }

    fn at_rest(&self) -> PosedMesh {
        PosedMesh { positions: self.positions.clone(), normals: self.normals.clone() }
    }

    fn grey() -> Atlas {
        Atlas { side: SIDE, rgb: GREY.repeat((SIDE * SIDE) as usize), covered: 0 }
    }

    fn bake(&self, images: &[(Camera, Vec<u8>)], light: &Light, settings: &PhotoSettings) -> PhotoTexture {
        let photos: Vec<Photo<'_>> =
            images.iter().enumerate().map(|(i, (camera, rgba))| Photo { frame: i / 2, camera, rgba }).collect();
        let unlit = Self::grey();
        let pose = |_: usize| (self.positions.clone(), self.normals.clone());
        let inputs =
            PhotoInputs { mesh: self.textured(), unlit: &unlit, photos: &photos, pose: &pose, light, baked: None };
        photograph_texture(&inputs, settings).unwrap()
    }
}

fn linear(bytes: [u8; 3]) -> Vec3 {
    Vec3::from_array(bytes.map(|byte| srgb::decode(f32::from(byte) / 255.0, f32::powf)))
}

/// Colour that varies slowly along the surface.
fn tint(at: DVec3) -> Vec3 {
    let at = at.as_vec3();
    Vec3::new(0.2 + 0.1 * (4.0 * at.x).sin(), 0.2 + 0.1 * (3.0 * at.y).cos(), 0.2 + 0.1 * (5.0 * at.z).sin())
}

fn texel_of(rgb: &[u8], texel: &Texel) -> [u8; 3] {
    let at = 3 * texel.index as usize;
    [rgb[at], rgb[at + 1], rgb[at + 2]]
}

/// Compares with one ray per pixel in f64.
#[test]
fn depths_are_those_of_rays() {
    let shape = Shape::bumpy();
    for camera in cameras() {
        let mut drawn = vec![None; 120 * 120];
        let projected = raster::project(&camera, &shape.positions);
        let depth =
            raster::draw(&projected, &shape.atlas.triangles, [120, 120], |i, t, weights| drawn[i] = Some((t, weights)));
        let mut compared = 0;
        for (i, found) in depth.iter().enumerate().filter(|(i, _)| i % 3 == 0) {
            let ray = camera.ray(DVec2::new((i % 120) as f64, (i / 120) as f64)).unwrap();
            let hit = shape.hit(camera.position(), ray);
            // The lens bends edges of triangles, which are drawn straight: outlines may differ by a pixel.
            let (Some((far, t, weights)), true) = (hit, found.is_finite()) else { continue };
            let z = camera.camera_from_world.transform_point(camera.position() + ray * far).z;
            assert!((z - f64::from(*found)).abs() < 4e-3, "{i}: {z} {found}");
            compared += 1;
            let Some((u, ours)) = drawn[i].filter(|(u, _)| *u == t) else { continue };
            assert_eq!(u, t);
            assert!(ours.iter().zip(weights).all(|(a, b)| (f64::from(*a) - b).abs() < 0.06), "{ours:?} {weights:?}");
        }
        let hits = (0..120 * 120).filter(|i| i % 3 == 0 && depth[*i].is_finite()).count();
        assert!(compared > 500 && compared + 40 > hits, "{compared} of {hits}");
    }
}

#[test]
fn poisoned_vertices_are_not_drawn() {
    let camera = camera(DVec3::new(0.0, 0.9, 2.5));
    let eye = camera.position().as_vec3();
    let poisoned = [Vec3::NAN, Vec3::INFINITY, Vec3::splat(f32::MAX), eye, eye + Vec3::Z, Vec3::splat(1e30)];
    let projected = raster::project(&camera, &poisoned);
    assert_eq!(projected[0], None);
    assert_eq!((projected[3], projected[4]), (None, None), "at the camera and behind it");
    let triangles: Vec<[u32; 3]> = (0..6).map(|i| [i, (i + 1) % 6, (i + 2) % 6]).chain([[0, 1, 99]]).collect();
    let depth = raster::draw(&projected, &triangles, [120, 120], |_, _, _| panic!("drawn"));
    assert!(depth.iter().all(|z| z.is_infinite()));
    assert!(raster::draw(&[], &[[0, 0, 0]], [0, 0], |_, _, _| ()).is_empty());
}

/// Compares each part with a plain f64 computation: rays for visibility, a search for outlines.
#[test]
fn a_view_shows_what_rays_see() {
    let shape = Shape::two_balls();
    let camera = camera(DVec3::new(0.1, 1.0, 2.5));
    let rgba = shape.photograph(&camera, |_, at, _| tint(at));
    let photo = Photo { frame: 0, camera: &camera, rgba: &rgba };
    let mesh = shape.at_rest();
    let view = PhotoView::new(&photo, &mesh, &shape.atlas.triangles);
    let table: [f32; 256] = srgb::byte_table(f32::powf);
    let (mut shown, mut hidden, mut full) = (0, 0, 0);
    for texel in texels(&shape.textured(), SIDE).iter().step_by(5) {
        let triangle = shape.atlas.triangles[texel.triangle as usize];
        let weights = texel.corners();
        let at: DVec3 =
            triangle.iter().zip(weights).map(|(i, w)| shape.positions[*i as usize].as_dvec3() * f64::from(w)).sum();
        let normal: DVec3 =
            triangle.iter().zip(weights).map(|(i, w)| shape.normals[*i as usize].as_dvec3() * f64::from(w)).sum();
        let (to_eye, normal) = (camera.position() - at, normal.normalize());
        let nearest = shape.hit(camera.position(), -to_eye.normalize()).map_or(f64::INFINITY, |hit| hit.0);
        let facing = (normal.dot(to_eye.normalize()) - 75f64.to_radians().cos()) / (1.0 - 75f64.to_radians().cos());
        let look = view.facet(&mesh, triangle).and_then(|facet| facet.look(weights, &table));
        if nearest < to_eye.length() - 0.05 || facing < -0.02 {
            assert!(look.is_none(), "{at} is hidden");
            hidden += 1;
            continue;
        }
        let Some(look) = look else { continue };
        shown += 1;
        assert!((f64::from(look.facing) - facing).abs() < 1e-4 && look.normal.as_dvec3().distance(normal) < 1e-5);
        let depth = camera.camera_from_world.transform_point(at).z;
        assert!((f64::from(look.density) - 160.0 / depth).abs() < 0.5);
        assert!(look.rgb.distance(tint(at)) < 0.03, "{} {}", look.rgb, tint(at));
        // Full weight only clear of outlines: all pixels around show the same ball.
        if look.shown > 0.999 {
            full += 1;
            let pixel = camera.project(at).unwrap().round();
            for (dx, dy) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)] {
                let ray = camera.ray(pixel + DVec2::new(dx, dy)).unwrap();
                let (far, ..) = shape.hit(camera.position(), ray).unwrap();
                assert!((far - to_eye.length()).abs() < 0.08, "{at}: an outline is beside it");
            }
        }
    }
    assert!(shown > 300 && hidden > 500 && full > 150, "{shown} {hidden} {full}");
}

/// Compares the means with a plain f64 sum over all views of a texel.
#[test]
fn texels_mix_their_views_by_the_formula() {
    let shape = Shape::bumpy();
    let mut light = Light::default();
    light.terms[2] = [0.3, 0.2, 0.1];
    let images: Vec<(Camera, Vec<u8>)> = cameras()
        .into_iter()
        .enumerate()
        .map(|(i, camera)| {
            let rgba = shape.photograph(&camera, |_, at, _| tint(at) * (1.0 + 0.2 * i as f32));
            (camera, rgba)
        })
        .collect();
    let settings = PhotoSettings { sharpness: 4.0, tolerance: 0.2, steps: 0 };
    let found = shape.bake(&images, &light, &settings);
    let table: [f32; 256] = srgb::byte_table(f32::powf);
    let mesh = shape.at_rest();
    let views: Vec<PhotoView<'_>> = images
        .iter()
        .map(|(camera, rgba)| PhotoView::new(&Photo { frame: 0, camera, rgba }, &mesh, &shape.atlas.triangles))
        .collect();
    let center = shape.positions.iter().map(|p| p.as_dvec3()).sum::<DVec3>() / shape.positions.len() as f64;
    let usual = 160.0 / images[..2].iter().map(|(c, _)| c.position().distance(center)).fold(f64::INFINITY, f64::min);
    let (all, mut mixed, mut total) = (texels(&shape.textured(), SIDE), 0, 0.0);
    for texel in &all {
        let triangle = shape.atlas.triangles[texel.triangle as usize];
        let (mut sum, mut weight, mut best, mut count) = ([0.0f64; 3], 0.0f64, 0.0f64, 0);
        for view in &views {
            let Some(look) = view.facet(&mesh, triangle).and_then(|facet| facet.look(texel.corners(), &table)) else {
                continue;
            };
            let shade = light.shade(look.normal);
            let unlit: [f64; 3] = std::array::from_fn(|k| f64::from(look.rgb[k]) / f64::from(shade[k]));
            let off = (0..3).map(|k| (unlit[k].sqrt() - f64::from(linear(GREY)[k]).sqrt()).abs()).fold(0.0, f64::max);
            let alike = (-0.5 * (off / 0.2).powi(2)).exp().max(0.01);
            let quality = f64::from(look.facing) * (f64::from(look.density) / usual).powi(2);
            let own = f64::from(look.shown) * alike * quality.powi(4);
            (0..3).for_each(|k| sum[k] += own * unlit[k]);
            weight += own;
            best = best.max(f64::from(look.shown) * f64::from(look.facing) * alike.sqrt());
            count += 1;
        }
        let t = (best / 0.25).min(1.0);
        let seen = t * t * (3.0 - 2.0 * t);
        total += seen;
        let base = linear(GREY).as_dvec3().to_array();
        let expected =
            std::array::from_fn(|k| if weight > 0.0 { base[k] + seen * (sum[k] / weight - base[k]) } else { base[k] });
        let expected = encode(DVec3::from_array(expected).as_vec3());
        let ours = texel_of(&found.atlas.rgb, texel);
        assert!(ours.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 1), "{ours:?} {expected:?}");
        mixed += usize::from(count > 1);
    }
    assert!(mixed > 500 && (f64::from(found.seen) - total / all.len() as f64).abs() < 1e-4, "{mixed} {}", found.seen);
    assert!(found.seen > 0.2 && found.seen < 0.95);
}

#[test]
fn neither_background_nor_what_stands_in_front_bleeds_in() {
    let shape = Shape::two_balls();
    // The mesh knows the small ball 8 mm beside where it was photographed.
    let mut moved = Shape::two_balls();
    let small = |p: &Vec3| p.distance(Vec3::new(0.05, 0.9, 0.7)) < 0.11;
    for position in moved.positions.iter_mut().filter(|p| small(p)) {
        position.x += 0.008;
    }
    let is_small = |t: usize| small(&shape.positions[shape.atlas.triangles[t][0] as usize]);
    let green = Vec3::new(0.0, 0.9, 0.0);
    let images: Vec<(Camera, Vec<u8>)> = [camera(DVec3::new(0.0, 0.9, 2.5)), camera(DVec3::new(0.5, 1.1, 2.4))]
        .into_iter()
        .map(|camera| {
            let paint = |t, at, _| if is_small(t) { green } else { tint(at) };
            let rgba = shape.photograph(&camera, paint);
            (camera, rgba)
        })
        .collect();
    // Without help of the Gaussians' colours.
    let found = moved.bake(&images, &Light::default(), &PhotoSettings { tolerance: 1e3, ..PhotoSettings::default() });
    let (mut large, mut ball) = (0, 0);
    for texel in texels(&moved.textured(), SIDE) {
        let [r, g, _] = texel_of(&found.atlas.rgb, &texel);
        if is_small(texel.triangle as usize) {
            ball += usize::from(g > 200);
            assert!(r < 130, "background or the large ball on the small one: {r}");
        } else {
            large += 1;
            assert!(r < 160 && g < 165, "{r} {g} on the large ball");
        }
    }
    assert!(large > 1000 && ball > 20, "{large} {ball}");
}

#[test]
fn light_is_divided_out() {
    let shape = Shape::bumpy();
    let mut light = Light::default();
    light.terms[1] = [0.5, 0.4, 0.3];
    let lit: Vec<(Camera, Vec<u8>)> = cameras()
        .into_iter()
        .map(|camera| {
            let rgba = shape.photograph(&camera, |_, at, normal| tint(at) * Vec3::from(light.shade(normal)));
            (camera, rgba)
        })
        .collect();
    let found = shape.bake(&lit, &light, &PhotoSettings { tolerance: 1.0, ..PhotoSettings::default() });
    let all = texels(&shape.textured(), SIDE);
    let place = |texel: &Texel| texel.blend(&shape.atlas.triangles, |i| shape.positions[i as usize]).as_dvec3();
    let off: Vec<f32> = all
        .iter()
        .map(|texel| (texel, linear(texel_of(&found.atlas.rgb, texel))))
        .filter(|(texel, color)| texel_of(&found.atlas.rgb, texel) != GREY && color.is_finite())
        .map(|(texel, color)| color.distance(tint(place(texel))))
        .collect();
    assert!(off.len() > all.len() / 3 && off.iter().sum::<f32>() / (off.len() as f32) < 0.02);
}

/// Cameras of different exposure: what varies slowly is that of the mean of all views.
#[test]
fn slow_variation_is_that_of_all_views() {
    let shape = Shape::bumpy();
    let all = texels(&shape.textured(), SIDE);
    let exposed: Vec<(Camera, Vec<u8>)> = cameras()
        .into_iter()
        .take(2)
        .zip([0.1, 0.5])
        .map(|(camera, value)| {
            let rgba = shape.photograph(&camera, |_, _, _| Vec3::splat(value));
            (camera, rgba)
        })
        .collect();
    let bake = |sharpness: f32, steps: usize| {
        shape.bake(&exposed, &Light::default(), &PhotoSettings { sharpness, steps, tolerance: 1e3 }).atlas.rgb
    };
    let plain = bake(1.0, 0);
    let off = |rgb: &[u8]| -> u64 {
        let texel_off = |texel: &Texel| u64::from(texel_of(rgb, texel)[0].abs_diff(texel_of(&plain, texel)[0]));
        all.iter().map(texel_off).sum()
    };
    let (with, without) = (off(&bake(30.0, 2)), off(&bake(30.0, 0)));
    assert!(without > 2 * all.len() as u64 && 5 * with < 4 * without, "{with} {without}");
}

#[test]
fn results_do_not_depend_on_threads() {
    let shape = Shape::bumpy();
    let images: Vec<(Camera, Vec<u8>)> = cameras()
        .into_iter()
        .map(|camera| {
            let rgba = shape.photograph(&camera, |_, at, _| tint(at));
            (camera, rgba)
        })
        .collect();
    let settings = PhotoSettings::default();
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| shape.bake(&images, &Light::default(), &settings))
    };
    assert!(on(1) == on(5));
}

#[test]
fn wrong_sizes_are_named_and_poison_leaves_the_texture() {
    let shape = Shape::bumpy();
    let (camera, unlit, light) = (camera(DVec3::new(0.0, 0.9, 2.5)), Shape::grey(), Light::default());
    let rgba = vec![255; 4 * 120 * 120];
    let photo = [Photo { frame: 7, camera: &camera, rgba: &rgba }];
    let good = |_: usize| (shape.positions.clone(), shape.normals.clone());
    let inputs =
        PhotoInputs { mesh: shape.textured(), unlit: &unlit, photos: &photo, pose: &good, light: &light, baked: None };
    let of = |inputs: &PhotoInputs<'_>| photograph_texture(inputs, &PhotoSettings::default());
    let message = |inputs: PhotoInputs<'_>| of(&inputs).unwrap_err().to_string();
    let cut = [Photo { rgba: &rgba[4..], ..photo[0] }];
    assert!(message(PhotoInputs { photos: &cut, ..inputs }).contains("camera a, frame 7: 57596 bytes, not the 57600"));
    let short = TexturedMesh { uvs: &[Vec2::ZERO; 3], ..inputs.mesh };
    assert!(message(PhotoInputs { mesh: short, ..inputs }).contains("texture coordinates: 3 vertices"));
    assert!(message(PhotoInputs { baked: Some(&[]), ..inputs }).contains("mean light: 0 vertices"));
    let empty = Atlas { side: SIDE, rgb: Vec::new(), covered: 0 };
    assert!(message(PhotoInputs { unlit: &empty, ..inputs }).contains("bake it from the Gaussians first"));

    // White photographs; the poses are of no use.
    let nan = |_: usize| (vec![Vec3::NAN; shape.positions.len()], shape.normals.clone());
    let other = |_: usize| (vec![Vec3::ZERO; 3], vec![Vec3::ZERO; 3]);
    let behind = |_: usize| (shape.positions.iter().map(|p| *p + Vec3::Z * 9.0).collect(), shape.normals.clone());
    for pose in [&nan as Poser<'_>, &other, &behind] {
        let made = of(&PhotoInputs { pose, ..inputs }).unwrap();
        assert!(made.seen <= 0.0 && made.atlas.rgb == unlit.rgb);
    }
    let none = of(&PhotoInputs { photos: &[], ..inputs }).unwrap();
    assert!(none.seen <= 0.0 && none.atlas.rgb == unlit.rgb && none.atlas.covered > 1000);
    let no_normals = |_: usize| (shape.positions.clone(), vec![Vec3::NAN; shape.normals.len()]);
    assert!(of(&PhotoInputs { pose: &no_normals, ..inputs }).unwrap().atlas.rgb == unlit.rgb);
    let missing = TexturedMesh { triangles: &[[0, 1, u32::MAX]], ..inputs.mesh };
    assert_eq!(of(&PhotoInputs { mesh: missing, ..inputs }).unwrap().atlas.covered, 0);
    // Baked light brightens what no photograph shows.
    let lit = vec![Vec3::splat(2.0); shape.positions.len()];
    let made = of(&PhotoInputs { photos: &[], baked: Some(&lit), ..inputs }).unwrap();
    let expected = encode(linear(GREY) * 2.0);
    let all = texels(&shape.textured(), SIDE);
    assert!(all.iter().all(|texel| texel_of(&made.atlas.rgb, texel) == expected));
    assert!(light_texture(&shape.textured(), &unlit, &lit).unwrap() == made.atlas);
}

/// Compares with nine rays per pixel in f64.
#[test]
fn drawn_pixels_are_the_mean_of_their_samples() {
    let shape = Shape::bumpy();
    let rgb: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| [i % SIDE, i / SIDE, 64].map(|value| (value * 2) as u8)).collect();
    let shades: Vec<Vec3> = shape.normals.iter().map(|normal| Vec3::splat(0.7) + 0.2 * *normal).collect();
    let mesh = DrawnMesh {
        positions: &shape.positions,
        shades: Some(&shades),
        uvs: &shape.atlas.uvs,
        triangles: &shape.atlas.triangles,
        rgb: &rgb,
        side: SIDE,
    };
    let camera = camera(DVec3::new(0.3, 1.0, 2.5));
    let found = draw_textured(&mesh, &camera);
    let texel = |x: f64, y: f64| {
        let clamp = |value: f64| (value.clamp(0.0, f64::from(SIDE - 1))) as usize;
        let at = 3 * (clamp(y) * SIDE as usize + clamp(x));
        linear([rgb[at], rgb[at + 1], rgb[at + 2]]).as_dvec3()
    };
    let (mut compared, mut covered) = (0, 0);
    for (i, pixel) in found.rgba.chunks_exact(4).enumerate().step_by(23) {
        let (mut sum, mut count) = (DVec3::ZERO, 0);
        for (u, v) in (0..3).flat_map(|v| (0..3).map(move |u| (f64::from(u) - 1.0, f64::from(v) - 1.0))) {
            let at = DVec2::new((i % 120) as f64 + u / 3.0, (i / 120) as f64 + v / 3.0);
            let Some((_, t, weights)) = shape.hit(camera.position(), camera.ray(at).unwrap()) else { continue };
            let corners = shape.atlas.triangles[t].iter().zip(weights);
            let (mut uv, mut shade) = (DVec2::ZERO, DVec3::ZERO);
            corners.for_each(|(i, w)| {
                uv += shape.atlas.uvs[*i as usize].as_dvec2() * w;
                shade += shades[*i as usize].as_dvec3() * w;
            });
            let place = uv * f64::from(SIDE) - 0.5;
            let (low, part) = (place.floor(), place - place.floor());
            let row = |y: f64| texel(low.x, y).lerp(texel(low.x + 1.0, y), part.x);
            sum += row(low.y).lerp(row(low.y + 1.0), part.y) * shade;
            count += 1;
        }
        covered += usize::from(count > 0);
        let alpha = (255 * count / 9) as u8;
        if count == 0 || pixel[3] != alpha {
            continue;
        }
        let expected = encode((sum / f64::from(count)).as_vec3());
        // Across seams of charts a ray may meet the neighbouring chart.
        compared += usize::from(pixel[..3].iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 3));
    }
    assert!(covered > 100 && compared * 100 > covered * 85, "{compared} of {covered}");
    let empty = draw_textured(&DrawnMesh { side: 3, ..mesh }, &camera);
    assert!(empty.rgba.iter().all(|byte| *byte == 0));
    let poisoned = DrawnMesh { positions: &[Vec3::NAN; 3], ..mesh };
    assert!(draw_textured(&poisoned, &camera).rgba.iter().all(|byte| *byte == 0));
    let no_coordinates = DrawnMesh { uvs: &[], ..mesh };
    assert!(draw_textured(&no_coordinates, &camera).rgba.iter().all(|byte| *byte == 0));
}
