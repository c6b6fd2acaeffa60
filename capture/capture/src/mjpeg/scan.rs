//! Walk through the entropy-coded scan of a sequential JPEG image (ITU-T T.81, annexes C and F), without its pixels.
//!
//! Damage almost always shifts the reader against the bits, so that it meets a code that does not exist, a 65th
//! coefficient, or the end of the data too early or too late. Decoders are lenient with these; here they are faults.

use super::fault::Fault;

/// Largest number of colour components of a frame.
const COMPONENTS: usize = 4;
/// Bits that one look-up decodes; longer codes are rare.
const FAST_BITS: u32 = 10;

/// Means of one block and of its outer rows, grey levels around 0.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct BlockMeans {
    /// Mean of all pixels.
    pub mean: f32,
    /// Means of the two rows at the top and the two at the bottom, from the edge inwards.
    pub top: [f32; 2],
    pub bottom: [f32; 2],
}

/// Blocks of one component, row by row.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Plane {
    /// Blocks per row and column, padded to whole MCUs.
    pub width: usize,
    pub height: usize,
    /// Blocks of one MCU in each direction.
    pub step: [usize; 2],
    pub blocks: Vec<BlockMeans>,
}

/// Entropy-coded content of an image.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Scan {
    pub planes: Vec<Plane>,
    /// MCUs between two restart markers; 0 for none.
    pub restart_interval: usize,
    /// Faults that some cameras commit in every image: padding bits and surplus bytes.
    pub oddity: Option<Fault>,
    pub tables: Tables,
}

/// Tables of an image, and which component uses which.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Tables {
    /// Quantisation tables in zigzag order.
    pub quantisation: Vec<[u16; 64]>,
    /// Identifier and quantisation table of each component.
    pub selectors: Vec<[u8; 2]>,
}

/// Component of a frame header.
#[derive(Debug, Clone, Copy, Default)]
struct Component {
    id: u8,
    sampling: [usize; 2],
    quantisation: usize,
    dc: usize,
    ac: usize,
}

/// Huffman decoder of one table.
#[derive(Debug, Clone)]
struct Huffman {
    /// Length and value by the next [`FAST_BITS`] bits; length 0 for longer codes.
    fast: Vec<(u8, u8)>,
    /// One more than the largest code of each length, left-aligned in 16 bits, and the offset from code to value.
    limits: [(u32, i32); 17],
    values: Vec<u8>,
}

impl Huffman {
    fn new(counts: &[u8], values: &[u8]) -> Result<Self, Fault> {
        let mut fast = vec![(0, 0); 1 << FAST_BITS];
        let mut limits = [(0, 0); 17];
        let (mut code, mut place) = (0u32, 0usize);
        for (length, &count) in (1u32..).zip(counts) {
            limits[length as usize].1 = place as i32 - code as i32;
            for &value in values.get(place..place + usize::from(count)).ok_or(Fault::Header)? {
                if code >> length != 0 {
                    return Err(Fault::Header);
                }
                if length <= FAST_BITS {
                    let first = (code << (FAST_BITS - length)) as usize;
                    fast[first..first + (1 << (FAST_BITS - length))].fill((length as u8, value));
                }
                code += 1;
            }
            place += usize::from(count);
            limits[length as usize].0 = code << (16 - length);
            code <<= 1;
        }
        Ok(Self { fast, limits, values: values[..place].to_vec() })
    }

    /// Decodes the next code.
    fn next(&self, bits: &mut Bits<'_>) -> Result<u8, Fault> {
        let ahead = bits.peek(16);
        let (length, value) = self.fast[(ahead >> (16 - FAST_BITS)) as usize];
        if length > 0 {
            bits.skip(u32::from(length))?;
            return Ok(value);
        }
        for length in FAST_BITS + 1..=16 {
            let (limit, offset) = self.limits[length as usize];
            if ahead < limit {
                bits.skip(length)?;
                let place = (ahead >> (16 - length)) as i32 + offset;
                return usize::try_from(place).ok().and_then(|i| self.values.get(i)).copied().ok_or(Fault::Code);
            }
        }
        Err(if bits.has(16) { Fault::Code } else { Fault::Early })
    }
}

/// Reader of the bits between two markers.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    buffer: u64,
    filled: u32,
}

impl<'a> Bits<'a> {
    fn new(bytes: &'a [u8], at: usize) -> Self {
        Self { bytes, at, buffer: 0, filled: 0 }
    }

    fn fill(&mut self) {
        while self.filled <= 56 {
            let Some(&byte) = self.bytes.get(self.at) else { return };
            if byte == 0xff {
                if self.bytes.get(self.at + 1) != Some(&0) {
                    return; // a marker
                }
                self.at += 1;
            }
            self.at += 1;
            self.buffer |= u64::from(byte) << (56 - self.filled);
            self.filled += 8;
        }
    }

    /// Returns the next bits, at most 16; zeros behind the last.
    fn peek(&mut self, count: u32) -> u32 {
        if self.filled < 16 {
            self.fill();
        }
        (self.buffer >> (64 - count)) as u32
    }

    fn has(&self, count: u32) -> bool {
        self.filled >= count
    }

    fn skip(&mut self, count: u32) -> Result<(), Fault> {
        if count > self.filled {
            return Err(Fault::Early);
        }
        self.buffer <<= count;
        self.filled -= count;
        Ok(())
    }

    /// Reads the amplitude of a coefficient (T.81, F.2.2.1).
    fn amplitude(&mut self, size: u8) -> Result<i32, Fault> {
        if size == 0 {
            return Ok(0);
        }
        let size = u32::from(size);
        let value = self.peek(size) as i32;
        self.skip(size)?;
        Ok(if value >> (size - 1) == 0 { value - (1 << size) + 1 } else { value })
    }

    /// Ends a section: only padding may precede the next marker. Returns that marker and whether something is odd.
    fn marker(&mut self) -> Result<(u8, Option<Fault>), Fault> {
        self.fill();
        let mut odd = None;
        let padding = self.filled % 8;
        if padding > 0 && self.buffer >> (64 - padding) != (1 << padding) - 1 {
            odd = Some(Fault::Padding);
        }
        let whole = (self.filled / 8) as usize;
        if whole > MAX_SURPLUS || (whole > 0 && self.bytes.get(self.at) != Some(&0xff)) {
            return Err(Fault::Surplus);
        }
        if whole > 0 {
            odd = Some(Fault::Surplus);
        }
        (self.buffer, self.filled) = (0, 0);
        // Any number of fill bytes may precede a marker.
        while self.bytes.get(self.at..self.at + 2) == Some(&[0xff, 0xff]) {
            self.at += 1;
        }
        match self.bytes.get(self.at..self.at + 2) {
            Some(&[0xff, marker]) => {
                self.at += 2;
                Ok((marker, odd))
            }
            _ => Err(Fault::Early),
        }
    }
}

/// Bytes before a marker that a camera may add to every section.
const MAX_SURPLUS: usize = 4;
/// Places of the vertical frequencies 1 to 7 without a horizontal one in zigzag order.
const COLUMN: [usize; 7] = [2, 3, 9, 10, 20, 21, 35];
/// These places as bits.
const COLUMN_SET: u64 = 1 << 2 | 1 << 3 | 1 << 9 | 1 << 10 | 1 << 20 | 1 << 21 | 1 << 35;

/// Everything before the scan.
struct Header {
    components: Vec<Component>,
    size: [usize; 2],
    quantisation: [Option<[u16; 64]>; 4],
    dc: [Option<Huffman>; 4],
    ac: [Option<Huffman>; 4],
    restart_interval: usize,
    start: usize,
}

fn header(bytes: &[u8], segments: impl Iterator<Item = (usize, u8)>) -> Result<Option<Header>, Fault> {
    let mut header = Header {
        components: Vec::new(),
        size: [0; 2],
        quantisation: [None; 4],
        dc: [const { None }; 4],
        ac: [const { None }; 4],
        restart_interval: 0,
        start: 0,
    };
    for (at, marker) in segments {
        let length = bytes.get(at + 2..at + 4).map_or(0, |l| usize::from(u16::from_be_bytes([l[0], l[1]])));
        let body = bytes.get(at + 4..at + 2 + length).ok_or(Fault::Header)?;
        match marker {
            0xdb => header.quantisation_tables(body)?,
            0xc4 => header.huffman_tables(body)?,
            0xc0 | 0xc1 => header.frame(body)?,
            // Progressive, lossless and arithmetic images come from no camera.
            0xc2..=0xcf => return Ok(None),
            0xdd => {
                let &[high, low] = body else { return Err(Fault::Header) };
                header.restart_interval = usize::from(u16::from_be_bytes([high, low]));
            }
            0xda => {
                header.start = at + 2 + length;
                return header.scan(body).map(|is_whole| is_whole.then_some(header));
            }
            _ => {}
        }
    }
    Err(Fault::Header)
}

impl Header {
    fn quantisation_tables(&mut self, mut body: &[u8]) -> Result<(), Fault> {
        while let Some((&kind, rest)) = body.split_first() {
            let (bytes, place) = (if kind >> 4 == 0 { 1 } else { 2 }, usize::from(kind & 15));
            let table = rest.get(..64 * bytes).filter(|_| kind >> 4 <= 1 && place < 4).ok_or(Fault::Header)?;
            let mut values = [0u16; 64];
            for (value, bytes) in values.iter_mut().zip(table.chunks_exact(bytes)) {
                *value = bytes.iter().fold(0, |sum, byte| sum << 8 | u16::from(*byte));
            }
            if values.contains(&0) {
                return Err(Fault::Header);
            }
            self.quantisation[place] = Some(values);
            body = &rest[64 * bytes..];
        }
        Ok(())
    }

    fn huffman_tables(&mut self, mut body: &[u8]) -> Result<(), Fault> {
        while !body.is_empty() {
            let (&kind, counts) = body.get(..17).and_then(<[u8]>::split_first).ok_or(Fault::Header)?;
            let total: usize = counts.iter().map(|count| usize::from(*count)).sum();
            let values = body.get(17..17 + total).ok_or(Fault::Header)?;
            let (class, place) = (kind >> 4, usize::from(kind & 15));
            if class > 1 || place > 3 {
                return Err(Fault::Header);
            }
            let tables = if class == 0 { &mut self.dc } else { &mut self.ac };
            tables[place] = Some(Huffman::new(counts, values)?);
            body = &body[17 + total..];
        }
        Ok(())
    }

    fn frame(&mut self, body: &[u8]) -> Result<(), Fault> {
        let &[8, h1, h0, w1, w0, count, ref rest @ ..] = body else { return Err(Fault::Header) };
        self.size = [[w1, w0], [h1, h0]].map(|bytes| usize::from(u16::from_be_bytes(bytes)));
        let count = usize::from(count);
        if self.size.contains(&0) || !(1..=COMPONENTS).contains(&count) || rest.len() != 3 * count {
            return Err(Fault::Header);
        }
        self.components.clear();
        for part in rest.chunks_exact(3) {
            let sampling = [usize::from(part[1] >> 4), usize::from(part[1] & 15)];
            if sampling.iter().any(|s| !(1..=4).contains(s)) || part[2] > 3 {
                return Err(Fault::Header);
            }
            self.components.push(Component { id: part[0], sampling, quantisation: part[2].into(), dc: 0, ac: 0 });
        }
        Ok(())
    }

    /// Reads the scan header; returns false where the image has more than this one scan.
    fn scan(&mut self, body: &[u8]) -> Result<bool, Fault> {
        let Some((&count, rest)) = body.split_first() else { return Err(Fault::Header) };
        let count = usize::from(count);
        if self.components.is_empty() || rest.len() != 2 * count + 3 {
            return Err(Fault::Header);
        }
        if count != self.components.len() {
            return Ok(false);
        }
        for (component, part) in self.components.iter_mut().zip(rest.chunks_exact(2)) {
            let (dc, ac) = (usize::from(part[1] >> 4), usize::from(part[1] & 15));
            if part[0] != component.id || dc > 3 || ac > 3 {
                return Err(Fault::Header);
            }
            (component.dc, component.ac) = (dc, ac);
        }
        if rest[2 * count..] != [0, 63, 0] {
            return Err(Fault::Header);
        }
        Ok(true)
    }
}

/// Decoder of the blocks of one component.
struct Blocks<'a> {
    dc: &'a Huffman,
    ac: &'a Huffman,
    quantisation: &'a [u16; 64],
    weights: [[f32; 7]; 2],
    last: i32,
}

/// Returns the weights of the vertical frequencies 1 to 7 in the means of the first and the second row of a block.
fn row_weights() -> [[f32; 7]; 2] {
    [1.0, 3.0].map(|row| {
        std::array::from_fn(|i| {
            let angle = row * (i + 1) as f32 * std::f32::consts::PI / 16.0;
            angle.cos() * std::f32::consts::FRAC_1_SQRT_2 / 4.0
        })
    })
}

impl Blocks<'_> {
    fn next(&mut self, bits: &mut Bits<'_>) -> Result<BlockMeans, Fault> {
        let size = self.dc.next(bits)?;
        if size > 11 {
            return Err(Fault::Coefficient);
        }
        self.last += bits.amplitude(size)?;
        let step = i32::from(self.quantisation[0]);
        let level = self.last * step;
        // Eight times the mean of values from -128 to 127, rounded to a step.
        if !(-1024 - step..=1016 + step).contains(&level) {
            return Err(Fault::Mean);
        }
        let mut column = [0f32; 7];
        let mut place = 1;
        while place < 64 {
            let code = self.ac.next(bits)?;
            let (run, size) = (usize::from(code >> 4), code & 15);
            if size == 0 {
                if run == 15 {
                    place += 16;
                    continue;
                }
                if run == 0 {
                    break;
                }
                return Err(Fault::Code);
            }
            place += run;
            if place > 63 || size > 10 {
                return Err(Fault::Coefficient);
            }
            let value = bits.amplitude(size)?;
            if (COLUMN_SET >> place) & 1 == 1 {
                let frequency = COLUMN.iter().filter(|column| **column < place).count();
                column[frequency] = (value * i32::from(self.quantisation[place])) as f32;
            }
            place += 1;
        }
        if place > 64 {
            return Err(Fault::Coefficient);
        }
        let mean = level as f32 / 8.0;
        // Odd frequencies, in even places, have the opposite sign at the bottom.
        let sum = |row: usize, from: usize| -> f32 {
            column.iter().zip(&self.weights[row]).skip(from).step_by(2).map(|(c, w)| c * w).sum()
        };
        let (odd, even) = ([sum(0, 0), sum(1, 0)], [sum(0, 1), sum(1, 1)]);
        let rows = |sign: f32| [0, 1].map(|row| mean + even[row] + sign * odd[row]);
        Ok(BlockMeans { mean, top: rows(1.0), bottom: rows(-1.0) })
    }
}

/// Walks through an image: `segments` are the positions and markers of its segments up to the scan. `None` for an image
/// that is not sequential with all components in one scan, of which nothing is known.
///
/// # Errors
/// The first fault.
pub(crate) fn walk(bytes: &[u8], segments: impl Iterator<Item = (usize, u8)>) -> Result<Option<Scan>, Fault> {
    let Some(mut header) = header(bytes, segments)? else { return Ok(None) };
    if header.components.len() == 1 {
        header.components[0].sampling = [1, 1]; // blocks of a single component follow row by row
    }
    let most = |axis: usize| header.components.iter().map(|c| c.sampling[axis]).max().unwrap_or(1);
    let [across, down] = [0, 1].map(|axis| header.size[axis].div_ceil(8 * most(axis)));
    // Every block takes at least two bits: a header that was damaged claims no memory.
    let per_mcu: usize = header.components.iter().map(|c| c.sampling[0] * c.sampling[1]).sum();
    if across * down * per_mcu > 4 * bytes.len() {
        return Err(Fault::Early);
    }
    let weights = row_weights();
    let mut scan = Scan { restart_interval: header.restart_interval, ..Scan::default() };
    let mut decoders = Vec::with_capacity(COMPONENTS);
    for component in &header.components {
        let tables = (&header.dc[component.dc], &header.ac[component.ac], &header.quantisation[component.quantisation]);
        let (Some(dc), Some(ac), Some(quantisation)) = tables else { return Err(Fault::Header) };
        decoders.push(Blocks { dc, ac, quantisation, weights, last: 0 });
        let (width, height) = (across * component.sampling[0], down * component.sampling[1]);
        let blocks = vec![BlockMeans::default(); width * height];
        scan.planes.push(Plane { width, height, step: component.sampling, blocks });
    }
    let mut bits = Bits::new(bytes, header.start);
    for mcu in 0..across * down {
        if header.restart_interval > 0 && mcu > 0 && mcu % header.restart_interval == 0 {
            let (marker, odd) = bits.marker()?;
            if marker != 0xd0 + ((mcu / header.restart_interval - 1) % 8) as u8 {
                return Err(Fault::Marker);
            }
            scan.oddity = scan.oddity.or(odd);
            for decoder in &mut decoders {
                decoder.last = 0;
            }
        }
        for (decoder, plane) in decoders.iter_mut().zip(&mut scan.planes) {
            let [columns, rows] = plane.step;
            for row in 0..rows {
                let first = (mcu / across * rows + row) * plane.width + mcu % across * columns;
                for block in &mut plane.blocks[first..first + columns] {
                    *block = decoder.next(&mut bits)?;
                }
            }
        }
    }
    let (marker, odd) = bits.marker()?;
    if marker != 0xd9 {
        return Err(Fault::Marker);
    }
    scan.oddity = scan.oddity.or(odd);
    scan.tables = Tables {
        quantisation: header.quantisation.into_iter().flatten().collect(),
        selectors: header.components.iter().map(|c| [c.id, c.quantisation as u8]).collect(),
    };
    Ok(Some(scan))
}

#[cfg(test)]
mod tests {
    use super::super::{segments, testing::encoded};
    use super::*;

    fn walked(bytes: &[u8]) -> Result<Scan, Fault> {
        walk(bytes, segments(bytes)).map(|scan| scan.expect("sequential"))
    }

    /// Replaces the end marker.
    fn ending(bytes: &[u8], end: &[u8]) -> Vec<u8> {
        [&bytes[..bytes.len() - 2], end].concat()
    }

    #[test]
    fn means_of_blocks_and_rows_are_those_of_the_decoded_image() {
        let grey = image::GrayImage::from_fn(40, 24, |x, y| image::Luma([(x * 3 + y * y / 4) as u8]));
        let mut bytes = std::io::Cursor::new(Vec::new());
        grey.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
        let decoded = image::load_from_memory(bytes.get_ref()).unwrap().into_luma8();
        let scan = walked(bytes.get_ref()).unwrap();
        let plane = &scan.planes[0];
        assert_eq!((plane.width, plane.height, plane.blocks.len()), (5, 3, 15));
        for (i, block) in plane.blocks.iter().enumerate() {
            let row = |y: usize| {
                let values = (0..8).map(|x| decoded.get_pixel((i % 5 * 8 + x) as u32, (i / 5 * 8 + y) as u32).0[0]);
                values.map(f32::from).sum::<f32>() / 8.0 - 128.0
            };
            let mean = (0..8).map(row).sum::<f32>() / 8.0;
            for (found, expected) in [
                (block.mean, mean),
                (block.top[0], row(0)),
                (block.top[1], row(1)),
                (block.bottom[0], row(7)),
                (block.bottom[1], row(6)),
            ] {
                assert!((found - expected).abs() < 0.6, "block {i}: {found} for {expected}");
            }
        }
    }

    #[test]
    fn surplus_bytes_and_cut_data_are_faults() {
        for interval in [0, 3] {
            let bytes = encoded(96, 64, interval, 0);
            let whole = walked(&bytes).unwrap();
            assert_eq!((whole.oddity, whole.restart_interval, whole.planes.len()), (None, interval as usize, 3));
            assert_eq!(walked(&ending(&bytes, &[0xff, 0xff, 0xd9])).unwrap(), whole, "fill bytes");
            assert_eq!(walked(&ending(&bytes, &[1, 2, 0xff, 0xd9])).unwrap().oddity, Some(Fault::Surplus));
            assert_eq!(walked(&ending(&bytes, &[7; 9])), Err(Fault::Surplus));
            assert_eq!(walked(&ending(&bytes, &[0xff, 0xd0])), Err(Fault::Marker));
            let start = segments(&bytes).last().unwrap().0 + 14;
            for cut in [start + 40, (start + bytes.len()) / 2, bytes.len() - 20] {
                let fault = walked(&[&bytes[..cut], &[0xff, 0xd9]].concat()).unwrap_err();
                assert!([Fault::Early, Fault::Marker, Fault::Coefficient, Fault::Code].contains(&fault), "{fault}");
            }
        }
    }

    #[test]
    fn restart_markers_come_in_order() {
        let bytes = encoded(96, 64, 3, 0);
        let place = |marker: u8| bytes.windows(2).position(|pair| pair == [0xff, marker]).unwrap();
        let mut swapped = bytes.clone();
        swapped[place(0xd0) + 1] = 0xd1;
        assert_eq!(walked(&swapped), Err(Fault::Marker));
        // A whole section is lost.
        let mut short = bytes.clone();
        short.drain(place(0xd0)..place(0xd1));
        assert_eq!(walked(&short), Err(Fault::Marker));
    }

    #[test]
    fn any_bytes_come_to_an_end() {
        let mut state = 5u64;
        let mut random = |n: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n.max(1)
        };
        for interval in [0, 3] {
            let bytes = encoded(96, 64, interval, 0);
            for round in 0..3000 {
                let mut found = bytes.clone();
                // Half of them in the header, whose sizes, tables and numbers are the dangerous part.
                let most = if round % 2 == 0 { 640 } else { bytes.len() };
                for _ in 0..1 + random(6) {
                    let at = 2 + random(most - 2);
                    found[at] = random(256) as u8;
                }
                found.truncate(if round % 5 == 0 { random(found.len()) } else { usize::MAX });
                let _ = walk(&found, segments(&found));
            }
        }
    }
}
