//! Plates: cached views of the empty room per camera, with the light of each lamp baked in.

use flyrig_gpu::{GpuContext, GpuError, StorageBuffer};
use flyrig_types::{Camera, Intrinsics};
use glam::{DVec2, Vec2};
use rayon::prelude::*;
use wgpu::{Texture, TextureUsages};

use crate::draw::gpu_parts::{DEPTH, SAMPLES, target};

/// Side of the cells of the grid of directions, pixels.
pub(crate) const GRID_CELL_PX: f64 = 8.0;
/// Most cached cameras, more than a rig has.
const MOST: usize = 129;
/// Memory budget of plates, bytes.
const BUDGET: u64 = 1 << 30;

/// View of the empty room of a camera through one point of its lens.
#[derive(Debug, Clone)]
pub(crate) struct RoomPlate {
    camera: Camera,
    lens_point: Vec2,
    focus_m: f64,
    /// Packed light, layer by layer: ambient, each lamp, glowing objects.
    pub layers: wgpu::Buffer,
    /// Depth of every sample.
    pub depth: Texture,
    pub directions: wgpu::Buffer,
    used: u64,
}

/// Plates of one image size and scene.
#[derive(Debug)]
pub(crate) struct Plates {
    size: [u32; 2],
    layers: usize,
    kept: Vec<RoomPlate>,
    scratch: Option<RoomPlate>,
    /// Depth at pixel centres, of the cameras whose truth was requested.
    centre_depths: Vec<(Camera, Texture)>,
    directions: Vec<(Intrinsics, wgpu::Buffer)>,
    round: u64,
}

impl Plates {
    pub(crate) fn new(size: [u32; 2], layers: usize) -> Self {
        Self {
            size,
            layers,
            kept: Vec::new(),
            scratch: None,
            centre_depths: Vec::new(),
            directions: Vec::new(),
            round: 0,
        }
    }

    /// Allows plates of earlier rounds to be replaced.
    pub(crate) fn next_round(&mut self) {
        self.round += 1;
    }

    /// Returns the plate of a view, and whether it still has to be rendered.
    pub(crate) fn find(
        &mut self,
        gpu: &GpuContext,
        camera: &Camera,
        focus_m: f64,
        lens_point: Vec2,
    ) -> Result<(RoomPlate, bool), GpuError> {
        let same = |plate: &RoomPlate| {
            // Without a way off the lens's middle the focus changes nothing.
            let focus = plate.focus_m.to_bits() == focus_m.to_bits() || lens_point == Vec2::ZERO;
            plate.lens_point == lens_point && focus && plate.camera == *camera
        };
        if let Some(plate) = self.kept.iter_mut().find(|plate| same(plate)) {
            plate.used = self.round;
            return Ok((plate.clone(), false));
        }
        let pixels = u64::from(self.size[0]) * u64::from(self.size[1]);
        let each = pixels * 4 * (self.layers as u64 + u64::from(SAMPLES));
        while (self.kept.len() as u64 + 1) * each > BUDGET {
            let oldest = (0..self.kept.len()).min_by_key(|&i| self.kept[i].used);
            match oldest {
                Some(i) if self.kept[i].used < self.round => drop(self.kept.swap_remove(i)),
                _ => {
                    let mut plate = match self.scratch.take() {
                        Some(plate) => plate,
                        None => self.fresh(gpu, camera, focus_m, lens_point)?,
                    };
                    plate.directions = self.directions(gpu, &camera.intrinsics)?;
                    self.scratch = Some(plate.clone());
                    return Ok((plate, true));
                }
            }
        }
        let plate = self.fresh(gpu, camera, focus_m, lens_point)?;
        self.kept.push(plate.clone());
        Ok((plate, true))
    }

    /// Returns the cached depth at pixel centres.
    pub(crate) fn centre_depth(&self, camera: &Camera) -> Option<Texture> {
        self.centre_depths.iter().find(|(known, _)| known == camera).map(|(_, depth)| depth.clone())
    }

    /// Caches depth at pixel centres.
    pub(crate) fn keep_centre_depth(&mut self, camera: &Camera, depth: &Texture) {
        if self.centre_depths.len() >= MOST {
            self.centre_depths.clear();
        }
        self.centre_depths.push((camera.clone(), depth.clone()));
    }

    fn fresh(
        &mut self,
        gpu: &GpuContext,
        camera: &Camera,
        focus_m: f64,
        lens_point: Vec2,
    ) -> Result<RoomPlate, GpuError> {
        let [width, height] = self.size;
        let pixels = width as usize * height as usize;
        let layers = StorageBuffer::<u32>::zeroed(gpu, "layers of the room's light", pixels * self.layers)?;
        let usage = TextureUsages::COPY_SRC | TextureUsages::TEXTURE_BINDING;
        Ok(RoomPlate {
            camera: camera.clone(),
            lens_point,
            focus_m,
            layers: layers.raw().clone(),
            depth: target(gpu, "depth of the room", [width, height, 1], SAMPLES, DEPTH, usage),
            directions: self.directions(gpu, &camera.intrinsics)?,
            used: self.round,
        })
    }

    fn directions(&mut self, gpu: &GpuContext, intrinsics: &Intrinsics) -> Result<wgpu::Buffer, GpuError> {
        if let Some((_, buffer)) = self.directions.iter().find(|(known, _)| known == intrinsics) {
            return Ok(buffer.clone());
        }
        let (columns, rows) = (grid_columns(intrinsics.width), grid_columns(intrinsics.height));
        let ideal: Vec<[f32; 2]> = (0..columns * rows)
            .into_par_iter()
            .map(|i| {
                let pixel = DVec2::new((i % columns) as f64, (i / columns) as f64) * GRID_CELL_PX - 0.5;
                let distorted = (pixel - intrinsics.center_px) / intrinsics.focal_px;
                // The corners have directions (the ring was checked), and so has all between them.
                intrinsics.lens.undistort(distorted).unwrap_or(distorted).as_vec2().to_array()
            })
            .collect();
        let buffer = StorageBuffer::from_slice(gpu, "directions of pixels", &ideal)?.raw().clone();
        if self.directions.len() >= MOST {
            self.directions.clear();
        }
        self.directions.push((*intrinsics, buffer.clone()));
        Ok(buffer)
    }
}

/// Returns the number of corners of the grid's cells along a side of the image.
pub(crate) fn grid_columns(side: u32) -> usize {
    (f64::from(side) / GRID_CELL_PX).ceil() as usize + 2
}
