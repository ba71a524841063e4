//! Parts of a surface: triangles connected by common vertices.

use super::Surface;

impl Surface {
    /// Removes the parts of fewer than `least` triangles, except the largest part. Returns the number of removed parts.
    pub fn leave_out_parts_below(&mut self, least: usize) -> usize {
        let mut parts = Parts::new(self.crossings.len());
        for &[a, b, c] in &self.triangles {
            parts.join(a, b);
            parts.join(b, c);
        }
        // Number of triangles of each part, stored at the vertex that names the part. Every part has some.
        let mut count = vec![0; self.crossings.len()];
        self.triangles.iter().for_each(|triangle| count[parts.name(triangle[0]) as usize] += 1);
        let least = least.min(count.iter().copied().max().unwrap_or(0));
        let left_out = count.iter().filter(|&&triangles| triangles > 0 && triangles < least).count();
        let mut left = Surface::default();
        // New number of each remaining vertex. Each has a triangle.
        let mut numbers = vec![0; self.crossings.len()];
        for (v, &crossing) in self.crossings.iter().enumerate() {
            if count[parts.name(v as u32) as usize] >= least {
                numbers[v] = left.crossings.len() as u32;
                left.crossings.push(crossing);
            }
        }
        let stays = self.triangles.iter().filter(|triangle| count[parts.name(triangle[0]) as usize] >= least);
        left.triangles = stays.map(|triangle| triangle.map(|v| numbers[v as usize])).collect();
        *self = left;
        left_out
    }
}

/// Disjoint sets of vertices (Tarjan 1975), each named by its smallest vertex. A vertex points to another vertex of its set, or to itself.
struct Parts(Vec<u32>);

impl Parts {
    fn new(vertices: usize) -> Self {
        Parts((0..vertices as u32).collect())
    }

    /// Returns the name of the set of a vertex, with path halving.
    fn name(&mut self, mut v: u32) -> u32 {
        while self.0[v as usize] != v {
            let next = self.0[v as usize];
            self.0[v as usize] = self.0[next as usize];
            v = next;
        }
        v
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.name(a), self.name(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}
