//! Polygons of the surface in a cell, for each of the 256 combinations of dense and thin corners.
//!
//! Vertices are on the edges whose ends differ. On each face, seen from outside of the cell in counterclockwise order, every run of dense
//! corners is cut off by a segment from the edge where the run begins to the edge where it ends. Two diagonally opposite dense corners are
//! therefore separated. The cell on the other side of the face does the same, in the opposite order. Each vertex starts a segment on one of
//! its two faces and ends one on the other: the segments form closed loops, counterclockwise seen from the thin side.

/// Corners of a cell, x slowest. Corner c is bit c of a case.
pub(super) const CORNERS: [[usize; 3]; 8] = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1], [1, 0, 0], [1, 0, 1], [1, 1, 0], [1, 1, 1]];

/// Edges of a cell: the corner where each begins, and its axis.
pub(super) const EDGES: [([usize; 3], usize); 12] = [
    ([0, 0, 0], 0),
    ([0, 0, 1], 0),
    ([0, 1, 0], 0),
    ([0, 1, 1], 0),
    ([0, 0, 0], 1),
    ([0, 0, 1], 1),
    ([1, 0, 0], 1),
    ([1, 0, 1], 1),
    ([0, 0, 0], 2),
    ([0, 1, 0], 2),
    ([1, 0, 0], 2),
    ([1, 1, 0], 2),
];

/// Returns the triangles of each case, as triples of edges.
pub(super) fn triangles() -> Vec<Vec<[u8; 3]>> {
    (0..256).map(|case| loops(case).iter().flat_map(|edges| filled(edges)).collect()).collect()
}

/// Returns the closed loops of edges of a case.
fn loops(case: usize) -> Vec<Vec<u8>> {
    let dense = |corner: [usize; 3]| case >> (corner[0] * 4 + corner[1] * 2 + corner[2]) & 1 == 1;
    let mut next = [None; 12];
    for (axis, side) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
        let round = face(axis, side);
        for start in 0..4 {
            let corner = |i: usize| round[(start + i) % 4];
            if dense(corner(0)) || !dense(corner(1)) {
                continue;
            }
            // A run begins between corners 0 and 1, and ends before the first thin corner.
            let end = (2..=4).find(|&i| !dense(corner(i))).unwrap_or(4);
            next[usize::from(between(corner(0), corner(1)))] = Some(between(corner(end - 1), corner(end)));
        }
    }
    let mut loops = Vec::new();
    for start in 0..12 {
        let (mut edges, mut edge) = (Vec::new(), start);
        while let Some(following) = next[usize::from(edge)].take() {
            edges.push(edge);
            edge = following;
        }
        if !edges.is_empty() {
            loops.push(edges);
        }
    }
    loops
}

/// Returns the corners of a face, counterclockwise seen from outside of the cell.
fn face(axis: usize, side: usize) -> [[usize; 3]; 4] {
    let mut round = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[u, v]| {
        let mut corner = [side; 3];
        corner[(axis + 1) % 3] = u;
        corner[(axis + 2) % 3] = v;
        corner
    });
    if side == 0 {
        round.reverse();
    }
    round
}

/// Returns the edge between two neighbouring corners.
fn between(a: [usize; 3], b: [usize; 3]) -> u8 {
    let is = |&(corner, axis): &([usize; 3], usize)| {
        let mut end = corner;
        end[axis] = 1;
        (a, b) == (corner, end) || (b, a) == (corner, end)
    };
    EDGES.iter().position(is).map_or(0, |edge| edge as u8)
}

/// Returns true if two edges lie on a common face.
fn share_a_face(a: u8, b: u8) -> bool {
    let [(a, along_a), (b, along_b)] = [a, b].map(|edge| EDGES[usize::from(edge)]);
    (0..3).any(|axis| axis != along_a && axis != along_b && a[axis] == b[axis])
}

/// Triangulates a loop without diagonals on a face of the cell, because the neighbouring cell could have the same edge.
fn filled(edges: &[u8]) -> Vec<[u8; 3]> {
    let n = edges.len();
    if n == 3 {
        return vec![[edges[0], edges[1], edges[2]]];
    }
    // Cut off a corner, and triangulate the rest.
    let cut = |i: usize| {
        let [before, here, after] = [i, i + 1, i + 2].map(|i| edges[i % n]);
        if share_a_face(before, after) {
            return None;
        }
        let mut triangles = filled(&edges.iter().copied().filter(|&edge| edge != here).collect::<Vec<_>>());
        let complete = triangles.len() == n - 3;
        triangles.push([before, here, after]);
        complete.then_some(triangles)
    };
    (0..n).find_map(cut).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    #[test]
    fn every_case_is_filled_and_its_border_is_the_segments_of_its_faces() {
        let all = triangles();
        assert_eq!(all.len(), 256);
        for (case, triangles) in all.iter().enumerate() {
            let loops = loops(case);
            let crossed = EDGES.iter().filter(|(corner, axis)| {
                let mut end = *corner;
                end[*axis] = 1;
                let dense = |c: [usize; 3]| case >> CORNERS.iter().position(|corner| *corner == c).unwrap() & 1;
                dense(*corner) != dense(end)
            });
            assert_eq!(loops.iter().map(Vec::len).sum::<usize>(), crossed.count(), "case {case}: every crossed edge is in one loop");
            assert_eq!(triangles.len(), loops.iter().map(|edges| edges.len() - 2).sum::<usize>(), "case {case} is filled");
            let mut sides: HashMap<[u8; 2], i32> = HashMap::new();
            for [a, b, c] in triangles {
                for [from, to] in [[a, b], [b, c], [c, a]] {
                    *sides.entry([*from, *to]).or_default() += 1;
                }
            }
            for (&[from, to], &count) in &sides {
                assert_eq!(count, 1, "case {case}: a side of two triangles in the same direction");
                let inner = sides.contains_key(&[to, from]);
                assert!(inner != share_a_face(from, to), "case {case}: sides on faces are borders, others are not");
            }
        }
    }

    #[test]
    fn one_dense_corner_is_cut_off_counterclockwise() {
        // Corner (0, 0, 0): from the edge along x to the edge along y to the edge along z.
        let triangle = triangles()[1][0];
        let start = triangle.iter().position(|&edge| edge == 0).unwrap();
        assert_eq!([0, 1, 2].map(|i| EDGES[usize::from(triangle[(start + i) % 3])].1), [0, 1, 2]);
    }
}
