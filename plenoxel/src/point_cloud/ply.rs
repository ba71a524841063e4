//! PLY files as others write them, and the writer of our own ([`encode`]): text or binary of either byte order, with any properties in any order.
//!
//! A [`PlyFile`] keeps the bytes, so that [`PlyFile::chosen`] can write some of the points with everything the file says of them, whatever
//! it may be, to the last digit. Memory is bounded by the size of the file: a header that promises more than the file holds is refused before
//! anything is allocated.
//!
//! (The crate `ply-rs-bw` was weighed. It refuses names such as `scalar_Coord._Z` and values such as `nan`, which CloudCompare writes.)

mod header;
mod write;

pub use header::{Element, Encoding, Header, Kind, Number, Property};
pub use write::encode;

use crate::error::{Error, Result};
use crate::files;
use glam::DVec3;
use std::path::{Path, PathBuf};

/// What CloudCompare puts in front of the name of a scalar field.
pub const SCALAR_PREFIX: &str = "scalar_";

/// A PLY file in memory whose points have been found.
#[derive(Debug)]
pub struct PlyFile {
    path: PathBuf,
    bytes: Vec<u8>,
    header: Header,
    /// Number of the element with the points.
    points: usize,
    /// Numbers of its properties x, y and z.
    axes: [usize; 3],
    rows: Rows,
}

/// Where the rows of the points are.
#[derive(Debug)]
enum Rows {
    /// One after the other, all of one length.
    Fixed { start: usize, stride: usize },
    /// Where each begins.
    At(Vec<usize>),
}

impl PlyFile {
    /// Reads what a user named, a file or a pipe, and finds the points in it: the element `vertex`, or one whose name contains `vert` or `point`.
    ///
    /// Errors: it cannot be read, is larger than there is memory for, is no PLY file, is cut short, or has no points with x, y and z.
    pub fn open(path: &Path) -> Result<Self> {
        Self::parse(path, files::read_named(path, files::CLOUD)?)
    }

    /// The same from the bytes of a file; `path` names it in messages.
    pub fn parse(path: &Path, bytes: Vec<u8>) -> Result<Self> {
        let header = Header::parse(path, &bytes)?;
        let lower = |element: &Element| element.name.to_lowercase();
        let exact = header.elements.iter().position(|element| lower(element) == "vertex");
        let like = || header.elements.iter().position(|element| lower(element).contains("vert") || lower(element).contains("point"));
        let Some(points) = exact.or_else(like) else {
            let names: Vec<&str> = header.elements.iter().map(|element| &element.name[..]).collect();
            return Err(Error::input(
                path,
                format!("the file has no points: its elements are [{}]", names.join(", ")),
                "expected an element `vertex`",
            ));
        };
        if u32::try_from(header.elements[points].count).is_err() {
            let found = format!("the header says {} points", header.elements[points].count);
            return Err(Error::input(path, found, "at most 4294967295 are supported"));
        }
        let mut file = PlyFile { path: path.to_owned(), bytes, header, points, axes: [0; 3], rows: Rows::At(Vec::new()) };
        let mut cursor = Cursor { bytes: &file.bytes, at: file.header.length, encoding: file.header.encoding };
        let mut rows = None;
        for (number, element) in file.header.elements.iter().enumerate() {
            let found = cursor.find_rows(element, number == points).map_err(|fault| file.fault(element, fault))?;
            rows = rows.or(found.filter(|_| number == points));
        }
        file.rows = rows.unwrap_or(Rows::At(Vec::new()));
        for (number, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let Some(property) = file.property(&[axis]) else {
                let names: Vec<&str> = file.element().properties.iter().map(|p| &p.name[..]).collect();
                let found = format!("the points have no property `{axis}`, but [{}]", names.join(", "));
                return Err(Error::input(path, found, "expected the properties x, y and z"));
            };
            file.axes[number] = property;
        }
        Ok(file)
    }

    /// What the file says above its data.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The element with the points.
    pub fn element(&self) -> &Element {
        &self.header.elements[self.points]
    }

    /// The number of points.
    pub fn len(&self) -> usize {
        self.element().count
    }

    /// True if there is no point.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The coordinates of the points.
    ///
    /// Errors: something in a text is no number, as in [`PlyFile::values`].
    pub fn positions(&self) -> Result<Vec<DVec3>> {
        let [x, y, z] = self.axes;
        let [x, y, z] = [self.column(x)?, self.column(y)?, self.column(z)?];
        Ok(x.into_iter().zip(y).zip(z).map(|((x, y), z)| DVec3::new(x, y, z)).collect())
    }

    /// Names of the scalar fields: every property of the points that is one number and no coordinate, normal or color, without the
    /// `scalar_` in front of it.
    pub fn field_names(&self) -> Vec<&str> {
        self.fields().map(|(_, p)| field_name(&p.name)).collect()
    }

    /// The values of a scalar field, by its name with or without `scalar_`.
    ///
    /// Errors: there is none with this name; something in a text is no number.
    pub fn values(&self, name: &str) -> Result<Vec<f32>> {
        let Some((property, _)) = self.fields().find(|(_, p)| p.name == name || field_name(&p.name) == name) else {
            let found = format!("the cloud has no scalar field `{name}`");
            return Err(Error::input(&self.path, found, format!("its scalar fields are [{}]", self.field_names().join(", "))));
        };
        self.in_single(property)
    }

    /// Elements besides the points, such as faces: they are not written again, for they name points by number.
    pub fn others(&self) -> impl Iterator<Item = &Element> {
        self.header.elements.iter().enumerate().filter(|(number, _)| *number != self.points).map(|(_, element)| element)
    }

    /// A file with some of the points, in the encoding of this one and with all their properties, its comments and one more.
    ///
    /// Panics if there is no point with one of the numbers.
    pub fn chosen(&self, numbers: &[u32], comment: &str) -> Vec<u8> {
        let mut file = header_lines(self.header.encoding, &self.header.remarks, comment, self.element(), numbers.len()).into_bytes();
        for &number in numbers {
            let start = self.row(number as usize);
            let mut cursor = self.cursor(start);
            for property in &self.element().properties {
                // Found once already, when the file was opened.
                let _ = cursor.skip(property.kind);
            }
            let row = &self.bytes[start..cursor.at];
            match self.header.encoding {
                Encoding::Ascii => {
                    // Programs want a line for each row, however it was broken here.
                    let words = row.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
                    file.extend(words.collect::<Vec<_>>().join(&b' '));
                    file.push(b'\n');
                }
                _ => file.extend_from_slice(row),
            }
        }
        file
    }

    /// Where a row begins.
    fn row(&self, number: usize) -> usize {
        match &self.rows {
            Rows::Fixed { start, stride } => start + number * stride,
            Rows::At(starts) => starts[number],
        }
    }

    fn cursor(&self, at: usize) -> Cursor<'_> {
        Cursor { bytes: &self.bytes, at, encoding: self.header.encoding }
    }

    /// Number of the property with one of some names, in small letters, that is one number.
    fn property(&self, names: &[&str]) -> Option<usize> {
        let fits = |p: &Property| matches!(p.kind, Kind::Scalar(_)) && names.contains(&&p.name.to_lowercase()[..]);
        self.element().properties.iter().position(fits)
    }

    /// The scalar fields, with the numbers of their properties.
    fn fields(&self) -> impl Iterator<Item = (usize, &Property)> {
        let known = |name: &str| COLORS.iter().chain(&NORMALS).any(|names| names.contains(&name)) || ["x", "y", "z"].contains(&name);
        let scalar = move |p: &Property| matches!(p.kind, Kind::Scalar(_)) && !known(&p.name.to_lowercase());
        self.element().properties.iter().enumerate().filter(move |(_, p)| scalar(p))
    }

    fn in_single(&self, property: usize) -> Result<Vec<f32>> {
        Ok(self.column(property)?.into_iter().map(|v| v as f32).collect())
    }

    /// The numbers of a property, row after row.
    fn column(&self, property: usize) -> Result<Vec<f64>> {
        let properties = &self.element().properties[..=property];
        let read = |row: usize| {
            let mut cursor = self.cursor(self.row(row));
            let before = &properties[..property];
            before.iter().try_for_each(|p| cursor.skip(p.kind))?;
            match properties[property].kind {
                Kind::Scalar(number) => cursor.number(number),
                Kind::List(..) => Err(Fault::NoNumber("a list".to_owned())),
            }
        };
        (0..self.len()).map(|row| read(row).map_err(|fault| self.fault(self.element(), (row, fault)))).collect()
    }

    /// A fault in a row of an element, as users read it.
    fn fault(&self, element: &Element, (row, fault): (usize, Fault)) -> Error {
        let Element { name, count, .. } = element;
        match fault {
            Fault::CutShort => {
                let found = format!("the header says {count} rows of `{name}`, and the file ends in row {row}");
                Error::input(&self.path, found, "the file is truncated: use an undamaged copy")
            }
            Fault::NoNumber(word) => {
                let found = format!("row {row} of `{name}` has `{word}` where a number is expected");
                Error::input(&self.path, found, "write the cloud again; rows are counted from 0")
            }
        }
    }
}

const COLORS: [&[&str]; 3] = [&["red", "diffuse_red", "r"], &["green", "diffuse_green", "g"], &["blue", "diffuse_blue", "b"]];
const NORMALS: [&[&str]; 3] = [&["nx", "normal_x"], &["ny", "normal_y"], &["nz", "normal_z"]];

/// Name of a scalar field by that of its property.
fn field_name(property: &str) -> &str {
    property.strip_prefix(SCALAR_PREFIX).unwrap_or(property)
}

/// The header of a file with one element.
fn header_lines(encoding: Encoding, remarks: &[String], comment: &str, element: &Element, count: usize) -> String {
    let encoding = match encoding {
        Encoding::Ascii => "ascii",
        Encoding::LittleEndian => "binary_little_endian",
        Encoding::BigEndian => "binary_big_endian",
    };
    let mut lines = vec!["ply".to_owned(), format!("format {encoding} 1.0")];
    lines.extend(remarks.iter().cloned());
    lines.push(format!("comment {comment}"));
    lines.push(format!("element {} {count}", element.name));
    lines.extend(element.properties.iter().map(|p| match p.kind {
        Kind::Scalar(number) => format!("property {} {}", number.name(), p.name),
        Kind::List(count, item) => format!("property list {} {} {}", count.name(), item.name(), p.name),
    }));
    lines.push("end_header\n".to_owned());
    lines.join("\n")
}

/// What can be wrong with a row.
#[derive(Debug)]
enum Fault {
    CutShort,
    NoNumber(String),
}

/// A place in the data.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl<'a> Cursor<'a> {
    /// Goes past an element, remembering where its rows begin if asked to. The fault comes with the number of its row.
    fn find_rows(&mut self, element: &Element, remember: bool) -> std::result::Result<Option<Rows>, (usize, Fault)> {
        let left = self.bytes.len() - self.at;
        let least = element.least_size(self.encoding);
        // The last number of a text needs no space after it.
        if element.count.checked_mul(least).is_none_or(|all| all > left + 1) {
            return Err((left / least.max(1), Fault::CutShort));
        }
        if let (Some(stride), true) = (element.stride(), self.encoding != Encoding::Ascii) {
            if element.count * stride > left {
                return Err((left / stride.max(1), Fault::CutShort));
            }
            let start = self.at;
            self.at += element.count * stride;
            return Ok(Some(Rows::Fixed { start, stride }));
        }
        if element.properties.is_empty() {
            return Ok(None);
        }
        let mut starts = Vec::new();
        for row in 0..element.count {
            self.skip_space();
            if remember {
                starts.push(self.at);
            }
            element.properties.iter().try_for_each(|p| self.skip(p.kind)).map_err(|fault| (row, fault))?;
        }
        Ok(Some(Rows::At(starts)))
    }

    /// Goes past a property.
    fn skip(&mut self, kind: Kind) -> std::result::Result<(), Fault> {
        match (kind, self.encoding) {
            (Kind::Scalar(_), Encoding::Ascii) => self.word().map(drop),
            (Kind::Scalar(number), _) => self.take(number.size()).map(drop),
            (Kind::List(count, item), _) => {
                let items = self.number(count)?;
                if items < 0.0 || items.fract() != 0.0 {
                    return Err(Fault::NoNumber(format!("a list of {items} items")));
                }
                // At most 2³², or what a text says, which saturates: the words or bytes must be there.
                match self.encoding {
                    Encoding::Ascii => (0..items as u64).try_for_each(|_| self.word().map(drop)),
                    _ => (items as usize).checked_mul(item.size()).ok_or(Fault::CutShort).and_then(|n| self.take(n)).map(drop),
                }
            }
        }
    }

    /// Reads a number.
    fn number(&mut self, number: Number) -> std::result::Result<f64, Fault> {
        if self.encoding == Encoding::Ascii {
            let word = self.word()?;
            let text = String::from_utf8_lossy(word);
            return text.parse().or_else(|_| {
                // C libraries write what is no number in many ways: -nan(ind), 1.#QNAN.
                let small = text.to_lowercase();
                let not_a_number = small.contains("nan") || small.contains("#ind");
                not_a_number.then_some(f64::NAN).ok_or_else(|| Fault::NoNumber(text.chars().take(40).collect()))
            });
        }
        let mut bytes = [0; 8];
        let size = number.size();
        bytes[..size].copy_from_slice(self.take(size)?);
        if self.encoding == Encoding::BigEndian {
            bytes[..size].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match number {
            Number::I8 => f64::from(a as i8),
            Number::U8 => f64::from(a),
            Number::I16 => f64::from(i16::from_le_bytes([a, b])),
            Number::U16 => f64::from(u16::from_le_bytes([a, b])),
            Number::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Number::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Number::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Number::F64 => f64::from_le_bytes(bytes),
        })
    }

    fn take(&mut self, n: usize) -> std::result::Result<&'a [u8], Fault> {
        let end = self.at.checked_add(n).filter(|&end| end <= self.bytes.len()).ok_or(Fault::CutShort)?;
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }

    fn skip_space(&mut self) {
        if self.encoding == Encoding::Ascii {
            self.at += self.bytes[self.at..].iter().take_while(|b| b.is_ascii_whitespace()).count();
        }
    }

    /// The next word of a text.
    fn word(&mut self) -> std::result::Result<&'a [u8], Fault> {
        self.skip_space();
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
        if length == 0 { Err(Fault::CutShort) } else { self.take(length) }
    }
}

#[cfg(test)]
mod tests;
