//! `flyrig mesh`: the person of a take, or an avatar, as a closed mesh with bones.

mod arguments;
mod source;
mod write;

use std::{path::Path, time::Instant};

use anyhow::{Context as _, Result, ensure};
use flyrig_gpu::GpuContext;
use flyrig_mesh::{Fusion, MeshOptions, MeshedPerson, PersonOptions};

use arguments::FusionKind;
pub use arguments::MeshArgs;
use source::Source;
use write::MeshFolder;

/// Runs the command.
pub fn mesh(args: &MeshArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    check_target(&args.out)?;
    let source = Source::open(args, gpu)?;
    let started = Instant::now();
    let mesh = MeshOptions {
        fusion: match args.fusion {
            FusionKind::Hgm => Fusion::Hgm,
            FusionKind::Naive => Fusion::Naive,
        },
        voxel_m: args.voxel,
        ..MeshOptions::default()
    };
    let options = PersonOptions { mesh, triangles: args.triangles as usize, texture_side: args.texture };
    let (person, report) = MeshedPerson::of_avatar(&source.avatar, &options)
        .with_context(|| format!("no mesh of {}", args.take.dataset.display()))?;
    let seconds = started.elapsed().as_secs_f64();
    MeshFolder { out: &args.out, source: &source, person: &person, report: &report, seconds, args }.write()
}

/// Checks that the folder can be written to, before any work.
fn check_target(out: &Path) -> Result<()> {
    let parent = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(parent.is_dir(), "the folder {} does not exist; make it, or choose another --out", parent.display());
    let taken = out.is_file() || std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some());
    ensure!(!taken, "{} exists already; remove it, or choose another --out", out.display());
    Ok(())
}
