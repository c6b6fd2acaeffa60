//! Several simulated people in one room, composited by depth.

use std::sync::Arc;

use anyhow::{Context, Result};
use flyrig_sim::{SimFrame, Simulator};
use flyrig_types::{Frame, FrameSet, Image, Mask, PixelFormat, Rig};

/// Slots of the input cameras on the ring.
pub const INPUTS: [usize; 4] = [0, 2, 4, 6];
/// Slots of the held-out cameras.
pub const HELD_OUT: [usize; 3] = [1, 3, 5];

/// Composites the views of people by one camera, the nearest in front: image, mask, and the index of the person whom each pixel shows.
fn composite(frames: &[SimFrame]) -> Result<(Image, Mask, Vec<usize>)> {
    let first = frames.first().context("no person was chosen")?;
    let (width, height) = (first.color.width(), first.color.height());
    let mut rgb = first.color.bytes().to_vec();
    let mut coverage = first.mask.coverage().to_vec();
    let mut depth = first.depth.clone();
    let mut shown = vec![0; depth.len()];
    for (who, frame) in frames.iter().enumerate().skip(1) {
        for i in 0..depth.len() {
            let (own, cover) = (frame.depth[i], u32::from(frame.mask.coverage()[i]));
            let in_front = own > 0.0 && (depth[i] <= 0.0 || own < depth[i]);
            if cover == 0 || !(in_front || depth[i] <= 0.0) {
                continue;
            }
            for c in 0..3 {
                let (over, under) = (u32::from(frame.color.bytes()[3 * i + c]), u32::from(rgb[3 * i + c]));
                rgb[3 * i + c] = ((over * cover + under * (255 - cover) + 127) / 255) as u8;
            }
            coverage[i] = coverage[i].max(frame.mask.coverage()[i]);
            if in_front {
                depth[i] = own;
                shown[i] = who;
            }
        }
    }
    Ok((Image::new(width, height, PixelFormat::Rgb8, rgb)?, Mask::new(width, height, coverage)?, shown))
}

/// Renders the chosen people as one camera sees them; see [`composite`].
pub fn capture(
    people: &mut [Simulator],
    chosen: &[usize],
    nanos: i64,
    slot: usize,
) -> Result<(Image, Mask, Vec<usize>)> {
    let frames = chosen.iter().map(|&who| Ok(people[who].render(nanos, slot)?)).collect::<Result<Vec<_>>>()?;
    composite(&frames)
}

/// Renders the chosen people into the input cameras.
pub fn frame_set(people: &mut [Simulator], chosen: &[usize], rig: &Rig, index: u64, nanos: i64) -> Result<FrameSet> {
    let frame = |slot: usize| -> Result<Option<Arc<Frame>>> {
        let (image, mask, _) = capture(people, chosen, nanos, slot)?;
        Ok(Some(Arc::new(Frame {
            camera: rig.cameras[slot].id.clone(),
            sequence: index,
            capture_nanos: nanos,
            exposure_nanos: None,
            image,
            mask: Some(mask),
        })))
    };
    Ok(FrameSet { index, master_nanos: nanos, frames: INPUTS.into_iter().map(frame).collect::<Result<_>>()? })
}
