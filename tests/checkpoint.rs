//! Grids on disk.

use plenoxel::checkpoint::{self, Header};
use plenoxel::field::voxel_grid::{Color, GridShape, GridSpace, Interpolation, VoxelGrid};
use plenoxel::space::Space;
use std::path::PathBuf;

fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("plenoxel-checkpoint-{}-{name}", std::process::id()));
    std::fs::create_dir_all(&path).expect("a temporary folder");
    path
}

fn grid() -> (VoxelGrid<f32>, Header) {
    let shape = GridShape::new(5, 1.4, Interpolation::Trilinear, Color::Sh { degree: 2, offset: 0.5 });
    let grid = VoxelGrid::random(shape, 3.0, 1.0, 9);
    let header = Header::new(&grid, "still life", [1.0, 1.0, 1.0], 42, 1234);
    (grid, header)
}

#[test]
fn a_grid_comes_back_as_it_was_with_all_that_explains_it() {
    let path = folder("round-trip").join("checkpoint.safetensors");
    let (grid, header) = grid();
    checkpoint::save(&path, &grid, &header).expect("it is written");
    let (read, read_header) = checkpoint::load::<f32>(&path).expect("it is read");
    assert_eq!(read_header, header);
    assert_eq!(read.shape(), grid.shape());
    for (read, written) in read.to_row_major().iter().zip(grid.to_row_major()) {
        assert!(read.data() == written.data());
    }
    // The same file serves f64, and writing that again gives the same bytes.
    let (double, _) = checkpoint::load::<f64>(&path).expect("it is read as f64");
    let again = path.with_file_name("again.safetensors");
    checkpoint::save(&again, &double, &header).expect("it is written");
    assert!(std::fs::read(&path).unwrap() == std::fs::read(&again).unwrap());
}

#[test]
fn a_sparse_grid_comes_back_with_the_same_voxels() {
    let path = folder("sparse").join("checkpoint.safetensors");
    let (whole, _) = grid();
    let grid = whole.pruned(&whole.voxels_where(|row| row % 3 == 1));
    let header = Header::new(&grid, "still life", [1.0; 3], 42, 1234);
    assert_eq!(header.format, checkpoint::SPARSE_FORMAT);
    checkpoint::save(&path, &grid, &header).expect("it is written");
    let (read, _) = checkpoint::load::<f32>(&path).expect("it is read");
    assert_eq!(read.lattice().masks(), grid.lattice().masks());
    for (a, b) in read.to_row_major().iter().zip(grid.to_row_major()) {
        assert!(a.data() == b.data());
    }
    // A list that does not fit the grid is refused.
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, replace(&bytes, br#"\"resolution\":5"#, br#"\"resolution\":3"#)).unwrap();
    assert!(checkpoint::load::<f32>(&path).expect_err("it is damaged").to_string().contains("list of voxels"));
}

#[test]
fn reduced_harmonics_come_back_and_whole_ones_leave_no_trace_of_them() {
    let path = folder("reduced").join("checkpoint.safetensors");
    let (whole, header) = grid();
    checkpoint::save(&path, &whole, &header).expect("it is written");
    let bytes = std::fs::read(&path).unwrap();
    assert!(!String::from_utf8_lossy(&bytes).contains("reduction"));
    // All voxels, and a fifth of them.
    let all = VoxelGrid::<f32>::random(GridShape { sh_reduction: 2, ..*whole.shape() }, 3.0, 1.0, 9);
    for grid in [all.pruned(&all.voxels_where(|row| row % 5 == 1)), all] {
        let header = Header::new(&grid, "still life", [1.0; 3], 42, 1234);
        assert_eq!(header.format, checkpoint::REDUCED_FORMAT);
        checkpoint::save(&path, &grid, &header).expect("it is written");
        let (read, read_header) = checkpoint::load::<f32>(&path).expect("it is read");
        assert_eq!((read.shape(), &read_header), (grid.shape(), &header));
        assert_eq!(read.lattice().masks(), grid.lattice().masks());
        let (read_lattice, lattice) = (read.harmonics_lattice().expect("reduced"), grid.harmonics_lattice().expect("reduced"));
        assert_eq!(read_lattice.masks(), lattice.masks());
        for (read, written) in read.params().zip(grid.params()) {
            let width = written.shape()[1];
            let lattice = if written.name() == "harmonics" { lattice } else { grid.lattice() };
            for row in (0..lattice.rows()).filter(|&row| lattice.node(row as u32).is_some()) {
                assert_eq!(read.tensor().data()[row * width..][..width], written.tensor().data()[row * width..][..width]);
            }
        }
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, replace(&bytes, br#"\"sh_reduction\":2"#, br#"\"sh_reduction\":3"#)).unwrap();
        let message = checkpoint::load::<f32>(&path).expect_err("it is damaged").to_string();
        assert!(message.contains("harmonics of other voxels") || message.contains("list of voxels"), "{message}");
    }
}

#[test]
fn coordinates_of_captures_come_back_and_their_numbers_are_checked() {
    let path = folder("coordinates").join("checkpoint.safetensors");
    let ndc = GridSpace { space: Space::Ndc { a: 1.75, b: 2.25 }, stretch: [1.0, 1.0, 0.375].into() };
    let contracted = GridSpace { space: Space::Contracted, ..GridSpace::WORLD };
    for (coordinates, sh_reduction) in [(ndc, 1), (contracted, 1), (contracted, 2)] {
        let half_width = if coordinates == contracted { Space::CONTRACTED } else { 1.25 };
        let shape = GridShape { coordinates, sh_reduction, half_width, ..*grid().0.shape() };
        let grid = VoxelGrid::<f32>::random(shape, 3.0, 1.0, 9);
        let header = Header::new(&grid, "still life", [1.0; 3], 42, 1234);
        assert_eq!(header.format, checkpoint::SPACE_FORMAT);
        checkpoint::save(&path, &grid, &header).expect("it is written");
        let (read, read_header) = checkpoint::load::<f32>(&path).expect("it is read");
        assert_eq!((read.shape(), &read_header), (grid.shape(), &header));
        assert!(read.params().zip(grid.params()).all(|(read, written)| read.tensor().shape() == written.tensor().shape()));
        let bytes = std::fs::read(&path).unwrap();
        // A program that knows no coordinates must not read such a file as one of the world.
        for (found, other) in [(&b"plenoxel 4"[..], &b"plenoxel 2"[..]), (b"1.0,1.0,", b"1.0,0.0,"), (b"1.0,1.0,", b"1.0,-1.,")] {
            std::fs::write(&path, replace(&bytes, found, other)).unwrap();
            let refused = checkpoint::load::<f32>(&path).expect_err("it is damaged");
            assert_eq!(refused.exit_code(), 3, "{refused}");
        }
    }
}

#[test]
fn a_damaged_or_foreign_file_is_named_with_what_is_wrong() {
    let dir = folder("damaged");
    let path = dir.join("checkpoint.safetensors");
    let (grid, header) = grid();
    checkpoint::save(&path, &grid, &header).expect("it is written");
    let whole = std::fs::read(&path).unwrap();
    let message = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        let error = checkpoint::load::<f32>(&path).expect_err("it is damaged");
        assert_eq!(error.exit_code(), 3, "{error}");
        error.to_string()
    };
    for cut in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        assert!(message(&whole[..cut]).contains("not a complete safetensors file"), "cut to {cut} bytes");
    }
    let text = String::from_utf8_lossy(&whole).into_owned();
    assert!(text.contains("plenoxel 1"));
    let later: Vec<u8> = replace(&whole, b"plenoxel 1", b"plenoxel 9");
    assert!(message(&later).contains("format `plenoxel 9`"));
    // The format of coordinates of captures, of a grid of the world.
    assert!(message(&replace(&whole, b"plenoxel 1", b"plenoxel 4")).contains("out of range"));
    assert!(message(&replace(&whole, br#"\"resolution\":5"#, br#"\"resolution\":7"#)).contains("expected"));
    let foreign = safetensors_without_metadata();
    assert!(message(&foreign).contains("without the key `plenoxel`"));
    assert_eq!(checkpoint::load::<f32>(&dir.join("missing")).expect_err("there is none").exit_code(), 3);
}

fn replace(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let at = bytes.windows(from.len()).position(|w| w == from).expect("the text is there");
    [&bytes[..at], to, &bytes[at + from.len()..]].concat()
}

/// A header of two bytes, `{}`, padded to eight, and nothing else.
fn safetensors_without_metadata() -> Vec<u8> {
    [&8u64.to_le_bytes()[..], b"{}      "].concat()
}

#[test]
fn a_file_is_written_whole_or_not_at_all() {
    let dir = folder("unwritable");
    // The path is a folder: the rename fails, and nothing of the attempt stays.
    let path = dir.join("taken");
    std::fs::create_dir_all(path.join("inside")).unwrap();
    let (grid, header) = grid();
    let error = checkpoint::save(&path, &grid, &header).expect_err("a folder is in the way");
    assert_eq!(error.exit_code(), 5);
    assert_eq!(std::fs::read_dir(&dir).unwrap().count(), 1);
}
