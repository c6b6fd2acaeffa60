//! Walks over the cubes of a field.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::field::{Evidence, Field, SIDE, VOXELS, local_of};
use crate::mesh::TriMesh;

use super::table::{EDGES, TRIANGLES};

/// Smallest distance of a vertex from the ends of its lattice edge, in voxels: exact zeros make no two vertices coincide.
const MARGIN: f32 = 0.02;
/// Voxels along the side of a block with its neighbours' first ones.
const WIDE: i32 = SIDE + 1;

/// Vertices on the lattice edges that start in a block.
#[derive(Debug, Default)]
struct BlockVertices {
    /// Three times the voxel plus the axis, ascending.
    edges: Vec<u16>,
    positions: Vec<Vec3>,
    from_hole: Vec<bool>,
}

/// Signed distances of a block and the first voxels of the neighbours behind it.
struct Cells {
    distances: Vec<f32>,
    evidence: Vec<Evidence>,
}

fn wide_of(local: IVec3) -> usize {
    ((local.z * WIDE + local.y) * WIDE + local.x) as usize
}

/// Extracts the surface where the distance is zero: closed, edge- and vertex-manifold for any distances, since the outermost
/// voxels of a field lie outside; triangles are counter-clockwise from outside. A vertex is marked as closing a hole if an
/// end of its lattice edge had no evidence. The result is the same for any number of threads.
///
/// A field from [`fuse`](crate::fuse) must have been closed before ([`close`](crate::close)), else its surface ends where
/// its blocks end.
#[must_use]
pub fn marching_cubes(field: &Field) -> TriMesh {
    // In the order of space: blocks without a surface that are stored all the same change nothing.
    let mut slots: Vec<usize> = (0..field.stored_blocks()).collect();
    slots.sort_unstable_by_key(|slot| (field.blocks()[*slot].z, field.blocks()[*slot].y, field.blocks()[*slot].x));
    let vertices: Vec<BlockVertices> =
        (0..slots.len()).into_par_iter().map(|slot| block_vertices(field, slot)).collect();
    let mut starts = vec![0; vertices.len()];
    let mut mesh = TriMesh::default();
    for slot in &slots {
        starts[*slot] = mesh.positions.len() as u32;
        mesh.positions.extend(&vertices[*slot].positions);
        mesh.from_hole.extend(&vertices[*slot].from_hole);
    }
    let vertex = |lattice: IVec3, axis: u8| -> Option<u32> {
        let block = lattice.div_euclid(IVec3::splat(SIDE));
        let local = lattice - block * SIDE;
        let slot = field.slot(block)?;
        let edge = ((local.z * SIDE + local.y) * SIDE + local.x) * 3 + i32::from(axis);
        let at = vertices[slot].edges.binary_search(&(edge as u16)).ok()?;
        Some(starts[slot] + at as u32)
    };
    let triangles: Vec<Vec<[u32; 3]>> =
        slots.into_par_iter().map(|slot| block_triangles(field, slot, &vertices[slot], &vertex)).collect();
    mesh.triangles = triangles.concat();
    mesh
}

fn gather(field: &Field, slot: usize) -> Cells {
    let block = field.blocks()[slot];
    let neighbors: [(Option<usize>, f32); 8] = std::array::from_fn(|i| {
        let neighbor = block + corner_offset(i as u8);
        let outside = if field.skipped_inside(neighbor) { -field.truncation_m() } else { field.truncation_m() };
        (field.slot(neighbor), outside)
    });
    let cells = (WIDE * WIDE * WIDE) as usize;
    let mut wide = Cells { distances: Vec::with_capacity(cells), evidence: Vec::with_capacity(cells) };
    for z in 0..WIDE {
        for y in 0..WIDE {
            for x in 0..WIDE {
                let (slot, outside) = neighbors[(x / SIDE + 2 * (y / SIDE) + 4 * (z / SIDE)) as usize];
                let voxel = (((z % SIDE) * SIDE + y % SIDE) * SIDE + x % SIDE) as usize;
                let (distance, evidence) = slot.map_or((outside, Evidence::Unknown), |slot| {
                    let (distances, evidence) = field.block(slot);
                    (distances[voxel], evidence[voxel])
                });
                wide.distances.push(distance);
                wide.evidence.push(evidence);
            }
        }
    }
    wide
}

fn corner_offset(corner: u8) -> IVec3 {
    let corner = i32::from(corner);
    IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2 & 1)
}

fn block_vertices(field: &Field, slot: usize) -> BlockVertices {
    let (block, cells) = (field.blocks()[slot], gather(field, slot));
    let mut vertices = BlockVertices::default();
    for voxel in 0..VOXELS {
        let local = local_of(voxel);
        for (axis, step) in [IVec3::X, IVec3::Y, IVec3::Z].into_iter().enumerate() {
            let (start, end) = (wide_of(local), wide_of(local + step));
            let (a, b) = (cells.distances[start], cells.distances[end]);
            if (a < 0.0) == (b < 0.0) {
                continue;
            }
            let place = (a / (a - b)).clamp(MARGIN, 1.0 - MARGIN);
            let place = if place.is_finite() { place } else { 0.5 };
            let ends = [cells.evidence[start], cells.evidence[end]];
            vertices.edges.push((voxel * 3 + axis) as u16);
            vertices.positions.push(field.center(block, voxel) + step.as_vec3() * (place * field.voxel_m()));
            vertices.from_hole.push(ends.contains(&Evidence::Unknown) && !ends.contains(&Evidence::Empty));
        }
    }
    vertices
}

fn block_triangles(
    field: &Field,
    slot: usize,
    own: &BlockVertices,
    vertex: &(dyn Fn(IVec3, u8) -> Option<u32> + Sync),
) -> Vec<[u32; 3]> {
    let (block, cells) = (field.blocks()[slot], gather(field, slot));
    let mut triangles = Vec::with_capacity(own.edges.len() * 2);
    for voxel in 0..VOXELS {
        let local = local_of(voxel);
        let inside = |corner: u8| cells.distances[wide_of(local + corner_offset(corner))] < 0.0;
        let case = (0..8).fold(0, |case, corner| case | usize::from(inside(corner)) << corner);
        let corner = |edge: u8| {
            let (corner, axis) = EDGES[edge as usize];
            vertex(block * SIDE + local + corner_offset(corner), axis)
        };
        triangles.extend(TRIANGLES[case].iter().filter_map(|[a, b, c]| Some([corner(*a)?, corner(*b)?, corner(*c)?])));
    }
    triangles
}
