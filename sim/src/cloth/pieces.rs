//! Control particles on loose surfaces, and the surfaces that follow them.

use std::collections::{BTreeSet, BinaryHeap, HashMap};

use flyrig_body::SkinWeights;
use glam::Vec3;

use super::colliders::Capsule;
use super::solver::{Particle, ParticleLink, Particles};
use crate::noise::smoothstep;
use crate::person::assembly::{Person, SheetRange};

/// Spacing of control particles, metres.
const SPACING_M: f32 = 0.030;
/// Free length below which a point is fixed, metres.
const SEWN_M: f32 = 0.008;
/// Distance between layers that lie on the body, metres.
const KEEP_M: f32 = 0.006;
/// Largest inward movement of cloth that hangs around the body, metres, so that it does not stay between the legs.
const INWARDS_M: f32 = 0.09;
/// Ratio of bending to stretching compliance.
const BEND_SOFT: f32 = 12.0;
/// Particles that influence a vertex.
const FOLLOWED: usize = 10;

/// Particles with their skinning; canonical space.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rigging {
    pub particles: Particles,
    pub canonical: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    pub skin: Vec<SkinWeights>,
}

/// Vertex that follows particles.
#[derive(Debug, Clone, Copy)]
struct Follower {
    vertex: u32,
    particles: [u32; FOLLOWED],
    weights: [f32; FOLLOWED],
    /// As [`Particle::inside_m`].
    inside_m: Option<f32>,
    /// Blend from the skinned normal (0) to the moved surface's (1).
    turned: f32,
}

/// All loose surfaces of a person.
pub(crate) struct Pieces {
    pub particles: Rigging,
    followers: Vec<Follower>,
    /// Triangles of the loose surfaces.
    triangles: Vec<[u32; 3]>,
    /// Per vertex of the person, the first vertex of its sheet at the same position.
    welded: Vec<u32>,
}

impl Pieces {
    /// Creates the pieces; `None` when nothing is loose.
    pub(crate) fn new(person: &Person, at_rest: &[Capsule]) -> Option<Self> {
        let mut pieces = Self {
            particles: Rigging::default(),
            followers: Vec::new(),
            triangles: Vec::new(),
            welded: (0..person.clothed.positions.len() as u32).collect(),
        };
        for sheet in &person.sheets {
            pieces.add(person, sheet, at_rest);
        }
        (!pieces.followers.is_empty()).then_some(pieces)
    }

    /// Adds a sheet if any of it is loose.
    fn add(&mut self, person: &Person, sheet: &SheetRange, at_rest: &[Capsule]) {
        let loose = |v: usize| person.free_m[v] > SEWN_M;
        if !sheet.vertices.clone().any(loose) {
            return;
        }
        let first = sheet.vertices.start;
        let triangles = &person.clothed.triangles[sheet.triangles.clone()];
        // Vertices of one place move as one.
        let mut places: HashMap<[u32; 3], u32> = HashMap::new();
        let weld: Vec<u32> = sheet
            .vertices
            .clone()
            .map(|v| *places.entry(person.clothed.positions[v].to_array().map(f32::to_bits)).or_insert(v as u32))
            .collect();
        let at = |v: u32| weld[v as usize - first];
        let mut neighbours: HashMap<u32, BTreeSet<u32>> = HashMap::new();
        for triangle in triangles {
            let [a, b, c] = triangle.map(at);
            for (from, to) in [(a, b), (b, c), (c, a)] {
                if from != to {
                    neighbours.entry(from).or_default().insert(to);
                    neighbours.entry(to).or_default().insert(from);
                }
            }
        }
        let position = |v: u32| person.clothed.positions[v as usize];
        let (cell, seeds) =
            sampled(sheet.vertices.start as u32, &weld, &neighbours, &position, |v| person.free_m[v as usize] > SEWN_M);
        let inside = |v: u32| {
            let depths = at_rest.iter().filter_map(|c| c.depth(position(v))).map(|(depth, _)| depth);
            sheet.hangs.then(|| depths.fold(0.0, f32::max))
        };
        let offset = self.particles.particles.points.len() as u32;
        for &seed in &seeds {
            let v = seed as usize;
            let free_m = if person.free_m[v] > SEWN_M { person.free_m[v] } else { 0.0 };
            let rests_m = (position(seed) - person.carriers[v]).dot(person.clothed.normals[v]);
            self.particles.particles.points.push(Particle {
                free_m,
                stiff: sheet.stiff,
                backstop_m: if sheet.hangs { (0.25 * free_m).min(INWARDS_M) } else { (rests_m - KEEP_M).max(0.0) },
                inside_m: inside(seed),
            });
            self.particles.canonical.push(position(seed));
            self.particles.normals.push(person.clothed.normals[v]);
            self.particles.skin.push(person.clothed.skin[v]);
        }
        let mut joined: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); seeds.len()];
        for (from, to) in neighbours.iter().flat_map(|(&from, all)| all.iter().map(move |&to| (from, to))) {
            if let (Some(&a), Some(&b)) = (cell.get(&from), cell.get(&to))
                && a != b
            {
                joined[a as usize].insert(b);
                joined[b as usize].insert(a);
            }
        }
        self.link(&joined, offset);
        for v in sheet.vertices.clone() {
            let Some(&own) = cell.get(&at(v as u32)) else { continue };
            if person.free_m[v] <= SEWN_M {
                continue;
            }
            let mut near = joined[own as usize].clone();
            near.extend(joined[own as usize].iter().flat_map(|&next| &joined[next as usize]));
            near.insert(own);
            self.followers.push(self.follower(
                (v as u32, person.clothed.positions[v]),
                near.into_iter(),
                offset,
                (person.free_m[v], inside(at(v as u32))),
            ));
        }
        self.triangles.extend_from_slice(triangles);
        for v in sheet.vertices.clone() {
            self.welded[v] = at(v as u32);
        }
    }

    /// Links neighbours by threads, and next neighbours by softer ones, which resist bending.
    fn link(&mut self, joined: &[BTreeSet<u32>], offset: u32) {
        let at = |i: u32, of: &Rigging| of.canonical[(i + offset) as usize];
        let mut links = Vec::new();
        for (a, all) in (0u32..).zip(joined) {
            for &b in all.iter().filter(|&&b| b > a) {
                let rest_m = at(a, &self.particles).distance(at(b, &self.particles));
                links.push(ParticleLink { ends: [a + offset, b + offset], rest_m, soft: 1.0 });
            }
            // Pairs of neighbours on opposite sides.
            for &b in all {
                for &c in all.iter().filter(|&&c| c > b) {
                    let [p, q, r] = [a, b, c].map(|i| at(i, &self.particles));
                    if (q - p).normalize_or_zero().dot((r - p).normalize_or_zero()) < -0.8 {
                        links.push(ParticleLink {
                            ends: [b + offset, c + offset],
                            rest_m: q.distance(r),
                            soft: BEND_SOFT,
                        });
                    }
                }
            }
        }
        self.particles.particles.links.extend(links);
    }

    fn follower(
        &self,
        (vertex, at): (u32, Vec3),
        near: impl Iterator<Item = u32>,
        offset: u32,
        (free_m, inside_m): (f32, Option<f32>),
    ) -> Follower {
        const REACH_M: f32 = 1.8 * SPACING_M;
        let mut candidates: Vec<(f32, u32)> = near
            .map(|i| {
                let share = 1.0 - (self.particles.canonical[(i + offset) as usize].distance(at) / REACH_M).powi(2);
                (share.max(1e-4).powi(2), i + offset)
            })
            .collect();
        candidates.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        candidates.truncate(FOLLOWED);
        let total: f32 = candidates.iter().map(|(weight, _)| weight).sum();
        let (mut particles, mut weights) = ([0; FOLLOWED], [0.0; FOLLOWED]);
        for (slot, (weight, particle)) in candidates.into_iter().enumerate() {
            (particles[slot], weights[slot]) = (particle, weight / total);
        }
        Follower { vertex, particles, weights, inside_m, turned: smoothstep(SEWN_M, 4.0 * SEWN_M, free_m) }
    }

    /// Smooths offsets against alternating neighbours: cloth makes no folds as small as the particle spacing.
    fn smoothed(&self, offsets: &[Vec3]) -> Vec<Vec3> {
        const ROUNDS: usize = 3;
        let Particles { points, links } = &self.particles.particles;
        let mut smooth = offsets.to_vec();
        for _ in 0..ROUNDS {
            let mut sums = vec![(Vec3::ZERO, 0.0f32); smooth.len()];
            for link in links.iter().filter(|link| link.soft <= 1.0) {
                let [a, b] = link.ends.map(|end| end as usize);
                sums[a] = (sums[a].0 + smooth[b], sums[a].1 + 1.0);
                sums[b] = (sums[b].0 + smooth[a], sums[b].1 + 1.0);
            }
            for ((offset, (sum, count)), point) in smooth.iter_mut().zip(sums).zip(points) {
                if count > 0.0 && point.free_m > 0.0 {
                    *offset = offset.lerp(sum / count, 0.5);
                }
            }
        }
        smooth
    }

    /// Moves the followers; returns every vertex's displacement.
    pub(crate) fn apply(
        &self,
        offsets: &[Vec3],
        capsules: &[Capsule],
        positions: &mut [Vec3],
        normals: &mut [Vec3],
    ) -> Vec<Vec3> {
        let offsets = self.smoothed(offsets);
        let mut displacement = vec![Vec3::ZERO; self.welded.len()];
        for follower in &self.followers {
            let vertex = follower.vertex as usize;
            let moved = follower
                .particles
                .iter()
                .zip(follower.weights)
                .map(|(&particle, weight)| offsets[particle as usize] * weight)
                .sum::<Vec3>();
            let skinned = positions[vertex];
            let mut place = skinned + moved;
            // Between particles the body is no flatter than at them. They go out towards where the surface faces,
            // so that neighbours stay beside each other.
            let normal = normals[vertex];
            for (capsule, inside_m) in capsules.iter().flat_map(|c| follower.inside_m.map(|inside_m| (c, inside_m))) {
                if let Some((depth, out)) = capsule.depth(place).filter(|(depth, _)| *depth > inside_m) {
                    let way = (out + normal).normalize_or(out);
                    place += way * ((depth - inside_m) / way.dot(out).max(0.4));
                }
            }
            displacement[vertex] = place - skinned;
            positions[vertex] = place;
        }
        let mut sums = vec![Vec3::ZERO; self.welded.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| positions[v as usize]);
            let normal = (b - a).cross(c - a);
            for vertex in triangle {
                sums[self.welded[*vertex as usize] as usize] += normal;
            }
        }
        for follower in &self.followers {
            let vertex = follower.vertex as usize;
            let turned = sums[self.welded[vertex] as usize].normalize_or(normals[vertex]);
            normals[vertex] = normals[vertex].lerp(turned, follower.turned).normalize_or(normals[vertex]);
        }
        displacement
    }
}

/// Samples particles about [`SPACING_M`] apart on the loose part of a welded mesh and a margin around it: each vertex's
/// cell, and each cell's vertex.
fn sampled(
    first: u32,
    weld: &[u32],
    neighbours: &HashMap<u32, BTreeSet<u32>>,
    position: &impl Fn(u32) -> Vec3,
    loose: impl Fn(u32) -> bool,
) -> (HashMap<u32, u32>, Vec<u32>) {
    #[derive(PartialEq)]
    struct Reached(f32, u32, u32);
    impl Eq for Reached {}
    impl PartialOrd for Reached {
        fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
            Some(self.cmp(other))
        }
    }
    impl Ord for Reached {
        // The nearest first out of a heap that gives the largest.
        fn cmp(&self, other: &Self) -> std::cmp::Ordering {
            other.0.total_cmp(&self.0).then(other.1.cmp(&self.1)).then(other.2.cmp(&self.2))
        }
    }
    /// Returns the vertices within `limit` of sources along edges: distance and source.
    fn flood(
        sources: &[(u32, u32)],
        limit: f32,
        neighbours: &HashMap<u32, BTreeSet<u32>>,
        position: &impl Fn(u32) -> Vec3,
        best: &mut HashMap<u32, (f32, u32)>,
    ) {
        let mut heap: BinaryHeap<Reached> = sources.iter().map(|&(vertex, of)| Reached(0.0, vertex, of)).collect();
        while let Some(Reached(distance, vertex, of)) = heap.pop() {
            if best.get(&vertex).is_some_and(|known| known.0 <= distance) {
                continue;
            }
            best.insert(vertex, (distance, of));
            for &next in neighbours.get(&vertex).into_iter().flatten() {
                let farther = distance + position(vertex).distance(position(next));
                if farther < limit && best.get(&next).is_none_or(|known| farther < known.0) {
                    heap.push(Reached(farther, next, of));
                }
            }
        }
    }
    let vertices: Vec<u32> =
        (0..weld.len() as u32).map(|i| i + first).filter(|&v| weld[(v - first) as usize] == v).collect();
    let loose_ones: Vec<(u32, u32)> = vertices.iter().filter(|&&v| loose(v)).map(|&v| (v, 0)).collect();
    let mut reached = HashMap::new();
    flood(&loose_ones, 1.6 * SPACING_M, neighbours, position, &mut reached);
    // Vertices in order; each that no particle is close to becomes one.
    let mut seeds: Vec<u32> = Vec::new();
    let mut best: HashMap<u32, (f32, u32)> = HashMap::new();
    for &vertex in vertices.iter().filter(|v| reached.contains_key(v)) {
        if best.get(&vertex).is_none_or(|known| known.0 > SPACING_M) {
            flood(&[(vertex, seeds.len() as u32)], 3.0 * SPACING_M, neighbours, position, &mut best);
            seeds.push(vertex);
        }
    }
    let cell = best.into_iter().filter(|(v, _)| reached.contains_key(v)).map(|(v, (_, seed))| (v, seed)).collect();
    (cell, seeds)
}
