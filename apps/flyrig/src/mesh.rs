//! `flyrig mesh`: the person of a take, or an avatar, as a closed mesh with bones; or a splat file as one without.

mod arguments;
mod held_out;
mod metrics;
mod named;
mod page;
mod source;
mod splats;
mod texture;
mod units;
mod write;

use std::{path::Path, time::Instant};

use anyhow::{Context as _, Result, ensure};
use flyrig_gpu::GpuContext;
use flyrig_mesh::{Fusion, MeshOptions, MeshedPerson, PersonOptions};

use arguments::FusionKind;
pub use arguments::MeshArgs;
use source::Source;
use write::{MeshFolder, partial_of};

/// Runs the command.
pub fn mesh(args: &MeshArgs, gpu: &dyn Fn() -> Result<GpuContext>) -> Result<()> {
    check_target(&args.out)?;
    let mesh = MeshOptions {
        fusion: match args.fusion {
            FusionKind::Hgm => Fusion::Hgm,
            FusionKind::Naive => Fusion::Naive,
        },
        voxel_m: args.voxel,
        ..MeshOptions::default()
    };
    if splats::is_splats(&args.take.dataset) {
        return splats::mesh_file(args, mesh, gpu);
    }
    splats::check_no_splats(args)?;
    let mut source = Source::open(args, gpu)?;
    let started = Instant::now();
    let options = PersonOptions { mesh, triangles: args.triangles as usize, texture_side: args.texture };
    let (mut person, report) = MeshedPerson::of_avatar(&source.avatar, &options)
        .with_context(|| format!("no mesh of {}", args.take.dataset.display()))?;
    let photos = texture::photograph(&mut person, &source, args.light)?;
    let seconds = started.elapsed().as_secs_f64();
    let held_out = match source.held_out.take() {
        Some(cameras) => cameras.compare(&person, (&source.avatar, &source.frames), args.light, gpu)?,
        None => None,
    };
    MeshFolder {
        out: &args.out,
        source: &source,
        person: &person,
        report: &report,
        photos: &photos,
        held_out,
        seconds,
        args,
    }
    .write()
}

/// Checks before any work that the folder can be written: it is new or empty, and its parent takes folders.
fn check_target(out: &Path) -> Result<()> {
    let partial = partial_of(out)?;
    let parent = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    ensure!(parent.is_dir(), "the folder {} does not exist; make it, or choose another --out", parent.display());
    let is_empty = |path: &Path| std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    let is_free = match std::fs::symlink_metadata(out) {
        Ok(found) => found.is_dir() && is_empty(out),
        Err(_) => true,
    };
    ensure!(is_free, "{} exists already; remove it, or choose another --out", out.display());
    ensure!(
        std::fs::symlink_metadata(&partial).is_err(),
        "{} is left over from a run that still goes on or was killed; remove it if none does",
        partial.display()
    );
    std::fs::create_dir(&partial)
        .and_then(|()| std::fs::remove_dir(&partial))
        .with_context(|| format!("cannot create {}", partial.display()))
}
