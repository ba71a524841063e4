//! The header of a PLY file: what the bytes after it mean.

use crate::error::{Error, Result};
use std::path::Path;

/// How numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// As text, separated by white space.
    Ascii,
    /// Least byte first.
    LittleEndian,
    /// Greatest byte first.
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

/// Every type with the names it has in files, the usual one first.
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

    /// Its usual name.
    pub fn name(self) -> &'static str {
        NUMBERS.iter().find(|(number, _)| *number == self).map_or("float", |(_, names)| names[0])
    }

    /// Bytes of one.
    pub fn size(self) -> usize {
        match self {
            Number::I8 | Number::U8 => 1,
            Number::I16 | Number::U16 => 2,
            Number::I32 | Number::U32 | Number::F32 => 4,
            Number::F64 => 8,
        }
    }
}

/// What a property is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One number.
    Scalar(Number),
    /// A number of items, and the items.
    List(Number, Number),
}

/// A column of an element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Property {
    /// As the file has it.
    pub name: String,
    /// What it is.
    pub kind: Kind,
}

/// A table of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Element {
    /// As the file has it.
    pub name: String,
    /// Its rows.
    pub count: usize,
    /// Its columns.
    pub properties: Vec<Property>,
}

impl Element {
    /// Bytes of a binary row; `None` if lists make rows differ.
    pub fn stride(&self) -> Option<usize> {
        self.properties
            .iter()
            .map(|p| match p.kind {
                Kind::Scalar(number) => Some(number.size()),
                Kind::List(..) => None,
            })
            .sum()
    }

    /// The fewest bytes that a row can take: each number of a text is a digit and a space.
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

/// All that stands above the data.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// How the data are written.
    pub encoding: Encoding,
    /// Lines that begin with `comment` or `obj_info`, in their order.
    pub remarks: Vec<String>,
    /// Tables, in the order of the data.
    pub elements: Vec<Element>,
    /// Where the data begin.
    pub length: usize,
}

impl Header {
    /// Reads the lines from `ply` to `end_header`.
    ///
    /// Errors name the line: not a PLY file, cut short, an unknown format or type.
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
        let mut at = 0;
        for number in 1.. {
            let Some(end) = file[at..].iter().position(|&b| b == b'\n').map(|length| at + length) else {
                return Err(Error::input(path, "the header has no `end_header`", "the file is truncated: use an undamaged copy"));
            };
            let line = String::from_utf8_lossy(&file[at..end]);
            let line = line.trim();
            at = end + 1;
            let bad = |accepted: &str| {
                let shown: String = line.chars().take(80).collect();
                Err(Error::input(path, format!("line {number} of the header is `{shown}`"), accepted))
            };
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["ply"] if number == 1 => {}
                _ if number == 1 => return bad("the first line must be `ply` alone"),
                [] => {}
                ["comment" | "obj_info", ..] => remarks.push(line.to_owned()),
                ["format", name, _version] => {
                    encoding = Some(match name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return bad("ascii, binary_little_endian and binary_big_endian are read"),
                    });
                }
                ["element", name, count] => match count.parse() {
                    Ok(count) => elements.push(Element { name: name.to_owned(), count, properties: Vec::new() }),
                    Err(_) => return bad("`element NAME COUNT` is expected, the count being a whole number"),
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
                            "`property TYPE NAME` or `property list TYPE TYPE NAME` is expected; types: char, uchar, short, ushort, int, uint, float, double",
                        );
                    };
                    let Some(element) = elements.last_mut() else { return bad("a property must stand below an element") };
                    element.properties.push(Property { name: name.to_owned(), kind });
                }
                ["end_header"] => break,
                _ => return bad("format, comment, obj_info, element, property and end_header are known"),
            }
        }
        let encoding = encoding.ok_or_else(|| Error::input(path, "the header has no line `format`", write_again))?;
        Ok(Header { encoding, remarks, elements, length: at })
    }
}
