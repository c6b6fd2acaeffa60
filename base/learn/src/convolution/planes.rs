//! Planes of numbers with a border of zeros.

/// Numbers between the pixels of two rows, all zero. Vectors of up to as many lanes read past a row's end without a check.
pub(super) const BORDER: usize = 16;

/// Planes of one size, one for each channel. Rows and columns around a plane count as zeros.
#[derive(Debug, Clone, PartialEq)]
pub struct Planes {
    channels: usize,
    height: usize,
    width: usize,
    /// A border, then the rows of all channels, each followed by a border: first a row of zeros for every channel, then the first row of
    /// every channel, and at the end zeros again. What is summed up together lies together.
    values: Vec<f32>,
}

impl Planes {
    /// Creates planes of zeros.
    #[must_use]
    pub fn zeros(channels: usize, height: usize, width: usize) -> Self {
        let mut planes = Self { channels, height, width, values: Vec::new() };
        planes.values = vec![0.0; planes.start(height + 2, 0)];
        planes
    }

    /// Creates planes of numbers without borders: channel by channel, row by row. Pixels beyond the end of the list are zero.
    #[must_use]
    pub fn new(channels: usize, height: usize, width: usize, values: &[f32]) -> Self {
        let mut planes = Self::zeros(channels, height, width);
        if width == 0 {
            return planes;
        }
        let mut rows = values.chunks(width);
        for channel in 0..channels {
            for y in 0..height {
                let Some(row) = rows.next() else { return planes };
                let start = planes.start(y + 1, channel);
                planes.values[start..start + row.len()].copy_from_slice(row);
            }
        }
        planes
    }

    /// Returns the numbers without borders: channel by channel, row by row.
    #[must_use]
    pub fn to_vec(&self) -> Vec<f32> {
        let mut values = Vec::with_capacity(self.channels * self.height * self.width);
        for channel in 0..self.channels {
            for y in 0..self.height {
                values.extend_from_slice(&self.values[self.start(y + 1, channel)..][..self.width]);
            }
        }
        values
    }

    /// Returns the number of planes.
    #[must_use]
    #[inline]
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Returns height and width of a plane.
    #[must_use]
    #[inline]
    pub fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }

    /// Returns all numbers with borders; see [`Self::start`].
    #[inline(always)]
    pub(super) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Returns the pixels of a row, filled up to whole vectors by zeros of the border.
    #[inline(always)]
    pub(super) fn padded_width(&self) -> usize {
        self.width.next_multiple_of(BORDER)
    }

    /// Returns the distance between rows that follow each other: those of two channels.
    #[inline(always)]
    pub(super) fn stride(&self) -> usize {
        self.padded_width() + BORDER
    }

    /// Returns where a row of a channel begins. Row 0 is the border above the first row of pixels.
    #[inline(always)]
    pub(super) fn start(&self, row: usize, channel: usize) -> usize {
        BORDER + (row * self.channels + channel) * self.stride()
    }

    /// Returns the rows of all channels in strips of up to `rows` rows.
    pub(super) fn strips_mut(&mut self, rows: usize) -> std::slice::ChunksMut<'_, f32> {
        let (start, end) = (self.start(1, 0), self.start(self.height + 1, 0));
        // `chunks_mut` refuses 0.
        let length = (rows * self.channels * self.stride()).max(1);
        self.values[start..end].chunks_mut(length)
    }
}
