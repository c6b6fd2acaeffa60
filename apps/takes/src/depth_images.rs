//! Depth images of a take's cameras: of depth cameras, of another program, or of the simulator.

use std::{
    io::{BufReader, Cursor},
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, bail, ensure};
use exr::prelude::{ReadChannels as _, ReadLayers as _, ReadSpecificChannel as _, read};
use flyrig_types::{Camera, MAX_IMAGE_SIDE};
use image::{DynamicImage, ImageFormat, ImageReader, Limits};

/// Folder with one folder of depth images per camera: `CAM/000000.exr`, channel `Z`, metres, or `CAM/000000.png`, 16-bit grey, millimetres,
/// 0 where nothing is known. The number is that of the frame in the take; depth is along the optical axis.
#[derive(Debug, Clone)]
pub struct DepthFolder {
    root: PathBuf,
}

impl DepthFolder {
    /// Opens the depth images of some cameras.
    ///
    /// # Errors
    /// No camera has a folder.
    pub fn open(root: &Path, cameras: &[Camera]) -> Result<Self> {
        let names: Vec<&str> = cameras.iter().map(|camera| camera.id.as_str()).collect();
        ensure!(
            names.iter().any(|name| root.join(name).is_dir()),
            "{} has no folder of an input camera ({}); depth images lie in {}/000000.exr (channel Z, metres) or .png (16-bit grey, millimetres)",
            root.display(),
            names.join(", "),
            root.join(names.first().unwrap_or(&"CAM")).display()
        );
        Ok(Self { root: root.to_owned() })
    }

    /// Reads the depths of a camera's frame, metres, row by row; `None` without a file.
    ///
    /// # Errors
    /// Names a file that is damaged, has no depths, or has another size than the camera's images.
    pub fn read(&self, camera: &Camera, number: u64) -> Result<Option<Vec<f32>>> {
        for (ending, parse) in [("exr", parse_exr as fn(&[u8], [usize; 2]) -> Result<Vec<f32>>), ("png", parse_png)] {
            let path = self.root.join(camera.id.as_str()).join(format!("{number:06}.{ending}"));
            let bytes = match std::fs::read(&path) {
                Ok(bytes) => bytes,
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                Err(error) => return Err(error).with_context(|| format!("cannot read {}", path.display())),
            };
            let size = camera.size().map(|side| side as usize);
            return parse(&bytes, size).map(Some).with_context(|| format!("{} is no depth image", path.display()));
        }
        Ok(None)
    }
}

fn ensure_size([width, height]: [usize; 2], of_camera: [usize; 2]) -> Result<()> {
    let [columns, rows] = of_camera;
    ensure!(
        [width, height] == of_camera,
        "it has {width}x{height} pixels, and the images of its camera {columns}x{rows}; give the depth of each pixel"
    );
    Ok(())
}

fn parse_exr(bytes: &[u8], size: [usize; 2]) -> Result<Vec<f32>> {
    // Sizes are compared before anything is allocated.
    let meta =
        exr::meta::MetaData::read_from_buffered(Cursor::new(bytes), false).context("it is damaged or cut off")?;
    let header = meta.headers.first().context("it has no image")?;
    ensure_size([header.layer_size.0, header.layer_size.1], size)?;
    let names: Vec<String> = header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
    ensure!(names.iter().any(|name| name == "Z"), "it has no channel Z (metres); it has {}", names.join(", "));
    let [width, height] = size;
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .specific_channels()
        .required("Z")
        .collect_pixels(
            move |_, _| vec![0.0f32; width * height],
            move |depths: &mut Vec<f32>, at, (depth,): (f32,)| {
                if let Some(place) = depths.get_mut(at.1 * width + at.0) {
                    *place = depth;
                }
            },
        )
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(BufReader::new(Cursor::new(bytes)))
        .context("it is damaged or cut off")?;
    Ok(image.layer_data.channel_data.pixels)
}

fn parse_png(bytes: &[u8], size: [usize; 2]) -> Result<Vec<f32>> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Png);
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_IMAGE_SIDE);
    limits.max_image_height = Some(MAX_IMAGE_SIDE);
    reader.limits(limits);
    let DynamicImage::ImageLuma16(image) = reader.decode().context("it is damaged or cut off")? else {
        bail!("its pixels are not 16-bit grey values (millimetres)");
    };
    ensure_size([image.width() as usize, image.height() as usize], size)?;
    Ok(image.into_raw().into_iter().map(|millimetres| f32::from(millimetres) / 1000.0).collect())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use exr::prelude::{Image, SpecificChannels, Vec2, WritableImage as _};
    use flyrig_types::{Intrinsics, Isometry};
    use image::{ImageBuffer, Luma};

    use super::*;

    const SIZE: [u32; 2] = [6, 4];

    fn camera(id: &str) -> Camera {
        Camera::new(id, Intrinsics::pinhole(SIZE[0], SIZE[1], 9.0), Isometry::IDENTITY)
    }

    fn write_exr(path: &Path, channel: &str, [width, height]: [usize; 2]) {
        let depth = |at: Vec2<usize>| (0.5 + (at.1 * width + at.0) as f32,);
        let channels = SpecificChannels::build().with_channel(channel).with_pixel_fn(depth);
        Image::from_channels((width, height), channels).write().to_file(path).unwrap();
    }

    #[test]
    fn metres_of_exr_and_millimetres_of_png_are_read_and_frames_may_be_missing() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["00", "01"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        write_exr(&folder.path().join("00/000007.exr"), "Z", [6, 4]);
        let grey = ImageBuffer::<Luma<u16>, _>::from_fn(6, 4, |x, y| Luma([(1500 + 10 * y + x) as u16]));
        grey.save(folder.path().join("01/000007.png")).unwrap();
        let depths = DepthFolder::open(folder.path(), &[camera("00"), camera("01"), camera("02")]).unwrap();
        let of = |name: &str, number| depths.read(&camera(name), number).unwrap();
        assert_eq!(of("00", 7).unwrap(), (0..24).map(|at| at as f32 + 0.5).collect::<Vec<f32>>());
        let millimetres = of("01", 7).unwrap();
        assert!((millimetres[0] - 1.5).abs() < 1e-6 && (millimetres[8] - 1.512).abs() < 1e-6);
        assert_eq!((of("00", 8), of("02", 7)), (None, None));
    }

    #[test]
    fn what_is_no_depth_image_is_named_with_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let error = DepthFolder::open(folder.path(), &[camera("00"), camera("03")]).unwrap_err().to_string();
        assert!(error.contains("no folder of an input camera (00, 03)"), "{error}");
        std::fs::create_dir(folder.path().join("00")).unwrap();
        let depths = DepthFolder::open(folder.path(), &[camera("00")]).unwrap();
        let at = |name: &str| folder.path().join("00").join(name);
        write_exr(&at("000000.exr"), "Z", [5, 4]);
        write_exr(&at("000001.exr"), "N.Z", [6, 4]);
        write_exr(&at("000002.exr"), "Z", [6, 4]);
        let whole = std::fs::read(at("000002.exr")).unwrap();
        std::fs::write(at("000002.exr"), &whole[..whole.len() / 2]).unwrap();
        std::fs::write(at("000003.exr"), b"").unwrap();
        ImageBuffer::<Luma<u8>, _>::from_fn(6, 4, |_, _| Luma([9u8])).save(at("000004.png")).unwrap();
        ImageBuffer::<Luma<u16>, _>::from_fn(9, 9, |_, _| Luma([9u16])).save(at("000005.png")).unwrap();
        std::fs::write(at("000006.png"), b"nothing").unwrap();
        for (number, reason) in [
            (0, "it has 5x4 pixels, and the images of its camera 6x4; give the depth of each pixel"),
            (1, "it has no channel Z (metres); it has N.Z"),
            (2, "it is damaged or cut off"),
            (3, "it is damaged or cut off"),
            (4, "its pixels are not 16-bit grey values (millimetres)"),
            (5, "it has 9x9 pixels"),
            (6, "it is damaged or cut off"),
        ] {
            let error = format!("{:#}", depths.read(&camera("00"), number).unwrap_err());
            assert!(error.contains(&format!("00{number}.")) && error.contains(reason), "{number}: {error}");
        }
    }
}
