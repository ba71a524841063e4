//! PLY files: a reader for files of other programs, in text or binary form of either byte order, with any properties in any order; and a
//! writer ([`encode`]).
//!
//! A [`PlyFile`] keeps the bytes, so that [`PlyFile::chosen`] writes a subset of the points with all their properties and all digits.
//! Memory is bounded by the size of the file: a header that announces more data than the file contains is an error before memory is
//! allocated. An ASCII file has one row per line, as the format specifies, and no data behind the last row.
//!
//! (The crate `ply-rs-bw` is not used: it rejects names such as `scalar_Coord._Z` and values such as `nan`, which CloudCompare writes.)

mod header;
mod write;

pub use header::{Element, Encoding, Header, Kind, Number, Property};
pub use write::encode;

use super::filter::Filters;
use crate::error::{Error, Result};
use crate::files;
use crate::memory;
use glam::DVec3;
use std::path::{Path, PathBuf};

/// Prefix of the names of scalar fields in files of CloudCompare.
pub const SCALAR_PREFIX: &str = "scalar_";

/// PLY file in memory, with the positions of its points.
#[derive(Debug)]
pub struct PlyFile {
    path: PathBuf,
    bytes: Vec<u8>,
    header: Header,
    /// Number of the element with the points.
    points: usize,
    /// Numbers of the properties x, y and z.
    axes: [usize; 3],
    rows: Rows,
}

/// Positions of the points' rows in the file.
#[derive(Debug)]
enum Rows {
    /// Consecutive rows of equal length.
    Fixed { start: usize, stride: usize },
    /// Start of each row.
    At(Vec<usize>),
}

impl PlyFile {
    /// Reads a file or a pipe, and finds the points in it: the element `vertex`, or one whose name contains `vert` or `point`.
    ///
    /// Errors if it cannot be read, does not fit into memory, is not a PLY file, is truncated or has data behind its last row, has a value that is not of
    /// its type, or has no points with x, y and z.
    pub fn open(path: &Path) -> Result<Self> {
        Self::parse(path, files::read_named(path, files::CLOUD)?)
    }

    /// Parses the bytes of a file. `path` names it in error messages.
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
        for (number, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let Some(property) = file.property(&[axis]) else {
                let names: Vec<&str> = file.element().properties.iter().map(|p| &p.name[..]).collect();
                let found = format!("the points have no property `{axis}`, but [{}]", names.join(", "));
                return Err(Error::input(path, found, "expected the properties x, y and z"));
            };
            file.axes[number] = property;
        }
        let mut cursor = file.cursor(file.header.length);
        let mut rows = Rows::At(Vec::new());
        for (number, element) in file.header.elements.iter().enumerate() {
            let is_points = number == points;
            cursor.check_length(element).map_err(|fault| file.fault(element, fault))?;
            if is_points {
                let needed = file.held(cursor.is_even(element));
                memory::check(path, &format!("reading {} points", element.count), needed)?;
            }
            let found = cursor.find_rows(element, is_points).map_err(|fault| file.fault(element, fault))?;
            if is_points {
                rows = found;
            }
        }
        cursor.skip_space();
        let rest = file.bytes.len() - cursor.at;
        if rest > 0 {
            let found = match cursor.encoding {
                Encoding::Ascii => {
                    let line = 1 + file.bytes[..cursor.at].iter().filter(|byte| **byte == b'\n').count();
                    format!("line {line} follows the last row that the header announces")
                }
                _ => format!("{rest} bytes follow the last row that the header announces"),
            };
            return Err(Error::input(path, found, "write the cloud again: its header does not match its data"));
        }
        file.rows = rows;
        Ok(file)
    }

    /// Returns the header of the file.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Returns the element with the points.
    pub fn element(&self) -> &Element {
        &self.header.elements[self.points]
    }

    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.element().count
    }

    /// Returns true if there are no points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Checks that there is memory to filter the points and to write the remaining ones.
    ///
    /// Errors if there is not. No memory is allocated before.
    pub fn check_memory(&self, filters: &Filters) -> Result<()> {
        let points = self.len() as u64;
        let values = if filters.value.is_some() { size_of::<f32>() as u64 } else { 0 };
        let filtering = size_of::<DVec3>() as u64 + filters.memory();
        let writing = size_of::<u32>() as u64 * points + self.bytes.len() as u64;
        let held = self.held(matches!(self.rows, Rows::Fixed { .. })) + values * points;
        memory::check(&self.path, &format!("filtering {points} points"), held + writing.max(filtering * points))
    }

    /// Returns the memory that the points take, bytes: the file, and the position of each row unless all rows have the same length.
    fn held(&self, is_even: bool) -> u64 {
        let place = if is_even { 0 } else { size_of::<usize>() };
        (self.bytes.len() + place * self.len()) as u64
    }

    /// Returns the coordinates of the points.
    ///
    /// Errors if a word of a text file is not a number, as in [`PlyFile::values`].
    pub fn positions(&self) -> Result<Vec<DVec3>> {
        let [x, y, z] = self.axes;
        self.each(|row| Ok(DVec3::new(self.value(row, x)?, self.value(row, y)?, self.value(row, z)?)))
    }

    /// Returns the names of the scalar fields: every scalar property of the points except coordinates, normals and colors, without the
    /// prefix `scalar_`.
    pub fn field_names(&self) -> Vec<&str> {
        self.fields().map(|(_, p)| field_name(&p.name)).collect()
    }

    /// Returns the values of a scalar field, by its name with or without `scalar_`.
    ///
    /// Errors if there is no such field, or if a word of a text file is not a number.
    pub fn values(&self, name: &str) -> Result<Vec<f32>> {
        let Some((property, _)) = self.fields().find(|(_, p)| p.name == name || field_name(&p.name) == name) else {
            let found = format!("the cloud has no scalar field `{name}`");
            return Err(Error::input(&self.path, found, format!("its scalar fields are [{}]", self.field_names().join(", "))));
        };
        self.in_single(property)
    }

    /// Returns the elements other than the points, such as faces. They are not written to filtered files, because they refer to points by
    /// number.
    pub fn others(&self) -> impl Iterator<Item = &Element> {
        self.header.elements.iter().enumerate().filter(|(number, _)| *number != self.points).map(|(_, element)| element)
    }

    /// Returns a file with some of the points, in the encoding of this file, with all their properties, with its comments and one more.
    ///
    /// Panics if a number is out of range.
    pub fn chosen(&self, numbers: &[u32], comment: &str) -> Vec<u8> {
        let mut file = header_lines(self.header.encoding, &self.header.remarks, comment, self.element(), numbers.len()).into_bytes();
        let end: &[u8] = if self.header.encoding == Encoding::Ascii { b"\n" } else { b"" };
        // A buffer that grows would take twice as much.
        file.reserve_exact(numbers.iter().map(|&number| self.row(number as usize).len() + end.len()).sum());
        for &number in numbers {
            file.extend_from_slice(self.row(number as usize));
            file.extend_from_slice(end);
        }
        file
    }

    /// Returns the bytes of a row, without its line break.
    fn row(&self, number: usize) -> &[u8] {
        let start = self.start(number);
        let mut cursor = self.cursor(start);
        match (&self.rows, self.header.encoding) {
            (Rows::Fixed { stride, .. }, _) => &self.bytes[start..start + stride],
            (Rows::At(_), Encoding::Ascii) => self.bytes[start..cursor.line_end()].trim_ascii(),
            (Rows::At(_), _) => {
                // The row was already checked when the file was opened.
                let _ = self.element().properties.iter().try_for_each(|p| cursor.skip(p.kind));
                &self.bytes[start..cursor.at]
            }
        }
    }

    /// Returns the start of a row.
    fn start(&self, number: usize) -> usize {
        match &self.rows {
            Rows::Fixed { start, stride } => start + number * stride,
            Rows::At(starts) => starts[number],
        }
    }

    fn cursor(&self, at: usize) -> Cursor<'_> {
        Cursor { bytes: &self.bytes, at, encoding: self.header.encoding }
    }

    /// Returns the number of the scalar property with one of these names, in lower case.
    fn property(&self, names: &[&str]) -> Option<usize> {
        let fits = |p: &Property| matches!(p.kind, Kind::Scalar(_)) && names.contains(&&p.name.to_lowercase()[..]);
        self.element().properties.iter().position(fits)
    }

    /// Returns the scalar fields, with the numbers of their properties.
    fn fields(&self) -> impl Iterator<Item = (usize, &Property)> {
        let known = |name: &str| COLORS.iter().chain(&NORMALS).any(|names| names.contains(&name)) || ["x", "y", "z"].contains(&name);
        let scalar = move |p: &Property| matches!(p.kind, Kind::Scalar(_)) && !known(&p.name.to_lowercase());
        self.element().properties.iter().enumerate().filter(move |(_, p)| scalar(p))
    }

    fn in_single(&self, property: usize) -> Result<Vec<f32>> {
        self.each(|row| self.value(row, property).map(|v| v as f32))
    }

    /// Calls `read` for each row and collects the results.
    fn each<T>(&self, read: impl Fn(usize) -> std::result::Result<T, Fault>) -> Result<Vec<T>> {
        let mut all = Vec::with_capacity(self.len());
        for row in 0..self.len() {
            all.push(read(row).map_err(|fault| self.fault(self.element(), (row, fault)))?);
        }
        Ok(all)
    }

    /// Returns the value of a property in a row.
    fn value(&self, row: usize, property: usize) -> std::result::Result<f64, Fault> {
        let mut cursor = self.cursor(self.start(row));
        let properties = &self.element().properties[..=property];
        properties[..property].iter().try_for_each(|p| cursor.pass(p.kind))?;
        match properties[property].kind {
            Kind::Scalar(number) => cursor.number(number),
            Kind::List(..) => Err(Fault::NoNumber { found: "a list".to_owned(), expected: Number::F64 }),
        }
    }

    /// Returns the error for a fault in a row of an element.
    fn fault(&self, element: &Element, (row, fault): (usize, Fault)) -> Error {
        let Element { name, count, .. } = element;
        match fault {
            Fault::CutShort => {
                let found = format!("the header announces {count} rows of `{name}`, but the file ends in row {row}");
                Error::input(&self.path, found, "the file is truncated: use an undamaged copy")
            }
            Fault::NoNumber { found, expected } => {
                let found = format!("row {row} of `{name}` has `{found}` where {} is expected", expected.expected());
                Error::input(&self.path, found, "write the cloud again; rows are counted from 0")
            }
            Fault::Line(how) => {
                let found = format!("the line of row {row} of `{name}` has {how} numbers than the header announces");
                Error::input(&self.path, found, "expected one line per row; rows are counted from 0")
            }
        }
    }
}

const COLORS: [&[&str]; 3] = [&["red", "diffuse_red", "r"], &["green", "diffuse_green", "g"], &["blue", "diffuse_blue", "b"]];
const NORMALS: [&[&str]; 3] = [&["nx", "normal_x"], &["ny", "normal_y"], &["nz", "normal_z"]];

/// Returns the name of a scalar field from the name of its property.
fn field_name(property: &str) -> &str {
    property.strip_prefix(SCALAR_PREFIX).unwrap_or(property)
}

/// Returns the header of a file with one element.
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

/// Fault in a row.
#[derive(Debug)]
enum Fault {
    CutShort,
    NoNumber {
        found: String,
        expected: Number,
    },
    /// A line has "fewer" or "more" numbers than a row.
    Line(&'static str),
}

/// Position in the data.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
}

impl<'a> Cursor<'a> {
    /// Checks that the rest of the file can contain as many rows as the element has.
    fn check_length(&self, element: &Element) -> std::result::Result<(), (usize, Fault)> {
        let left = self.bytes.len() - self.at;
        let (least, room) = match self.encoding {
            // The last number of a text needs no space after it.
            Encoding::Ascii => (element.least_size(self.encoding), left + 1),
            _ => (element.least_size(self.encoding), left),
        };
        match element.count.checked_mul(least) {
            Some(all) if all <= room => Ok(()),
            _ => Err((left / least.max(1), Fault::CutShort)),
        }
    }

    /// True if all rows of an element have one length.
    fn is_even(&self, element: &Element) -> bool {
        self.encoding != Encoding::Ascii && element.stride().is_some()
    }

    /// Goes past an element, of which there [may be](Self::check_length) so many rows, remembering where they begin if asked to. The fault comes with
    /// the number of its row.
    fn find_rows(&mut self, element: &Element, remember: bool) -> std::result::Result<Rows, (usize, Fault)> {
        if let (Some(stride), true) = (element.stride(), self.is_even(element)) {
            let start = self.at;
            self.at += element.count * stride;
            return Ok(Rows::Fixed { start, stride });
        }
        let mut starts = Vec::with_capacity(if remember { element.count } else { 0 });
        if element.properties.is_empty() {
            return Ok(Rows::At(starts));
        }
        for row in 0..element.count {
            if remember {
                starts.push(self.at);
            }
            let passed = match self.encoding {
                Encoding::Ascii => self.line(element),
                _ => element.properties.iter().try_for_each(|p| self.skip(p.kind)),
            };
            passed.map_err(|fault| (row, fault))?;
        }
        Ok(Rows::At(starts))
    }

    /// Skips a line, which is a row.
    fn line(&mut self, element: &Element) -> std::result::Result<(), Fault> {
        let end = self.line_end();
        let mut line = Cursor { bytes: &self.bytes[..end], ..*self };
        let read = element.properties.iter().try_for_each(|p| line.skip(p.kind));
        line.skip_space();
        self.at = self.bytes.len().min(end + 1);
        match read {
            Err(Fault::CutShort) if end < self.bytes.len() => Err(Fault::Line("fewer")),
            Ok(()) if line.at < end => Err(Fault::Line("more")),
            other => other,
        }
    }

    /// Returns the end of the line, before its line break.
    fn line_end(&self) -> usize {
        let rest = &self.bytes[self.at..];
        self.at + rest.iter().position(|byte| *byte == b'\n').unwrap_or(rest.len())
    }

    /// Skips a property and checks its numbers.
    fn skip(&mut self, kind: Kind) -> std::result::Result<(), Fault> {
        match (kind, self.encoding) {
            (Kind::Scalar(number), Encoding::Ascii) => self.number(number).map(drop),
            (Kind::List(count, item), Encoding::Ascii) => {
                // The words must be there, however many a text says.
                (0..self.items(count)?).try_for_each(|_| self.number(item).map(drop))
            }
            (kind, _) => self.pass(kind),
        }
    }

    /// Goes past a property that has been checked, or whose bytes mean some number in any case.
    fn pass(&mut self, kind: Kind) -> std::result::Result<(), Fault> {
        match (kind, self.encoding) {
            (Kind::Scalar(_), Encoding::Ascii) => self.word().map(drop),
            (Kind::Scalar(number), _) => self.take(number.size()).map(drop),
            (Kind::List(count, item), _) => {
                let items = self.items(count)?;
                match self.encoding {
                    Encoding::Ascii => (0..items).try_for_each(|_| self.word().map(drop)),
                    _ => (items as usize).checked_mul(item.size()).ok_or(Fault::CutShort).and_then(|n| self.take(n)).map(drop),
                }
            }
        }
    }

    /// Reads how many items a list has.
    fn items(&mut self, count: Number) -> std::result::Result<u64, Fault> {
        let items = self.number(count)?;
        // Of a type of whole numbers.
        if items < 0.0 {
            Err(Fault::NoNumber { found: format!("a list of {items} items"), expected: Number::U32 })
        } else {
            Ok(items as u64)
        }
    }

    /// Reads a number.
    fn number(&mut self, number: Number) -> std::result::Result<f64, Fault> {
        if self.encoding == Encoding::Ascii {
            let word = self.word()?;
            let value = std::str::from_utf8(word).ok().and_then(|text| number.parse(text));
            let found = || String::from_utf8_lossy(&word[..word.len().min(40)]).into_owned();
            return value.ok_or_else(|| Fault::NoNumber { found: found(), expected: number });
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

    /// Returns the next word of a text.
    fn word(&mut self) -> std::result::Result<&'a [u8], Fault> {
        self.skip_space();
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
        if length == 0 { Err(Fault::CutShort) } else { self.take(length) }
    }
}

#[cfg(test)]
mod tests;
