//! The triangles around each vertex.

/// Returns the triangles around each of `vertices` vertices, ascending. Indices must be in range.
pub(super) fn triangles_around(vertices: usize, triangles: &[[u32; 3]]) -> Vec<Vec<u32>> {
    let mut around = vec![Vec::new(); vertices];
    for (t, triangle) in (0u32..).zip(triangles) {
        triangle.iter().for_each(|i| around[*i as usize].push(t));
    }
    around
}
