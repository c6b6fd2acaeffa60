//! Undoes moves of vertices that made a surface intersect itself.

use glam::Vec3;

use crate::TriMesh;
use crate::intersections::intersecting;

/// Puts the vertices of triangles that intersect others, and those around them, back to where they were `before`, until none intersects or
/// all of them are back. Returns the number of vertices put back.
pub(crate) fn untangle(mesh: &mut TriMesh, before: &[Vec3]) -> usize {
    let mut is_back = vec![false; mesh.positions.len()];
    // Each round but the last puts further vertices back.
    loop {
        let pairs = intersecting(mesh);
        let mut is_near = vec![false; mesh.positions.len()];
        for triangle in pairs.as_flattened() {
            mesh.triangles[*triangle as usize].iter().for_each(|i| is_near[*i as usize] = true);
        }
        let mut is_new = false;
        for i in mesh.triangles.iter().filter(|t| t.iter().any(|i| is_near[*i as usize])).flatten() {
            let i = *i as usize;
            is_new |= !std::mem::replace(&mut is_back[i], true);
            mesh.positions[i] = before[i];
        }
        if !is_new {
            break;
        }
    }
    is_back.iter().filter(|back| **back).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{self_intersections, shapes};

    #[test]
    fn moves_are_undone_where_they_tangle_and_kept_elsewhere() {
        let start = shapes::bumpy_sphere(20);
        let mut mesh = start.clone();
        mesh.positions.iter_mut().for_each(|p| p.y += 0.001);
        // Through the other side of the sphere.
        mesh.positions[200] = start.positions[200] + (Vec3::Y * 0.9 - start.positions[200]) * 2.4;
        assert!(self_intersections(&mesh) > 0);
        let moved = mesh.clone();
        let count = untangle(&mut mesh, &start.positions);
        assert_eq!(self_intersections(&mesh), 0);
        assert!(count > 3 && count < 400, "{count}");
        let kept = mesh.positions.iter().zip(&moved.positions).filter(|(a, b)| a == b).count();
        assert_eq!(kept + count, start.positions.len());
        assert_eq!(untangle(&mut mesh, &start.positions), 0);
    }

    #[test]
    fn surfaces_that_were_tangled_before_come_back() {
        let mut mesh = shapes::two_tori(24, 8);
        mesh.positions.iter_mut().take(24 * 8).for_each(|p| *p += Vec3::X * 0.5);
        let start = mesh.positions.clone();
        assert!(self_intersections(&mesh) > 0);
        mesh.positions.iter_mut().for_each(|p| *p *= 1.01);
        let moved = mesh.positions.clone();
        let back = untangle(&mut mesh, &start);
        assert!(back > 0 && back < start.len(), "{back}");
        let all = mesh.positions.iter().zip(start.iter().zip(&moved));
        assert!(all.clone().all(|(now, (start, moved))| now == start || now == moved));
        assert_eq!(all.filter(|(now, (start, moved))| now == start && now != moved).count(), back);
        for pair in intersecting(&mesh).as_flattened() {
            assert!(mesh.triangles[*pair as usize].iter().all(|i| mesh.positions[*i as usize] == start[*i as usize]));
        }
        assert_eq!(untangle(&mut TriMesh::default(), &[]), 0);
    }
}
