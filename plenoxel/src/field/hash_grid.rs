//! Multiresolution hash encoding (Müller et al. 2022): features of a position, interpolated in grids of several resolutions.
//!
//! With x in [0, 1]³, level l has the scale s = base · growthˡ − 1 and the resolution N = ⌈s⌉ + 1. The position in the grid is u = s x + ½, and
//! the features of the eight corners of its cell are interpolated trilinearly. The result has the features of all levels, one after another.
//!
//! A level has min(N³ rounded up to a multiple of 8, 2ᵀ) rows of a common table. If all N³ nodes have a row, node (i, j, k) has row
//! i + j N + k N², modulo the number of rows. Otherwise nodes share rows: (i xor j · 2654435761 xor k · 805459861) mod 2ᵀ, in 32 bits. These
//! are the conventions of tiny-cuda-nn, except for the order of the levels in the table: those whose nodes share rows are first, so that each
//! has one bucket of 2ᵀ rows in the sums of gradients.

mod loops;
mod sums;

use autograd::{Buffer, GradSink, Indices, Kernel, KernelCall, Real, RowSparse, Tensor, parallel};
use loops::{BLOCK, TOGETHER};
use std::sync::Arc;

/// Sizes of a hash grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Number of levels L.
    pub levels: usize,
    /// Features of a level F: 1, 2, 4 or 8.
    pub features: usize,
    /// Base-2 logarithm T of the largest number of rows of a level, 3 to 24.
    pub log2_rows: u32,
    /// Resolution of the first level.
    pub base: usize,
    /// Ratio of the resolutions of consecutive levels.
    pub growth: f64,
}

/// One level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Scale s.
    pub scale: f64,
    /// Nodes along each axis N.
    pub resolution: usize,
    /// First row.
    pub first: usize,
    /// Number of rows.
    pub rows: usize,
    /// True if nodes share rows.
    pub hashed: bool,
}

/// Factors of the coordinates in the hash.
const PRIMES: [u32; 3] = [1, 2_654_435_761, 805_459_861];

impl Level {
    /// Returns the factors of the coordinates of a node.
    #[inline(always)]
    fn factors(&self) -> [u32; 3] {
        let n = self.resolution as u32;
        if self.hashed { PRIMES } else { [1, n, n.wrapping_mul(n)] }
    }

    /// Returns the row of a node, from the products of its coordinates with the [`factors`](Self::factors).
    #[inline(always)]
    fn row(&self, node: [u32; 3]) -> u32 {
        self.first as u32 + if self.hashed { self.row_in_level::<true>(node) } else { self.row_in_level::<false>(node) }
    }

    /// Returns the row of a node, counted from the first one of the level, which is hashed or is not.
    #[inline(always)]
    fn row_in_level<const HASHED: bool>(&self, [x, y, z]: [u32; 3]) -> u32 {
        let rows = self.rows as u32;
        if HASHED {
            (x ^ y ^ z) & (rows - 1)
        } else {
            // The outermost node of an axis may be one beyond the grid.
            let row = x + y + z;
            if row < rows { row } else { row - rows }
        }
    }
}

/// Layout of a hash grid in its table. Cloning copies a pointer.
#[derive(Clone, Debug)]
pub struct HashGrid {
    shape: Shape,
    levels: Arc<[Level]>,
}

impl HashGrid {
    /// Creates the layout.
    ///
    /// Panics if a size is out of range, or if the table has more than 2³¹ rows.
    #[track_caller]
    pub fn new(shape: Shape) -> Self {
        let Shape { levels, features, log2_rows, base, growth } = shape;
        assert!(
            levels > 0 && [1, 2, 4, 8].contains(&features),
            "HashGrid: {levels} levels of {features} features; expected 1, 2, 4 or 8 features"
        );
        assert!((3..=24).contains(&log2_rows) && base >= 2 && growth >= 1.0, "HashGrid: invalid sizes {shape:?}");
        let most = 1usize << log2_rows;
        let level = |l: usize| {
            let scale = base as f64 * growth.powi(l as i32) - 1.0;
            let resolution = scale.ceil() as usize + 1;
            let nodes = resolution.saturating_pow(3);
            Level { scale, resolution, first: 0, rows: (nodes.saturating_add(7) / 8 * 8).min(most), hashed: nodes > most }
        };
        let mut levels: Vec<Level> = (0..levels).map(level).collect();
        let mut first = 0;
        for hashed in [true, false] {
            for level in levels.iter_mut().filter(|level| level.hashed == hashed) {
                level.first = first;
                first += level.rows;
            }
        }
        assert!(first < 1 << 31, "HashGrid: a table of {first} rows");
        HashGrid { shape, levels: levels.into() }
    }

    /// Returns the sizes.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Returns the levels.
    pub fn levels(&self) -> &[Level] {
        &self.levels
    }

    /// Returns the number of rows of the table, whose shape is `[rows, features]`.
    pub fn rows(&self) -> usize {
        self.levels.iter().map(|level| level.rows).sum()
    }

    /// Returns the number of values of an encoded position.
    pub fn width(&self) -> usize {
        self.shape.levels * self.shape.features
    }

    /// Encodes positions `[m, 3]` in the unit cube with a table `[rows, features]`: `[m, width]`. Positions outside are clamped.
    ///
    /// Differentiable with respect to the table, with a row-sparse gradient, and to the positions. The gradient with respect to a clamped
    /// coordinate is 0, and it is discontinuous between cells.
    ///
    /// Panics if a shape is another.
    #[track_caller]
    pub fn encode<T: Real>(&self, table: &Tensor<T>, positions: &Tensor<T>) -> Tensor<T> {
        let want = [self.rows(), self.shape.features];
        assert_eq!(table.shape(), want, "hash_encode: the table must be {want:?}, got {:?}", table.shape());
        assert!(positions.ndim() == 2 && positions.shape()[1] == 3, "hash_encode: positions must be [m, 3], got {:?}", positions.shape());
        let (m, width) = (positions.shape()[0], self.width());
        let (features, data) = (self.shape.features, table.data());
        let groups = loops::groups(positions.data().as_chunks::<3>().0);
        let mut blocks = Buffer::stale(m * width);
        for (l, level) in self.levels.iter().enumerate() {
            // From one look-up a row on, nearly all of a level is read. Measured with four look-ups a row.
            if 8 * m >= level.rows && level.rows * features <= LOADED {
                let rows = &data[level.first * features..][..level.rows * features];
                parallel::map_chunks(rows.len(), parallel::CHUNK, |range| parallel::load(&rows[range]));
            }
            parallel::for_each_chunk(&mut blocks, BLOCK * width, |start, block| {
                let count = block.len() / width;
                let groups = &groups[start / width / TOGETHER..][..count.div_ceil(TOGETHER)];
                loops::encode(level, features, data, groups, &mut block[l * count * features..][..count * features]);
            });
        }
        let out = self.copied(&blocks, true);
        Tensor::from_kernel(out, &[m, width], &[table, positions], Encode { grid: self.clone() })
    }

    /// Copies the numbers of blocks to the rows of a tensor `[m, levels · features]`, or such rows to blocks.
    fn copied<T: Real>(&self, numbers: &[T], to_rows: bool) -> Buffer<T> {
        let mut out = Buffer::stale(numbers.len());
        parallel::for_each_chunk(&mut out, BLOCK * self.width(), |start, out| {
            loops::copy_block(self.shape.levels, self.shape.features, to_rows, &numbers[start..start + out.len()], out);
        });
        out
    }
}

/// Size of the largest level that is read in order before its look-ups, in numbers: 8 MB in single precision, which fit in a last-level cache.
const LOADED: usize = 1 << 21;

/// Kernel that maps a table and positions to encoded positions.
#[derive(Debug)]
struct Encode {
    grid: HashGrid,
}

impl<T: Real> Kernel<T> for Encode {
    fn name(&self) -> &'static str {
        "hash_encode"
    }

    fn reference(&self, inputs: &[Tensor<T>]) -> Tensor<T> {
        let [table, positions] = inputs else { unreachable!("hash_encode has two inputs") };
        let inside = positions.clamp(0.0, 1.0);
        let levels = self.grid.levels.iter().map(|level| {
            let u = &inside * level.scale + 0.5;
            let cells = u.constant_map(T::floor);
            let above = u - &cells;
            let below = 1.0 - &above;
            let corner = |c: usize| {
                let up = [c & 1, c >> 1 & 1, c >> 2];
                let row = |cell: &[T; 3]| {
                    let factors = level.factors();
                    level.row([0, 1, 2].map(|a| (cell[a].index() + up[a] as u32).wrapping_mul(factors[a])))
                };
                let rows: Vec<u32> = cells.data().as_chunks().0.iter().map(row).collect();
                let share = |a: usize| if up[a] == 1 { above.narrow(1, a, 1) } else { below.narrow(1, a, 1) };
                table.gather_rows(&Indices::from(rows)) * (share(0) * share(1) * share(2))
            };
            (1..8).fold(corner(0), |sum, c| sum + corner(c))
        });
        Tensor::concat(&levels.collect::<Vec<_>>().iter().collect::<Vec<_>>(), 1)
    }

    fn vjp(&self, call: &KernelCall<'_, T>, out: &mut GradSink<T>) {
        let (positions, g) = (call.input(1), call.cotangent());
        let (places, features) = (positions.data().as_chunks::<3>().0, self.grid.shape.features);
        if call.needs(0) {
            let sums = sums::HashSums { grid: self.grid.clone(), groups: loops::groups(places), blocks: self.grid.copied(g.data(), false) };
            out.rows(0, RowSparse::deferred(&[self.grid.rows(), features], Arc::new(sums)));
        }
        if call.needs(1) {
            let (table, width) = (call.input(0), self.grid.width());
            let mut slopes = Buffer::stale(positions.len());
            parallel::for_each_rows(&mut slopes, 3, |first, slopes| {
                let range = first..first + slopes.len() / 3;
                let g = &g.data()[range.start * width..range.end * width];
                loops::slopes(&self.grid.levels, features, table.data(), &places[range], g, slopes);
            });
            out.dense(1, slopes);
        }
    }
}
