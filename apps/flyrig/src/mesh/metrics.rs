//! Numbers of `metrics.json` that every mesh has.

use flyrig_mesh::{MeshReport, Topology};
use serde_json::{Value, json};

/// Mesh that is simplified and has a texture.
pub(super) struct Finished<'a> {
    /// Fusion and surface.
    pub mesh: &'a MeshReport,
    /// Topology of the simplified mesh.
    pub topology: &'a Topology,
    /// Mean distance of the simplified mesh from the fused one, metres.
    pub simplified_by_m: f32,
    /// Charts of the texture, and the share of its texels that they cover, 0..=1.
    pub charts: u32,
    pub coverage: f32,
    /// Seconds of simplification and of the texture.
    pub simplified_s: f64,
    pub textured_s: f64,
}

impl Finished<'_> {
    /// Returns the numbers of the surface, with `more`, whose objects are joined with those of the same name.
    pub fn metrics(&self, more: Value) -> Value {
        let (mesh, topology, seconds) = (self.mesh, self.topology, &self.mesh.seconds);
        let mut metrics = json!({
            "vertices": topology.vertices,
            "triangles": topology.triangles,
            "closed_manifold": topology.is_closed_manifold(),
            "components": topology.components,
            "genus": topology.genus(),
            "self_intersections": topology.self_intersections,
            "area_m2": topology.area_m2,
            "volume_m3": topology.volume_m3,
            "fused_triangles": mesh.topology.triangles,
            "simplified_by_mm": 1e3 * self.simplified_by_m,
            "charts": self.charts,
            "texture_coverage": self.coverage,
            "hole_share": mesh.hole_share,
            "voxel_mm": 1e3 * mesh.settings.voxel_m,
            "truncation_mm": 1e3 * mesh.settings.truncation_m,
            "angle_rad": mesh.settings.angle_rad,
            "decay_mm": 1e3 * mesh.settings.decay_m,
            "blocks": mesh.blocks,
            "skipped_blocks": mesh.skipped_blocks,
            "seconds": {
                "density": seconds.density,
                "fusion": seconds.fuse,
                "signs": seconds.signs,
                "surface": seconds.surface,
                "components": seconds.components,
                "topology": seconds.topology,
                "simplification": self.simplified_s,
                "texture": self.textured_s,
            },
        });
        join(&mut metrics, more);
        metrics
    }
}

/// Adds the entries of one object to another.
fn join(all: &mut Value, more: Value) {
    match (all, more) {
        (Value::Object(all), Value::Object(more)) => {
            more.into_iter().for_each(|(name, value)| join(all.entry(name).or_insert(Value::Null), value));
        }
        (all, more) => *all = more,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_of_the_same_name_are_joined() {
        let mut all = json!({ "a": 1, "seconds": { "b": 2, "c": 3 } });
        join(&mut all, json!({ "d": [4], "seconds": { "c": 5, "e": null } }));
        assert_eq!(all, json!({ "a": 1, "d": [4], "seconds": { "b": 2, "c": 5, "e": null } }));
    }
}
