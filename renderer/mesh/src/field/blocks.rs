//! Storage of the field: a box of blocks, of which those near the surface are stored.

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::error::MeshError;

use super::lattice::{SIDE, VOXELS, directions, layer, local_of, seal};

/// Largest number of blocks of the box, 4 bytes each.
const MAX_GRID_BLOCKS: usize = 1 << 22;
/// Largest number of stored blocks, 2.5 KiB each.
const MAX_STORED_BLOCKS: usize = 1 << 17;
/// Slot of blocks that are not stored.
const NONE: u32 = u32::MAX;

/// Source of a voxel's distance.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Evidence {
    /// Nearby points.
    Points,
    /// No evidence: the winding number of all points decided.
    Unknown,
    /// Cut away: known to be empty.
    Empty,
}

/// One stored voxel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Voxel {
    /// Centre in the world, metres.
    pub center: Vec3,
    /// Signed distance to the surface, positive outside, clamped to the truncation distance; metres.
    pub distance_m: f32,
    /// Source of the distance.
    pub evidence: Evidence,
}

/// Fills the distances and sources of the block at the given coordinates.
pub type Fill<'a> = &'a (dyn Fn(IVec3, &mut [f32], &mut [Evidence]) + Sync);

/// Signed distances on a lattice of voxels: a box of 8 x 8 x 8 blocks, of which those near the surface are stored. A
/// block that is not stored lies entirely inside or entirely outside.
#[derive(Debug, Clone)]
pub struct Field {
    origin: Vec3,
    voxel_m: f32,
    truncation_m: f32,
    /// Size of the box, blocks.
    size: IVec3,
    /// Slot of each block of the box; `NONE` if it is not stored.
    slots: Vec<u32>,
    /// Whether a block that is not stored lies inside.
    inside: Vec<bool>,
    /// Coordinates of the stored blocks.
    blocks: Vec<IVec3>,
    distances: Vec<f32>,
    evidence: Vec<Evidence>,
}

impl Field {
    /// Makes an empty box around points between `low` and `high`, metres, wide enough for their evidence.
    ///
    /// # Errors
    /// [`MeshError::Extent`] if the box would have more than 4 194 304 blocks.
    pub(crate) fn around(low: Vec3, high: Vec3, voxel_m: f32, truncation_m: f32) -> Result<Self, MeshError> {
        let margin = f64::from(truncation_m) + 2.0 * f64::from(voxel_m);
        let (low, high) = (low.as_dvec3() - margin, high.as_dvec3() + margin);
        let extent = high - low;
        let size = (extent / (f64::from(voxel_m) * f64::from(SIDE))).ceil().max(DVec3::ONE);
        let blocks = size.element_product();
        if blocks.is_nan() || blocks > MAX_GRID_BLOCKS as f64 {
            let extent_m = extent.as_vec3().to_array();
            return Err(MeshError::Extent { voxel_m, extent_m, blocks, limit: MAX_GRID_BLOCKS });
        }
        Ok(Self {
            origin: low.as_vec3(),
            voxel_m,
            truncation_m,
            size: size.as_ivec3(),
            slots: vec![NONE; blocks as usize],
            inside: vec![false; blocks as usize],
            blocks: Vec::new(),
            distances: Vec::new(),
            evidence: Vec::new(),
        })
    }

    /// Makes a field of `blocks` blocks along each axis, all stored, with the given distances by place on the lattice.
    #[cfg(test)]
    pub(crate) fn from_values(blocks: i32, voxel_m: f32, value: impl Fn(IVec3) -> f32 + Sync) -> Self {
        let high = Vec3::splat((blocks * SIDE) as f32 * voxel_m * 0.999 - 6.0 * voxel_m);
        let mut field = Self::around(Vec3::ZERO, high, voxel_m, voxel_m).unwrap();
        let all = field.skipped_blocks();
        let fill = |block: IVec3, distances: &mut [f32], evidence: &mut [Evidence]| {
            evidence.fill(Evidence::Points);
            for (voxel, distance) in distances.iter_mut().enumerate() {
                *distance = value(block * SIDE + local_of(voxel));
            }
        };
        field.store(&all, &fill).unwrap();
        field
    }

    /// Returns the side of a voxel, metres.
    #[must_use]
    pub fn voxel_m(&self) -> f32 {
        self.voxel_m
    }

    /// Returns the bound of the distances, metres.
    #[must_use]
    pub fn truncation_m(&self) -> f32 {
        self.truncation_m
    }

    /// Returns the number of stored blocks.
    #[must_use]
    pub fn stored_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Returns the number of blocks of the box, stored or not.
    #[must_use]
    pub fn grid_blocks(&self) -> usize {
        self.slots.len()
    }

    /// Iterates over all stored voxels in a fixed order.
    pub fn voxels(&self) -> impl Iterator<Item = Voxel> {
        self.blocks.iter().enumerate().flat_map(move |(slot, block)| {
            (0..VOXELS).map(move |voxel| Voxel {
                center: self.center(*block, voxel),
                distance_m: self.distances[slot * VOXELS + voxel],
                evidence: self.evidence[slot * VOXELS + voxel],
            })
        })
    }

    /// Returns the coordinates of the stored blocks, by slot.
    pub(crate) fn blocks(&self) -> &[IVec3] {
        &self.blocks
    }

    /// Returns the coordinates of all blocks of the box that are not stored.
    pub(crate) fn skipped_blocks(&self) -> Vec<IVec3> {
        let skipped = self.slots.iter().enumerate().filter(|(_, slot)| **slot == NONE);
        skipped.map(|(at, _)| self.coordinates(at)).collect()
    }

    fn coordinates(&self, at: usize) -> IVec3 {
        let at = at as i32;
        IVec3::new(at % self.size.x, at / self.size.x % self.size.y, at / (self.size.x * self.size.y))
    }

    /// Returns the index in the box of the block at `block`; `None` outside the box.
    fn index(&self, block: IVec3) -> Option<usize> {
        let inside = block.cmpge(IVec3::ZERO).all() && block.cmplt(self.size).all();
        inside.then(|| ((block.z * self.size.y + block.y) * self.size.x + block.x) as usize)
    }

    /// Returns the slot of a stored block.
    pub(crate) fn slot(&self, block: IVec3) -> Option<usize> {
        self.index(block).map(|at| self.slots[at]).filter(|slot| *slot != NONE).map(|slot| slot as usize)
    }

    /// Returns whether the block lies in the box, is not stored and lies inside the surface.
    pub(crate) fn skipped_inside(&self, block: IVec3) -> bool {
        self.index(block).is_some_and(|at| self.slots[at] == NONE && self.inside[at])
    }

    /// Returns distances and sources of a stored block.
    pub(crate) fn block(&self, slot: usize) -> (&[f32], &[Evidence]) {
        let range = slot * VOXELS..(slot + 1) * VOXELS;
        (&self.distances[range.clone()], &self.evidence[range])
    }

    /// Returns the centre of a voxel, metres.
    pub(crate) fn center(&self, block: IVec3, voxel: usize) -> Vec3 {
        self.position(block * SIDE + local_of(voxel))
    }

    /// Returns the world position of a place on the lattice, metres.
    pub(crate) fn position(&self, lattice: IVec3) -> Vec3 {
        self.origin + lattice.as_vec3() * self.voxel_m
    }

    /// Returns the blocks that may have voxels within `radius` metres of a point, in order.
    pub(crate) fn blocks_touched(&self, points: &[Vec3], radius: f32) -> Vec<IVec3> {
        let block = |point: Vec3| {
            let block = ((point - self.origin) / (self.voxel_m * SIDE as f32)).floor().as_ivec3();
            block.clamp(IVec3::ZERO, self.size - 1)
        };
        let mut touched = vec![false; self.slots.len()];
        for point in points {
            let (low, high) = (block(point - radius), block(point + radius));
            for z in low.z..=high.z {
                for y in low.y..=high.y {
                    let row = (z * self.size.y + y) * self.size.x;
                    touched[(row + low.x) as usize..=(row + high.x) as usize].fill(true);
                }
            }
        }
        touched.iter().enumerate().filter(|(_, touched)| **touched).map(|(at, _)| self.coordinates(at)).collect()
    }

    /// Sets on which side the blocks that are not stored lie, in the order of [`Self::skipped_blocks`]; those at the faces
    /// of the box stay outside.
    pub(crate) fn set_skipped(&mut self, blocks: &[IVec3], inside: &[bool]) {
        for (block, inside) in blocks.iter().zip(inside) {
            let border = block.cmple(IVec3::ZERO).any() || block.cmpge(self.size - 1).any();
            if let Some(at) = self.index(*block) {
                self.inside[at] = *inside && !border;
            }
        }
    }

    /// Returns which of the blocks that are not stored have a neighbour of the other side that is not stored either.
    pub(crate) fn disagreeing_skipped(&self, blocks: &[IVec3]) -> Vec<IVec3> {
        let disagrees = |block: &&IVec3| {
            let own = self.skipped_inside(**block);
            directions().any(|direction| {
                self.index(**block + direction).is_some_and(|at| self.slots[at] == NONE && self.inside[at] != own)
            })
        };
        blocks.par_iter().with_min_len(256).filter(disagrees).copied().collect()
    }

    /// Stores further blocks and fills them in parallel. Blocks outside the box and stored ones are passed over.
    ///
    /// # Errors
    /// [`MeshError::Extent`] if more than 131 072 blocks would be stored.
    pub(crate) fn store(&mut self, blocks: &[IVec3], fill: Fill) -> Result<(), MeshError> {
        let first = self.blocks.len();
        for block in blocks {
            let Some(at) = self.index(*block).filter(|at| self.slots[*at] == NONE) else { continue };
            self.slots[at] = self.blocks.len() as u32;
            self.blocks.push(*block);
        }
        if self.blocks.len() > MAX_STORED_BLOCKS {
            let extent_m = (self.size * SIDE).as_vec3() * self.voxel_m;
            return Err(MeshError::Extent {
                voxel_m: self.voxel_m,
                extent_m: extent_m.to_array(),
                blocks: self.blocks.len() as f64,
                limit: MAX_STORED_BLOCKS,
            });
        }
        self.distances.resize(self.blocks.len() * VOXELS, self.truncation_m);
        self.evidence.resize(self.blocks.len() * VOXELS, Evidence::Unknown);
        self.refill_from(first, fill);
        Ok(())
    }

    /// Runs `fill` on all stored blocks in parallel.
    pub(crate) fn refill(&mut self, fill: Fill) {
        self.refill_from(0, fill);
    }

    fn refill_from(&mut self, first: usize, fill: Fill) {
        let (size, truncation) = (self.size, self.truncation_m);
        let distances = self.distances[first * VOXELS..].par_chunks_mut(VOXELS);
        let evidence = self.evidence[first * VOXELS..].par_chunks_mut(VOXELS);
        distances.zip(evidence).zip(&self.blocks[first..]).for_each(|((distances, evidence), block)| {
            fill(*block, distances, evidence);
            seal(*block, size, truncation, distances);
        });
    }

    /// Stores blocks until no stored voxel has a neighbour on the other side in a block that is not stored. The surface
    /// is closed afterwards.
    ///
    /// # Errors
    /// [`MeshError::Extent`] if too many blocks would be stored.
    pub(crate) fn settle(&mut self, fill: Fill) -> Result<(), MeshError> {
        let mut checked = 0;
        while checked < self.blocks.len() {
            let mut wanted: Vec<IVec3> =
                (checked..self.blocks.len()).into_par_iter().flat_map_iter(|slot| self.wanted_by(slot)).collect();
            wanted.sort_unstable_by_key(|block| (block.z, block.y, block.x));
            wanted.dedup();
            checked = self.blocks.len();
            self.store(&wanted, fill)?;
        }
        Ok(())
    }

    /// Returns the neighbours of a stored block that are not stored and lie on the other side than its voxels beside them.
    fn wanted_by(&self, slot: usize) -> Vec<IVec3> {
        let (block, (distances, _)) = (self.blocks[slot], self.block(slot));
        let wanted = |direction: &IVec3| {
            let at = self.index(block + *direction).filter(|at| self.slots[*at] == NONE);
            at.is_some_and(|at| layer(*direction).any(|voxel| (distances[voxel] < 0.0) != self.inside[at]))
        };
        directions().filter(wanted).map(|direction| block + direction).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_stored_until_the_surface_is_closed() {
        let mut field = Field::around(Vec3::ZERO, Vec3::ONE, 0.01, 0.03).unwrap();
        let center = Vec3::splat(0.5);
        let origin = field.origin;
        let fill = move |block: IVec3, distances: &mut [f32], _: &mut [Evidence]| {
            for (voxel, distance) in distances.iter_mut().enumerate() {
                let place = origin + (block * SIDE + local_of(voxel)).as_vec3() * 0.01;
                *distance = place.distance(center) - 0.3;
            }
        };
        let start = field.blocks_touched(&[Vec3::new(0.5, 0.5, 0.8)], 0.0)[0];
        field.set_skipped(&field.blocks_touched(&[center], 0.0), &[true]);
        field.store(&[start], &fill).unwrap();
        field.settle(&fill).unwrap();
        // All blocks of the sphere's surface were reached from one of them, and the one inside it was not stored.
        let expected = field.skipped_blocks().into_iter().filter(|block| {
            let signs: Vec<bool> = (0..VOXELS).map(|v| field.center(*block, v).distance(center) < 0.3).collect();
            signs.contains(&true) && signs.contains(&false)
        });
        assert_eq!(expected.count(), 0);
        assert!(field.stored_blocks() < field.grid_blocks());
    }
}
