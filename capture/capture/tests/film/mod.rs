//! Videos that tests write with FFmpeg.

use std::{fs::File, path::Path, time::Duration};

use ac_ffmpeg::{
    codec::{
        AudioCodecParameters, CodecParameters, Encoder as _,
        audio::ChannelLayout,
        video::{PixelFormat as FramePixels, VideoEncoder, VideoFrameMut, VideoFrameScaler},
    },
    format::{
        io::IO,
        muxer::{Muxer, OutputFormat},
    },
    packet::PacketMut,
    time::{TimeBase, Timestamp},
};

/// Returns a time base of 1 ms.
fn millis() -> TimeBase {
    TimeBase::new(1, 1000)
}

/// Film of 64x48 pixels.
pub struct Film<'a> {
    pub container: &'a str,
    pub codec: &'a str,
    pub time_base: TimeBase,
    /// Returns the colour (sRGB) of the left half of a frame by its number; the right half is black.
    pub color: fn(u8) -> [u8; 3],
    /// Largest number of consecutive frames that are stored after a later one.
    pub reordered: u32,
    /// Presentation times, milliseconds.
    pub times: Vec<i64>,
    /// Length of the sound track, milliseconds; none for 0.
    pub sound: i64,
    pub muxing: &'a [(&'a str, &'a str)],
}

/// Returns a film without sound whose frames become ever brighter.
pub fn film<'a>(container: &'a str, codec: &'a str, reordered: u32, times: Vec<i64>) -> Film<'a> {
    let color = |i: u8| [60 + 4 * i; 3];
    Film { container, codec, time_base: millis(), color, reordered, times, sound: 0, muxing: &[] }
}

impl Film<'_> {
    pub fn write(&self, path: &Path) {
        let format: FramePixels = if self.codec == "mjpeg" { "yuvj420p" } else { "yuv420p" }.parse().unwrap();
        let rgb: FramePixels = "rgb24".parse().unwrap();
        let scaler = VideoFrameScaler::builder().source_pixel_format(rgb).source_width(64).source_height(48);
        let scaler = scaler.target_pixel_format(format).target_width(64).target_height(48);
        let mut scaler = scaler.build().unwrap();
        let mut encoder = VideoEncoder::builder(self.codec)
            .unwrap()
            .pixel_format(format)
            .width(64)
            .height(48)
            .time_base(self.time_base)
            .set_option("flags", if self.container == "mpegts" { "+qscale" } else { "+qscale+global_header" })
            .set_option("global_quality", 236)
            .set_option("bf", self.reordered)
            .build()
            .unwrap();
        let mut builder = Muxer::builder().interleaved(true);
        builder.add_stream(&CodecParameters::from(encoder.codec_parameters())).unwrap();
        builder.streams_mut()[0].set_time_base(self.time_base);
        if self.sound > 0 {
            let sound = AudioCodecParameters::builder("pcm_s16le")
                .unwrap()
                .sample_rate(8000)
                .sample_format("s16".parse().unwrap())
                .channel_layout(&ChannelLayout::from_channels(1).unwrap())
                .build();
            builder.add_stream(&CodecParameters::from(sound)).unwrap();
        }
        // To move the index to the front, FFmpeg opens the file again.
        builder = builder.set_option("url", path.to_str().unwrap());
        for (key, value) in self.muxing {
            builder = builder.set_option(key, value);
        }
        let file = IO::from_seekable_write_stream(File::create(path).unwrap());
        let mut muxer = builder.build(file, OutputFormat::find_by_name(self.container).unwrap()).unwrap();
        let mut pass_on = |encoder: &mut VideoEncoder| {
            while let Some(packet) = encoder.take().unwrap() {
                // The last frame has no duration otherwise, and no player shows it.
                let packet = packet.into_mut().with_duration(Duration::from_millis(40)).freeze();
                muxer.push(packet.with_stream_index(0)).unwrap();
            }
        };
        for (i, time) in self.times.iter().enumerate() {
            let mut frame = VideoFrameMut::black(rgb, 64, 48);
            for row in frame.planes_mut()[0].lines_mut() {
                row[..3 * 32].chunks_exact_mut(3).for_each(|pixel| pixel.copy_from_slice(&(self.color)(i as u8)));
            }
            let frame = frame.with_time_base(self.time_base).with_pts(Timestamp::from_millis(*time));
            encoder.push(scaler.scale(&frame.freeze()).unwrap()).unwrap();
            pass_on(&mut encoder);
        }
        encoder.flush().unwrap();
        pass_on(&mut encoder);
        for second in 0..self.sound / 1000 {
            let packet =
                PacketMut::new(16_000).with_time_base(millis()).with_pts(Timestamp::from_millis(1000 * second));
            muxer.push(packet.with_dts(Timestamp::from_millis(1000 * second)).with_stream_index(1).freeze()).unwrap();
        }
        muxer.flush().unwrap();
        // Some writers return their number of bytes, which the wrapper takes for an error.
        let _ = muxer.close();
    }
}
