//! Texture coordinates for a mesh that has none.
//!
//! Charts are grown, flattened (least-squares conformal maps with as-rigid-as-possible refinement) and packed by uvunwrap,
//! whose result does not depend on the machine or the number of threads. Vertices are split where charts meet.

use glam::{DVec2, DVec3, Vec2, Vec3};
use uvunwrap::{Density, MeshInput, Options};

use crate::{MeshFault, TriMesh};

/// Smallest and largest texture, texels per side.
const SIDES: std::ops::RangeInclusive<u32> = 64..=16_384;

/// Reason why a mesh gets no texture coordinates.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AtlasError {
    /// The texture is too small or too large.
    #[error("a texture of {0} texels a side; choose {least} to {most}", least = SIDES.start(), most = SIDES.end())]
    Side(u32),
    /// The gutter leaves no room for charts.
    #[error("a gutter of {gutter} texels leaves no room in a texture of {side} texels a side; choose at most {most}", most = side / 16)]
    Gutter {
        /// Texels around each chart.
        gutter: u32,
        /// Texels per side.
        side: u32,
    },
    /// The mesh is faulty.
    #[error(transparent)]
    Mesh(#[from] MeshFault),
    /// The charts cannot be made.
    #[error("charts: {0}")]
    Charts(#[from] uvunwrap::Error),
    /// The mesh has no triangles with an area.
    #[error("the mesh has no surface")]
    Empty,
    /// The charts do not fit into the texture.
    #[error(
        "{charts} charts do not fit into a texture of {side} texels a side; choose a larger texture or a simpler mesh"
    )]
    Full {
        /// Number of charts.
        charts: u32,
        /// Texels per side.
        side: u32,
    },
}

/// Size of a texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AtlasSettings {
    /// Texels per side, 64..=16384.
    pub side: u32,
    /// Unused texels around each chart and along the texture's border; charts are at least twice as far apart. At most a
    /// sixteenth of the side.
    pub gutter: u32,
}

impl Default for AtlasSettings {
    fn default() -> Self {
        Self { side: 2048, gutter: 4 }
    }
}

/// Texture coordinates of a mesh, with vertices split at the borders of charts.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshAtlas {
    /// Index of the original vertex of each vertex.
    pub source: Vec<u32>,
    /// Texture coordinates of each vertex in 0..=1, v down as in glTF; charts are not mirrored.
    pub uvs: Vec<Vec2>,
    /// Chart of each vertex; 0 for vertices that only triangles without area use.
    pub chart: Vec<u32>,
    /// Triangles of the original in their order, with the new vertices' indices.
    pub triangles: Vec<[u32; 3]>,
    /// Number of charts.
    pub charts: u32,
    /// Fraction of the texture's area that shows surface.
    pub coverage: f32,
    /// Mean size of a texel on the surface, metres.
    pub texel_m: f32,
    /// Mean stretch, weighted by area. A triangle's stretch is the longest distance on it that a texel covers, relative to
    /// [`Self::texel_m`]; 1 is ideal.
    pub mean_stretch: f32,
    /// Stretch that 99 % of the area do not exceed.
    pub stretch_99: f32,
    /// Largest stretch of a triangle.
    pub worst_stretch: f32,
}

impl MeshAtlas {
    /// Returns an attribute of the original vertices for the split ones; elements out of range are skipped.
    #[must_use]
    pub fn split<T: Copy>(&self, values: &[T]) -> Vec<T> {
        self.source.iter().filter_map(|i| values.get(*i as usize).copied()).collect()
    }
}

/// Cuts a mesh into charts and places them in a square texture without overlaps. Equal input gives equal output.
///
/// # Errors
/// [`AtlasError`] for a texture or a gutter out of range, a faulty mesh, and charts that do not fit.
pub fn mesh_atlas(mesh: &TriMesh, settings: AtlasSettings) -> Result<MeshAtlas, AtlasError> {
    MeshFault::check(mesh)?;
    let AtlasSettings { side, gutter } = settings;
    if !SIDES.contains(&side) {
        return Err(AtlasError::Side(side));
    }
    if gutter > side / 16 {
        return Err(AtlasError::Gutter { gutter, side });
    }
    let positions: Vec<[f32; 3]> = mesh.positions.iter().map(Vec3::to_array).collect();
    let input = MeshInput::new(&positions, mesh.triangles.as_flattened());
    let options = Options { density: Density::Auto { page_size: side }, padding: gutter, ..Options::default() };
    let atlas = uvunwrap::generate(&[input], &options)?;
    let charts = atlas.chart_count;
    if atlas.page_count > 1 {
        return Err(AtlasError::Full { charts, side });
    }
    let Some(output) = atlas.meshes.first().filter(|_| charts > 0) else {
        return Err(AtlasError::Empty);
    };
    // The page ends below the last chart; rows count from the top of the texture once they are turned, so that charts are
    // seen from outside.
    let scale = Vec2::new(atlas.width as f32, atlas.height as f32) / side as f32;
    let uv =
        |[u, v]: [f32; 2]| (Vec2::new(u, 0.0) * scale + Vec2::new(0.0, 1.0 - v * scale.y)).clamp(Vec2::ZERO, Vec2::ONE);
    let mut result = MeshAtlas {
        source: output.vertices.iter().map(|vertex| vertex.xref).collect(),
        uvs: output.vertices.iter().map(|vertex| uv(vertex.uv)).collect(),
        chart: output.vertices.iter().map(|vertex| vertex.chart.unwrap_or(0)).collect(),
        triangles: output.indices.as_chunks().0.to_vec(),
        charts,
        coverage: 0.0,
        texel_m: 0.0,
        mean_stretch: 0.0,
        stretch_99: 0.0,
        worst_stretch: 0.0,
    };
    measure(&mut result, mesh, side);
    if result.coverage > 0.0 { Ok(result) } else { Err(AtlasError::Empty) }
}

/// Fills in coverage, texel size and stretch.
fn measure(atlas: &mut MeshAtlas, mesh: &TriMesh, side: u32) {
    let mut rows: Vec<Stretch> = Vec::with_capacity(atlas.triangles.len());
    for (new, old) in atlas.triangles.iter().zip(&mesh.triangles) {
        let uvs = new.map(|i| atlas.uvs[i as usize].as_dvec2() * f64::from(side));
        rows.extend(Stretch::new(old.map(|i| mesh.positions[i as usize].as_dvec3()), uvs));
    }
    let area: f64 = rows.iter().map(|row| row.area).sum();
    let texels: f64 = rows.iter().map(|row| row.texels).sum();
    if area <= 0.0 || texels <= 0.0 {
        return;
    }
    let texel = (area / texels).sqrt();
    rows.sort_by(|a, b| a.longest.total_cmp(&b.longest));
    let mut sum = 0.0;
    let most = rows.iter().find(|row| {
        sum += row.area;
        sum >= 0.99 * area
    });
    atlas.coverage = (texels / f64::from(side).powi(2)) as f32;
    atlas.texel_m = texel as f32;
    atlas.mean_stretch = (rows.iter().map(|row| row.area * row.longest).sum::<f64>() / area / texel) as f32;
    atlas.stretch_99 = (most.map_or(0.0, |row| row.longest) / texel) as f32;
    atlas.worst_stretch = (rows.last().map_or(0.0, |row| row.longest) / texel) as f32;
}

/// Map from the texture to the surface of one triangle.
struct Stretch {
    /// Square metres.
    area: f64,
    /// Area in the texture, square texels.
    texels: f64,
    /// Largest singular value of the map from texels to the surface (Sander et al. 2001, L-infinity stretch), metres.
    longest: f64,
}

impl Stretch {
    /// Returns `None` for triangles without area, which get no place in the texture.
    fn new([a, b, c]: [DVec3; 3], [p, q, r]: [DVec2; 3]) -> Option<Self> {
        let area = 0.5 * (b - a).cross(c - a).length();
        let double = (q - p).perp_dot(r - p);
        if area <= 1e-14 || double.abs() <= 1e-9 {
            return None;
        }
        let along_u = ((b - a) * (r.y - p.y) - (c - a) * (q.y - p.y)) / double;
        let along_v = ((c - a) * (q.x - p.x) - (b - a) * (r.x - p.x)) / double;
        let (uu, uv, vv) = (along_u.dot(along_u), along_u.dot(along_v), along_v.dot(along_v));
        let longest = (0.5 * (uu + vv + ((uu - vv).powi(2) + 4.0 * uv * uv).sqrt())).sqrt();
        Some(Self { area, texels: 0.5 * double.abs(), longest })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shapes;

    const SIDE: i32 = 512;

    /// Calls `visit(x, y)` for the texels whose centres lie in a triangle, at least `inset` texels from its edges.
    fn each_texel(uvs: [Vec2; 3], inset: f32, mut visit: impl FnMut(i32, i32)) {
        let [a, b, c] = uvs.map(|uv| uv * SIDE as f32);
        let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
        let sign = (b - a).perp_dot(c - a).signum();
        for (x, y) in (low.x as i32..high.x as i32).flat_map(|x| (low.y as i32..high.y as i32).map(move |y| (x, y))) {
            let center = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let is_inside = |p: Vec2, q: Vec2| sign * (q - p).normalize_or_zero().perp_dot(center - p) >= inset;
            if is_inside(a, b) && is_inside(b, c) && is_inside(c, a) {
                visit(x, y);
            }
        }
    }

    #[test]
    fn charts_do_not_overlap_and_keep_their_gutter() {
        for mesh in [shapes::bumpy_sphere(30), shapes::two_tori(80, 24)] {
            let atlas = mesh_atlas(&mesh, AtlasSettings { side: SIDE as u32, gutter: 4 }).unwrap();
            let mut counts = vec![0u32; (SIDE * SIDE) as usize];
            let mut owner = vec![u32::MAX; (SIDE * SIDE) as usize];
            for (new, old) in atlas.triangles.iter().zip(&mesh.triangles) {
                assert_eq!(new.map(|i| atlas.source[i as usize]), *old);
                let chart = atlas.chart[new[0] as usize];
                assert!(new.iter().all(|i| atlas.chart[*i as usize] == chart));
                let uvs = new.map(|i| atlas.uvs[i as usize]);
                // Seen from outside, the texture is not mirrored: v points down.
                assert!((uvs[1] - uvs[0]).perp_dot(uvs[2] - uvs[0]) < 0.0);
                each_texel(uvs, 0.01, |x, y| counts[(y * SIDE + x) as usize] += 1);
                each_texel(uvs, 0.0, |x, y| owner[(y * SIDE + x) as usize] = chart);
            }
            assert!(counts.iter().all(|n| *n <= 1), "triangles overlap");
            for (x, y) in (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| (x, y))) {
                let chart = owner[(y * SIDE + x) as usize];
                if chart == u32::MAX {
                    continue;
                }
                assert!((4..SIDE - 4).contains(&x) && (4..SIDE - 4).contains(&y), "{x} {y}");
                for (u, v) in (x - 8..=x + 8).flat_map(|u| (y - 8..=y + 8).map(move |v| (u, v))) {
                    if (0..SIDE).contains(&u) && (0..SIDE).contains(&v) {
                        let other = owner[(v * SIDE + u) as usize];
                        assert!(other == u32::MAX || other == chart, "charts {chart} and {other} at {x} {y}");
                    }
                }
            }
            let covered = owner.iter().filter(|chart| **chart != u32::MAX).count() as f32 / (SIDE * SIDE) as f32;
            assert!((covered - atlas.coverage).abs() < 0.02 && atlas.coverage > 0.35, "{covered} {}", atlas.coverage);
            assert!(atlas.mean_stretch < 1.15 && atlas.worst_stretch < 3.0);
            assert_eq!(atlas.split(&mesh.positions).len(), atlas.uvs.len());
            assert_eq!(atlas, mesh_atlas(&mesh, AtlasSettings { side: SIDE as u32, gutter: 4 }).unwrap());
        }
    }

    /// A flat square of 1 m fills the texture with equal texels.
    #[test]
    fn a_flat_square_has_no_stretch() {
        let corner = |i: u32| Vec3::new((i & 1) as f32, (i >> 1) as f32, 0.0);
        let mesh = TriMesh {
            positions: (0..4).map(corner).collect(),
            triangles: vec![[0, 1, 3], [0, 3, 2]],
            from_hole: Vec::new(),
        };
        let atlas = mesh_atlas(&mesh, AtlasSettings { side: 256, gutter: 4 }).unwrap();
        assert_eq!(atlas.charts, 1);
        assert!((atlas.mean_stretch - 1.0).abs() < 1e-4 && (atlas.worst_stretch - 1.0).abs() < 1e-4);
        assert!(
            (atlas.texel_m - 1.0 / 248.0).abs() < 2e-4 && atlas.coverage > 0.85,
            "{} {}",
            atlas.texel_m,
            atlas.coverage
        );
    }

    /// A chart twice as long as wide on the surface, square in the texture.
    #[test]
    fn stretch_is_the_longest_side_of_a_texel() {
        let positions = [DVec3::ZERO, DVec3::X * 2.0, DVec3::Y];
        let stretch = Stretch::new(positions, [DVec2::ZERO, DVec2::X * 10.0, DVec2::Y * 10.0]).unwrap();
        assert!((stretch.longest - 0.2).abs() < 1e-12 && (stretch.area - 1.0).abs() < 1e-12);
        assert!(Stretch::new(positions, [DVec2::ZERO; 3]).is_none());
    }

    #[test]
    fn faulty_meshes_and_sizes_are_refused() {
        let message = |change: fn(&mut TriMesh), side, gutter| {
            let mut mesh = shapes::bumpy_sphere(4);
            change(&mut mesh);
            mesh_atlas(&mesh, AtlasSettings { side, gutter }).unwrap_err().to_string()
        };
        assert!(message(|_| (), 5, 4).contains("choose 64 to 16384"));
        assert!(message(|_| (), 64, 5).contains("choose at most 4"));
        assert_eq!(message(|m| m.triangles.clear(), 64, 4), "the mesh has no surface");
        assert_eq!(message(|m| m.positions.fill(Vec3::ONE), 64, 4), "the mesh has no surface");
        assert_eq!(message(|m| m.positions[3].x = f32::NAN, 64, 4), "vertex 3 is not a finite number");
        assert!(message(|m| m.triangles[0][1] = 1 << 30, 64, 4).contains("refers to vertex 1073741824 of 162"));
    }
}
