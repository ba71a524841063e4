//! The NumPy file format, version 1.0 (`numpy.lib.format`): a magic number, a header with a Python dictionary, and the numbers of one array.

use super::{Dtype, bytes_of, read, read_numbers, replace};
use crate::error::FileError;
use crate::pool::Buffer;
use crate::real::Real;
use crate::tensor::Tensor;
use std::path::Path;

const MAGIC: &[u8; 8] = b"\x93NUMPY\x01\x00";

impl<T: Real> Tensor<T> {
    /// Writes the value to a NumPy file, which `numpy.load` can read. The file has version 1.0 and C order; the type is `<f4` for `f32` and `<f8` for `f64`.
    ///
    /// ```
    /// use autograd::Tensor;
    /// let path = std::env::temp_dir().join(format!("autograd-{}.npy", std::process::id()));
    /// let x = Tensor::from_vec(vec![1.0f32, 2.0, 3.0, 4.0, 5.0, 6.0], &[2, 3]);
    /// x.save_npy(&path)?;
    /// let back = Tensor::<f64>::load_npy(&path)?;
    /// assert_eq!((back.shape(), back.data()), (&[2, 3][..], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0][..]));
    /// # std::fs::remove_file(path).unwrap();
    /// # Ok::<(), autograd::FileError>(())
    /// ```
    ///
    /// Errors: [`FileError::Io`] if the file cannot be written, for example because the folder does not exist.
    pub fn save_npy(&self, path: impl AsRef<Path>) -> Result<(), FileError> {
        let bytes = encode(self);
        replace(path.as_ref(), |temporary| std::fs::write(temporary, bytes))
    }

    /// Reads the array of a NumPy file as a constant. The file must have version 1.0, C order and the type `<f4` or `<f8`; the numbers are converted to `T`.
    ///
    /// Errors: [`FileError::Io`] if the file cannot be read; [`FileError::Format`] if it has another format or if its length does not fit its header.
    pub fn load_npy(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref();
        let bytes = read(path)?;
        decode(&bytes).map_err(|(found, expected)| FileError::Format { path: path.to_owned(), found, expected: expected.into() })
    }
}

fn encode<T: Real>(x: &Tensor<T>) -> Vec<u8> {
    let kind = match Dtype::of::<T>() {
        Dtype::F32 => "<f4",
        Dtype::F64 => "<f8",
    };
    let sizes: Vec<String> = x.shape().iter().map(usize::to_string).collect();
    // A Python tuple of one element has a trailing comma.
    let comma = if x.ndim() == 1 { "," } else { "" };
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({}{comma}), }}", sizes.join(", "));
    // Spaces and a line break pad the header to a multiple of 64 bytes.
    let length = (MAGIC.len() + 2 + header.len() + 1).next_multiple_of(64) - MAGIC.len() - 2;
    header = format!("{header:<width$}\n", width = length - 1);
    let mut bytes = [&MAGIC[..], &(length as u16).to_le_bytes(), header.as_bytes()].concat();
    bytes.extend(bytes_of(x.data()));
    bytes
}

/// Decodes the bytes of a NumPy file. The error is what was found and what was expected.
fn decode<T: Real>(bytes: &[u8]) -> Result<Tensor<T>, (String, &'static str)> {
    let Some(rest) = bytes.strip_prefix(&MAGIC[..]) else {
        let found = match bytes.strip_prefix(&MAGIC[..6]) {
            Some([major, minor, ..]) => format!("a NumPy file of version {major}.{minor}"),
            _ => "a file that is not a NumPy file".to_owned(),
        };
        return Err((found, "a NumPy file of version 1.0, as written by numpy.save"));
    };
    let header = rest.split_first_chunk().and_then(|(length, rest)| rest.split_at_checked(usize::from(u16::from_le_bytes(*length))));
    let Some((header, data)) = header else {
        return Err((format!("{} bytes, which end inside the header", bytes.len()), "a complete file"));
    };
    let header = String::from_utf8_lossy(header);
    let unreadable = || (format!("the header {:?}", header.trim_end()), "a dictionary with descr, fortran_order and shape");
    let value = |key: &str| Some(header.split_once(&format!("'{key}':"))?.1.trim_start());
    let dtype = match value("descr").ok_or_else(unreadable)?.split('\'').nth(1).ok_or_else(unreadable)? {
        "<f4" => Dtype::F32,
        "<f8" => Dtype::F64,
        other => return Err((format!("numbers of type {other}"), "<f4 or <f8; astype(numpy.float32) converts")),
    };
    if !value("fortran_order").ok_or_else(unreadable)?.starts_with("False") {
        return Err(("an array in Fortran order".into(), "C order; numpy.ascontiguousarray converts"));
    }
    let sizes = value("shape").and_then(|text| text.strip_prefix('(')?.split_once(')')).ok_or_else(unreadable)?.0;
    let sizes = sizes.split(',').map(str::trim).filter(|size| !size.is_empty());
    let shape: Vec<usize> = sizes.map(|size| size.parse().map_err(|_| unreadable())).collect::<Result<_, _>>()?;
    let count = shape.iter().try_fold(1usize, |count, &n| count.checked_mul(n));
    if count.and_then(|count| count.checked_mul(dtype.size())) != Some(data.len()) {
        return Err((format!("{} bytes of numbers", data.len()), "the number of bytes for the shape in the header"));
    }
    let mut values = Buffer::stale(data.len() / dtype.size());
    read_numbers(data, dtype, &mut values);
    Ok(Tensor::from_buffer(values, &shape))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The expected bytes are those of `numpy.array([1, -0.5], dtype='<f4')` in format 1.0.
    #[test]
    fn the_bytes_are_numpys() {
        let mut want = b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }".to_vec();
        want.resize(127, b' ');
        want.extend(b"\n\x00\x00\x80\x3f\x00\x00\x00\xbf");
        assert_eq!(encode(&Tensor::from_vec(vec![1.0f32, -0.5], &[2])), want);
    }

    #[test]
    fn every_shape_comes_back_in_both_precisions() {
        for shape in [&[][..], &[0], &[7], &[2, 3], &[3, 0, 2], &[1, 2, 3, 4]] {
            let n = shape.iter().product();
            let x = Tensor::from_vec((0..n).map(|i: usize| 0.1 + i as f64).collect(), shape);
            let back = decode::<f64>(&encode(&x)).expect("a whole file");
            assert_eq!((back.shape(), back.data()), (shape, x.data()));
            let single = decode::<f32>(&encode(&x)).expect("a whole file");
            let twice = decode::<f64>(&encode(&single)).expect("a whole file");
            assert!(twice.data().iter().zip(x.data()).all(|(a, b)| *a == f64::from(*b as f32)));
        }
    }

    #[test]
    fn each_way_to_be_no_such_file_is_named() {
        let whole = encode(&Tensor::from_vec(vec![1.0f64; 6], &[2, 3]));
        let with = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let at = whole.windows(from.len()).position(|part| part == from.as_bytes()).expect("a part of the header");
            let mut bytes = whole.clone();
            bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
            bytes
        };
        for (bytes, found) in [
            (b"PNG".to_vec(), "not a NumPy file"),
            (with("\u{1}\u{0}", "\u{2}\u{0}"), "version 2.0"),
            (whole[..9].to_vec(), "9 bytes, which end inside"),
            (whole[..100].to_vec(), "100 bytes, which end inside"),
            (with("<f8", "<i8"), "<i8"),
            (with("False", "True "), "Fortran"),
            (with("'shape'", "'shade'"), "the header"),
            (with("(2, 3)", "(2, x)"), "the header"),
            (with("(2, 3)", "(-2,3)"), "the header"),
            (with("(2, 3)", "(2, 4)"), "48 bytes"),
            (whole[..whole.len() - 1].to_vec(), "47 bytes"),
        ] {
            let (message, _) = decode::<f64>(&bytes).expect_err(found);
            assert!(message.contains(found), "{found} is not in: {message}");
        }
        let huge = with("(2, 3), }       ", "(99999999999999)");
        assert!(decode::<f64>(&huge).is_err());
    }

    #[test]
    fn an_error_names_the_file() {
        let error = Tensor::<f32>::load_npy("/nowhere/at/all.npy").expect_err("no such file").to_string();
        assert!(error.contains("/nowhere/at/all.npy") && error.contains("reading"), "{error}");
        let error = Tensor::<f32>::ones(&[2]).save_npy("/nowhere/at/all.npy").expect_err("no such folder").to_string();
        assert!(error.contains("/nowhere/at/all.npy") && error.contains("writing"), "{error}");
    }
}
