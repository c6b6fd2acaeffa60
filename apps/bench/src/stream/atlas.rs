//! Colours as a video: all Gaussians in template order along a Z-order curve, coded as VP9 by the program ffmpeg.
//!
//! The template order bisects the surface recursively, as the curve does the image: neighbours on the surface are near each other. Motion
//! is that of the stream. A key frame comes every second, as the stream refreshes its colours.

use std::{
    io::Write as _,
    process::{Command, Stdio},
    sync::Arc,
};

use anyhow::{Context, Result, ensure};
use flyrig_fusion::PersonFrame;
use flyrig_renderer::{linear_from_srgb, srgb_from_linear};

use super::{
    forms::{Coded, Form, StreamForm},
    take::{CodedTake, Kept},
};

/// Bytes of the headers of an IVF file, which ffmpeg writes, and of each of its frames, which starts with its size.
const FILE_HEADER: usize = 32;
const FRAME_HEADER: usize = 12;

/// Returns whether ffmpeg can be run.
pub fn has_codec() -> bool {
    ffmpeg(&["-version"], &[]).is_ok()
}

/// Runs ffmpeg from standard input to standard output. Returns also its processor time, seconds.
fn ffmpeg(arguments: &[&str], input: &[u8]) -> Result<(Vec<u8>, f64)> {
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-hide_banner", "-nostats", "-benchmark"]).args(arguments);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().context("cannot start ffmpeg")?;
    let stdin = child.stdin.take();
    let output = std::thread::scope(|scope| {
        // It may end before it has read everything; its exit status tells.
        scope.spawn(move || stdin.map(|mut stdin| stdin.write_all(input)));
        child.wait_with_output()
    })?;
    let log = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "ffmpeg {}: {}\n{log}", arguments.join(" "), output.status);
    Ok((output.stdout, processor_secs(&log)))
}

/// Reads the line "bench: utime=0.250s stime=0.010s rtime=0.300s".
fn processor_secs(log: &str) -> f64 {
    let part =
        |name: &str| log.split_whitespace().find_map(|word| word.strip_prefix(name)?.strip_suffix('s')?.parse().ok());
    part("utime=").unwrap_or(0.0) + part("stime=").unwrap_or(0.0)
}

/// Layout of Gaussians in an image whose sides are powers of two.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Layout {
    gaussians: usize,
    bits: u32,
}

impl Layout {
    fn new(gaussians: usize) -> Self {
        Self { gaussians: gaussians.max(1), bits: gaussians.max(4).next_power_of_two().ilog2() }
    }

    fn size(self) -> [usize; 2] {
        [1 << self.bits.div_ceil(2), 1 << (self.bits / 2)]
    }

    /// Returns the pixel of a cell of the curve: its even bits are x, its odd bits y.
    fn pixel(self, cell: usize) -> usize {
        let half = |first: u32| (first..self.bits).step_by(2).map(|bit| (cell >> bit & 1) << (bit / 2)).sum::<usize>();
        half(1) * self.size()[0] + half(0)
    }

    /// Returns the Gaussian of a cell: each has one cell or two.
    fn gaussian(self, cell: usize) -> usize {
        (cell * self.gaussians) >> self.bits
    }

    /// Returns the first cell of a Gaussian.
    fn cell(self, gaussian: usize) -> usize {
        (gaussian << self.bits).div_ceil(self.gaussians)
    }

    /// Renders colours into the sRGB bytes of an image.
    fn image(self, frame: &PersonFrame, colors: &[[f32; 4]]) -> Vec<u8> {
        let mut image = vec![0; 3 << self.bits];
        let order = &frame.template().gaussian_order;
        for cell in 0..1 << self.bits {
            let color = colors[order[self.gaussian(cell)] as usize];
            let at = 3 * self.pixel(cell);
            for channel in 0..3 {
                image[at + channel] = (255.0 * srgb_from_linear(color[channel])).round() as u8;
            }
        }
        image
    }

    /// Reads linear colours in template order.
    fn colors(self, image: &[u8]) -> Vec<[f32; 4]> {
        let of = |gaussian| {
            let at = 3 * self.pixel(self.cell(gaussian));
            let [red, green, blue] = [0, 1, 2].map(|channel| linear_from_srgb(f32::from(image[at + channel]) / 255.0));
            [red, green, blue, 1.0]
        };
        (0..self.gaussians).map(of).collect()
    }
}

/// A take with colours decoded from the video.
pub struct VideoAtlas {
    crf: u8,
    layout: Layout,
    /// Bytes of the video by frame of the take.
    sizes: Vec<usize>,
    images: Vec<u8>,
    /// Mean milliseconds per frame, including the start of ffmpeg and colour conversion.
    encode_ms: f64,
    decode_ms: f64,
    motion: StreamForm,
}

impl VideoAtlas {
    /// Codes the colours of a take with a constant quality: 0 is best, 63 worst.
    ///
    /// # Errors
    /// Failures of ffmpeg, or a changing number of Gaussians.
    pub fn new(crf: u8, take: &CodedTake) -> Result<Self> {
        let layout = Layout::new(take.kept.first().map_or(0, |kept| kept.splats.color.len()));
        let [width, height] = layout.size();
        let mut images = Vec::new();
        for kept in &take.kept {
            let found = kept.splats.color.len();
            ensure!(found == layout.gaussians, "frame {}: {found} Gaussians after {}", kept.number, layout.gaussians);
            images.extend(layout.image(&kept.frame, &kept.splats.color));
        }
        let (size, crf_text) = (format!("{width}x{height}"), crf.to_string());
        let (video, encode_secs) = ffmpeg(
            &[
                &["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", &size, "-r", "30", "-i", "-"][..],
                &["-c:v", "libvpx-vp9", "-pix_fmt", "yuv444p", "-crf", &crf_text, "-b:v", "0", "-g", "30"],
                // As a live rig has to: without looking ahead.
                &["-deadline", "realtime", "-cpu-used", "5", "-lag-in-frames", "0", "-auto-alt-ref", "0"],
                &["-threads", "1", "-f", "ivf", "-"],
            ]
            .concat(),
            &images,
        )?;
        let (back, decode_secs) =
            ffmpeg(&["-threads", "1", "-i", "-", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], &video)?;
        let [encode_ms, decode_ms] = [encode_secs, decode_secs].map(|secs| 1e3 * secs / take.kept.len() as f64);
        let sizes = frame_sizes(&video);
        let (coded, wanted) = (sizes.len(), take.kept.len());
        ensure!(coded == wanted && back.len() == images.len(), "{coded} of {wanted} frames came out of the codec");
        let motion = StreamForm::new(flyrig_stream::ColorSettings::default().step);
        Ok(Self { crf, layout, sizes, images: back, encode_ms, decode_ms, motion })
    }
}

/// Returns the bytes of each frame of an IVF file, without headers.
fn frame_sizes(video: &[u8]) -> Vec<usize> {
    let mut rest = video.get(FILE_HEADER..).unwrap_or_default();
    let mut sizes = Vec::new();
    while let Some(&[a, b, c, d]) = rest.first_chunk::<4>() {
        let size = u32::from_le_bytes([a, b, c, d]) as usize;
        sizes.push(size);
        rest = rest.get(FRAME_HEADER + size..).unwrap_or_default();
    }
    sizes
}

impl Form for VideoAtlas {
    fn name(&self) -> String {
        format!("VP9 atlas, crf {}", self.crf)
    }

    fn code(&mut self, at: usize, kept: &Kept) -> Result<Coded> {
        let coded = self.motion.code(at, kept)?;
        let length = 3 << self.layout.bits;
        let image = self.images.get(at * length..(at + 1) * length).context("no such frame")?;
        Ok(Coded {
            colors: Arc::new(self.layout.colors(image)),
            bytes: coded.motion_bytes + self.sizes.get(at).context("no such frame")?,
            encode_ms: self.encode_ms,
            decode_ms: self.decode_ms,
            ..coded
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_gaussian_has_a_pixel_of_its_own() {
        for gaussians in [1, 2, 5, 64, 1000, 1025] {
            let layout = Layout::new(gaussians);
            let [width, height] = layout.size();
            assert_eq!(width * height, 1 << layout.bits);
            let mut pixels: Vec<usize> = (0..1 << layout.bits).map(|cell| layout.pixel(cell)).collect();
            pixels.sort_unstable();
            assert!(pixels.into_iter().eq(0..width * height), "{gaussians}");
            for gaussian in 0..gaussians {
                assert_eq!(layout.gaussian(layout.cell(gaussian)), gaussian, "of {gaussians}");
            }
        }
    }

    #[test]
    fn sizes_of_frames_and_processor_time_are_read() {
        let secs = processor_secs("frame=1\nbench: utime=0.250s stime=0.010s rtime=0.300s\nbench: maxrss=1kB\n");
        assert!((secs - 0.26).abs() < 1e-9, "{secs}");

        let mut video = vec![0; FILE_HEADER];
        for size in [3u32, 0, 70_000] {
            video.extend(size.to_le_bytes());
            video.resize(video.len() + 8 + size as usize, 1);
        }
        assert_eq!(frame_sizes(&video), [3, 0, 70_000]);
        assert!(frame_sizes(&video[..20]).is_empty());
    }
}
