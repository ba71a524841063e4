//! Pictures of 32-bit floats as OpenEXR and NumPy files.

use exr::prelude::{Encoding, Image, SpecificChannels, Vec2, WritableImage};
use ndarray::ArrayView3;
use plenoxel::error::Result;
use plenoxel::files::{atomically, npy::Header};
use std::path::Path;

/// Writes `[h, w, 3]` as the channels R, G, B, and anything else as the channel Y. Programs display channels of these names.
pub fn write_exr(path: &Path, values: ArrayView3<'_, f32>) -> Result<()> {
    let (height, width, channels) = values.dim();
    let size = (width, height);
    let at = |Vec2(x, y): Vec2<usize>, c: usize| values[[y, x, c]];
    atomically(path, |temporary| {
        let written = if channels == 3 {
            let channels = SpecificChannels::rgb(|place| (at(place, 0), at(place, 1), at(place, 2)));
            Image::from_encoded_channels(size, Encoding::SMALL_LOSSLESS, channels).write().to_file(temporary)
        } else {
            let channels = SpecificChannels::build().with_channel("Y").with_pixel_fn(|place| (at(place, 0),));
            Image::from_encoded_channels(size, Encoding::SMALL_LOSSLESS, channels).write().to_file(temporary)
        };
        written.map_err(|error| match error {
            exr::error::Error::Io(error) => error,
            other => std::io::Error::other(other.to_string()),
        })
    })
}

/// Encodes `[h, w, 3]`, or `[h, w]` for one channel, in row-major order, as a NumPy file.
pub fn npy(values: ArrayView3<'_, f32>) -> Vec<u8> {
    let (height, width, channels) = values.dim();
    let shape = if channels == 1 { &[height, width][..] } else { &[height, width, channels] };
    let mut bytes = Header::encode("<f4", shape);
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    #[test]
    fn a_numpy_file_has_an_aligned_header_and_the_numbers_in_rows() {
        let values = Array3::from_shape_fn((2, 3, 1), |(y, x, _)| (10 * y + x) as f32);
        let bytes = npy(values.view());
        let header = bytes.iter().position(|b| *b == b'\n').unwrap() + 1;
        assert!(header.is_multiple_of(64) && bytes.starts_with(b"\x93NUMPY\x01\x00"));
        assert_eq!(usize::from(u16::from_le_bytes([bytes[8], bytes[9]])), header - 10);
        assert!(String::from_utf8_lossy(&bytes[10..header]).starts_with("{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }"));
        let numbers: Vec<f32> = bytes[header..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        assert_eq!(numbers, [0.0, 1.0, 2.0, 10.0, 11.0, 12.0]);
    }
}
