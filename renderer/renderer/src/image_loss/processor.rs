//! `image_loss.wgsl` on the processor. Threads share rows; sums run per row, in the order of the rows.

use std::array::from_fn;

use flyrig_gpu::StorageBuffer;
use glam::Vec4;
use rayon::prelude::*;

use crate::backward::gradients::ImageGradients;
use crate::image_loss::settings::{LossConstants, SUMS, UNKNOWN_RGBA};

/// Converts sRGB bytes with coverage to premultiplied linear colour at the compared size; negative where the image is
/// unknown.
pub(super) fn unpack(
    loss: &LossConstants,
    bytes: &StorageBuffer<u32>,
    linear: &StorageBuffer<f32>,
    wanted: &StorageBuffer<[f32; 4]>,
) {
    let (Some(bytes), Some(linear), Some(mut wanted)) = (bytes.slice(), linear.slice(), wanted.slice_mut()) else {
        return;
    };
    let Some(linear) = linear.first_chunk::<256>() else { return };
    let (shrink, source_width) = (loss.shrink as usize, loss.source_width as usize);
    rows(loss, &mut wanted).for_each(|(y, row)| {
        for (offset, out) in row.iter_mut().enumerate() {
            let x = loss.first[0] as usize + offset;
            let (mut sum, mut unknown) = (Vec4::ZERO, 0);
            for v in 0..shrink {
                let at = (y * shrink + v) * source_width + x * shrink;
                for word in &bytes[at..at + shrink] {
                    let [red, green, blue, mask] = word.to_le_bytes();
                    unknown += u32::from(word.to_le_bytes() == UNKNOWN_RGBA);
                    let channel = |byte: u8| linear[usize::from(byte)];
                    sum += Vec4::new(channel(red), channel(green), channel(blue), 1.0) * (f32::from(mask) / 255.0);
                }
            }
            let count = loss.shrink * loss.shrink;
            let is_unknown = loss.with_unknown != 0 && 2 * unknown > count;
            *out = if is_unknown { [-1.0 / count as f32; 4] } else { (sum / count as f32).to_array() };
        }
    });
}

/// Compares a rendered image with the wanted one.
pub(super) fn compare(
    loss: &LossConstants,
    wanted: &StorageBuffer<[f32; 4]>,
    rendered: &StorageBuffer<[f32; 4]>,
    out: &ImageGradients,
    sums: &StorageBuffer<[f32; 4]>,
) {
    let (Some(wanted), Some(rendered), Some(mut sums)) = (wanted.slice(), rendered.slice(), sums.slice_mut()) else {
        return;
    };
    let (Some(mut d_color), Some(mut d_carry)) = (out.color.slice_mut(), out.depth_carry.slice_mut()) else { return };
    let width = loss.size[0] as usize;
    let [left, top] = loss.first.map(|side| side as usize);
    let [right, bottom] = from_fn(|i| (loss.first[i] + loss.area[i]) as usize - 1);
    let weights = Vec4::new(loss.color_weight, loss.color_weight, loss.color_weight, loss.mask_weight);
    let along = 2.0 * weights;
    let outs = rows(loss, &mut d_color).zip(rows(loss, &mut d_carry));
    let row_sums: Vec<[f32; 4]> = outs
        .map(|((y, d_color), (_, d_carry))| {
            let mut sums = [0.0; 4];
            for (offset, (d_color, d_carry)) in d_color.iter_mut().zip(d_carry).enumerate() {
                let x = left + offset;
                let at = y * width + x;
                let goal = Vec4::from(wanted[at]);
                if goal.w < 0.0 {
                    (*d_color, *d_carry) = ([0.0; 4], [0.0; 4]);
                    continue;
                }
                let off = Vec4::from(rendered[at]) - goal;
                let squared = off.truncate().length_squared();
                sums[0] += loss.color_weight * squared + loss.mask_weight * off.w * off.w;
                sums[1] += off.w * off.w;
                sums[2] += goal.w * squared;
                sums[3] += goal.w;
                *d_color = (along * off).to_array();
                *d_carry = [0.0; 4];
                if x > left && y > top && x < right && y < bottom {
                    let slope = |after: usize, before: usize| {
                        0.5 * (Vec4::from(rendered[after]) - Vec4::from(rendered[before]))
                    };
                    let (dx, dy) = (slope(at + 1, at - 1), slope(at + width, at - width));
                    *d_carry = [0.0, (along * dx).dot(dx), (along * dx).dot(dy), (along * dy).dot(dy)];
                }
            }
            sums
        })
        .collect();
    // As many sums as the device has, each over neighbouring rows.
    let share = row_sums.len().div_ceil(SUMS as usize).max(1);
    let sums = &mut sums[loss.sums_at as usize..][..SUMS as usize];
    for (sum, rows) in sums.iter_mut().zip(row_sums.chunks(share)) {
        *sum = rows.iter().fold([0.0; 4], |sum, row| from_fn(|i| sum[i] + row[i]));
    }
}

/// Returns the rows of the area within an image: row number, and the part of the row in the area.
fn rows<'a>(
    loss: &LossConstants,
    picture: &'a mut [[f32; 4]],
) -> impl IndexedParallelIterator<Item = (usize, &'a mut [[f32; 4]])> {
    let (first, area) = (loss.first.map(|side| side as usize), loss.area.map(|side| side as usize));
    let rows = picture.par_chunks_mut(loss.size[0] as usize).enumerate().skip(first[1]).take(area[1]);
    rows.map(move |(y, row)| (y, &mut row[first[0]..first[0] + area[0]])).with_min_len(8)
}
