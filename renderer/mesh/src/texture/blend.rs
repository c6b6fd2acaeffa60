//! Means of the photographs' colours in each texel.

use flyrig_avatar::{Atlas, grow, srgb_bytes};
use flyrig_model::srgb;
use glam::Vec3;
use rayon::prelude::*;

use super::harmonize::Welded;
use super::inputs::{Photo, PhotoInputs, PhotoTexture};
use super::texels::{Texel, texels};
use super::view::{Look, PhotoView, PosedMesh, smooth};

/// Frames that are held at a time.
const BATCH: usize = 4;
/// Texels per task.
const CHUNK: usize = 8192;
/// View above which photographs alone make a texel: cosine between normal and ray of about 0.45.
const SEEN: f32 = 0.25;
/// Least weight of a colour unlike the Gaussians'.
const UNLIKE: f32 = 0.01;

/// Settings of [`super::photograph_texture`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotoSettings {
    /// Power of a view's quality in the sharp mean; 1 weighs all views, large values choose the best.
    pub sharpness: f32,
    /// Difference from the Gaussians' colour, in square roots of linear colour, at which a photograph has weight 0.6.
    pub tolerance: f32,
    /// Steps over which differences of the two means are smoothed on the surface; no correction at 0.
    pub steps: usize,
}

impl Default for PhotoSettings {
    fn default() -> Self {
        Self { sharpness: 6.0, tolerance: 0.25, steps: 6 }
    }
}

/// Weighted sums of a texel.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    sharp: Vec3,
    sharp_weight: f32,
    plain: Vec3,
    plain_weight: f32,
    /// Best view, 0..=1.
    seen: f32,
}

/// Sharp and plain mean of a texel; `None` where no photograph shows it.
type Means = Option<(Vec3, Vec3)>;

/// Photographs of one frame.
struct Shot<'a> {
    mesh: PosedMesh,
    views: Vec<PhotoView<'a>>,
}

/// Returns the density of pixels at which a view has weight 1, pixels per metre: that of the nearest camera in the first frame. Only
/// ratios count, but powers of small numbers vanish.
fn usual_density(inputs: &PhotoInputs<'_>) -> f32 {
    let Some(first) = inputs.photos.first() else { return 1.0 };
    let (positions, _) = (inputs.pose)(first.frame);
    let center = positions.iter().copied().sum::<Vec3>() / positions.len().max(1) as f32;
    let density = |photo: &Photo<'_>| {
        let away = photo.camera.position().as_vec3().distance(center);
        photo.camera.intrinsics.focal_px.max_element() as f32 / away
    };
    let of_frame = inputs.photos.iter().take_while(|photo| photo.frame == first.frame);
    let densities = of_frame.map(density).filter(|density| density.is_finite() && *density > 0.0);
    densities.reduce(f32::max).unwrap_or(1.0)
}

/// Numbers that all texels share. Tables are for sRGB bytes: linear colour, and its square root.
struct Tables {
    linear: [f32; 256],
    root: [f32; 256],
    /// [`usual_density`].
    density: f32,
}

/// Makes the texture of checked inputs.
pub(super) fn blend(inputs: &PhotoInputs<'_>, settings: &PhotoSettings) -> PhotoTexture {
    let linear: [f32; 256] = srgb::byte_table(f32::powf);
    let tables = Tables { linear, root: linear.map(f32::sqrt), density: usual_density(inputs) };
    let texels = texels(&inputs.mesh, inputs.unlit.side);
    let mut sums = vec![Sums::default(); texels.len()];
    let frames: Vec<&[Photo<'_>]> = inputs.photos.chunk_by(|a, b| a.frame == b.frame).collect();
    for batch in frames.chunks(BATCH) {
        let shots: Vec<Shot<'_>> = batch.par_iter().map(|photos| Shot::new(inputs, photos)).collect();
        sums.par_chunks_mut(CHUNK).zip(texels.par_chunks(CHUNK)).for_each(|(sums, texels)| {
            for shot in &shots {
                shot.add(inputs, settings, (texels, &tables), sums);
            }
        });
    }
    finish(inputs, settings, (&texels, &tables), &sums)
}

impl<'a> Shot<'a> {
    fn new(inputs: &PhotoInputs<'_>, photos: &[Photo<'a>]) -> Self {
        let (positions, normals) = (inputs.pose)(photos.first().map_or(0, |photo| photo.frame));
        let mesh = PosedMesh { positions, normals };
        // A pose of another mesh shows nothing.
        let fits = mesh.positions.len() == inputs.mesh.positions.len() && mesh.normals.len() == mesh.positions.len();
        let used = photos.iter().filter(|_| fits);
        let views = used.map(|photo| PhotoView::new(photo, &mesh, inputs.mesh.triangles)).collect();
        Self { mesh, views }
    }

    /// Adds the colours of these photographs to the sums of texels.
    fn add(
        &self,
        inputs: &PhotoInputs<'_>,
        settings: &PhotoSettings,
        (texels, tables): (&[Texel], &Tables),
        sums: &mut [Sums],
    ) {
        for view in &self.views {
            let mut rest = &mut *sums;
            for run in texels.chunk_by(|a, b| a.triangle == b.triangle) {
                let (sums, after) = std::mem::take(&mut rest).split_at_mut(run.len());
                rest = after;
                let triangle = run.first().map_or([0; 3], |texel| inputs.mesh.triangles[texel.triangle as usize]);
                let Some(facet) = view.facet(&self.mesh, triangle) else { continue };
                for (texel, sums) in run.iter().zip(sums) {
                    let Some(look) = facet.look(texel.corners(), &tables.linear) else { continue };
                    sums.add(&look, settings, (inputs, texel, tables));
                }
            }
        }
    }
}

/// Returns the largest difference of a channel from the Gaussians' colour, in square roots of linear colour.
fn difference(inputs: &PhotoInputs<'_>, texel: &Texel, unlit: Vec3, tables: &Tables) -> f32 {
    let known = &inputs.unlit.rgb[3 * texel.index as usize..][..3];
    let channel = |(value, byte): (f32, &u8)| (value.max(0.0).sqrt() - tables.root[usize::from(*byte)]).abs();
    unlit.to_array().into_iter().zip(known).map(channel).fold(0.0, f32::max)
}

/// Makes the texture of the sums.
fn finish(
    inputs: &PhotoInputs<'_>,
    settings: &PhotoSettings,
    (texels, tables): (&[Texel], &Tables),
    sums: &[Sums],
) -> PhotoTexture {
    let side = inputs.unlit.side as usize;
    let triangles = inputs.mesh.triangles;
    let means: Vec<Means> = sums.iter().map(Sums::means).collect();
    let surface = Welded::new(inputs.mesh.positions, triangles);
    let mut moved = vec![(Vec3::ZERO, 0.0); surface.places()];
    for (texel, (sums, means)) in texels.iter().zip(sums.iter().zip(&means)) {
        let Some((sharp, plain)) = means else { continue };
        for (vertex, weight) in triangles[texel.triangle as usize].iter().zip(texel.corners()) {
            let weight = weight.max(0.0) * sums.seen;
            let sum = &mut moved[surface.place(*vertex)];
            sum.0 += (*plain - *sharp) * weight;
            sum.1 += weight;
        }
    }
    let moved = surface.spread(moved, settings.steps, 1.0);
    let color = |(texel, (sums, means)): (&Texel, (&Sums, &Means))| {
        let known = &inputs.unlit.rgb[3 * texel.index as usize..][..3];
        let mut base = Vec3::from_array(std::array::from_fn(|k| tables.linear[usize::from(known[k])]));
        if let Some(shades) = inputs.baked {
            base *= texel.blend(triangles, |vertex| shades[vertex as usize]);
        }
        let Some((sharp, _)) = means else { return (base, 0.0) };
        let slow = texel.blend(triangles, |vertex| moved[surface.place(vertex)].0);
        let photo = if settings.steps == 0 { *sharp } else { *sharp + slow };
        let seen = smooth(sums.seen / SEEN);
        (base.lerp(photo, seen), seen)
    };
    let colors: Vec<(Vec3, f32)> =
        texels.par_iter().zip(sums.par_iter().zip(&means)).with_min_len(1024).map(color).collect();
    let mut image = vec![None; side * side];
    for (texel, (color, _)) in texels.iter().zip(&colors) {
        image[texel.index as usize] = Some(srgb_bytes(*color));
    }
    let seen: f64 = colors.iter().map(|(_, seen)| f64::from(*seen)).sum();
    grow(&mut image, side);
    let rest = inputs.unlit.rgb.as_chunks().0;
    let rgb = image.into_iter().zip(rest).flat_map(|(color, known)| color.unwrap_or(*known)).collect();
    PhotoTexture {
        atlas: Atlas { side: inputs.unlit.side, rgb, covered: texels.len() },
        seen: (seen / texels.len().max(1) as f64) as f32,
    }
}

impl Sums {
    /// Adds the colour of a photograph.
    fn add(
        &mut self,
        look: &Look,
        settings: &PhotoSettings,
        (inputs, texel, tables): (&PhotoInputs<'_>, &Texel, &Tables),
    ) {
        let unlit = look.rgb / Vec3::from(inputs.light.shade(look.normal));
        let off = difference(inputs, texel, unlit, tables) / settings.tolerance;
        let alike = (-0.5 * off * off).exp().max(UNLIKE);
        let rgb = if inputs.baked.is_some() { look.rgb } else { unlit };
        let quality = look.facing * (look.density / tables.density).powi(2);
        let plain = look.shown * alike * quality;
        let sharp = look.shown * alike * quality.powf(settings.sharpness);
        self.plain += rgb * plain;
        self.plain_weight += plain;
        self.sharp += rgb * sharp;
        self.sharp_weight += sharp;
        self.seen = self.seen.max(look.shown * look.facing * alike.sqrt());
    }

    /// Returns the sharp and the plain mean; `None` where no photograph shows the texel.
    fn means(&self) -> Means {
        if self.plain_weight < 1e-12 {
            return None;
        }
        let plain = self.plain / self.plain_weight;
        // Powers of small numbers vanish: the views are all poor, and any of them will do.
        let sharp = if self.sharp_weight < 1e-30 { plain } else { self.sharp / self.sharp_weight };
        Some((sharp, plain))
    }
}
