//! Mesh files: PLY, OBJ, binary glTF and STL.

use super::mesh::Mesh;
use crate::error::{Error, Result};
use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use std::fmt::{self, Display, Write};
use std::str::FromStr;

/// Format of a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MeshFormat {
    /// Stanford PLY, binary little endian; colors as bytes `red`, `green`, `blue`.
    Ply,
    /// Wavefront OBJ, text; colors after the positions, `v x y z r g b`, in [0, 1].
    Obj,
    /// Binary glTF 2.0. Positions are those of the dataset; the node is rotated so that the z of the world becomes glTF's y, which is up. The
    /// material is unlit, because the colors include the lighting. Colors are linear, as glTF requires.
    Glb,
    /// Binary STL: triangles with one normal each. The format has no colors.
    Stl,
}

impl MeshFormat {
    /// All formats.
    pub const ALL: [Self; 4] = [MeshFormat::Ply, MeshFormat::Obj, MeshFormat::Glb, MeshFormat::Stl];

    /// Returns true if files of this format contain colors.
    pub fn has_colors(self) -> bool {
        self != MeshFormat::Stl
    }

    /// Encodes a mesh in this format. `comment` is one line about the origin of the mesh.
    ///
    /// Errors if the mesh is larger than the format allows.
    pub fn encode(self, mesh: &Mesh, comment: &str) -> Result<Vec<u8>> {
        match self {
            MeshFormat::Ply => Ok(ply(mesh, comment)),
            MeshFormat::Obj => Ok(obj(mesh, comment)),
            MeshFormat::Glb => glb(mesh, comment),
            MeshFormat::Stl => stl(mesh, comment),
        }
    }
}

impl Display for MeshFormat {
    /// Formats the name, which is also the file extension.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            MeshFormat::Ply => "ply",
            MeshFormat::Obj => "obj",
            MeshFormat::Glb => "glb",
            MeshFormat::Stl => "stl",
        })
    }
}

impl FromStr for MeshFormat {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let known = Self::ALL.into_iter().find(|format| format.to_string().eq_ignore_ascii_case(text));
        known.ok_or_else(|| Error::config("format", format!("\"{text}\""), "ply, obj, glb, stl"))
    }
}

fn ply(mesh: &Mesh, comment: &str) -> Vec<u8> {
    let header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment {comment}\n\
        element vertex {}\nproperty float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\nproperty float nz\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\n\
        element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.triangles.len()
    );
    let mut file = Vec::with_capacity(header.len() + mesh.positions.len() * 27 + mesh.triangles.len() * 13);
    file.extend_from_slice(header.as_bytes());
    for ((position, normal), color) in mesh.positions.iter().zip(&mesh.normals).zip(&mesh.colors) {
        file.extend(position.iter().chain(normal).flat_map(|x| x.to_le_bytes()));
        file.extend_from_slice(color);
    }
    for triangle in &mesh.triangles {
        file.push(3);
        file.extend(triangle.iter().flat_map(|v| v.to_le_bytes()));
    }
    file
}

fn obj(mesh: &Mesh, comment: &str) -> Vec<u8> {
    let mut file = format!("# {comment}\n");
    let mut line = |text: fmt::Arguments<'_>| {
        // Writing to a string cannot fail.
        let _ = file.write_fmt(text);
    };
    for ([x, y, z], color) in mesh.positions.iter().zip(&mesh.colors) {
        let [r, g, b] = color.map(|c| f64::from(c) / 255.0);
        line(format_args!("v {x} {y} {z} {r:.4} {g:.4} {b:.4}\n"));
    }
    for [x, y, z] in &mesh.normals {
        line(format_args!("vn {x:.4} {y:.4} {z:.4}\n"));
    }
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|v| u64::from(v) + 1);
        line(format_args!("f {a}//{a} {b}//{b} {c}//{c}\n"));
    }
    file.into_bytes()
}

/// Constants of the glTF specification: component types, targets of buffer views.
mod gltf {
    pub const UNSIGNED_SHORT: u32 = 5123;
    pub const UNSIGNED_INT: u32 = 5125;
    pub const FLOAT: u32 = 5126;
    pub const VERTICES: u32 = 34962;
    pub const INDICES: u32 = 34963;
}

fn glb(mesh: &Mesh, comment: &str) -> Result<Vec<u8>> {
    let floats = |rows: &[[f32; 3]]| -> Vec<u8> { rows.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect() };
    // 16-bit colors, because 8 bits would show bands in dark regions; with alpha, because rows must start at multiples of four bytes.
    let colors = mesh.colors.iter().flat_map(|rgb| rgb.map(linear).into_iter().chain([u16::MAX]).flat_map(u16::to_le_bytes)).collect();
    let count = mesh.positions.len();
    let bound = |pick: fn(f32, f32) -> f32| {
        let corner = mesh.positions.iter().copied().reduce(|a, b| [0, 1, 2].map(|axis| pick(a[axis], b[axis])));
        corner.unwrap_or_default()
    };
    let parts: [(Vec<u8>, u32, Value); 4] = [
        (
            floats(&mesh.positions),
            gltf::VERTICES,
            json!({ "componentType": gltf::FLOAT, "type": "VEC3", "count": count, "min": bound(f32::min), "max": bound(f32::max) }),
        ),
        (floats(&mesh.normals), gltf::VERTICES, json!({ "componentType": gltf::FLOAT, "type": "VEC3", "count": count })),
        (colors, gltf::VERTICES, json!({ "componentType": gltf::UNSIGNED_SHORT, "normalized": true, "type": "VEC4", "count": count })),
        (
            mesh.triangles.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect(),
            gltf::INDICES,
            json!({ "componentType": gltf::UNSIGNED_INT, "type": "SCALAR", "count": 3 * mesh.triangles.len() }),
        ),
    ];
    let (mut binary, mut views, mut accessors) = (Vec::new(), Vec::new(), Vec::new());
    for (number, (bytes, target, mut accessor)) in parts.into_iter().enumerate() {
        views.push(json!({ "buffer": 0, "byteOffset": binary.len(), "byteLength": bytes.len(), "target": target }));
        accessor["bufferView"] = json!(number);
        accessors.push(accessor);
        binary.extend(bytes);
    }
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let to_y_up = DQuat::from_xyzw(-half, 0.0, 0.0, half) * DQuat::from_mat3(&mesh.upright);
    let document = json!({
        "asset": { "version": "2.0", "generator": comment },
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        // A quarter turn around x: (x, y, z) to (x, z, −y).
        "nodes": [{ "mesh": 0, "rotation": to_y_up.to_array() }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0, "NORMAL": 1, "COLOR_0": 2 }, "indices": 3, "material": 0 }] }],
        "materials": [{
            "pbrMetallicRoughness": { "baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0 },
            "extensions": { "KHR_materials_unlit": {} }
        }],
        "buffers": [{ "byteLength": binary.len() }],
        "bufferViews": views,
        "accessors": accessors,
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    // All parts consist of whole words, so the binary needs no padding.
    let total = 12 + 8 + text.len() + 8 + binary.len();
    let Ok(length) = u32::try_from(total) else {
        return Err(Error::usage("format", format!("the mesh has {total} bytes, but glb files may have at most 4 GiB"), "use ply or obj"));
    };
    let word = |n: usize| (n as u32).to_le_bytes();
    let header = [b"glTF".as_slice(), &2u32.to_le_bytes(), &length.to_le_bytes()].concat();
    Ok([header.as_slice(), &word(text.len()), b"JSON", &text, &word(binary.len()), b"BIN\0", &binary].concat())
}

fn stl(mesh: &Mesh, comment: &str) -> Result<Vec<u8>> {
    let Ok(count) = u32::try_from(mesh.triangles.len()) else {
        let found = format!("the mesh has {} triangles, but stl files may have at most 4294967295", mesh.triangles.len());
        return Err(Error::usage("format", found, "use ply or obj"));
    };
    // Many programs take a file that begins with the word "solid" for text.
    let mut file = format!("binary STL, {comment}").into_bytes();
    file.resize(80, b' ');
    file.extend(count.to_le_bytes());
    file.reserve(50 * mesh.triangles.len());
    for triangle in &mesh.triangles {
        let corners = triangle.map(|v| mesh.positions[v as usize]);
        let [a, b, c] = corners.map(|corner| DVec3::from(corner.map(f64::from)));
        let normal = (b - a).cross(c - a).normalize_or_zero().as_vec3().to_array();
        file.extend([normal].iter().chain(&corners).flatten().flat_map(|x| x.to_le_bytes()));
        file.extend([0; 2]);
    }
    Ok(file)
}

/// Converts an sRGB byte to 16 bits of linear light (IEC 61966-2-1).
fn linear(byte: u8) -> u16 {
    let c = f64::from(byte) / 255.0;
    let linear = if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    (linear * 65535.0).round() as u16
}
