//! Pixel formats of drivers, and removal of row padding.

use flyrig_types::PixelFormat;

use super::sys::ActiveFormat;
use crate::camera_options::FormatChoice;

impl FormatChoice {
    /// Every choice but [`Self::Auto`], in the order of preference of [`Self::Auto`].
    pub(crate) const ORDER: [Self; 7] =
        [Self::Yuyv, Self::Uyvy, Self::Nv12, Self::Rgb24, Self::Mjpeg, Self::Bayer8, Self::Grey];

    /// Returns the FourCCs of the format, best first.
    pub(crate) fn fourccs(self) -> &'static [[u8; 4]] {
        const CODES: [&[[u8; 4]]; 7] = [
            &[*b"YUYV"],
            &[*b"UYVY"],
            &[*b"NV12", *b"NM12"],
            &[*b"RGB3", *b"BGR3"],
            &[*b"MJPG", *b"JPEG"],
            &[*b"RGGB", *b"GRBG", *b"GBRG", *b"BA81"],
            &[*b"GREY"],
        ];
        Self::ORDER.iter().position(|&choice| choice == self).map_or(&[], |place| CODES[place])
    }

    /// Returns the choice that a FourCC belongs to.
    pub(crate) fn of_fourcc(fourcc: [u8; 4]) -> Option<Self> {
        Self::ORDER.into_iter().find(|choice| choice.fourccs().contains(&fourcc))
    }

    /// Returns the bytes of an image on the bus. A JPEG image is estimated at 0.3 bytes per pixel.
    pub(crate) fn bytes_per_frame(self, width: u32, height: u32) -> u64 {
        let pixels = u64::from(width) * u64::from(height);
        match self {
            Self::Yuyv | Self::Uyvy | Self::Auto => pixels * 2,
            Self::Nv12 => pixels * 3 / 2,
            Self::Rgb24 => pixels * 3,
            Self::Grey | Self::Bayer8 => pixels,
            Self::Mjpeg => pixels * 3 / 10,
        }
    }
}

/// Returns the pixel layout of a FourCC.
pub(crate) fn pixel_format(fourcc: [u8; 4]) -> Option<PixelFormat> {
    Some(match &fourcc {
        b"YUYV" => PixelFormat::Yuyv,
        b"UYVY" => PixelFormat::Uyvy,
        b"NV12" | b"NM12" => PixelFormat::Nv12,
        b"MJPG" | b"JPEG" => PixelFormat::Mjpeg,
        b"GREY" => PixelFormat::Gray8,
        b"RGGB" => PixelFormat::BayerRggb8,
        b"GRBG" => PixelFormat::BayerGrbg8,
        b"GBRG" => PixelFormat::BayerGbrg8,
        b"BA81" => PixelFormat::BayerBggr8,
        b"RGB3" => PixelFormat::Rgb8,
        b"BGR3" => PixelFormat::Bgr8,
        _ => return None,
    })
}

/// Formats a FourCC for messages.
pub(crate) fn fourcc_text(fourcc: [u8; 4]) -> String {
    String::from_utf8_lossy(&fourcc).trim_end().to_owned()
}

/// Copies the pixels of a frame out of a driver's planes into `out`, rows without padding.
///
/// # Errors
/// Text that says what is missing.
pub(crate) fn pack<'a>(
    active: &ActiveFormat,
    plane: impl Fn(usize) -> &'a [u8],
    out: &mut Vec<u8>,
) -> Result<PixelFormat, String> {
    let Some(format) = pixel_format(active.fourcc) else {
        return Err(format!("the driver sends {}, which cannot be read", fourcc_text(active.fourcc)));
    };
    out.clear();
    let first = plane(0);
    if first.is_empty() {
        return Err("the frame is empty".to_owned());
    }
    let (width, height) = (active.width as usize, active.height as usize);
    let stride = |plane: usize, row: usize| (active.stride[plane] as usize).max(row);
    match format {
        PixelFormat::Mjpeg => out.extend_from_slice(first),
        PixelFormat::Nv12 => {
            let (row, chroma_row) = (width, width.div_ceil(2) * 2);
            let luma_stride = stride(0, row);
            rows(first, luma_stride, row, height, out)?;
            let (chroma, chroma_stride) = if active.planes > 1 {
                (plane(1), stride(1, chroma_row))
            } else {
                (first.get(luma_stride * height..).unwrap_or(&[]), luma_stride.max(chroma_row))
            };
            rows(chroma, chroma_stride, chroma_row, height.div_ceil(2), out)?;
        }
        packed => {
            let row = packed.byte_len(active.width, 1).unwrap_or(width);
            rows(first, stride(0, row), row, height, out)?;
        }
    }
    Ok(format)
}

/// Appends `count` rows of `row` bytes, `stride` bytes apart.
fn rows(bytes: &[u8], stride: usize, row: usize, count: usize, out: &mut Vec<u8>) -> Result<(), String> {
    let needed = stride * count.saturating_sub(1) + row;
    if bytes.len() < needed {
        return Err(format!("the frame is cut off: {} of {needed} bytes", bytes.len()));
    }
    if stride == row {
        out.extend_from_slice(&bytes[..needed]);
    } else {
        bytes.chunks(stride).take(count).for_each(|line| out.extend_from_slice(&line[..row]));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn active(fourcc: &[u8; 4], width: u32, height: u32, stride: &[u32]) -> ActiveFormat {
        let mut strides = [0; 8];
        strides[..stride.len()].copy_from_slice(stride);
        ActiveFormat { fourcc: *fourcc, width, height, stride: strides, planes: stride.len() }
    }

    fn packed(active: &ActiveFormat, planes: &[&[u8]]) -> Result<(PixelFormat, Vec<u8>), String> {
        let mut out = vec![9; 3];
        let format = pack(active, |plane| planes.get(plane).copied().unwrap_or(&[]), &mut out)?;
        Ok((format, out))
    }

    #[test]
    fn every_choice_has_codes_that_lead_back_to_it() {
        for choice in FormatChoice::ORDER {
            assert!(!choice.fourccs().is_empty());
            for &fourcc in choice.fourccs() {
                assert_eq!(FormatChoice::of_fourcc(fourcc), Some(choice));
                assert!(pixel_format(fourcc).is_some(), "{}", fourcc_text(fourcc));
            }
        }
        assert_eq!((FormatChoice::of_fourcc(*b"H264"), pixel_format(*b"H264")), (None, None));
    }

    #[test]
    fn padding_of_rows_is_left_out() {
        let bytes: Vec<u8> = (0..20).collect();
        let (format, out) = packed(&active(b"GREY", 3, 4, &[5]), &[&bytes]).unwrap();
        assert_eq!((format, out.as_slice()), (PixelFormat::Gray8, &[0, 1, 2, 5, 6, 7, 10, 11, 12, 15, 16, 17][..]));
        let (_, out) = packed(&active(b"GREY", 3, 4, &[0]), &[&bytes]).unwrap();
        assert_eq!(out, (0..12).collect::<Vec<u8>>(), "a driver that tells no stride has none");
        // The last row may come without its padding.
        assert!(packed(&active(b"GREY", 3, 4, &[5]), &[&bytes[..18]]).is_ok());
        let error = packed(&active(b"GREY", 3, 4, &[5]), &[&bytes[..17]]).unwrap_err();
        assert_eq!(error, "the frame is cut off: 17 of 18 bytes");
        let (format, out) = packed(&active(b"YUYV", 2, 2, &[6]), &[&bytes]).unwrap();
        assert_eq!((format, out.as_slice()), (PixelFormat::Yuyv, &[0, 1, 2, 3, 6, 7, 8, 9][..]));
    }

    #[test]
    fn nv12_in_one_plane_and_in_two_is_the_same() {
        let (luma, chroma): (Vec<u8>, Vec<u8>) = ((0..24).collect(), (100..112).collect());
        let one: Vec<u8> = luma.iter().chain(&chroma).copied().collect();
        let expected =
            vec![0, 1, 2, 3, 6, 7, 8, 9, 12, 13, 14, 15, 18, 19, 20, 21, 100, 101, 102, 103, 106, 107, 108, 109];
        for (fourcc, strides, planes) in [
            (b"NV12", &[6][..], vec![one.as_slice()]),
            (b"NM12", &[6, 6][..], vec![luma.as_slice(), chroma.as_slice()]),
        ] {
            let (format, out) = packed(&active(fourcc, 4, 4, strides), &planes).unwrap();
            assert_eq!((format, &out), (PixelFormat::Nv12, &expected));
        }
        assert!(packed(&active(b"NM12", 4, 4, &[6, 6]), &[&luma]).unwrap_err().contains("cut off: 0 of"));
        // Odd sides round the chroma up.
        assert_eq!(packed(&active(b"NV12", 3, 3, &[0]), &[&[1; 50]]).unwrap().1.len(), 9 + 4 * 2);
    }

    #[test]
    fn empty_frames_and_unknown_codes_are_refused() {
        assert_eq!(packed(&active(b"MJPG", 4, 4, &[0]), &[&[]]).unwrap_err(), "the frame is empty");
        assert!(packed(&active(b"H264", 4, 4, &[0]), &[&[1]]).unwrap_err().contains("H264"));
        assert_eq!(packed(&active(b"MJPG", 4, 4, &[0]), &[&[1, 2]]).unwrap(), (PixelFormat::Mjpeg, vec![1, 2]));
    }
}
