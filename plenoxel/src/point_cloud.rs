//! Point clouds with colors, normals and scalar fields: what is made of a voxel grid, and what others send.
//!
//! Coordinates are `f64`, in whatever frame they came; [`filter`] cleans a cloud as CloudCompare does, [`from_grid`] makes one of a grid,
//! [`ply`] reads the PLY files of others and writes them.

pub mod filter;
pub mod from_grid;
mod plane;
pub mod ply;
mod sums;
mod tree;

use glam::DVec3;

/// Points with what is known of each; every list that is there has one entry for each point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Coordinates.
    pub positions: Vec<DVec3>,
    /// Red, green, blue.
    pub colors: Option<Vec<[u8; 3]>>,
    /// Unit, or zero where there is none.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Numbers with a name.
    pub fields: Vec<ScalarField>,
}

/// A number for each point.
#[derive(Clone, Debug, PartialEq)]
pub struct ScalarField {
    /// Without the `scalar_` that CloudCompare puts in front of it in a file.
    pub name: String,
    /// One for each point; may be no number.
    pub values: Vec<f32>,
}

impl PointCloud {
    /// The number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True if there is no point.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// The values of the field with a name.
    pub fn field(&self, name: &str) -> Option<&[f32]> {
        self.fields.iter().find(|field| field.name == name).map(|field| &field.values[..])
    }

    /// The points with some numbers, in their order.
    ///
    /// Panics if there is no point with one of the numbers.
    pub fn chosen(&self, numbers: &[u32]) -> Self {
        fn of<E: Copy>(list: &[E], numbers: &[u32]) -> Vec<E> {
            numbers.iter().map(|&i| list[i as usize]).collect()
        }
        PointCloud {
            positions: of(&self.positions, numbers),
            colors: self.colors.as_ref().map(|list| of(list, numbers)),
            normals: self.normals.as_ref().map(|list| of(list, numbers)),
            fields: self.fields.iter().map(|f| ScalarField { name: f.name.clone(), values: of(&f.values, numbers) }).collect(),
        }
    }
}
