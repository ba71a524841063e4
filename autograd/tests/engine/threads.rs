//! Results and gradients have the same bits for any number of threads.

use autograd::{Indices, Tensor};
use ndarray::Array;

/// Returns numbers of different magnitudes, so that another order of additions gives different bits.
fn numbers(shape: &[usize], seed: u64) -> Tensor<f32> {
    let n: usize = shape.iter().product();
    let number = |i: usize| {
        let bits = (i as u64 + seed * 1_000_003).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_mul(0xd1b5_4a32_d192_ed03);
        ((bits >> 40) as f32 / 16_777_216.0 - 0.4) * [1.0, 1e-3, 30.0][(bits >> 32) as usize % 3]
    };
    Tensor::variable(Array::from_shape_vec(shape, (0..n).map(number).collect()).expect("as many numbers"))
}

fn row_numbers(n: usize, table: u32) -> Indices {
    Indices::from((0..n as u32).map(|i| i.wrapping_mul(2_654_435_761) % table).collect::<Vec<_>>())
}

/// Returns the offsets of segments of 0 to 12 rows.
fn segments(rows: usize) -> Indices {
    let mut offsets = vec![0u32];
    while let Some(&last) = offsets.last()
        && (last as usize) < rows
    {
        offsets.push((last + last.wrapping_mul(7919) % 13).max(last + offsets.len() as u32 % 2).min(rows as u32));
    }
    Indices::from(offsets)
}

type Family = (&'static str, Vec<Tensor<f32>>, fn(&[Tensor<f32>]) -> Tensor<f32>);

/// Returns functions and inputs. The sizes span several chunks and are not multiples of a chunk size.
fn families() -> Vec<Family> {
    const N: usize = 100_003;
    vec![
        ("elementwise", vec![numbers(&[N], 1)], |x| {
            (x[0].exp() + x[0].sigmoid() * x[0].softplus()).square().abs().sqrt() + x[0].sin().relu() + x[0].powi(3).clamp(-1.0, 1.0)
        }),
        ("opacity and logarithm", vec![numbers(&[N], 1)], |x| x[0].one_minus_exp_neg() + (x[0].square() + 1.0).ln() + x[0].cos()),
        ("powers and hyperbolic functions", vec![numbers(&[N], 1), numbers(&[N], 2)], |x| {
            (x[0].square() + 0.1).pow(&x[1].tanh()) + x[0].expm1() + (x[0].square() + 0.1).powf(0.3) + x[1].leaky_relu(0.1)
        }),
        ("sines of large arguments", vec![numbers(&[N], 1)], |x| (&x[0] * 1e5).sin() + (&x[0] * 1e5).cos()),
        ("normalisation", vec![numbers(&[N / 3, 3], 1)], |x| {
            x[0].softmax(1) * x[0].normalize(0) + (x[0].log_sum_exp(1) * x[0].norm(1)).unsqueeze(1)
        }),
        ("arithmetic", vec![numbers(&[N], 1), numbers(&[N], 2)], |x| {
            (&x[0] * &x[1] - &x[0] / (x[1].square() + 1.0)).maximum(&x[1]).minimum(&x[0])
        }),
        ("broadcasting rows", vec![numbers(&[N / 3, 3], 1), numbers(&[3], 2), numbers(&[N / 3, 1], 3)], |x| (&x[0] + &x[1]) * &x[2]),
        ("broadcasting a scalar", vec![numbers(&[N], 1), numbers(&[], 2)], |x| &x[0] * &x[1]),
        ("broadcasting blocks", vec![numbers(&[40, 1, 700], 1), numbers(&[40, 9, 1], 2)], |x| &x[0] * &x[1]),
        ("sum and mean", vec![numbers(&[N], 1)], |x| x[0].sum() * x[0].mean()),
        ("sum of the first axis", vec![numbers(&[N, 5], 1)], |x| x[0].sum_axis(0)),
        ("sum of the middle axis", vec![numbers(&[70, 600, 7], 1)], |x| x[0].sum_axis(1)),
        ("sum of the last axis", vec![numbers(&[N / 3, 3], 1)], |x| x[0].sum_axis(1)),
        ("extrema", vec![numbers(&[701, 307], 1)], |x| x[0].max() * x[0].min() + x[0].max_axis(0).sum() + x[0].min_axis(1).mean()),
        ("shapes", vec![numbers(&[301, 20, 30], 1)], |x| {
            let moved = x[0].permute(&[2, 0, 1]).narrow(1, 3, 200).pad(2, 1, 25);
            Tensor::concat(&[&moved, &moved.broadcast_to(&[30, 200, 25]).square()], 2).reshape(&[3000, 100]).transpose()
        }),
        ("product of large matrices", vec![numbers(&[1500, 70], 1), numbers(&[70, 130], 2)], |x| x[0].matmul(&x[1])),
        ("product over a long inner dimension", vec![numbers(&[5, 60_001], 1), numbers(&[60_001, 3], 2)], |x| x[0].matmul(&x[1])),
        ("product of many matrices", vec![numbers(&[3001, 3, 4], 1), numbers(&[3001, 4, 5], 2)], |x| x[0].matmul(&x[1])),
        ("product of many by one matrix", vec![numbers(&[3001, 3, 4], 1), numbers(&[4, 5], 2)], |x| x[0].matmul(&x[1])),
        ("running sums", vec![numbers(&[503, 301], 1)], |x| x[0].cumsum(1) + x[0].exclusive_cumsum(0)),
        ("segments", vec![numbers(&[N], 1)], |x| {
            let rays = segments(N);
            x[0].segment_exclusive_sum(&rays) * x[0].segment_sum(&rays).segment_repeat(&rays)
        }),
        ("segments of rows", vec![numbers(&[N, 3], 1)], |x| {
            let rays = segments(N);
            x[0].segment_exclusive_sum(&rays) * x[0].segment_sum(&rays).segment_repeat(&rays)
        }),
        ("lookups", vec![numbers(&[20_011, 4], 1)], |x| {
            x[0].gather_rows(&row_numbers(N, 20_011)) * x[0].gather_rows(&row_numbers(N, 9973))
        }),
        ("lookups, dense in the end", vec![numbers(&[20_011, 5], 1)], |x| x[0].exp().gather_rows(&row_numbers(N, 20_011))),
        ("scattering", vec![numbers(&[N, 3], 1)], |x| x[0].scatter_rows(&row_numbers(N, 1009), 1009).square()),
        ("trilinear", vec![numbers(&[30 * 30 * 30, 4], 1), numbers(&[N, 3], 2)], |x| x[0].trilinear(&(15.0 + 0.5 * &x[1]), [30, 30, 30])),
        ("nearest", vec![numbers(&[30 * 30 * 30, 4], 1)], |x| x[0].nearest(&numbers(&[N, 3], 2), [30, 30, 30])),
        ("masks", vec![numbers(&[N], 1), numbers(&[N], 2)], |x| {
            Tensor::where_(&x[0].greater(&x[1]), &x[0], &x[1].square()).masked(&x[1].greater_equal(&x[0].detach().cos()))
        }),
    ]
}

/// Returns the bits of the result and of the gradients of its sum of squares.
fn bits((_, inputs, f): &Family) -> Vec<Vec<u32>> {
    let y = f(inputs);
    let gradients = (&y * &y).sum().backward();
    let of = |data: &mut dyn Iterator<Item = f32>| data.map(f32::to_bits).collect::<Vec<_>>();
    std::iter::once(of(&mut y.data().iter().copied())).chain(inputs.iter().map(|x| of(&mut gradients.array(x).into_iter()))).collect()
}

#[test]
fn every_family_of_ops_has_the_same_bits_for_any_number_of_threads() {
    let families = families();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
        pool.install(|| families.iter().map(bits).collect::<Vec<_>>())
    };
    let alone = with(1);
    for (family, parts) in families.iter().zip(&alone) {
        assert!(parts.iter().skip(1).all(|part| part.iter().any(|&b| b != 0)), "{}: a gradient is zero", family.0);
    }
    for threads in [2, 3, 8] {
        for ((family, want), got) in families.iter().zip(&alone).zip(with(threads)) {
            assert!(*want == got, "{} differs with {threads} threads", family.0);
        }
    }
}
