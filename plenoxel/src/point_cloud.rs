//! Point clouds with colors, normals and scalar fields, created from a voxel grid or read from files.
//!
//! Coordinates are `f64`, in the frame of their source. [`filter`] filters a cloud like CloudCompare, [`from_grid`] creates a cloud from a
//! grid, and [`ply`] reads and writes PLY files.

pub mod filter;
pub mod from_grid;
mod plane;
pub mod ply;
mod sums;
mod tree;

use crate::geometry::Similarity;
use glam::DVec3;

/// Points with optional attributes. Every list that is present has one entry per point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Coordinates.
    pub positions: Vec<DVec3>,
    /// Colors: red, green, blue.
    pub colors: Option<Vec<[u8; 3]>>,
    /// Normals of unit length; zero for points without a normal.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Named scalar fields.
    pub fields: Vec<ScalarField>,
}

/// One number per point.
#[derive(Clone, Debug, PartialEq)]
pub struct ScalarField {
    /// Name, without the prefix `scalar_` that CloudCompare uses in files.
    pub name: String,
    /// One value per point; may be NaN.
    pub values: Vec<f32>,
}

impl PointCloud {
    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Returns true if there are no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Returns the values of the field of this name.
    pub fn field(&self, name: &str) -> Option<&[f32]> {
        self.fields.iter().find(|field| field.name == name).map(|field| &field.values[..])
    }

    /// Returns the image of the cloud under a similarity. Scalar fields are unchanged.
    pub fn moved(mut self, by: &Similarity) -> Self {
        self.positions.iter_mut().for_each(|position| *position = by.point(*position));
        for normal in self.normals.iter_mut().flatten() {
            *normal = (by.rotation * DVec3::from(normal.map(f64::from))).as_vec3().to_array();
        }
        self
    }

    /// Returns the points with the given numbers, in that order.
    ///
    /// Panics if a number is out of range.
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
