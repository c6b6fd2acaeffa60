//! Headers of binary PLY files with typed properties.

use crate::files::ply_error::PlyError;

/// Order of the bytes of each number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Endian {
    Little,
    Big,
}

/// Type of a property, with the names of both conventions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PlyType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl PlyType {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Returns the length of a number, bytes.
    pub fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Returns the number that `bytes` begin with; NaN where they are too few.
    pub fn read(self, bytes: &[u8], endian: Endian) -> f64 {
        fn first<const N: usize>(bytes: &[u8], endian: Endian) -> Option<[u8; N]> {
            let mut found: [u8; N] = bytes.get(..N)?.try_into().ok()?;
            if endian == Endian::Big {
                found.reverse();
            }
            Some(found)
        }
        let value = match self {
            Self::I8 => first(bytes, endian).map(|b| i8::from_le_bytes(b).into()),
            Self::U8 => first(bytes, endian).map(|b| u8::from_le_bytes(b).into()),
            Self::I16 => first(bytes, endian).map(|b| i16::from_le_bytes(b).into()),
            Self::U16 => first(bytes, endian).map(|b| u16::from_le_bytes(b).into()),
            Self::I32 => first(bytes, endian).map(|b| i32::from_le_bytes(b).into()),
            Self::U32 => first(bytes, endian).map(|b| u32::from_le_bytes(b).into()),
            Self::F32 => first(bytes, endian).map(|b| f32::from_le_bytes(b).into()),
            Self::F64 => first(bytes, endian).map(f64::from_le_bytes),
        };
        value.unwrap_or(f64::NAN)
    }
}

/// Place and type of a property in a row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Column {
    /// Offset in the row, bytes.
    pub offset: usize,
    pub kind: PlyType,
}

/// Header of a PLY file up to its element `vertex`.
#[derive(Debug)]
pub(super) struct Header<'a> {
    pub endian: Endian,
    /// Rows of the element `vertex`.
    pub rows: u64,
    /// Properties of the element `vertex`.
    columns: Vec<(&'a str, Column)>,
    /// Length of a row, bytes.
    pub row_bytes: usize,
    /// Offset of the first row in the file, bytes; saturated.
    pub first: u64,
    /// Comments without the word `comment`.
    pub comments: Vec<&'a str>,
}

/// Element of a header.
struct Element<'a> {
    name: &'a str,
    rows: u64,
    columns: Vec<(&'a str, Column)>,
    row_bytes: usize,
}

impl<'a> Header<'a> {
    /// Parses the header at the start of a file.
    ///
    /// # Errors
    /// [`PlyError::NoEnd`] without an end of the header; [`PlyError::Header`] for an unknown line, text in place of
    /// binary numbers, a repeated property, a list in the element `vertex` or one before it, and without that element.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, PlyError> {
        /// Bound on the length of a header, bytes.
        const LONGEST: usize = 1 << 16;
        let (mut length, mut endian) = (0usize, None);
        let (mut comments, mut elements) = (Vec::new(), Vec::<Element<'a>>::new());
        let is_complete = |elements: &[Element<'a>]| elements.iter().rev().skip(1).any(|e| e.name == "vertex");
        for line in bytes[..bytes.len().min(LONGEST)].split_inclusive(|byte| *byte == b'\n') {
            let is_first = length == 0;
            length += line.len();
            // Comments may be in any encoding.
            let is_comment = line.starts_with(b"comment") || line.starts_with(b"obj_info");
            let text = match std::str::from_utf8(line) {
                Err(_) if is_comment && !is_first => continue,
                text => text.ok().and_then(|text| text.strip_suffix('\n')).ok_or(PlyError::NoEnd)?.trim(),
            };
            let refused = || PlyError::Header(text.chars().take(80).collect());
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            match words.as_slice() {
                ["ply"] if is_first => {}
                _ if is_first => return Err(refused()),
                ["comment", ..] => comments.push(text["comment".len()..].trim()),
                ["obj_info", ..] => {}
                ["format", "binary_little_endian", "1.0"] if endian.is_none() => endian = Some(Endian::Little),
                ["format", "binary_big_endian", "1.0"] if endian.is_none() => endian = Some(Endian::Big),
                ["element", name, rows] if endian.is_some() => {
                    let rows = rows.parse().map_err(|_| refused())?;
                    elements.push(Element { name, rows, columns: Vec::new(), row_bytes: 0 });
                }
                // Rows after the vertices are not read, so they may have any layout.
                ["property", ..] if is_complete(&elements) => {}
                ["property", kind, name] => {
                    let (element, kind) = elements.last_mut().zip(PlyType::parse(kind)).ok_or_else(refused)?;
                    if element.columns.iter().any(|(known, _)| known == name) {
                        return Err(refused());
                    }
                    element.columns.push((name, Column { offset: element.row_bytes, kind }));
                    element.row_bytes += kind.bytes();
                }
                ["end_header"] => {
                    let lacking = if endian.is_none() { "nothing of a format" } else { "nothing of an element vertex" };
                    let lacking = || PlyError::Header(lacking.to_owned());
                    return Self::new(endian, elements, comments, length).ok_or_else(lacking);
                }
                _ => return Err(refused()),
            }
        }
        Err(PlyError::NoEnd)
    }

    fn new(endian: Option<Endian>, elements: Vec<Element<'a>>, comments: Vec<&'a str>, length: usize) -> Option<Self> {
        let mut first = length as u64;
        for element in elements {
            if element.name == "vertex" {
                let Element { rows, columns, row_bytes, .. } = element;
                return Some(Self { endian: endian?, rows, columns, row_bytes, first, comments });
            }
            first = first.saturating_add(element.rows.saturating_mul(element.row_bytes as u64));
        }
        None
    }

    /// Returns the property of this name.
    pub fn column(&self, name: &str) -> Option<Column> {
        self.columns.iter().find(|(known, _)| *known == name).map(|(_, column)| *column)
    }

    /// Returns the rows.
    ///
    /// # Errors
    /// [`PlyError::Short`] if the file has fewer.
    pub fn body(&self, bytes: &'a [u8]) -> Result<&'a [u8], PlyError> {
        let from = usize::try_from(self.first).ok().and_then(|first| bytes.get(first..)).unwrap_or_default();
        let needed = usize::try_from(self.rows).ok().and_then(|rows| rows.checked_mul(self.row_bytes));
        needed.and_then(|needed| from.get(..needed)).ok_or(PlyError::Short { gaussians: self.rows, found: from.len() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_every_type_are_read_in_both_orders() {
        let cases: [(&str, &[u8], f64); 8] = [
            ("char", &(-7i8).to_be_bytes(), -7.0),
            ("uint8", &200u8.to_be_bytes(), 200.0),
            ("short", &(-30_000i16).to_be_bytes(), -30_000.0),
            ("uint16", &60_000u16.to_be_bytes(), 60_000.0),
            ("int", &(-70_000i32).to_be_bytes(), -70_000.0),
            ("uint32", &4_000_000_000u32.to_be_bytes(), 4e9),
            ("float32", &1.5f32.to_be_bytes(), 1.5),
            ("double", &(-2.25f64).to_be_bytes(), -2.25),
        ];
        for (name, big, expected) in cases {
            let kind = PlyType::parse(name).unwrap();
            let little: Vec<u8> = big.iter().rev().copied().collect();
            assert_eq!(kind.bytes(), big.len());
            for (bytes, endian) in [(big, Endian::Big), (&little[..], Endian::Little)] {
                assert!((kind.read(bytes, endian) - expected).abs() <= 0.0, "{name} {endian:?}");
                assert!(kind.read(&bytes[1..], endian).is_nan(), "{name} cut off");
            }
        }
        assert_eq!(PlyType::parse("half"), None);
    }

    #[test]
    fn rows_begin_after_the_elements_before_them() {
        let text = "ply\r\nformat binary_big_endian 1.0\r\ncomment  made by hand \r\nelement extra 2\r\n\
                    property uchar a\r\nproperty double b\r\nelement vertex 3\r\nproperty short x\r\nproperty float y\r\n\
                    element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n";
        let header = Header::parse(text.as_bytes()).unwrap();
        assert_eq!((header.endian, header.rows, header.row_bytes), (Endian::Big, 3, 6));
        assert_eq!((header.first, &header.comments[..]), (text.len() as u64 + 18, &["made by hand"][..]));
        assert_eq!((header.column("y").unwrap().offset, header.column("y").unwrap().kind), (2, PlyType::F32));
        assert!(header.column("a").is_none());
        assert!(matches!(header.body(text.as_bytes()), Err(PlyError::Short { gaussians: 3, found: 0 })));
        let whole = [text.as_bytes(), &[0; 18 + 18 + 5]].concat();
        assert_eq!(header.body(&whole).unwrap().len(), 18);
    }

    #[test]
    fn foreign_headers_are_refused() {
        let refused = |text: &str| Header::parse(format!("ply\n{text}end_header\n").as_bytes()).unwrap_err();
        let binary = "format binary_little_endian 1.0\n";
        for text in [
            "format ascii 1.0\nelement vertex 1\nproperty float x\n".to_owned(),
            format!("{binary}{binary}element vertex 1\n"),
            format!("{binary}element vertex 1\nproperty list uchar int x\n"),
            format!("{binary}element face 1\nproperty list uchar int x\nelement vertex 1\nproperty float x\n"),
            format!("{binary}element vertex 1\nproperty float x\nproperty float x\n"),
            format!("{binary}property float x\n"),
            format!("{binary}element vertex 1\nproperty half x\n"),
            format!("{binary}element face 1\nproperty float x\n"),
            "element vertex 1\n".to_owned(),
        ] {
            assert!(matches!(refused(&text), PlyError::Header(_)), "{text}");
        }
        let huge =
            format!("{binary}element a 18446744073709551615\nproperty double b\nelement vertex 2\nproperty char x\n");
        let text = format!("ply\n{huge}end_header\n");
        assert!(matches!(Header::parse(text.as_bytes()).unwrap().body(text.as_bytes()), Err(PlyError::Short { .. })));
    }
}
