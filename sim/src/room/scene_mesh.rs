//! Mesh of flat and round objects, divided into cells small enough for bent lenses.

use bytemuck::{Pod, Zeroable};
use glam::{Affine3A, Vec2, Vec3};
use rayon::prelude::*;

use crate::room::surfaces::Surface;

/// Vertex in the memory layout of the room's shader.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct SceneVertex {
    pub position: [f32; 3],
    pub normal: [f32; 3],
    /// Texture coordinates, texture layer, openness.
    pub paint: [f32; 4],
    /// Linear factor on the texture, gloss.
    pub tint: [f32; 4],
    /// Emitted light, and the layer of the plate that it belongs to.
    pub glow: [f32; 2],
}

/// Material of an object.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Coat {
    pub surface: Surface,
    /// Linear factor on the texture.
    pub tint: Vec3,
    pub gloss: f32,
    /// Emitted light, times the texture.
    pub glow: f32,
    /// Layer of the plate that the emitted light belongs to.
    pub glow_layer: usize,
}

impl Coat {
    pub(crate) fn new(surface: Surface, tint: Vec3) -> Self {
        Self { surface, tint, gloss: 0.04, glow: 0.0, glow_layer: 0 }
    }

    pub(crate) fn glossy(self, gloss: f32) -> Self {
        Self { gloss, ..self }
    }

    pub(crate) fn glowing(self, glow: f32, glow_layer: usize) -> Self {
        Self { glow, glow_layer, ..self }
    }
}

/// Box that occludes ambient light, as a transform from the world to the unit cube.
#[derive(Debug, Clone, Copy)]
struct Solid {
    unit_from_world: Affine3A,
    center: Vec3,
    reach_m: f32,
}

/// Vertices and triangles, first those that cast no shadow.
#[derive(Debug, Clone)]
pub(crate) struct SceneMesh {
    pub vertices: Vec<SceneVertex>,
    pub triangles: Vec<[u32; 3]>,
    /// First triangle that casts a shadow.
    pub first_caster: usize,
    solids: Vec<Solid>,
    cell_m: f32,
    /// Whether new objects occlude ambient light; many small ones cost time without visible effect.
    pub shading: bool,
    /// Placement of new objects.
    pub at: Affine3A,
}

impl SceneMesh {
    /// Creates an empty mesh; `cell_m` is the longest side of a cell.
    pub(crate) fn new(cell_m: f32) -> Self {
        let at = Affine3A::IDENTITY;
        Self {
            vertices: Vec::new(),
            triangles: Vec::new(),
            first_caster: 0,
            solids: Vec::new(),
            cell_m,
            shading: true,
            at,
        }
    }

    /// Places the following objects on the floor, turned about the vertical.
    pub(crate) fn place(&mut self, at: Vec3, yaw: f32) {
        self.at = Affine3A::from_translation(at) * Affine3A::from_rotation_z(yaw);
    }

    pub(crate) fn cells(&self, length: f32) -> usize {
        (length / self.cell_m).ceil().clamp(1.0, 400.0) as usize
    }

    /// Adds a grid of vertices over 0..=1 squared; seen from outside, the second parameter runs to the left of the
    /// first.
    pub(crate) fn grid(&mut self, [across, up]: [usize; 2], coat: Coat, point: impl Fn(Vec2) -> (Vec3, Vec3, Vec2)) {
        let first = self.vertices.len() as u32;
        for j in 0..=up {
            for i in 0..=across {
                let (position, normal, uv) = point(Vec2::new(i as f32 / across as f32, j as f32 / up as f32));
                let normal = self.at.transform_vector3(normal).normalize_or(Vec3::Z);
                self.vertices.push(SceneVertex {
                    position: self.at.transform_point3(position).to_array(),
                    normal: normal.to_array(),
                    paint: [uv.x, uv.y, coat.surface as u32 as f32, 1.0],
                    tint: coat.tint.extend(coat.gloss).to_array(),
                    glow: [coat.glow, coat.glow_layer as f32],
                });
            }
        }
        let row = across as u32 + 1;
        for j in 0..up as u32 {
            for i in 0..across as u32 {
                let a = first + j * row + i;
                self.triangles.extend([[a, a + 1, a + row], [a + 1, a + row + 1, a + row]]);
            }
        }
    }

    /// Adds a flat quadrilateral from a corner along two sides; it faces along their cross product.
    pub(crate) fn quad(&mut self, corner: Vec3, u: Vec3, v: Vec3, coat: Coat) {
        let normal = u.cross(v).normalize_or(Vec3::Z);
        let size = Vec2::new(u.length(), v.length());
        let per_m = coat.surface.repeats_a_metre();
        let cells = [self.cells(size.x), self.cells(size.y)];
        self.grid(cells, coat, |t| {
            let uv = per_m.map_or(Vec2::new(t.x, 1.0 - t.y), |per_m| t * size * per_m);
            (corner + u * t.x + v * t.y, normal, uv)
        });
    }

    /// Adds a box around a centre.
    pub(crate) fn block(&mut self, middle: Vec3, half: Vec3, coat: Coat) {
        let (x, y, z) = (Vec3::X * half.x * 2.0, Vec3::Y * half.y * 2.0, Vec3::Z * half.z * 2.0);
        let (low, high) = (middle - half, middle + half);
        self.quad(Vec3::new(low.x, low.y, high.z), x, y, coat);
        self.quad(Vec3::new(low.x, high.y, low.z), x, -y, coat);
        self.quad(low, x, z, coat);
        self.quad(Vec3::new(high.x, low.y, low.z), y, z, coat);
        self.quad(Vec3::new(high.x, high.y, low.z), -x, z, coat);
        self.quad(Vec3::new(low.x, high.y, low.z), -y, z, coat);
        self.solid(middle, half);
    }

    /// Adds a cylinder or truncated cone, from one end to the other; closed at both.
    pub(crate) fn rod(&mut self, from: Vec3, to: Vec3, radii: [f32; 2], coat: Coat) {
        let along = to - from;
        let axis = along.normalize_or(Vec3::Z);
        let side = axis.any_orthonormal_vector();
        let other = axis.cross(side);
        let round = self.cells(radii[0].max(radii[1]) * std::f32::consts::TAU).clamp(10, 48);
        let per_m = coat.surface.repeats_a_metre().unwrap_or(1.0);
        let slope = (radii[0] - radii[1]) / along.length().max(1e-4);
        let wide = radii[0].max(radii[1]) * std::f32::consts::TAU;
        let cells = [round, self.cells(along.length())];
        self.grid(cells, coat, |t| {
            let (sin, cos) = (t.x * std::f32::consts::TAU).sin_cos();
            let out = side * cos + other * sin;
            let radius = radii[0] + (radii[1] - radii[0]) * t.y;
            (from + along * t.y + out * radius, out + axis * slope, Vec2::new(t.x * wide, t.y * along.length()) * per_m)
        });
        for (middle, radius, up) in [(to, radii[1], 1.0), (from, radii[0], -1.0)] {
            if radius > 0.0 {
                self.grid([round, self.cells(radius).max(1)], coat, |t| {
                    let (sin, cos) = (t.x * std::f32::consts::TAU * up).sin_cos();
                    let out = (side * cos + other * sin) * radius * (1.0 - t.y);
                    (middle + out, axis * up, Vec2::new(cos, sin) * radius * (1.0 - t.y) * per_m)
                });
            }
        }
        let half = along.abs() * 0.5 + (Vec3::ONE - axis.abs()) * radii[0].max(radii[1]) * 0.8;
        self.solid((from + to) * 0.5, half.max(Vec3::splat(0.005)));
    }

    /// Adds a cushion: a box with well-rounded edges; `square` 0 for a ball, towards 1 for a box.
    pub(crate) fn cushion(&mut self, middle: Vec3, half: Vec3, square: f32, coat: Coat) {
        // |x|ⁿ + |y|ⁿ + |z|ⁿ = 1, met by rays in the directions of a ball's points.
        let n = 2.0 / (1.0 - square.clamp(0.0, 0.8));
        let per_m = coat.surface.repeats_a_metre().unwrap_or(1.0);
        let round = self.cells(half.max_element() * 4.0).clamp(12, 48);
        self.grid([round * 2, round], coat, |t| {
            let (sin_a, cos_a) = (t.x * std::f32::consts::TAU).sin_cos();
            let (sin_b, cos_b) = ((t.y - 0.5) * std::f32::consts::PI).sin_cos();
            // At the poles the cosine must not become negative by rounding.
            let ray = Vec3::new(cos_b.max(0.0) * cos_a, cos_b.max(0.0) * sin_a, sin_b);
            let p = ray / ray.abs().powf(n).element_sum().powf(1.0 / n);
            let normal = p.signum() * p.abs().powf(n - 1.0) / half;
            (middle + p * half, normal, Vec2::new(t.x * half.x * 6.0, t.y * half.z.max(half.y) * 3.0) * per_m)
        });
        self.solid(middle, half * 0.85);
    }

    /// Adds a leaf: a bent strip, wide in its middle, visible from both sides.
    pub(crate) fn leaf(&mut self, root: Vec3, out: Vec3, length_m: f32, width_m: f32, droop: f32, coat: Coat) {
        let flat = Vec3::new(out.x, out.y, 0.0).normalize_or(Vec3::X);
        let side = flat.cross(Vec3::Z).normalize_or(Vec3::Y);
        let spine = |t: f32| root + out.normalize_or(Vec3::Z) * length_m * t - Vec3::Z * droop * length_m * t * t;
        self.grid([2, 7], coat, |t| {
            let wide = width_m * (std::f32::consts::PI * t.y.powf(0.8)).sin().max(0.02);
            let along = spine((t.y + 0.01).min(1.0)) - spine(t.y - 0.01);
            let fold = Vec3::Z * (t.x - 0.5).abs() * wide * 0.5;
            let tilt = side * (t.x - 0.5) * 0.8;
            let normal = side.cross(along).normalize_or(Vec3::Z) - tilt;
            (spine(t.y) + side * (t.x - 0.5) * wide + fold, normal, t)
        });
    }

    /// Returns whether an object may stand between a lamp and a ball.
    pub(crate) fn may_hide(&self, lamp: Vec3, center: Vec3, radius: f32) -> bool {
        let along = center - lamp;
        self.solids.iter().any(|solid| {
            let t = ((solid.center - lamp).dot(along) / along.length_squared().max(1e-6)).clamp(0.0, 1.0);
            // The cone widens towards the ball; penumbrae come on top.
            (lamp + along * t).distance(solid.center) < solid.reach_m + radius * t + 0.3
        })
    }

    fn solid(&mut self, middle: Vec3, half: Vec3) {
        if !self.shading {
            return;
        }
        let world_from_unit =
            self.at * Affine3A::from_translation(middle) * Affine3A::from_scale(half.max(Vec3::splat(1e-3)));
        self.solids.push(Solid {
            unit_from_world: world_from_unit.inverse(),
            center: self.at.transform_point3(middle),
            reach_m: half.length(),
        });
    }

    /// Computes every vertex's unoccluded fraction of the surroundings, within 0.7 m, in a room of this half side and
    /// height.
    pub(crate) fn find_openness(&mut self, half_m: f32, height_m: f32) {
        let solids = &self.solids;
        self.vertices.par_iter_mut().for_each(|vertex| {
            let (p, n) = (Vec3::from(vertex.position), Vec3::from(vertex.normal));
            let walls = [
                (half_m - p.x, -Vec3::X),
                (half_m + p.x, Vec3::X),
                (half_m - p.y, -Vec3::Y),
                (half_m + p.y, Vec3::Y),
                (p.z, Vec3::Z),
                (height_m - p.z, -Vec3::Z),
            ];
            let mut open = 1.0;
            for (distance, inward) in walls {
                let near = (1.0 - distance.max(0.0) / 0.7).max(0.0);
                open *= 1.0 - 0.38 * (0.5 - 0.5 * n.dot(inward)) * near * near;
            }
            vertex.paint[3] = open * openness(solids, p, n);
        });
    }
}

/// Returns the fraction of a surface's cosine-weighted surroundings that boxes leave free; occluders count up to a
/// distance of 0.7 m.
fn openness(solids: &[Solid], p: Vec3, n: Vec3) -> f32 {
    const RAYS: u64 = 16;
    const REACH_M: f32 = 0.7;
    let start = p + n * 0.012;
    let near: Vec<&Solid> = solids.iter().filter(|s| s.center.distance(p) < s.reach_m + REACH_M).collect();
    if near.is_empty() {
        return 1.0;
    }
    let (side, other) = n.any_orthonormal_pair();
    let hidden: f32 = (0..RAYS)
        .map(|ray| {
            let (r2, angle) = ((ray as f32 + 0.5) / RAYS as f32, ray as f32 * 2.399_963);
            let direction = (side * angle.cos() + other * angle.sin()) * r2.sqrt() + n * (1.0 - r2).sqrt();
            let first = near.iter().filter_map(|s| hit(s, start, direction)).fold(REACH_M, f32::min);
            1.0 - first / REACH_M
        })
        .sum();
    1.0 - 0.9 * hidden / RAYS as f32
}

/// Returns the distance along a ray to a box that it enters from outside.
fn hit(solid: &Solid, start: Vec3, direction: Vec3) -> Option<f32> {
    let from = solid.unit_from_world.transform_point3(start);
    let along = solid.unit_from_world.transform_vector3(direction);
    let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
    for axis in 0..3 {
        let (a, b) = ((-1.0 - from[axis]) / along[axis], (1.0 - from[axis]) / along[axis]);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    (enter > 0.0 && enter < leave).then_some(enter)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_small_fronts_face_out_and_what_is_covered_knows_it() {
        let mut mesh = SceneMesh::new(0.1);
        let coat = Coat::new(Surface::Plain, Vec3::ONE);
        mesh.block(Vec3::new(0.0, 0.0, 0.5), Vec3::new(0.4, 0.3, 0.5), coat);
        mesh.cushion(Vec3::new(2.0, 0.0, 0.5), Vec3::splat(0.4), 0.5, coat);
        mesh.rod(Vec3::new(-2.0, 0.0, 0.0), Vec3::new(-2.0, 0.0, 1.0), [0.2, 0.1], coat);
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|v| Vec3::from(mesh.vertices[v as usize].position));
            let normal = (b - a).cross(c - a);
            let longest = a.distance(b).max(b.distance(c)).max(c.distance(a));
            assert!(longest < 0.1 * 2.2, "{longest}");
            if normal.length() > 1e-7 {
                let shading = triangle.map(|v| Vec3::from(mesh.vertices[v as usize].normal)).iter().sum::<Vec3>();
                assert!(normal.dot(shading) > 0.0, "{a} {b} {c}: {normal} {shading}");
            }
        }
        // The floor: open far away, covered at the foot of the box.
        mesh.place(Vec3::ZERO, 0.0);
        let floor = mesh.vertices.len();
        mesh.quad(Vec3::new(-4.0, -4.0, 0.0), Vec3::X * 8.0, Vec3::Y * 8.0, coat);
        mesh.find_openness(5.0, 3.0);
        let open = |x: f32, y: f32| {
            let of = |v: &&SceneVertex| Vec2::new(v.position[0] - x, v.position[1] - y).length();
            mesh.vertices[floor..].iter().min_by(|a, b| of(a).total_cmp(&of(b))).unwrap().paint[3]
        };
        assert!(open(0.0, 2.5) > 0.99 && open(0.5, 0.0) < 0.82, "{} {}", open(0.0, 2.5), open(0.5, 0.0));
    }
}
