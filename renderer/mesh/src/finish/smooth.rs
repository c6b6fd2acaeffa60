//! Smoothing of a rough surface that keeps its creases, its volume and its thin parts.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::around::triangles_around;
use crate::TriMesh;
use crate::density::median;
use crate::mesh::area_vector;

/// Distance over which normals are averaged, in spacings of the points that the surface was fused from.
const SPACINGS: f64 = 2.0;
/// Variance along the surface of one round of averages over adjacent triangles, in squared lengths of an edge.
const ROUND: f64 = 0.3;
/// Largest number of rounds.
const MAX_ROUNDS: usize = 60;
/// Deviation of the differences of normals that count as noise, in medians of those of adjacent triangles.
const NOISE: f64 = 2.5;
/// Rounds in which vertices follow the smoothed normals.
const MOVES: usize = 10;

/// Triangles and what lies beside them.
struct Neighbors {
    /// Triangles around each vertex, ascending.
    around: Vec<Vec<u32>>,
    /// Triangles that share a vertex with each triangle, itself included, ascending.
    beside: Vec<Vec<u32>>,
}

/// Smooths a mesh in place: the normals of its triangles become means over those around them, weighted by area and by a Gaussian of the
/// difference, and then the vertices move along these normals until they fit (bilateral normal filter, Zheng et al. 2011). The width of the
/// Gaussian follows from the roughness of the mesh, the distance from the spacing of the points, so that the result hardly depends on the size
/// of the triangles. No vertex moves further than `spacing_m` metres. Indices must be in range. The result is the same for any number of threads.
pub(crate) fn smooth(mesh: &mut TriMesh, spacing_m: f32) {
    let neighbors = Neighbors::new(mesh);
    let areas: Vec<DVec3> = (0..mesh.triangles.len()).map(|i| area_vector(mesh.corners(i))).collect();
    let area = areas.iter().map(|a| a.length()).sum::<f64>() / areas.len().max(1) as f64;
    // Side of an equilateral triangle of the mean area.
    let edge_squared = area * 4.0 / 3f64.sqrt();
    let wanted = (SPACINGS * f64::from(spacing_m)).powi(2) / (ROUND * edge_squared);
    if !wanted.is_finite() || wanted <= 0.0 {
        return;
    }
    let rounds = (wanted.ceil() as usize).min(MAX_ROUNDS);
    let normals = smooth_normals(&areas, &neighbors, rounds);
    let start = mesh.positions.clone();
    for _ in 0..MOVES {
        mesh.positions = (0..start.len())
            .into_par_iter()
            .with_min_len(256)
            .map(|i| {
                start[i] + (follow(mesh, &normals, &neighbors.around[i], i) - start[i]).clamp_length_max(spacing_m)
            })
            .collect();
    }
}

impl Neighbors {
    fn new(mesh: &TriMesh) -> Self {
        let around = triangles_around(mesh.positions.len(), &mesh.triangles);
        let beside = |triangle: &[u32; 3]| {
            let mut beside: Vec<u32> = triangle.iter().flat_map(|i| &around[*i as usize]).copied().collect();
            beside.sort_unstable();
            beside.dedup();
            beside
        };
        let beside = mesh.triangles.par_iter().with_min_len(256).map(beside).collect();
        Self { around, beside }
    }
}

/// Returns the smoothed unit normals of triangles with the given area vectors; zero where there is none.
fn smooth_normals(areas: &[DVec3], neighbors: &Neighbors, rounds: usize) -> Vec<DVec3> {
    let mut normals: Vec<DVec3> = areas.iter().map(|area| area.normalize_or_zero()).collect();
    let rows = || neighbors.beside.iter().enumerate();
    let differences =
        rows().flat_map(|(t, row)| row.iter().filter(move |other| **other > t as u32).map(move |o| (t, *o)));
    let noise = f64::from(median(differences.map(|(t, o)| normals[t].distance(normals[o as usize]) as f32).collect()));
    let rate = 0.5 / (NOISE * noise).powi(2).max(f64::MIN_POSITIVE);
    for _ in 0..rounds {
        let mean = |(t, row): (usize, &Vec<u32>)| {
            let weighted = row.iter().map(|other| {
                let other = *other as usize;
                normals[other] * (areas[other].length() * (-normals[t].distance_squared(normals[other]) * rate).exp())
            });
            weighted.sum::<DVec3>().try_normalize().unwrap_or(normals[t])
        };
        normals = neighbors.beside.par_iter().enumerate().with_min_len(256).map(mean).collect();
    }
    normals
}

/// Returns where a vertex goes: the mean of its places on the planes through the centres of its triangles.
fn follow(mesh: &TriMesh, normals: &[DVec3], around: &[u32], vertex: usize) -> Vec3 {
    let own = mesh.positions[vertex].as_dvec3();
    let steps = around.iter().map(|t| {
        let normal = normals[*t as usize];
        let center = mesh.corners(*t as usize).iter().sum::<DVec3>() / 3.0;
        normal * normal.dot(center - own)
    });
    let way = steps.sum::<DVec3>() / around.len().max(1) as f64;
    let moved = (own + way).as_vec3();
    if moved.is_finite() { moved } else { mesh.positions[vertex] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Connectivity, self_intersections, shapes};

    fn noise(i: usize, k: usize) -> f32 {
        ((12.9898 * i as f32 + 78.233 * k as f32).sin() * 43758.547).fract()
    }

    fn rough(mesh: &TriMesh, amount: f32) -> TriMesh {
        let normals = mesh.normals();
        let place = |(i, p): (usize, &Vec3)| *p + normals[i] * (amount * noise(i, 1));
        TriMesh { positions: mesh.positions.iter().enumerate().map(place).collect(), ..mesh.clone() }
    }

    fn angle_errors(mesh: &TriMesh, truth: &TriMesh) -> f64 {
        let cosine = |i: usize| {
            let [a, b] = [mesh, truth].map(|mesh| area_vector(mesh.corners(i)).normalize_or_zero());
            a.dot(b).clamp(-1.0, 1.0).acos()
        };
        (0..mesh.triangles.len()).map(cosine).sum::<f64>() / mesh.triangles.len() as f64
    }

    #[test]
    fn roughness_goes_and_volume_stays() {
        for truth in [shapes::bumpy_sphere(40), shapes::two_tori(200, 40)] {
            let mut mesh = rough(&truth, 0.006);
            let before = angle_errors(&mesh, &truth);
            smooth(&mut mesh, 0.018);
            let after = angle_errors(&mesh, &truth);
            assert!(after < 0.4 * before, "{before} {after}");
            let ratio = shapes::volume(&mesh) / shapes::volume(&truth);
            assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
            assert_eq!(self_intersections(&mesh), 0);
            assert_eq!(Connectivity::new(&mesh.triangles), Connectivity::new(&truth.triangles));
        }
    }

    /// A finger: a torus of 7 mm with as much smoothing as a person gets.
    #[test]
    fn thin_parts_keep_their_width() {
        let mut thin = shapes::two_tori(700, 12);
        thin.positions.truncate(700 * 12);
        thin.triangles.truncate(2 * 700 * 12);
        for p in &mut thin.positions {
            let ring = Vec3::new(p.x, 0.0, p.z).normalize() * 0.6;
            *p = ring + (*p - ring) * 0.07;
        }
        let mut mesh = thin.clone();
        smooth(&mut mesh, 0.0044);
        let ratio = shapes::volume(&mesh) / shapes::volume(&thin);
        assert!((0.93..1.02).contains(&ratio), "{ratio}");
    }

    /// The edges of a rough box stay where they are.
    #[test]
    fn creases_stay() {
        let mut truth = shapes::bumpy_sphere(40);
        for p in &mut truth.positions {
            let d = *p - Vec3::Y * 0.9;
            *p = d / d.abs().max_element() * 0.3;
        }
        let mut mesh = rough(&truth, 0.001);
        smooth(&mut mesh, 0.018);
        let at_edge = |p: &Vec3| p.to_array().iter().filter(|x| x.abs() > 0.285).count() >= 2;
        let edge = truth.positions.iter().enumerate().filter(|(_, p)| at_edge(p));
        let (mut count, mut sum) = (0, 0.0);
        for (i, p) in edge {
            count += 1;
            sum += p.distance(mesh.positions[i]);
        }
        assert!(count > 100 && sum / (count as f32) < 0.002, "{count} {}", sum / count as f32);
    }

    /// The definition, one triangle after another in f64.
    #[test]
    fn normals_are_those_of_the_definition() {
        let mesh = rough(&shapes::bumpy_sphere(6), 0.03);
        let areas: Vec<DVec3> = (0..mesh.triangles.len()).map(|i| area_vector(mesh.corners(i))).collect();
        let found = smooth_normals(&areas, &Neighbors::new(&mesh), 2);
        let mut normals: Vec<DVec3> = areas.iter().map(|a| *a / a.length()).collect();
        let touch = |a: usize, b: usize| mesh.triangles[a].iter().any(|i| mesh.triangles[b].contains(i));
        let mut differences = Vec::new();
        for (a, b) in (0..normals.len()).flat_map(|a| (a + 1..areas.len()).map(move |b| (a, b))) {
            if touch(a, b) {
                differences.push((normals[a] - normals[b]).length());
            }
        }
        differences.sort_by(f64::total_cmp);
        let width = NOISE * differences[differences.len() / 2];
        for _ in 0..2 {
            let mut next = Vec::new();
            for a in 0..normals.len() {
                let mut sum = DVec3::ZERO;
                for b in (0..normals.len()).filter(|b| touch(a, *b)) {
                    let difference = (normals[a] - normals[b]).length() / width;
                    sum += areas[b].length() * (-difference * difference / 2.0).exp() * normals[b];
                }
                next.push(sum / sum.length());
            }
            normals = next;
        }
        assert!(found.iter().zip(&normals).all(|(a, b)| a.distance(*b) < 1e-6));
    }

    #[test]
    fn flat_poisoned_and_empty_meshes_are_harmless() {
        let mut empty = TriMesh::default();
        smooth(&mut empty, 0.01);
        assert_eq!(empty, TriMesh::default());
        let mut flat = shapes::bumpy_sphere(4);
        flat.positions.fill(Vec3::ONE);
        let before = flat.clone();
        smooth(&mut flat, 0.01);
        assert_eq!(flat, before);
        for bad in [Vec3::NAN, Vec3::INFINITY] {
            let mut mesh = shapes::bumpy_sphere(4);
            mesh.positions[3] = bad;
            smooth(&mut mesh, 0.01);
            assert_eq!(mesh.positions.iter().filter(|p| !p.is_finite()).count(), 1);
        }
        for spacing_m in [0.0, f32::NAN] {
            let mut mesh = before.clone();
            smooth(&mut mesh, spacing_m);
            assert_eq!(mesh, before);
        }
    }

    #[test]
    fn threads_change_nothing() {
        let run = |threads: usize| {
            let mut mesh = rough(&shapes::bumpy_sphere(40), 0.004);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| smooth(&mut mesh, 0.01));
            mesh
        };
        assert_eq!(run(1), run(3));
    }
}
