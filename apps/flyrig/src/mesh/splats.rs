//! Meshes of splat files of other tools, which have no body: static ones, without bones.

use std::{path::Path, time::Instant};

use anyhow::{Context as _, Result, bail, ensure};
use flyrig_body::write_mesh_ply;
use flyrig_gpu::GpuContext;
use flyrig_mesh::{
    MeshFile, MeshOptions, SplatMesh, SplatOptions, SplatReport, mesh_splats, write_3mf, write_glb, write_obj,
    write_usdz,
};
use flyrig_renderer::{SplatFile, SplatFilter};
use flyrig_report::{png, stop, write_whole};
use glam::Vec3;
use serde_json::json;

use super::arguments::{LightKind, MeshArgs};
use super::metrics::Finished;
use super::page::{ShownMesh, write_page};
use super::units::{Unit, Up};
use super::write::{create_surfaces, write_folder};

/// Files of packed splats, which other programs unpack.
const PACKED: [&str; 5] = ["spz", "sog", "splat", "ksplat", "lcc"];

/// Returns whether a path names splats and neither a take nor an avatar.
pub(super) fn is_splats(path: &Path) -> bool {
    let extension = extension(path);
    extension == "ply" || PACKED.contains(&extension.as_str())
}

fn extension(path: &Path) -> String {
    path.extension().map(|extension| extension.to_string_lossy().to_lowercase()).unwrap_or_default()
}

/// Meshes a splat file.
///
/// # Errors
/// The file holds no Gaussians of one person, an option does not apply to splats, or a file cannot be written.
pub(super) fn mesh_file(args: &MeshArgs, mesh: MeshOptions<'_>, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    let path = &args.take.dataset;
    check_options(args)?;
    if PACKED.contains(&extension(path).as_str()) {
        bail!(
            "{} is packed; unpack it: splat-transform {} {}",
            path.display(),
            path.display(),
            path.with_extension("ply").display()
        );
    }
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let file = SplatFile::parse(&bytes).with_context(|| format!("no mesh of {}", path.display()))?;
    drop(bytes);
    let options = SplatOptions {
        unit_m: args.unit.map_or(1.0, Unit::metres),
        filter: file.filter,
        mesh,
        triangles: args.triangles as usize,
        texture_side: args.texture,
    };
    let started = Instant::now();
    let (mesh, report) = mesh_splats(&file.splats, &gpu()?.fastest(), &options)
        .with_context(|| format!("no mesh of {}", path.display()))?;
    let seconds = started.elapsed().as_secs_f64();
    ensure!(!stop::requested(), "stopped; nothing was written");
    let written = Written { args, file: &file, mesh: &mesh, report: &report, seconds };
    write_folder(&args.out, |folder| written.write_to(folder))?;
    written.print();
    Ok(())
}

/// Checks that no option of takes or avatars is given.
fn check_options(args: &MeshArgs) -> Result<()> {
    args.check_no_take("a splat file")?;
    ensure!(
        args.motion.is_none() && args.light == LightKind::Removed,
        "{} is a splat file, without bones and with the light in its colours: leave out --motion and --light",
        args.take.dataset.display()
    );
    Ok(())
}

/// Checks that no option of splat files is given for another source.
pub(super) fn check_no_splats(args: &MeshArgs) -> Result<()> {
    ensure!(
        args.unit.is_none() && args.up.is_none(),
        "{} is no splat file (*.ply): leave out --unit and --up",
        args.take.dataset.display()
    );
    Ok(())
}

/// Mesh that is written.
struct Written<'a> {
    args: &'a MeshArgs,
    file: &'a SplatFile,
    mesh: &'a SplatMesh,
    report: &'a SplatReport,
    seconds: f64,
}

impl Written<'_> {
    fn write_to(&self, folder: &Path) -> Result<()> {
        let SplatMesh { positions, normals, uvs, triangles, texture } = self.mesh;
        // In the file's own axes, metres.
        create_surfaces(folder)?;
        write_mesh_ply(&folder.join("surface/000000.ply"), positions, normals, triangles, &[])?;
        let turn = self.args.up.unwrap_or(Up::Y).to_y();
        let turned = |vectors: &[Vec3]| -> Vec<Vec3> { vectors.iter().map(|vector| turn * *vector).collect() };
        let (positions, normals) = (turned(positions), turned(normals));
        let image = png::encode_rgb(&texture.rgb, texture.side, texture.side)?;
        let mesh = MeshFile {
            positions: &positions,
            normals: &normals,
            uvs,
            triangles,
            texture: Some(&image),
            // The colours of photographs contain the light.
            is_lit: false,
            skeleton: None,
        };
        write_glb(&folder.join("mesh.glb"), &mesh)?;
        write_obj(&folder.join("mesh.obj"), &mesh)?;
        write_usdz(&folder.join("mesh.usdz"), &mesh)?;
        write_3mf(&folder.join("mesh.3mf"), &mesh)?;
        let metrics = self.metrics();
        write_whole(&folder.join("metrics.json"), &serde_json::to_vec_pretty(&metrics)?)?;
        let shown = ShownMesh {
            positions: &positions,
            normals: &normals,
            uvs,
            triangles,
            texture: (&texture.rgb, texture.side),
        };
        let title = format!("Mesh of {}", self.args.take.dataset.display());
        write_page(folder, title, Vec::new(), &metrics, &shown)
    }

    fn metrics(&self) -> serde_json::Value {
        let SplatReport { mesh, counts, seconds: [viewed_s, simplified_s, textured_s], .. } = self.report;
        let report = self.report;
        let finished = Finished {
            mesh,
            topology: &report.topology,
            simplified_by_m: report.simplified_by_m,
            charts: report.charts,
            coverage: report.coverage,
            simplified_s: *simplified_s,
            textured_s: *textured_s,
        };
        finished.metrics(json!({
            "splats": self.args.take.dataset.display().to_string(),
            "harmonics_degree": self.file.degree,
            "flat_gaussians": self.file.is_flat,
            "filter": match self.file.filter { SplatFilter::Classic => "classic", SplatFilter::Mip => "mip" },
            "gaussians": counts.used,
            "rows_left_out": self.file.left_out,
            "invalid": counts.not_finite,
            "transparent": counts.transparent,
            "distant": counts.distant,
            "clamped": counts.clamped,
            "spacing_mm": 1e3 * report.spacing_m,
            "views": report.views[0],
            "view_pixels": report.views[1],
            "pixel_mm": 1e3 * report.pixel_m,
            "drawn_beyond_mm": 1e3 * report.drawn_beyond_m,
            "kept_vertices": report.kept_vertices,
            "points": mesh.points,
            "dropped_points": mesh.dropped.total(),
            "removed_components": mesh.removed.volumes_m3.len(),
            "unseen_texels": report.unseen_texels,
            "carved_voxels": mesh.emptied_voxels,
            "seconds": { "views": viewed_s, "carving": mesh.seconds.carve, "all": self.seconds },
        }))
    }

    fn print(&self) {
        let (report, mesh) = (self.report, &self.report.mesh);
        println!(
            "{} triangles from {} Gaussians ({} rows left out) at voxels of {:.1} mm in {:.1} s; {:.1} % of the surface closes holes; {}",
            report.topology.triangles,
            report.counts.used,
            self.file.left_out + report.counts.not_finite,
            1e3 * mesh.settings.voxel_m,
            self.seconds,
            100.0 * mesh.hole_share,
            self.args.out.join("mesh.glb").display()
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splats_are_known_by_their_extension() {
        for name in ["a.ply", "a.PLY", "b.spz", "c.sog", "d.splat"] {
            assert!(is_splats(Path::new(name)), "{name}");
        }
        for name in ["take", "a.flyavatar", "a.mcap", "ply"] {
            assert!(!is_splats(Path::new(name)), "{name}");
        }
    }
}
