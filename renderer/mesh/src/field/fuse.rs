//! Fusion of points into the field, in parallel by block.

use flyrig_body::PointGrid;
use glam::{IVec3, Vec3};

use crate::error::MeshError;
use crate::points::OrientedPoints;
use crate::settings::{Fusion, FusionSettings};

use super::blocks::{Evidence, Field};
use super::evidence::Nearby;
use super::lattice::{SIDE, voxel_of};

/// Voxels along the side of a brick, whose voxels share one selection of points.
const BRICK: i32 = 2;

/// Fuses oriented points into signed distances at the voxels around them (HGM, Eq. 18).
///
/// At voxel centre `x` the distance is the mean of `(x - p)·n`, clamped to the truncation distance, over the points `p`
/// within it. [`Fusion::Hgm`] weights a point by its own weight and by `exp(-|x - p|² / 2 sigma²)`, and accepts it if its
/// normal lies within `theta_t` of the voxel's. The paper leaves the voxel's normal open; here it starts as the mean of
/// the normals around the nearest point, which this point dominates, and is then recomputed from the accepted points. A
/// voxel between two surfaces therefore follows one of them. For this choice, distance along the surface counts twice. Voxels without accepted points, or with none whose tangent
/// plane carries it within twice sigma, stay unknown. The result is the same for any number of threads.
///
/// # Errors
/// [`MeshError::Setting`] for settings outside their ranges, [`MeshError::TooFewPoints`] for no points, and
/// [`MeshError::Extent`] if the grid would need more blocks than fit into memory.
pub fn fuse(points: &OrientedPoints, settings: &FusionSettings, fusion: Fusion) -> Result<Field, MeshError> {
    fuse_blocks(points, settings, fusion, false)
}

/// Fuses points as [`fuse`] does; `dense` stores the blocks without points too.
pub(crate) fn fuse_blocks(
    points: &OrientedPoints,
    settings: &FusionSettings,
    fusion: Fusion,
    dense: bool,
) -> Result<Field, MeshError> {
    settings.check()?;
    let positions = points.positions();
    let (Some(low), Some(high)) =
        (positions.iter().copied().reduce(Vec3::min), positions.iter().copied().reduce(Vec3::max))
    else {
        return Err(MeshError::TooFewPoints { count: 0, needed: 1 });
    };
    let radius = settings.truncation_m;
    let mut field = Field::around(low, high, settings.voxel_m, radius)?;
    let grid = PointGrid::new(positions, radius);
    let blocks = if dense { field.skipped_blocks() } else { field.blocks_touched(positions, radius) };
    let lattice = field.clone();
    field.store(&blocks, &|block, distances, evidence| {
        fill(&lattice, points, &grid, (settings, fusion), block, distances, evidence);
    })?;
    Ok(field)
}

fn fill(
    field: &Field,
    points: &OrientedPoints,
    grid: &PointGrid,
    (settings, fusion): (&FusionSettings, Fusion),
    block: IVec3,
    distances: &mut [f32],
    evidence: &mut [Evidence],
) {
    let radius = settings.truncation_m;
    let corner = |lattice: IVec3| field.position(lattice);
    let (low, high) = (corner(block * SIDE), corner(block * SIDE + (SIDE - 1)));
    let (mut around, mut nearby) = (Nearby::default(), Nearby::default());
    grid.near_box(low - radius, high + radius, |index, position| {
        if position.distance_squared(position.clamp(low, high)) <= radius * radius {
            around.push(points, index);
        }
    });
    let bricks = SIDE / BRICK;
    for brick in 0..bricks * bricks * bricks {
        let first = IVec3::new(brick % bricks, brick / bricks % bricks, brick / (bricks * bricks)) * BRICK;
        let lattice = block * SIDE + first;
        nearby.select(&around, corner(lattice), corner(lattice + (BRICK - 1)), radius);
        for i in 0..BRICK * BRICK * BRICK {
            let local = first + IVec3::new(i % BRICK, i / BRICK % BRICK, i / (BRICK * BRICK));
            let voxel = voxel_of(local);
            if let Some(distance) = nearby.distance(corner(block * SIDE + local), settings, fusion) {
                distances[voxel] = distance;
                evidence[voxel] = Evidence::Points;
            }
        }
    }
}
