//! BVH motion clips.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};

use crate::BodyError;

/// Longest clip, frames; a longer one has a damaged header.
const MAX_FRAMES: usize = 10_000_000;

/// Degree of freedom that one number of a motion line drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BvhChannel {
    /// Translation along x, y, z (0, 1, 2), the clip's units.
    Position(usize),
    /// Rotation about x, y, z (0, 1, 2), degrees.
    Rotation(usize),
}

/// Joint of a clip.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhJoint {
    /// Name.
    pub name: String,
    /// Index of the parent, smaller than the joint's own; `None` for the root.
    pub parent: Option<usize>,
    /// Position in the parent at rest, in the clip's units.
    pub offset: DVec3,
    /// Channels in the order of the motion lines; the first rotation is the outermost.
    pub channels: Vec<BvhChannel>,
    /// Position of the limb's end in this joint, where the file gives an end site.
    pub end_site: Option<DVec3>,
}

/// Motion clip: a skeleton and one line of numbers per frame. Lengths have no unit in BVH.
#[derive(Debug, Clone, PartialEq)]
pub struct BvhClip {
    /// File, for messages.
    pub path: PathBuf,
    /// Joints, parents first, the root at 0.
    pub joints: Vec<BvhJoint>,
    /// Time between frames, seconds.
    pub frame_secs: f64,
    /// Numbers of each frame: all joints' channels in order.
    pub frames: Vec<Vec<f64>>,
}

/// Joint in a frame: position and `parent_from_joint` rotation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BvhLocal {
    pub translation: DVec3,
    pub rotation: DQuat,
}

impl BvhClip {
    /// Returns the local transform of each joint in a frame; at rest where `frame` does not exist.
    pub(crate) fn locals(&self, frame: usize) -> Vec<BvhLocal> {
        let mut numbers = self.frames.get(frame).into_iter().flatten().copied();
        let local = |joint: &BvhJoint| {
            let mut local = BvhLocal { translation: joint.offset, rotation: DQuat::IDENTITY };
            let mut moved = None;
            for channel in &joint.channels {
                let number = numbers.next().unwrap_or(0.0);
                match *channel {
                    BvhChannel::Position(axis) => moved.get_or_insert(DVec3::ZERO)[axis] = number,
                    BvhChannel::Rotation(axis) => {
                        local.rotation *= DQuat::from_axis_angle(DVec3::AXES[axis], number.to_radians());
                    }
                }
            }
            // Position channels replace the offset.
            local.translation = moved.unwrap_or(local.translation);
            local
        };
        self.joints.iter().map(local).collect()
    }
}

/// Reads a BVH file.
///
/// # Errors
/// [`BodyError::Io`]; [`BodyError::Bvh`] names the line.
pub fn load_bvh(path: impl AsRef<Path>) -> Result<BvhClip, BodyError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| BodyError::Io { path: path.into(), source })?;
    parse_bvh(&decode_text(&bytes), path)
}

/// Decodes UTF-8 or UTF-16 with a byte order mark, as editors on Windows write it; other bytes are taken as UTF-8.
fn decode_text(bytes: &[u8]) -> String {
    let wide = |rest: &[u8], unit: fn([u8; 2]) -> u16| {
        String::from_utf16_lossy(&rest.as_chunks().0.iter().map(|pair| unit(*pair)).collect::<Vec<_>>())
    };
    match bytes {
        [0xff, 0xfe, rest @ ..] => wide(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => wide(rest, u16::from_be_bytes),
        _ => String::from_utf8_lossy(bytes).into_owned(),
    }
}

/// Reads BVH text; `path` is for messages. A joint's name is the rest of its line, spaces included.
///
/// # Errors
/// [`BodyError::Bvh`] names the line.
pub fn parse_bvh(text: &str, path: &Path) -> Result<BvhClip, BodyError> {
    let text = text.trim_start_matches('\u{feff}');
    // Old editors end lines by a carriage return alone.
    let text = if text.contains('\n') { Cow::Borrowed(text) } else { Cow::Owned(text.replace('\r', "\n")) };
    let mut words = Words { path, line: 0, rest: "", lines: text.lines() };
    words.expect("HIERARCHY")?;
    words.expect("ROOT")?;
    let mut joints = vec![joint(&mut words, None)?];
    // The open braces: the joint they belong to.
    let mut open = vec![0];
    while let Some(&current) = open.last() {
        match words.next("a joint, an end site or '}'")?.to_ascii_uppercase().as_str() {
            "OFFSET" => joints[current].offset = words.vector()?,
            "CHANNELS" => joints[current].channels = channels(&mut words)?,
            "JOINT" => {
                let child = joint(&mut words, Some(current))?;
                if joints.iter().any(|known| known.name == child.name) {
                    return Err(words.fail(format!("a second joint is called '{}'", child.name)));
                }
                open.push(joints.len());
                joints.push(child);
            }
            "END" | "ENDSITE" => {
                // "Site", or a name of another program.
                words.rest = words.rest.find('{').map_or("", |brace| &words.rest[brace..]);
                words.expect("{")?;
                words.expect("OFFSET")?;
                joints[current].end_site = Some(words.vector()?);
                words.expect("}")?;
            }
            "}" => {
                open.pop();
            }
            other => return Err(words.fail(format!("'{other}' where a joint, an end site or '}}' should stand"))),
        }
    }
    words.expect("MOTION")?;
    words.label("FRAMES")?;
    let count = words.number()?;
    if !(count >= 1.0 && count <= MAX_FRAMES as f64 && count.fract() == 0.0) {
        return Err(words.fail(format!("{count} frames; a clip has 1 to {MAX_FRAMES}")));
    }
    words.expect("FRAME")?;
    words.label("TIME")?;
    let frame_secs = words.number()?;
    if !(1e-5..=10.0).contains(&frame_secs) {
        return Err(words.fail(format!("the frame time is {frame_secs} s; it must lie between 0.00001 and 10")));
    }
    let width: usize = joints.iter().map(|joint| joint.channels.len()).sum();
    if width == 0 {
        return Err(words.fail("no joint has channels, nothing moves".to_owned()));
    }
    let mut frames = Vec::new();
    for _ in 0..count as usize {
        frames.push((0..width).map(|_| words.number()).collect::<Result<Vec<_>, _>>()?);
    }
    // Lines of another width than the skeleton's would shift every number of the following frames.
    let left = words.count_left();
    if !left.is_multiple_of(width) {
        return Err(words.fail(format!(
            "{left} numbers are left after {count} frames of {width} channels; the lines do not fit the skeleton"
        )));
    }
    if left > 0 {
        let (file, more) = (path.display(), left / width);
        tracing::warn!("{file}: {more} frames more than the {count} that its header names are left out");
    }
    Ok(BvhClip { path: path.into(), joints, frame_secs, frames })
}

fn joint(words: &mut Words<'_>, parent: Option<usize>) -> Result<BvhJoint, BodyError> {
    let name = words.name()?;
    words.expect("{")?;
    Ok(BvhJoint { name, parent, offset: DVec3::ZERO, channels: Vec::new(), end_site: None })
}

fn channels(words: &mut Words<'_>) -> Result<Vec<BvhChannel>, BodyError> {
    let count = words.number()?;
    if !(0.0..=6.0).contains(&count) || count.fract() != 0.0 {
        return Err(words.fail(format!("{count} channels; a joint has 0 to 6")));
    }
    let mut channels = Vec::new();
    for _ in 0..count as usize {
        let word = words.next("a channel name")?.to_ascii_lowercase();
        let axis = ["x", "y", "z"].iter().position(|axis| word.starts_with(axis));
        channels.push(match (axis, word.get(1..)) {
            (Some(axis), Some("position")) => BvhChannel::Position(axis),
            (Some(axis), Some("rotation")) => BvhChannel::Rotation(axis),
            _ => return Err(words.fail(format!("channel '{word}'; known are Xposition .. Zrotation"))),
        });
    }
    Ok(channels)
}

/// Words of a text with their line numbers.
struct Words<'a> {
    path: &'a Path,
    line: usize,
    /// Unread part of the current line.
    rest: &'a str,
    lines: std::str::Lines<'a>,
}

impl<'a> Words<'a> {
    /// Moves to the next word.
    fn seek(&mut self, wanted: &str) -> Result<(), BodyError> {
        loop {
            self.rest = self.rest.trim_start();
            if !self.rest.is_empty() {
                return Ok(());
            }
            let Some(line) = self.lines.next() else {
                return Err(self.fail(format!("the file ends where {wanted} should stand; it is cut off")));
            };
            self.line += 1;
            self.rest = line;
        }
    }

    fn next(&mut self, wanted: &str) -> Result<&'a str, BodyError> {
        self.seek(wanted)?;
        let (word, rest) = self.rest.split_at(self.rest.find(char::is_whitespace).unwrap_or(self.rest.len()));
        self.rest = rest;
        Ok(word)
    }

    /// Reads a name: the rest of the line, up to an opening brace.
    fn name(&mut self) -> Result<String, BodyError> {
        self.seek("a joint name")?;
        let (name, rest) = self.rest.split_at(self.rest.find('{').unwrap_or(self.rest.len()));
        self.rest = rest;
        match name.trim_end() {
            "" => Err(self.fail("a joint without a name".to_owned())),
            name => Ok(name.to_owned()),
        }
    }

    /// Reads a word and the colon behind it, with or without spaces around the colon.
    fn label(&mut self, wanted: &str) -> Result<(), BodyError> {
        self.seek(&format!("'{wanted}:'"))?;
        match self.rest.split_at_checked(wanted.len()) {
            Some((label, rest)) if label.eq_ignore_ascii_case(wanted) => {
                self.rest = rest.trim_start().trim_start_matches(':');
                Ok(())
            }
            _ => Err(self.fail(format!("'{}' where '{wanted}:' should stand", self.rest.trim_end()))),
        }
    }

    /// Counts the words up to the end of the file.
    fn count_left(&mut self) -> usize {
        let rest = std::mem::take(&mut self.rest).split_whitespace().count();
        rest + self.lines.by_ref().map(|line| line.split_whitespace().count()).sum::<usize>()
    }

    fn expect(&mut self, wanted: &str) -> Result<(), BodyError> {
        let found = self.next(&format!("'{wanted}'"))?;
        match found.eq_ignore_ascii_case(wanted) {
            true => Ok(()),
            false => Err(self.fail(format!("'{found}' where '{wanted}' should stand"))),
        }
    }

    fn number(&mut self) -> Result<f64, BodyError> {
        let word = self.next("a number")?;
        match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(self.fail(format!("'{word}' where a finite number should stand"))),
        }
    }

    fn vector(&mut self) -> Result<DVec3, BodyError> {
        Ok(DVec3::new(self.number()?, self.number()?, self.number()?))
    }

    fn fail(&self, message: String) -> BodyError {
        BodyError::Bvh { path: self.path.into(), line: self.line.max(1), message }
    }
}
