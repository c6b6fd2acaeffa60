//! Messages of ROS: `sensor_msgs`, `tf2_msgs`, and `foxglove_msgs`.

use flyrig_types::Isometry;
use glam::{DQuat, DVec3};

use super::{
    cdr::Reader,
    content::{Family, ImageMessage, Kind, LensMessage, Link, Pixels},
};

/// Most transforms in a message.
const MOST_LINKS: usize = 1 << 16;

/// Reads time and frame of a `std_msgs/Header`, or the same fields of foxglove's messages.
fn header(reader: &mut Reader, family: Family) -> Result<(i64, String), String> {
    if reader.is_ros1() && family == Family::Ros {
        reader.u32()?;
    }
    Ok((reader.time()?, reader.text()?))
}

pub(super) fn image(mut reader: Reader, family: Family, kind: Kind) -> Result<ImageMessage, String> {
    let (stamp_nanos, frame_id) = header(&mut reader, family)?;
    let pixels = match (kind, family) {
        (Kind::RawImage, Family::Ros) => {
            let (height, width) = (reader.u32()?, reader.u32()?);
            let encoding = reader.text()?;
            let _is_big_endian = reader.u8()?;
            Pixels::Raw { width, height, encoding, step: reader.u32()?, data: reader.bytes()? }
        }
        (Kind::RawImage, Family::Foxglove) => {
            let (width, height) = (reader.u32()?, reader.u32()?);
            Pixels::Raw { width, height, encoding: reader.text()?, step: reader.u32()?, data: reader.bytes()? }
        }
        (_, Family::Ros) => Pixels::Compressed { format: reader.text()?, data: reader.bytes()? },
        (_, Family::Foxglove) => {
            let data = reader.bytes()?;
            Pixels::Compressed { format: reader.text()?, data }
        }
    };
    Ok(ImageMessage { stamp_nanos, frame_id, pixels })
}

pub(super) fn lens(mut reader: Reader, family: Family) -> Result<LensMessage, String> {
    let (_, frame_id) = header(&mut reader, family)?;
    let (first, second) = (reader.u32()?, reader.u32()?);
    let (width, height) = if family == Family::Ros { (second, first) } else { (first, second) };
    let model = reader.text()?;
    let count = reader.length()?;
    let d = reader.f64s(count)?;
    let (k, r, p) = (reader.f64s(9)?, reader.f64s(9)?, reader.f64s(12)?);
    let mut lens = LensMessage { frame_id, width, height, model, d, k, r, p, ..LensMessage::default() };
    if family == Family::Ros {
        lens.binning = [reader.u32()?, reader.u32()?];
        for value in &mut lens.region {
            *value = reader.u32()?;
        }
    }
    Ok(lens)
}

pub(super) fn links(mut reader: Reader, family: Family, kind: Kind) -> Result<Vec<Link>, String> {
    let count = if kind == Kind::Link { 1 } else { reader.length()? };
    if count > MOST_LINKS {
        return Err(format!("{count} transforms, at most {MOST_LINKS}"));
    }
    (0..count).map(|_| link(&mut reader, family)).collect()
}

fn link(reader: &mut Reader, family: Family) -> Result<Link, String> {
    let (_, parent) = header(reader, family)?;
    let child = reader.text()?;
    let [x, y, z, i, j, k, w] = std::array::from_fn(|_| reader.f64());
    let (translation, rotation) = (DVec3::new(x?, y?, z?), DQuat::from_xyzw(i?, j?, k?, w?));
    Ok(Link { parent, child, parent_from_child: Isometry { rotation, translation } })
}
