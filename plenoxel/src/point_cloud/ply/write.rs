//! PLY writer, with property names that CloudCompare, MeshLab and Open3D recognize.
//!
//! The file is binary, little-endian. Properties: `x`, `y`, `z`; `nx`, `ny`, `nz`; `red`, `green`, `blue` from 0 to 255; `scalar_<name>`
//! for each scalar field, which CloudCompare reads as scalar fields; and `quality`, a copy of the first field, which MeshLab reads
//! (CloudCompare's command line ignores it). No property is a list, because CloudCompare does not read lists of points.

use super::{Element, Encoding, Kind, Number, Property, SCALAR_PREFIX, header_lines};
use crate::point_cloud::PointCloud;

/// Encodes a cloud as a file. `comments` become comment lines of the header. Coordinates are `float`, or `double` if some cannot be
/// represented as `float`. Spaces in names become `_`.
pub fn encode(cloud: &PointCloud, comments: &[String]) -> Vec<u8> {
    let exact = |p: &glam::DVec3| p.as_vec3().as_dvec3() == *p || !p.is_finite();
    let coordinate = if cloud.positions.iter().all(exact) { Number::F32 } else { Number::F64 };
    let mut properties = Vec::new();
    let mut add = |number: Number, names: &[&str]| {
        properties.extend(names.iter().map(|name| Property { name: name.replace(' ', "_"), kind: Kind::Scalar(number) }));
    };
    add(coordinate, &["x", "y", "z"]);
    if cloud.normals.is_some() {
        add(Number::F32, &["nx", "ny", "nz"]);
    }
    if cloud.colors.is_some() {
        add(Number::U8, &["red", "green", "blue"]);
    }
    for field in &cloud.fields {
        add(Number::F32, &[&format!("{SCALAR_PREFIX}{}", field.name)]);
    }
    if !cloud.fields.is_empty() {
        add(Number::F32, &["quality"]);
    }
    let element = Element { name: "vertex".to_owned(), count: cloud.len(), properties };
    let remarks: Vec<String> = comments.iter().map(|line| format!("comment {line}")).collect();
    let program = concat!("written by plenoxel ", env!("CARGO_PKG_VERSION"));
    let mut file = header_lines(Encoding::LittleEndian, &remarks, program, &element, cloud.len()).into_bytes();
    file.reserve(cloud.len() * element.least_size(Encoding::LittleEndian));
    for i in 0..cloud.len() {
        let position = cloud.positions[i].to_array();
        match coordinate {
            Number::F64 => position.iter().for_each(|x| file.extend(x.to_le_bytes())),
            _ => position.iter().for_each(|&x| file.extend((x as f32).to_le_bytes())),
        }
        if let Some(normals) = &cloud.normals {
            normals[i].iter().for_each(|n| file.extend(n.to_le_bytes()));
        }
        if let Some(colors) = &cloud.colors {
            file.extend(colors[i]);
        }
        for field in cloud.fields.iter().chain(cloud.fields.first()) {
            file.extend(field.values[i].to_le_bytes());
        }
    }
    file
}
