//! What this machine can do at most: bandwidth of memory, rows picked at random from tables of several sizes, and matrix products.
//!
//!     cargo bench --bench roofline
//!
//! `gb_per_s` counts the bytes that the code reads and writes; a store also reads the line it writes to, unless it goes around the cache.

mod support;

use autograd::{Buffer, Indices, Matrix, Precision, Tensor, multiply, parallel};
use std::hint::black_box;
use support::{Arguments, arguments, median, numbers, peak_memory_mb, repeat, suffix};

/// Numbers in the arrays that are read and written from end to end: 256 MB.
const LONG: usize = 64 << 20;
/// Rows picked at random.
const PICKS: usize = 4_000_000;

fn print(name: &str, times: &[f64], bytes: usize, rows: Option<usize>) {
    let ms = median(times);
    let row = serde_json::json!({
        "limit": name, "ms": ms, "gb_per_s": bytes as f64 / ms * 1e-6, "million_rows_per_s": rows.map(|n| n as f64 / ms * 1e-3),
        "threads": rayon::current_num_threads(), "peak_rss_mb": peak_memory_mb(),
    });
    println!("{row}");
}

fn main() {
    support::on_the_pool(run);
}

fn run() {
    let args = arguments();
    let bytes = LONG * size_of::<f32>();
    let row = |name: &str, bytes: usize, f: &mut dyn FnMut()| {
        if args.wants(name) {
            print(name, &repeat(args.repeats, f), bytes, None);
        }
    };
    let (x, mut y) = (Buffer::<f32>::copy_of(&numbers(LONG, 1)), Buffer::<f32>::zeros(LONG));
    row("read", bytes, &mut || {
        black_box(parallel::sum(&x, |v| v));
    });
    row("fill", bytes, &mut || parallel::fill(&mut y, 1.0));
    row("copy", 2 * bytes, &mut || parallel::copy(&x, &mut y));
    row("update", 3 * bytes, &mut || parallel::zip_in_place(&mut y, &x, |a, b| a + 0.5 * b));
    drop((x, y));
    // The density of 64³ and of 128³ voxels, colors of 128³, harmonics of 128³.
    for (side, width) in [(64, 1), (128, 1), (128, 3), (128, 27)] {
        gather(&args, side, width);
    }
    for width in [16, 64, 128, 256] {
        products(&args, width, Precision::Full);
        products(&args, width, Precision::Mixed);
    }
}

/// Random rows of a table, each added up where it is found: nothing is written.
fn gather(args: &Arguments, side: usize, width: usize) {
    let name = format!("gather_{side}_{width}");
    if !args.wants(&name) {
        return;
    }
    let rows = side * side * side;
    let table = Tensor::<f32>::from_buffer(Buffer::copy_of(&numbers(rows * width, 2)), &[rows, width]);
    let picks: Indices = numbers(PICKS, 7).iter().map(|x| ((x * rows as f32) as u32).min(rows as u32 - 1)).collect::<Vec<_>>().into();
    let times = repeat(args.repeats, || {
        let sums = parallel::map_chunks(PICKS, 1 << 14, |range| match width {
            1 => add::<1>(table.data(), &picks[range]),
            3 => add::<3>(table.data(), &picks[range]),
            _ => add::<27>(table.data(), &picks[range]),
        });
        black_box(sums);
    });
    print(&name, &times, PICKS * width * size_of::<f32>(), Some(PICKS));
}

/// Products of 256 rows with a square matrix, on all threads.
fn products(args: &Arguments, width: usize, precision: Precision) {
    let name = format!("gemm_{width}{}", suffix(precision));
    if !args.wants(&name) {
        return;
    }
    let (rows, blocks) = (256, 1024);
    let (x, w) = (numbers(rows * width, 3), numbers(width * width, 4));
    let mut out = Buffer::<f32>::zeros(blocks * rows * width);
    let times = repeat(args.repeats, || {
        parallel::for_each_chunk(&mut out, rows * width, |_, out| {
            multiply(Matrix::new(&x, rows, width), Matrix::new(&w, width, width), out, precision)
        });
    });
    let ms = median(&times);
    let flops = 2.0 * (blocks * rows * width * width) as f64;
    let row = serde_json::json!({ "limit": name, "ms": ms, "gflop_per_s": flops * 1e-6 / ms, "threads": rayon::current_num_threads() });
    println!("{row}");
}

fn add<const W: usize>(table: &[f32], picks: &[u32]) -> f32 {
    let table = table.as_chunks::<W>().0;
    let mut sum = [0.0; W];
    for &row in picks {
        sum.iter_mut().zip(&table[row as usize]).for_each(|(s, v)| *s += v);
    }
    sum.iter().sum()
}
