//! Cuts space that is known to be empty out of the field.

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::error::MeshError;
use crate::field::{Evidence, Field, SIDE, VOXELS, local_of, voxel_of};

/// Says whether a place in the world, metres, is known to be empty, such as outside a silhouette.
pub type Empty<'a> = &'a (dyn Fn(Vec3) -> bool + Sync);

/// Bisections of the lattice edge that leaves the empty space: 1/64 voxel.
const BISECTIONS: usize = 6;
/// Step between tested voxels of blocks that are not stored.
const STEP: i32 = 2;

/// Moves empty voxels outside, whatever else is known. The cut is as smooth as the border of the empty space: beside it, the
/// distance is that of the plane through the places where the lattice's edges cross it. Returns the number of voxels cut.
///
/// # Errors
/// [`MeshError::Extent`] if too many blocks would be stored.
pub fn carve(field: &mut Field, empty: Empty) -> Result<usize, MeshError> {
    let cut = Cut {
        empty,
        origin: field.position(IVec3::ZERO),
        voxel_m: field.voxel_m(),
        truncation_m: field.truncation_m(),
    };
    let fill = move |block: IVec3, distances: &mut [f32], evidence: &mut [Evidence]| {
        cut.apply(block, distances, evidence);
    };
    let fill_inside = move |block: IVec3, distances: &mut [f32], evidence: &mut [Evidence]| {
        distances.fill(-cut.truncation_m);
        cut.apply(block, distances, evidence);
    };
    field.refill(&fill);
    let mut inside = field.skipped_blocks();
    inside.retain(|block| field.skipped_inside(*block));
    let wanted: Vec<IVec3> = inside.into_par_iter().filter(|block| cut.touches(*block)).collect();
    field.store(&wanted, &fill_inside)?;
    // Carving only moves voxels outside, so the blocks reached from here are those inside.
    field.settle(&fill_inside)?;
    let emptied = |slot: usize| field.block(slot).1.iter().filter(|state| **state == Evidence::Empty).count();
    Ok((0..field.stored_blocks()).into_par_iter().map(emptied).sum())
}

/// Empty space on a lattice.
#[derive(Clone, Copy)]
struct Cut<'a> {
    empty: Empty<'a>,
    origin: Vec3,
    voxel_m: f32,
    truncation_m: f32,
}

impl Cut<'_> {
    fn position(&self, lattice: IVec3) -> Vec3 {
        self.origin + lattice.as_vec3() * self.voxel_m
    }

    /// Returns whether any tested voxel of the block is empty.
    fn touches(&self, block: IVec3) -> bool {
        let tested = (0..VOXELS).map(local_of).filter(|local| *local % STEP == IVec3::ZERO);
        tested.into_iter().any(|local| (self.empty)(self.position(block * SIDE + local)))
    }

    fn apply(&self, block: IVec3, distances: &mut [f32], evidence: &mut [Evidence]) {
        // With a margin of one voxel.
        let width = SIDE + 2;
        let mut known = vec![None; (width * width * width) as usize];
        let mut is_empty = |local: IVec3| {
            let at = ((local.z + 1) * width + local.y + 1) * width + local.x + 1;
            *known[at as usize].get_or_insert_with(|| (self.empty)(self.position(block * SIDE + local)))
        };
        for local in (0..VOXELS).map(local_of) {
            let voxel = voxel_of(local);
            // The cut changes no voxel that is as far outside as can be.
            if distances[voxel] >= self.truncation_m {
                continue;
            }
            let own = is_empty(local);
            // Squared inverse distances to the border along the axes: those of a plane add up.
            let mut slope = 0.0;
            for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
                let nearest = [axis, -axis].into_iter().filter(|step| is_empty(local + *step) != own);
                let nearest = nearest.map(|step| self.border(block * SIDE + local, step, own)).fold(f32::MAX, f32::min);
                slope += (nearest * nearest).recip();
            }
            let distance = slope.sqrt().recip().min(self.truncation_m);
            let distance = if own { distance } else { -distance };
            if distance > distances[voxel] {
                distances[voxel] = distance;
            }
            if own {
                evidence[voxel] = Evidence::Empty;
            }
        }
    }

    /// Returns the distance from a voxel to the border of the empty space towards a neighbour on its other side, metres.
    fn border(&self, lattice: IVec3, step: IVec3, own: bool) -> f32 {
        let (start, step) = (self.position(lattice), step.as_vec3() * self.voxel_m);
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..BISECTIONS {
            let middle = (low + high) * 0.5;
            if (self.empty)(start + step * middle) == own {
                low = middle;
            } else {
                high = middle;
            }
        }
        (low + high) * 0.5 * self.voxel_m
    }
}
