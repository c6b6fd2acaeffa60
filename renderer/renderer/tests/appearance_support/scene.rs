//! A person of two parts that no edge connects: an egg-shaped body and a ball in front of its belly. Surfaces have
//! formulas, so images and canonical maps are made without any rasteriser of ours.

use flyrig_body::{DeformationGraph, Part, SkinWeights, SurfaceGaussians};
use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use flyrig_renderer::ViewInput;
use flyrig_types::{Camera, Intrinsics, Isometry, Lens};
use glam::{DQuat, DVec2, DVec3, Vec2, Vec3};

/// Canonical centre and radii of the parts, metres.
const PARTS: [(DVec3, DVec3); 2] =
    [(DVec3::new(0.0, 1.0, 0.0), DVec3::new(0.25, 0.6, 0.2)), (DVec3::new(0.0, 1.1, 0.45), DVec3::new(0.1, 0.1, 0.1))];

/// Constant part of the scene.
pub struct Person {
    pub surface: SurfaceGaussians,
    pub graph: DeformationGraph,
    pub canonical: Vec<[f32; 4]>,
    /// Gaussians of the body; those of the ball follow.
    pub body_count: usize,
}

/// Depth of the Gaussians below the surface that the cameras see, metres.
pub const DEPTH_M: f32 = 0.004;

/// The posed Gaussians of an instant.
#[derive(Clone)]
pub struct Frame {
    pub world_from_canonical: Isometry,
    pub center_scale: Vec<[f32; 4]>,
    pub normal: Vec<[f32; 4]>,
}

/// Images of one camera.
#[derive(Clone)]
pub struct View {
    pub camera: Camera,
    pub rgba: Vec<u8>,
    pub canonical: Vec<[f32; 4]>,
    /// Colours of the last frame's Gaussians, paler than the image.
    pub rendered: Vec<[f32; 4]>,
}

/// Evenly spread Gaussians and nodes, a ninth of them on the ball.
pub fn person(gaussians: usize, nodes: usize) -> Person {
    let split = |count: usize| [count - count / 9, count / 9];
    let [body_count, ball_count] = split(gaussians);
    let spread = |counts: [usize; 2]| -> Vec<(usize, DVec3, DVec3)> {
        let part = |part: usize| {
            let (center, radii) = PARTS[part];
            (0..counts[part]).map(move |i| {
                let z = 1.0 - (2.0 * i as f64 + 1.0) / counts[part] as f64;
                let angle = i as f64 * 2.399_963_229_728_653;
                let r = (1.0 - z * z).sqrt();
                let unit = DVec3::new(r * angle.cos(), z, r * angle.sin());
                (part, center + unit * radii, (unit / radii).normalize())
            })
        };
        part(0).chain(part(1)).collect()
    };
    let points = spread([body_count, ball_count]);
    let nodes = spread(split(nodes));
    let nearest = |part: usize, point: DVec3, skip: usize| -> [(u32, f64); 4] {
        let mut best = [(0, f64::INFINITY); 4];
        for (i, node) in nodes.iter().enumerate().filter(|(i, node)| node.0 == part && *i != skip) {
            let d2 = node.1.distance_squared(point);
            if d2 < best[3].1 {
                best[3] = (i as u32, d2);
                best.sort_by(|a, b| a.1.total_cmp(&b.1));
            }
        }
        best
    };
    let hang = |&(part, point, _): &(usize, DVec3, DVec3)| {
        let found = nearest(part, point, usize::MAX);
        let weights = found.map(|(_, d2)| (-(d2 - found[0].1) / 0.001).exp());
        let sum: f64 = weights.iter().sum();
        (found.map(|(node, _)| node), weights.map(|w| (w / sum) as f32))
    };
    let (gaussian_nodes, gaussian_weights) = points.iter().map(hang).unzip();
    let neighbors =
        nodes.iter().enumerate().map(|(i, node)| nearest(node.0, node.1, i).map(|(other, _)| other)).collect();
    let count = points.len();
    let positions: Vec<Vec3> = points.iter().map(|p| p.1.as_vec3()).collect();
    Person {
        canonical: positions.iter().map(|p| p.extend(0.0).to_array()).collect(),
        surface: SurfaceGaussians {
            positions,
            normals: points.iter().map(|p| p.2.as_vec3()).collect(),
            uvs: vec![Vec2::ZERO; count],
            parts: vec![Part::Torso; count],
            skin: vec![SkinWeights::default(); count],
            scale_m: vec![0.003; count],
            depth_m: vec![0.0; count],
            triangle: vec![0; count],
            barycentric: vec![[1.0, 0.0, 0.0]; count],
        },
        graph: DeformationGraph {
            nodes: nodes.iter().map(|node| node.1.as_vec3()).collect(),
            node_gaussian: vec![0; nodes.len()],
            neighbors,
            gaussian_nodes,
            gaussian_weights,
        },
        body_count,
    }
}

/// The person turned about the vertical, and shifted.
pub fn frame(person: &Person, turn: f64) -> Frame {
    let world_from_canonical = Isometry::new(DQuat::from_rotation_y(turn), DVec3::new(0.1 * turn, -1.0, 0.05));
    let place = |(p, n): (&Vec3, &Vec3)| {
        let center = *p - *n * DEPTH_M;
        world_from_canonical.transform_point(center.as_dvec3()).as_vec3().extend(0.003).to_array()
    };
    let rotate = |n: &Vec3| (world_from_canonical.rotation * n.as_dvec3()).as_vec3().extend(DEPTH_M).to_array();
    Frame {
        center_scale: person.surface.positions.iter().zip(&person.surface.normals).map(place).collect(),
        normal: person.surface.normals.iter().map(rotate).collect(),
        world_from_canonical,
    }
}

/// A camera on a ring around the y axis, 2.5 m out, with the given lens.
pub fn camera(name: &str, azimuth: f64, size: u32, lens: Lens) -> Camera {
    let eye = DVec3::new(2.5 * azimuth.sin(), 0.3, 2.5 * azimuth.cos());
    let side = f64::from(size);
    Camera {
        time_offset_nanos: 0,
        color: Default::default(),
        id: name.into(),
        intrinsics: Intrinsics {
            width: size,
            height: size,
            focal_px: DVec2::new(1.7 * side, 1.65 * side),
            center_px: DVec2::new(0.49 * side, 0.51 * side),
            lens,
        },
        camera_from_world: Isometry::look_at(eye, DVec3::ZERO, DVec3::Y),
    }
}

/// Three cameras of three lenses, 120 degrees apart.
pub fn ring(size: u32) -> [Camera; 3] {
    let radial = Lens::RadialTangential { radial: [-0.1, 0.03, 0.0], tangential: [0.001, -0.002] };
    let fisheye = Lens::Fisheye { coefficients: [0.02, -0.01, 0.0, 0.0] };
    let third = std::f64::consts::TAU / 3.0;
    [
        camera("pinhole", 0.2, size, Lens::PINHOLE),
        camera("radial", 0.2 + third, size, radial),
        camera("fisheye", 0.2 + 2.0 * third, size, fisheye),
    ]
}

/// sRGB colour of a canonical point: waves a few centimetres long.
pub fn pattern(p: DVec3) -> [u8; 3] {
    let wave = |x: f64, phase: f64| (127.5 + 100.0 * (x + phase).sin()) as u8;
    [wave(20.0 * p.x, 0.0), wave(25.0 * p.y, 1.0), wave(15.0 * (p.z + p.x), 2.0)]
}

/// Draws the person by intersecting each pixel's ray with the parts; `background` where it hits nothing. Pixels whose
/// neighbour is background have half mask coverage and a colour between the two.
pub fn view(frame: &Frame, camera: &Camera, background: [u8; 3], paint: impl Fn(DVec3) -> [u8; 3]) -> View {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let canonical_from_world = frame.world_from_canonical.inverse();
    let eye = canonical_from_world.transform_point(camera.position());
    let hit = |x: i64, y: i64| {
        let ray = camera.ray(DVec2::new(x as f64, y as f64))?;
        let direction = canonical_from_world.rotation * ray;
        let along = |(center, radii): (DVec3, DVec3)| {
            let (o, d) = ((eye - center) / radii, direction / radii);
            let (a, b, c) = (d.dot(d), o.dot(d), o.dot(o) - 1.0);
            let root = b * b - a * c;
            (root >= 0.0).then(|| (-b - root.sqrt()) / a)
        };
        PARTS.into_iter().filter_map(along).min_by(f64::total_cmp).map(|t| eye + direction * t)
    };
    let (mut rgba, mut canonical, mut rendered) = (Vec::new(), Vec::new(), Vec::new());
    for y in 0..height as i64 {
        for x in 0..width as i64 {
            let Some(point) = hit(x, y) else {
                rgba.extend([background[0], background[1], background[2], 0]);
                canonical.push([0.0; 4]);
                rendered.push([0.0; 4]);
                continue;
            };
            let inner = [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(dx, dy)| hit(x + dx, y + dy).is_some());
            let color = paint(point);
            for c in 0..3 {
                rgba.push(if inner { color[c] } else { color[c] / 2 + background[c] / 2 });
            }
            rgba.push(if inner { 255 } else { 128 });
            let alpha = if inner { 1.0 } else { 0.75 };
            rendered.push(
                [color[0], color[1], color[2], 255].map(|c| (alpha * (0.5 * f64::from(c) / 255.0 + 0.5 * 0.3)) as f32),
            );
            rendered[canonical.len()][3] = alpha as f32;
            canonical.push((point * alpha).as_vec3().extend(alpha as f32).to_array());
        }
    }
    View { camera: camera.clone(), rgba, canonical, rendered }
}

/// Images of one camera on the device: bytes, canonical positions, last colours.
pub type ViewBuffers = (StorageBuffer<u32>, StorageBuffer<[f32; 4]>, StorageBuffer<[f32; 4]>);

/// Uploads the images of all cameras.
pub fn upload(gpu: &GpuContext, views: &[View]) -> Result<Vec<ViewBuffers>, GpuError> {
    let one = |view: &View| {
        let map = |map: &[[f32; 4]]| StorageBuffer::from_slice(gpu, "map", map);
        Ok((StorageBuffer::from_bytes(gpu, "image", &view.rgba)?, map(&view.canonical)?, map(&view.rendered)?))
    };
    views.iter().map(one).collect()
}

/// Joins cameras and uploaded images.
pub fn inputs<'a>(views: &'a [View], buffers: &'a [ViewBuffers]) -> Vec<ViewInput<'a>> {
    let input = |(view, (picture, canonical, rendered)): (&'a View, &'a ViewBuffers)| ViewInput {
        camera: &view.camera,
        picture,
        canonical,
        rendered,
        gaussians: None,
    };
    views.iter().zip(buffers).map(input).collect()
}
