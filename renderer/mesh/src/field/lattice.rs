//! Places of voxels within blocks.

use glam::IVec3;

/// Voxels along the side of a block.
pub const SIDE: i32 = 8;
/// Voxels of a block.
pub const VOXELS: usize = 512;

/// Returns the index within a block of the voxel at `local`, each in `0..8`.
pub fn voxel_of(local: IVec3) -> usize {
    ((local.z * SIDE + local.y) * SIDE + local.x) as usize
}

/// Returns the place in its block of a voxel with an index below 512.
pub fn local_of(voxel: usize) -> IVec3 {
    let voxel = voxel as i32;
    IVec3::new(voxel % SIDE, voxel / SIDE % SIDE, voxel / (SIDE * SIDE))
}

/// Returns the 26 directions of neighbours.
pub fn directions() -> impl Iterator<Item = IVec3> {
    (0..27).filter(|i| *i != 13).map(|i| IVec3::new(i % 3, i / 3 % 3, i / 9) - 1)
}

/// Returns the voxels of a block that touch its neighbour in `direction`.
pub fn layer(direction: IVec3) -> impl Iterator<Item = usize> {
    let ends = direction.to_array().map(|step| match step {
        -1 => (0, 1),
        1 => (SIDE - 1, SIDE),
        _ => (0, SIDE),
    });
    (ends[2].0..ends[2].1).flat_map(move |z| {
        (ends[1].0..ends[1].1).flat_map(move |y| (ends[0].0..ends[0].1).map(move |x| voxel_of(IVec3::new(x, y, z))))
    })
}

/// Puts the outermost voxels of the box outside.
pub fn seal(block: IVec3, size: IVec3, truncation_m: f32, distances: &mut [f32]) {
    for axis in 0..3 {
        for (face, step) in [(0, -1), (size[axis] - 1, 1)] {
            if block[axis] == face {
                let mut direction = IVec3::ZERO;
                direction[axis] = step;
                layer(direction).for_each(|voxel| distances[voxel] = distances[voxel].max(truncation_m));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_have_one_index_each() {
        assert!((0..VOXELS).all(|voxel| voxel_of(local_of(voxel)) == voxel));
        assert_eq!(directions().count(), 26);
        assert_eq!(layer(IVec3::new(0, 0, 1)).collect::<Vec<_>>(), (448..512).collect::<Vec<_>>());
        assert_eq!(layer(IVec3::new(-1, -1, 0)).count(), 8);
        assert_eq!(layer(IVec3::ONE).collect::<Vec<_>>(), [511]);
    }
}
