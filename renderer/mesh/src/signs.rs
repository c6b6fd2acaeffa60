//! Signs of voxels without evidence, from the winding number.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::error::MeshError;
use crate::field::{Evidence, Field, SIDE, VOXELS, local_of, voxel_of};
use crate::winding::Winding;

/// Voxels along the side of a brick, which is evaluated once where the winding number is clear.
const BRICK: i32 = 2;
/// Distance of the winding number from one half at which no surface passes through a brick or block.
const CLEAR: f32 = 0.25;

/// Gives every voxel without evidence, and every block that is not stored, the side that the winding number of the points
/// has there: inside above one half. The distance of such a voxel is `(0.5 - winding) * 2` truncation distances, so the
/// surface crosses holes smoothly. Blocks are stored where the surface leaves the evidence. Returns the number of stored
/// voxels that were given a sign.
///
/// # Errors
/// [`MeshError::Extent`] if too many blocks would be stored.
pub fn close(field: &mut Field, winding: &Winding) -> Result<usize, MeshError> {
    let lattice = (field.position(IVec3::ZERO), field.voxel_m());
    let truncation = field.truncation_m();
    let fill = move |block: IVec3, distances: &mut [f32], evidence: &mut [Evidence]| {
        fill(winding, lattice, truncation, block, distances, evidence);
    };
    field.refill(&fill);
    let skipped = field.skipped_blocks();
    let numbers: Vec<f32> = skipped
        .par_iter()
        .with_min_len(16)
        .map(|block| winding.number(position(lattice, *block * SIDE, (SIDE - 1) as f32 * 0.5)))
        .collect();
    let inside: Vec<bool> = numbers.iter().map(|number| *number > 0.5).collect();
    field.set_skipped(&skipped, &inside);
    let unclear = skipped.iter().zip(&numbers).filter(|(_, number)| (**number - 0.5).abs() < CLEAR);
    let mut wanted: Vec<IVec3> = unclear.map(|(block, _)| *block).collect();
    wanted.extend(field.disagreeing_skipped(&skipped));
    field.store(&wanted, &fill)?;
    field.settle(&fill)?;
    let unknown = |slot: usize| field.block(slot).1.iter().filter(|state| **state == Evidence::Unknown).count();
    Ok((0..field.stored_blocks()).into_par_iter().map(unknown).sum())
}

fn position((origin, voxel_m): (Vec3, f32), lattice: IVec3, offset: f32) -> Vec3 {
    origin + (lattice.as_vec3() + offset) * voxel_m
}

fn fill(
    winding: &Winding,
    lattice: (Vec3, f32),
    truncation_m: f32,
    block: IVec3,
    distances: &mut [f32],
    evidence: &[Evidence],
) {
    let distance = |number: f32| ((0.5 - number) * 2.0).clamp(-1.0, 1.0) * truncation_m;
    for first in (0..VOXELS).map(local_of).filter(|local| (*local % BRICK) == IVec3::ZERO) {
        let voxels = (0..BRICK * BRICK * BRICK)
            .map(|i| first + IVec3::new(i % BRICK, i / BRICK % BRICK, i / (BRICK * BRICK)))
            .filter(|local| evidence[voxel_of(*local)] == Evidence::Unknown);
        if voxels.clone().next().is_none() {
            continue;
        }
        let number = winding.number(position(lattice, block * SIDE + first, (BRICK - 1) as f32 * 0.5));
        let clear = (number - 0.5).abs() > CLEAR;
        for local in voxels {
            let own = if clear { number } else { winding.number(position(lattice, block * SIDE + local, 0.0)) };
            distances[voxel_of(local)] = distance(own);
        }
    }
}
