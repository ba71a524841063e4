//! Header of a PLY file: the layout of the data.

use crate::error::{Error, Result};
use crate::memory;
use std::collections::BTreeSet;
use std::path::Path;

/// Encoding of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// Text, separated by white space.
    Ascii,
    /// Binary, least significant byte first.
    LittleEndian,
    /// Binary, most significant byte first.
    BigEndian,
}

/// Type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Number {
    /// `char`
    I8,
    /// `uchar`
    U8,
    /// `short`
    I16,
    /// `ushort`
    U16,
    /// `int`
    I32,
    /// `uint`
    U32,
    /// `float`
    F32,
    /// `double`
    F64,
}

/// All types with their names in files, the usual name first.
const NUMBERS: [(Number, [&str; 2]); 8] = [
    (Number::I8, ["char", "int8"]),
    (Number::U8, ["uchar", "uint8"]),
    (Number::I16, ["short", "int16"]),
    (Number::U16, ["ushort", "uint16"]),
    (Number::I32, ["int", "int32"]),
    (Number::U32, ["uint", "uint32"]),
    (Number::F32, ["float", "float32"]),
    (Number::F64, ["double", "float64"]),
];

impl Number {
    fn named(name: &str) -> Option<Self> {
        NUMBERS.iter().find(|(_, names)| names.contains(&name)).map(|(number, _)| *number)
    }

    /// Returns the usual name of the type.
    pub fn name(self) -> &'static str {
        NUMBERS.iter().find(|(number, _)| *number == self).map_or("float", |(_, names)| names[0])
    }

    /// Returns the expected text of an ASCII file, in words.
    pub(super) fn expected(self) -> String {
        match self.range() {
            Some([low, high]) => format!("a whole number from {low} to {high}"),
            None => "a number".to_owned(),
        }
    }

    /// Returns the smallest and the largest value of an integer type.
    fn range(self) -> Option<[i64; 2]> {
        let bits = 8 * self.size() as u32;
        match self {
            Number::I8 | Number::I16 | Number::I32 => Some([-(1 << (bits - 1)), (1 << (bits - 1)) - 1]),
            Number::U8 | Number::U16 | Number::U32 => Some([0, (1 << bits) - 1]),
            Number::F32 | Number::F64 => None,
        }
    }

    /// Parses a number of this type. Floating-point types accept NaN in the spelling of any C library: -nan(ind), 1.#QNAN.
    pub(super) fn parse(self, text: &str) -> Option<f64> {
        match self.range() {
            Some([low, high]) => text.parse().ok().filter(|value| (low..=high).contains(value)).map(|value| value as f64),
            None => text.parse().ok().or_else(|| {
                let small = text.to_lowercase();
                (small.contains("nan") || small.contains("#ind")).then_some(f64::NAN)
            }),
        }
    }

    /// Returns the size in bytes.
    pub fn size(self) -> usize {
        match self {
            Number::I8 | Number::U8 => 1,
            Number::I16 | Number::U16 => 2,
            Number::I32 | Number::U32 | Number::F32 => 4,
            Number::F64 => 8,
        }
    }
}

/// Kind of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Single number.
    Scalar(Number),
    /// List: the type of its length, and the type of its items.
    List(Number, Number),
}

/// Property of an element: a column.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    /// Name, as in the file.
    pub name: String,
    /// Kind of the property.
    pub kind: Kind,
}

/// Element of the file: a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Element {
    /// Name, as in the file.
    pub name: String,
    /// Number of rows.
    pub count: usize,
    /// Columns.
    pub properties: Vec<Property>,
}

impl Element {
    /// Returns the bytes of a binary row; `None` if lists make the lengths of rows differ.
    pub fn stride(&self) -> Option<usize> {
        self.properties
            .iter()
            .map(|p| match p.kind {
                Kind::Scalar(number) => Some(number.size()),
                Kind::List(..) => None,
            })
            .sum()
    }

    /// Returns the smallest possible size of a row in bytes. A number in a text takes at least a digit and a space.
    pub fn least_size(&self, encoding: Encoding) -> usize {
        let binary = |p: &Property| match p.kind {
            Kind::Scalar(number) | Kind::List(number, _) => number.size(),
        };
        match encoding {
            Encoding::Ascii => 2 * self.properties.len(),
            _ => self.properties.iter().map(binary).sum(),
        }
    }
}

/// Largest size of a header, bytes: room for thousands of comments and properties.
const MOST: usize = 1 << 20;

/// Header of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Encoding of the data.
    pub encoding: Encoding,
    /// Lines that begin with `comment` or `obj_info`, in order.
    pub remarks: Vec<String>,
    /// Elements, in the order of the data.
    pub elements: Vec<Element>,
    /// Offset of the data in the file.
    pub length: usize,
}

impl Header {
    /// Parses the lines from `ply` to `end_header`.
    ///
    /// Errors if the file is not a PLY file, is truncated, has an unknown format or type or a repeated name, or has a header of more than a megabyte; the error names
    /// the line.
    pub fn parse(path: &Path, file: &[u8]) -> Result<Self> {
        let write_again = "write the cloud again as PLY 1.0";
        if !file.starts_with(b"ply") {
            let start: String = String::from_utf8_lossy(&file[..file.len().min(16)]).escape_debug().collect();
            let found = match start.is_empty() {
                true => "this is not a PLY file: it is empty".to_owned(),
                false => format!("this is not a PLY file: it begins with `{start}`, not with `ply`"),
            };
            return Err(Error::input(path, found, "give a PLY file"));
        }
        let (mut encoding, mut remarks, mut elements) = (None, Vec::new(), Vec::<Element>::new());
        // Of elements, and of the properties of the last.
        let (mut tables, mut columns) = (BTreeSet::new(), BTreeSet::new());
        let head = &file[..file.len().min(MOST)];
        let mut at = 0;
        for number in 1.. {
            let Some(end) = head[at..].iter().position(|&b| b == b'\n').map(|length| at + length) else {
                if head.len() < file.len() {
                    let found = format!("the header is longer than the limit of {}", memory::bytes(MOST as u64));
                    return Err(Error::input(path, found, "remove comments and properties that are not needed"));
                }
                return Err(Error::input(path, "the header has no `end_header`", "the file is truncated: use an undamaged copy"));
            };
            let line = String::from_utf8_lossy(&file[at..end]);
            let line = line.trim();
            at = end + 1;
            let bad = |expected: &str| {
                let shown: String = line.chars().take(80).collect();
                Err(Error::input(path, format!("line {number} of the header is `{shown}`"), expected))
            };
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["ply"] if number == 1 => {}
                _ if number == 1 => return bad("expected `ply` as the first line"),
                [] => {}
                ["comment" | "obj_info", ..] => remarks.push(line.to_owned()),
                ["format", ..] if encoding.is_some() => return bad("expected one line `format`"),
                ["format", name, "1.0"] => {
                    encoding = Some(match name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return bad("expected ascii, binary_little_endian or binary_big_endian"),
                    });
                }
                ["format", ..] => return bad("expected `format ENCODING 1.0`"),
                ["element", name, count] => match count.parse() {
                    Ok(_) if !tables.insert(name.to_owned()) => return bad("expected a different name for each element"),
                    Ok(count) => {
                        columns.clear();
                        elements.push(Element { name: name.to_owned(), count, properties: Vec::new() });
                    }
                    Err(_) => return bad("expected `element NAME COUNT`, where COUNT is a whole number"),
                },
                ["property", ref kind @ .., name] => {
                    let kind = match *kind {
                        [number] => Number::named(number).map(Kind::Scalar),
                        ["list", count, item] => {
                            let count = Number::named(count).filter(|count| !matches!(count, Number::F32 | Number::F64));
                            count.zip(Number::named(item)).map(|(count, item)| Kind::List(count, item))
                        }
                        _ => None,
                    };
                    let Some(kind) = kind else {
                        return bad(
                            "expected `property TYPE NAME` or `property list TYPE TYPE NAME` with the types char, uchar, short, ushort, int, uint, float, double",
                        );
                    };
                    let Some(element) = elements.last_mut() else { return bad("expected an element before its properties") };
                    if !columns.insert(name.to_owned()) {
                        return bad("expected a different name for each property of an element");
                    }
                    element.properties.push(Property { name: name.to_owned(), kind });
                }
                ["end_header"] => break,
                _ => return bad("expected format, comment, obj_info, element, property or end_header"),
            }
        }
        let encoding = encoding.ok_or_else(|| Error::input(path, "the header has no line `format`", write_again))?;
        Ok(Header { encoding, remarks, elements, length: at })
    }
}
