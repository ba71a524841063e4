//! NumPy files of one table of double-precision numbers.

use crate::error::{Error, Result};
use crate::files::npy::Header;
use std::path::Path;

/// A table in row-major order.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Number of columns.
    pub columns: usize,
    /// The numbers, row by row.
    pub values: Vec<f64>,
}

/// Parses the bytes of a .npy file: little-endian float64 in C order, with two axes. `path` names it in error messages.
///
/// Errors if the file is damaged or has other content.
pub fn parse(path: &Path, bytes: &[u8]) -> Result<Table> {
    let bad = |found: String| Error::input(path, found, "expected a .npy file of little-endian float64 in C order, with two axes");
    let mut data = bytes;
    let header = Header::read(&mut data).map_err(bad)?;
    if header.kind != "<f8" {
        return Err(bad(format!("the numbers are of type '{}'", header.kind)));
    }
    if header.fortran_order {
        return Err(bad("the table is not in C order".into()));
    }
    let [rows, columns] = header.shape[..] else { return Err(bad(format!("the table has the shape {}", header.shape_as_text()))) };
    let expected = rows.checked_mul(columns).and_then(|n| n.checked_mul(8));
    if expected != Some(data.len()) {
        return Err(bad(format!("the table has {rows} x {columns} numbers, but the file {} bytes of them", data.len())));
    }
    Ok(Table { columns, values: data.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(descr: &str, order: &str, shape: &str, data: &[f64]) -> Vec<u8> {
        let header = format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
        let data = data.iter().flat_map(|value| value.to_le_bytes());
        b"\x93NUMPY\x01\0".iter().copied().chain((header.len() as u16).to_le_bytes()).chain(header.bytes()).chain(data).collect()
    }

    #[test]
    fn a_table_is_read_and_everything_else_refused_with_the_reason() {
        let read = |bytes: &[u8]| parse(Path::new("a.npy"), bytes);
        let good = file("<f8", "False", "(2, 3)", &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(read(&good).unwrap(), Table { columns: 3, values: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0] });
        for (bytes, words) in [
            (file("<f4", "False", "(1, 1)", &[1.0]), "of type '<f4'"),
            (file("<f8", "True", "(1, 1)", &[1.0]), "not in C order"),
            (file("<f8", "False", "(1,)", &[1.0]), "the shape (1,)"),
            (file("<f8", "False", "(2, 1)", &[1.0]), "2 x 1 numbers, but the file 8 bytes"),
            (file("<f8", "False", "(9999999999999999, 9999999999999999)", &[1.0]), "but the file 8 bytes"),
            (good[..7].to_vec(), "ends within its header"),
            (good[..40].to_vec(), "ends within its header"),
            (good[..good.len() - 1].to_vec(), "but the file 47 bytes"),
            (b"PK\x03\x04".to_vec(), "not a NumPy file"),
            (b"\x93NUMPY\x09\0\0\0".to_vec(), "version 9"),
            (b"\x93NUMPY\x02\0\0\0\0\xf0".to_vec(), "more than 65536"),
        ] {
            let message = read(&bytes).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("float64"), "{message}");
        }
    }
}
