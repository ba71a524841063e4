//! Value and gradient of the total variation in one pass over bricks.
//!
//! With q = 1 / √(…) for each cell and channel, the node of a cell gets −q (dx + dy + dz), and each neighbour q d, both divided by the number of
//! terms. A task computes the contributions q d of each of its bricks once. Then every node collects from its own cell and from the three cells
//! behind it, so no two tasks write the same node. If a brick behind belongs to another task, its last layer of cells is computed again.
//!
//! A brick consists of four *slabs* of equal x, a slab of four *lines* of equal y, a line of four nodes along z. Loops run over slabs. The nodes
//! ahead along y and z are loaded at an offset of a line and of a node, once in the brick and once in the brick ahead, and a constant mask
//! selects between both.

use super::{EPSILON, Run};
use autograd::lattice::{BRICK, BRICK_ROWS, Neighbours, STRIDE, has, local_of};
use autograd::{Buffer, Real, dispatched, parallel};
use std::hint::select_unpredictable;

/// Returns the number of bricks of a task. A large grid has 64 tasks or more. With at least 256 bricks in each, few have a brick behind in another task. A task
/// keeps [`Leaving`] of each brick: at most 2 MB, unless 256 bricks need more.
pub(super) fn task<T, const S: usize>(count: usize) -> usize {
    const LEAST: usize = 256;
    count.div_ceil(64).clamp(LEAST, ((2 << 20) / size_of::<Leaving<T, S>>()).max(LEAST))
}

/// Returns S elements from `start` on, or the last S elements.
#[inline(always)]
fn window<T, const S: usize>(flat: &[T], start: usize) -> &[T; S] {
    flat[start.min(flat.len() - S)..].first_chunk().expect("there are S elements")
}

/// Contributions that leave a brick along each axis: those of its last slab, of the last line of each slab, and of the last node of each line.
type Leaving<T, const S: usize> = [[T; S]; 3];

/// Contributions q d of the cells of a brick to the nodes ahead. Along x and y, those that come from the brick behind are in front, so
/// that what a slab gets and what it gives are windows of the same array.
struct Contributions<T, const N: usize, const S: usize> {
    /// Along x: the last slab of the brick behind, and four slabs.
    x: [[T; S]; BRICK + 1],
    /// Along y, for each slab: a line of the brick behind, and four lines.
    y: [[[T; N]; BRICK + 1]; BRICK],
    /// Along z: an unused slab, and four slabs.
    z: [[T; S]; BRICK + 1],
    /// Along z, at the first node of each line: the last node of a line of the brick behind. Other nodes are unused.
    behind_z: [[T; S]; BRICK],
}

impl<T: Real, const N: usize, const S: usize> Contributions<T, N, S> {
    fn zeros() -> Box<Self> {
        let zero = T::zero();
        Box::new(Contributions {
            x: [[zero; S]; BRICK + 1],
            y: [[[zero; N]; BRICK + 1]; BRICK],
            z: [[zero; S]; BRICK + 1],
            behind_z: [[zero; S]; BRICK],
        })
    }

    /// Clears the contributions of a brick without cells.
    #[inline(always)]
    fn clear(&mut self) {
        self.x[1..].fill([T::zero(); S]);
        self.y.iter_mut().for_each(|lines| lines[1..].fill([T::zero(); N]));
        self.z[1..].fill([T::zero(); S]);
    }

    /// Stores what leaves the brick.
    #[inline(always)]
    fn store_leaving<const W: usize>(&self, [slab, lines, nodes]: &mut Leaving<T, S>) {
        *slab = self.x[BRICK];
        lines.as_chunks_mut().0.iter_mut().zip(&self.y).for_each(|(line, lines)| *line = lines[BRICK]);
        let lines_along_z = self.z[1..].as_flattened().as_chunks::<N>().0;
        for (node, line) in nodes.as_chunks_mut::<W>().0.iter_mut().zip(lines_along_z) {
            *node = *line.last_chunk().expect("a line has four nodes");
        }
    }

    /// Takes what leaves the brick behind along an axis.
    #[inline(always)]
    fn enter<const W: usize>(&mut self, axis: usize, leaving: &[T; S]) {
        match axis {
            0 => self.x[0] = *leaving,
            1 => self.y.iter_mut().zip(leaving.as_chunks().0).for_each(|(lines, line)| lines[0] = *line),
            _ => {
                let lines = self.behind_z.as_flattened_mut().as_chunks_mut::<N>().0;
                for (line, node) in lines.iter_mut().zip(leaving.as_chunks::<W>().0) {
                    *line.first_chunk_mut().expect("a line has four nodes") = *node;
                }
            }
        }
    }

    /// Computes the contributions of slab x of a brick, and adds √(…) of its cells to `roots`.
    #[inline(always)]
    fn compute<const W: usize>(
        &mut self,
        table: &[[T; S]],
        bricks: &[Neighbours],
        brick: usize,
        x: usize,
        ones: &[T; S],
        roots: &mut [T; S],
    ) {
        let own = brick * BRICK + x;
        let (v, flat) = (&table[own], table.as_flattened());
        // Bricks ahead have higher numbers, because bricks are in Morton order. So the last slab of the table has no cells, and no other window ends beyond the
        // table. If a brick is missing, its nodes are arbitrary: no cell reads them.
        let [ahead_x, ahead_y, ahead_z] = bricks[brick].ahead;
        let beyond = |ahead: Option<u32>, x: usize, offset: usize| match ahead {
            Some(ahead) => {
                debug_assert!(ahead as usize > brick);
                (ahead as usize * BRICK + x) * S - offset
            }
            None => own * S,
        };
        let next_x = if x + 1 < BRICK { &table[own + 1] } else { window(flat, beyond(ahead_x, 0, 0)) };
        let near_y: &[T; S] = window(flat, own * S + N);
        let near_z: &[T; S] = window(flat, own * S + W);
        let beyond_y: &[T; S] = window(flat, beyond(ahead_y, x, S - N));
        let beyond_z: &[T; S] = window(flat, beyond(ahead_z, x, N - W));

        let cells = bricks[brick].cells >> (STRIDE[0] * x) & 0xffff;
        let mut with_cell = [T::zero(); S];
        let has_cell = if cells == 0xffff {
            ones
        } else {
            for node in (0..16).filter(|&node| has(cells, node)) {
                with_cell[node * W..(node + 1) * W].fill(T::one());
            }
            &with_cell
        };
        let to_x = &mut self.x[x + 1];
        let to_y: &mut [T; S] = self.y[x].as_flattened_mut().last_chunk_mut().expect("there are four lines");
        let to_z = &mut self.z[x + 1];
        differences::<T, W, N, S>(v, next_x, [near_y, beyond_y], [near_z, beyond_z], has_cell, to_x, to_y, to_z, roots);
    }
}

/// Computes the contributions of a slab to the nodes ahead along each axis, and adds √(…) of its cells to `roots`.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn differences<T: Real, const W: usize, const N: usize, const S: usize>(
    v: &[T; S],
    next_x: &[T; S],
    [near_y, beyond_y]: [&[T; S]; 2],
    [near_z, beyond_z]: [&[T; S]; 2],
    has_cell: &[T; S],
    to_x: &mut [T; S],
    to_y: &mut [T; S],
    to_z: &mut [T; S],
    roots: &mut [T; S],
) {
    for l in 0..S {
        // All are loaded before one is selected; otherwise, addresses are selected, and each element is loaded by itself.
        let [y_near, y_beyond, z_near, z_beyond] = [near_y[l], beyond_y[l], near_z[l], beyond_z[l]];
        let next_y = select_unpredictable(l < S - N, y_near, y_beyond);
        let next_z = select_unpredictable(Ends::<W, N, S>::LAST[l], z_beyond, z_near);
        let (dx, dy, dz) = (next_x[l] - v[l], next_y - v[l], next_z - v[l]);
        let (square, inverse_root) = inverse_root(dx, dy, dz);
        let inverse_root = has_cell[l] * inverse_root;
        roots[l] += square * inverse_root;
        to_x[l] = dx * inverse_root;
        to_y[l] = dy * inverse_root;
        to_z[l] = dz * inverse_root;
    }
}

/// Returns r² = dx² + dy² + dz² + ε, and 1 / r.
#[inline(always)]
fn inverse_root<T: Real>(dx: T, dy: T, dz: T) -> (T, T) {
    let square = dx * dx + dy * dy + dz * dz + T::lit(EPSILON);
    (square, square.inverse_sqrt())
}

/// Masks of the first and the last node of each line of a slab.
struct Ends<const W: usize, const N: usize, const S: usize>;

impl<const W: usize, const N: usize, const S: usize> Ends<W, N, S> {
    const FIRST: [bool; S] = Self::mask(0);
    const LAST: [bool; S] = Self::mask(N - W);

    const fn mask(first: usize) -> [bool; S] {
        let mut mask = [false; S];
        let mut l = 0;
        while l < S {
            mask[l] = l % N >= first && l % N < first + W;
            l += 1;
        }
        mask
    }
}

/// Prefetches slab x of a brick, and what is read with it of the bricks ahead. Along z, that is the whole slab: the nodes that are read are in all or most of
/// its cache lines.
#[inline(always)]
fn prefetch_slab<T: Real, const N: usize, const S: usize>(table: &[[T; S]], bricks: &[Neighbours], brick: usize, x: usize) {
    parallel::prefetch(&table[brick * BRICK + x]);
    let [ahead_x, ahead_y, ahead_z] = bricks[brick].ahead;
    if x == 0
        && let Some(ahead) = ahead_x
    {
        parallel::prefetch(&table[ahead as usize * BRICK]);
    }
    if let Some(ahead) = ahead_y {
        parallel::prefetch(&table[ahead as usize * BRICK + x][..N]);
    }
    if let Some(ahead) = ahead_z {
        parallel::prefetch(&table[ahead as usize * BRICK + x]);
    }
}

/// Prefetches what slab x of a brick reads of the bricks behind that belong to other tasks, before brick `first`: whole slabs of them, and along x only the last
/// slab.
#[inline(always)]
fn prefetch_behind<T: Real, const N: usize, const S: usize>(
    table: &[[T; S]],
    bricks: &[Neighbours],
    run: Run,
    first: u32,
    brick: usize,
    x: usize,
) {
    for (axis, behind) in bricks[brick].behind.iter().enumerate() {
        // Bricks behind have lower numbers.
        if let &Some(behind) = behind
            && behind < first
            && run.contains(behind as usize)
            && (axis > 0 || x + 1 == BRICK)
        {
            prefetch_slab::<T, N, S>(table, bricks, behind as usize, x);
        }
    }
}

/// Largest size of a brick that is prefetched, in bytes. Larger ones are left to the hardware.
const PREFETCHED: usize = 4096;
/// Number of bricks between the one that is read and the one that is prefetched. The latter is prefetched slab by slab: with rows of four numbers, a brick and
/// its gradient have 32 cache lines, which are too many at once ([`parallel::prefetch`]).
const PREFETCH_AHEAD: usize = 2;

/// Computes the gradient of a slab from what its nodes get and give.
#[inline(always)]
fn collect<T: Real, const W: usize, const N: usize, const S: usize>(
    g: &mut [T; S],
    scale: T,
    [from_x, to_x]: [&[T; S]; 2],
    [from_y, to_y]: [&[T; S]; 2],
    [near_z, beyond_z, to_z]: [&[T; S]; 3],
) {
    for l in 0..S {
        let (near, beyond) = (near_z[l], beyond_z[l]);
        let from_z = select_unpredictable(Ends::<W, N, S>::FIRST[l], beyond, near);
        g[l] = scale * ((from_x[l] - to_x[l]) + (from_y[l] - to_y[l]) + (from_z - to_z[l]));
    }
}

/// Returns the place of a brick behind among those of a task that come before it.
#[inline(always)]
fn place_of(before: &[u32], behind: u32) -> Option<usize> {
    // Without gaps between the bricks, the place follows from the number.
    let near = behind.checked_sub(*before.first()?)? as usize;
    if before.get(near) == Some(&behind) { Some(near) } else { before.binary_search(&behind).ok() }
}

dispatched! {
/// Computes what leaves a brick of another task along an axis: the contributions of the 16 cells of its last layer.
#[allow(clippy::needless_range_loop)] // Several arrays have the same index.
fn leaving_along<T: Real, const W: usize, const S: usize>(table: &[[T; S]], bricks: &[Neighbours], run: Run, brick: usize, axis: usize) -> [T; S] {
    let mut leaving = [T::zero(); S];
    if !run.contains(brick) {
        return leaving;
    }
    let rows = table.as_flattened().as_chunks::<W>().0;
    let Neighbours { cells, ahead, .. } = &bricks[brick];
    let others = [[1, 2], [0, 2], [0, 1]][axis];
    // Differences to the nodes ahead along x, y and z. They stay 0 where there is no cell, which then contributes 0.
    let mut differences = [[T::zero(); S]; 3];
    for k in 0..BRICK * BRICK {
        let node = (BRICK - 1) * STRIDE[axis] + k / BRICK * STRIDE[others[0]] + k % BRICK * STRIDE[others[1]];
        if !has(*cells, node) {
            continue;
        }
        let value = &rows[brick * BRICK_ROWS + node];
        for along in 0..3 {
            let next = if local_of(node)[along] + 1 < BRICK {
                brick * BRICK_ROWS + node + STRIDE[along]
            } else {
                let ahead = ahead[along].expect("a cell has its nodes");
                ahead as usize * BRICK_ROWS + node - (BRICK - 1) * STRIDE[along]
            };
            let (next, d) = (&rows[next], &mut differences[along][k * W..][..W]);
            for l in 0..W {
                d[l] = next[l] - value[l];
            }
        }
    }
    let [dx, dy, dz] = &differences;
    for l in 0..S {
        leaving[l] = differences[axis][l] * inverse_root(dx[l], dy[l], dz[l]).1;
    }
    leaving
}
}

dispatched! {
/// Returns Σ √(dx² + dy² + dz² + ε) over the cells of a task's bricks `reached`, which ascend, as far as they are in the run. If `GRADIENT` is true, sets
/// `gradient`, which has their slabs, to `scale` times the gradient of the sum over all cells of the run; otherwise it is empty.
pub(super) fn value_and_gradient<T: Real, const W: usize, const N: usize, const S: usize, const GRADIENT: bool>(
    table: &[[T; S]],
    bricks: &[Neighbours],
    run: Run,
    reached: &[u32],
    scale: T,
    gradient: &mut [[T; S]],
) -> T {
    let mut sum = T::zero();
    let ones = [T::one(); S];
    let mut passed = Buffer::<T>::stale(if GRADIENT { 3 * reached.len() * S } else { 0 });
    let passed: &mut [Leaving<T, S>] = passed.as_chunks_mut::<S>().0.as_chunks_mut().0;
    let mut own = Contributions::<T, N, S>::zeros();
    for (k, &brick) in reached.iter().enumerate() {
        let later = reached.get(k + PREFETCH_AHEAD).filter(|_| size_of::<[[T; S]; BRICK]>() <= PREFETCHED).map(|&later| later as usize);
        let number = brick as usize;
        if GRADIENT {
            for (axis, &behind) in bricks[number].behind.iter().enumerate() {
                let Some(behind) = behind else {
                    own.enter::<W>(axis, &[T::zero(); S]);
                    continue;
                };
                match place_of(&reached[..k], behind) {
                    Some(place) => own.enter::<W>(axis, &passed[place][axis]),
                    None => own.enter::<W>(axis, &leaving_along::<T, W, S>(table, bricks, run, behind as usize, axis)),
                }
            }
        }
        let (in_run, mut roots) = (run.contains(number), [T::zero(); S]);
        for x in 0..BRICK {
            if let Some(later) = later {
                if run.contains(later) {
                    prefetch_slab::<T, N, S>(table, bricks, later, x);
                }
                if GRADIENT {
                    prefetch_behind::<T, N, S>(table, bricks, run, reached[0], later, x);
                    parallel::prefetch(&gradient[(k + PREFETCH_AHEAD) * BRICK + x]);
                }
            }
            if in_run {
                own.compute::<W>(table, bricks, number, x, &ones, &mut roots);
            }
        }
        if !in_run {
            own.clear();
        }
        sum += folded(roots);
        if GRADIENT {
            for (x, g) in gradient[k * BRICK..][..BRICK].iter_mut().enumerate() {
                let (from_x, to_x, y) = (&own.x[x], &own.x[x + 1], own.y[x].as_flattened());
                let (from_y, to_y): (&[T; S], &[T; S]) = (window(y, 0), window(y, N));
                let near_z: &[T; S] = window(own.z.as_flattened(), (x + 1) * S - W);
                collect::<T, W, N, S>(g, scale, [from_x, to_x], [from_y, to_y], [near_z, &own.behind_z[x], &own.z[x + 1]]);
            }
            own.store_leaving::<W>(&mut passed[k]);
        }
    }
    sum
}
}

/// Sums lanes pairwise. Sequential addition would take as long as all other work.
#[inline(always)]
fn folded<T: Real, const S: usize>(mut lanes: [T; S]) -> T {
    let mut width = S;
    while width.is_multiple_of(2) {
        width /= 2;
        for l in 0..width {
            lanes[l] += lanes[width + l];
        }
    }
    lanes[..width].iter().copied().sum()
}
