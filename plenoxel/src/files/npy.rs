//! The header of the NumPy file format, versions 1 to 3 (`numpy.lib.format`): a magic number, and a dictionary of Python as text.
//! `ndarray-npy` reads neither half precision nor text.

use std::io::Read;

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// Length of the longest header that is read. NumPy writes about 120 bytes.
const LONGEST: usize = 1 << 16;

/// Type, order and shape of an array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// Type of the numbers, as in `'<f4'`, without the quotation marks.
    pub kind: String,
    /// True if the first axis is the fastest.
    pub fortran_order: bool,
    /// Length of each axis; none for a single number.
    pub shape: Vec<usize>,
}

impl Header {
    /// Reads a header; the numbers follow in `source`.
    ///
    /// Errors: what was found instead of a header, for a message.
    pub fn read(mut source: impl Read) -> Result<Self, String> {
        let mut exactly = |bytes: &mut [u8]| source.read_exact(bytes).map_err(|_| "the file ends within its header".to_owned());
        let mut magic = [0; 6];
        if exactly(&mut magic).is_err() || magic != *MAGIC {
            return Err("this is not a NumPy file".to_owned());
        }
        let mut version = [0; 2];
        exactly(&mut version)?;
        let mut length = [0; 4];
        match version[0] {
            1 => exactly(&mut length[..2])?,
            2 | 3 => exactly(&mut length)?,
            version => return Err(format!("the file has version {version} of the format")),
        }
        let length = u32::from_le_bytes(length) as usize;
        if length > LONGEST {
            return Err(format!("the header has {length} bytes, more than {LONGEST}"));
        }
        let mut text = vec![0; length];
        exactly(&mut text)?;
        let text = String::from_utf8_lossy(&text);
        // NumPy writes the dictionary in one way.
        let after = |key: &str| text.split_once(&format!("'{key}':")).map(|(_, rest)| rest.trim_start());
        let kind = after("descr").and_then(|rest| rest.strip_prefix('\'')?.split_once('\'')).map(|(kind, _)| kind.to_owned());
        let fortran_order = after("fortran_order").and_then(|rest| match rest {
            rest if rest.starts_with("False") => Some(false),
            rest if rest.starts_with("True") => Some(true),
            _ => None,
        });
        let sides = after("shape").and_then(|rest| rest.strip_prefix('(')?.split_once(')')).map(|(sides, _)| sides);
        let sides = sides.map(|sides| sides.split(',').map(str::trim).filter(|side| !side.is_empty()));
        let shape = sides.and_then(|mut sides| {
            sides.try_fold(Vec::new(), |mut shape, side| {
                shape.push(side.parse().ok()?);
                Some(shape)
            })
        });
        match (kind, fortran_order, shape) {
            (Some(kind), Some(fortran_order), Some(shape)) => Ok(Header { kind, fortran_order, shape }),
            _ => Err("the header is not a dictionary with descr, fortran_order and shape".to_owned()),
        }
    }

    /// Returns the bytes of the header of an array in C order, in version 1 of the format. They are padded to a multiple of 64.
    pub fn encode(kind: &str, shape: &[usize]) -> Vec<u8> {
        let sides: String = shape.iter().map(|side| format!("{side}, ")).collect();
        let sides = if shape.len() == 1 { sides.trim_end() } else { sides.trim_end_matches(", ") };
        let text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({sides}), }}");
        let before = MAGIC.len() + 4;
        let length = (before + text.len() + 1).next_multiple_of(64) - before;
        let text = format!("{text:<width$}\n", width = length - 1);
        [&MAGIC[..], &[1, 0], &(length as u16).to_le_bytes(), text.as_bytes()].concat()
    }

    /// Returns the shape as Python writes it.
    pub fn shape_as_text(&self) -> String {
        let sides: Vec<String> = self.shape.iter().map(usize::to_string).collect();
        format!("({}{})", sides.join(", "), if sides.len() == 1 { "," } else { "" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_that_is_written_is_read_again() {
        for shape in [&[][..], &[7], &[2, 3], &[1, 0, 3, 4, 5]] {
            let bytes = Header::encode("<f2", shape);
            assert!(bytes.len().is_multiple_of(64) && bytes.ends_with(b"\n"));
            let mut rest = &bytes[..];
            let header = Header { kind: "<f2".into(), fortran_order: false, shape: shape.into() };
            assert_eq!((Header::read(&mut rest), rest.len()), (Ok(header), 0));
        }
        let text = |shape: &[usize]| String::from_utf8_lossy(&Header::encode("<i4", shape)[10..]).into_owned();
        assert!(text(&[7]).starts_with("{'descr': '<i4', 'fortran_order': False, 'shape': (7,), }"));
        assert!(text(&[]).contains("'shape': (), }") && text(&[2, 3]).contains("'shape': (2, 3), }"));
    }
}
