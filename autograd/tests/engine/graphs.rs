//! Lifetime of graphs, and higher derivatives.

use autograd::{Cotangent, GradSink, Indices, Kernel, KernelCall, Op, Param, Tensor, Vjp, grad, no_grad, value_and_grad};
use ndarray::{Array2, ArrayD, arr0, arr1, arr2};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// y = x. The reference count of the witness tells how many ops are alive.
#[derive(Debug)]
struct Identity {
    _witness: Arc<()>,
}
impl Op<f64> for Identity {
    fn name(&self) -> &'static str {
        "identity"
    }
    fn vjp(&self, cx: &Vjp<'_, f64>) -> Vec<Option<Cotangent<f64>>> {
        vec![cx.wrt(0, || cx.cotangent().clone())]
    }
}

fn identity(x: &Tensor<f64>, witness: &Arc<()>) -> Tensor<f64> {
    Tensor::from_op(x.data().to_vec().into(), x.shape(), &[x], Identity { _witness: witness.clone() })
}

fn alive(witness: &Arc<()>) -> usize {
    Arc::strong_count(witness) - 1
}

#[test]
fn a_chain_of_a_million_nodes_goes_backward_and_is_dropped_without_recursion_and_without_a_leak() {
    let work = || {
        let witness = Arc::new(());
        let x = Tensor::variable(arr0(2.0));
        let chain = || (0..1_000_000).fold(x.clone(), |y, _| identity(&y, &witness));
        let y = chain();
        assert_eq!(alive(&witness), 1_000_000);
        assert_eq!(y.backward().array(&x)[[]], 1.0);
        drop(y);
        assert_eq!(alive(&witness), 0);
        // The graph is freed during the backward pass.
        let (value, gradients) = value_and_grad(chain);
        assert_eq!((value, gradients.array(&x)[[]], alive(&witness)), (2.0, 1.0, 0));
        // In a differentiable pass, the search for the needed nodes and the new graph have the same depth.
        let y = chain();
        assert_eq!(grad(&y, &[&x])[0].item(), 1.0);
        drop(y);
        assert_eq!(alive(&witness), 0);
    };
    // A recursive walk would need a hundred bytes of stack for each node.
    std::thread::Builder::new().stack_size(256 * 1024).spawn(work).expect("a thread").join().expect("no overflow");
}

#[test]
fn a_graph_with_exponentially_many_paths_takes_one_visit_of_each_node() {
    let x = Tensor::variable(arr0(1.0));
    let y = (0..60).fold(x.clone(), |y, _| &y + &y);
    assert_eq!(y.backward().array(&x)[[]], 2f64.powi(60));
    assert_eq!(grad(&y, &[&x])[0].item(), 2f64.powi(60));
}

#[test]
fn the_graph_is_gone_when_value_and_grad_returns_so_that_an_update_is_in_place() {
    let witness = Arc::new(());
    let mut w = Param::new("w", arr1(&[1.0, 2.0]));
    let address = w.tensor().data().as_ptr();
    let (value, gradients) = value_and_grad(|| identity(w.tensor(), &witness).square().sum());
    assert_eq!((value, alive(&witness)), (5.0, 0));
    assert_eq!(gradients.of(&w).expect("a gradient").data(), [2.0, 4.0]);
    w.update(|w| w[0] = 7.0);
    assert_eq!(w.tensor().data(), [7.0, 2.0]);
    assert_eq!(w.tensor().data().as_ptr(), address);
}

#[test]
fn an_update_while_somebody_holds_the_graph_leaves_the_old_values_to_the_graph() {
    let mut w = Param::new("w", arr1(&[1.0, 2.0]));
    let y = w.tensor().square().sum();
    let before = w.tensor().clone();
    w.update(|w| w.fill(100.0));
    assert_eq!(before.data(), [1.0, 2.0]);
    // The gradient is computed at the old values and belongs to the parameter.
    assert_eq!(y.backward().of(&w).expect("a gradient").data(), [2.0, 4.0]);
    assert_eq!(w.tensor().square().sum().backward().of(&w).expect("a gradient").data(), [200.0, 200.0]);
}

#[test]
fn backward_may_be_called_again() {
    let x = Tensor::variable(arr1(&[1.0, -2.0]));
    let y = x.powi(3).sum();
    let (first, second) = (y.backward(), y.backward());
    assert_eq!(first.array(&x), second.array(&x));
    assert_eq!(first.array(&x).as_slice(), Some(&[3.0, 12.0][..]));
}

#[test]
fn the_gradient_of_the_gradient_of_the_gradient_is_the_third_derivative() {
    let x = Tensor::variable(arr1(&[2.0, -1.0]));
    let first = grad(&x.powi(5).sum(), &[&x]).remove(0);
    let second = grad(&first.sum(), &[&x]).remove(0);
    let third = grad(&second.sum(), &[&x]).remove(0);
    assert_eq!(first.data(), [80.0, 5.0]);
    assert_eq!(second.data(), [160.0, -20.0]);
    // 60 x²
    assert_eq!(third.data(), [240.0, 60.0]);
    assert_eq!(third.sum().backward().array(&x).as_slice(), Some(&[240.0, -120.0][..]));
}

type Map<'a> = &'a dyn Fn(&Tensor<f64>) -> Tensor<f64>;

fn close(a: &ArrayD<f64>, b: &ArrayD<f64>) -> bool {
    a.shape() == b.shape() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-14)
}

/// The cotangent of the terms of a sum is a scalar; that of their product with a tensor of ones is a tensor.
#[test]
fn the_terms_of_a_sum_have_the_derivatives_of_a_sum_weighted_by_ones() {
    let (rows, references) = (Indices::from(vec![1, 0]), Arc::new(AtomicUsize::new(0)));
    let of_terms: [(&str, Map<'_>); 25] = [
        ("x", &|x| x.clone()),
        ("exp", &|x| x.exp()),
        ("expm1", &|x| x.expm1()),
        ("one_minus_exp_neg", &|x| x.one_minus_exp_neg()),
        ("ln", &|x| x.square().ln()),
        ("sqrt", &|x| x.square().sqrt()),
        ("square", &|x| x.square()),
        ("abs", &|x| x.abs()),
        ("sigmoid", &|x| x.sigmoid()),
        ("softplus", &|x| x.softplus()),
        ("relu", &|x| x.relu()),
        ("leaky_relu", &|x| x.leaky_relu(0.1)),
        ("clamp", &|x| x.clamp(-1.0, 1.0)),
        ("tanh", &|x| x.tanh()),
        ("powi 0", &|x| x.powi(0)),
        ("powi 3", &|x| x.powi(3)),
        ("powf 0", &|x| x.square().powf(0.0)),
        ("powf 1.5", &|x| x.square().powf(1.5)),
        ("sin", &|x| x.sin()),
        ("affine", &|x| 3.0 * x.square() - 1.0),
        ("sum_axis", &|x| x.square().sum_axis(0)),
        ("kernel", &|x| cube(x, &references)),
        ("gather_rows", &|x| x.gather_rows(&rows)),
        ("rows twice, and all", &|x| x.gather_rows(&rows) + x + x.gather_rows(&rows)),
        ("a term twice", &|x| x.square() + x + x.square()),
    ];
    let tables = [arr2(&[[0.3, -0.7, 1.2], [0.9, 0.2, -1.1]]), arr2(&[[0.4], [-0.6]]), Array2::zeros((2, 0))];
    for (table, (name, of_terms)) in tables.iter().flat_map(|table| of_terms.map(|terms| (table, terms))) {
        let x = Tensor::variable(table.clone());
        for others in [false, true] {
            let loss = |weighted: bool| {
                let terms = of_terms(&x);
                let terms = if weighted { &terms * Tensor::ones(terms.shape()) } else { terms };
                // Two sums add up to a uniform cotangent of x itself, and the third is another contribution.
                if others { terms.sum() / 6.0 + x.sum() + x.sum() + x.cos().sum() } else { terms.sum() }
            };
            let [got, want] = [false, true].map(|weighted| grad(&loss(weighted), &[&x]).remove(0));
            let [got_once, want_once] = [false, true].map(|weighted| loss(weighted).backward().array(&x));
            let [got_twice, want_twice] = [&got, &want].map(|slope| grad(&slope.sin().sum(), &[&x]).remove(0).to_array());
            assert!(close(&got.to_array(), &want.to_array()) && close(&got_once, &want_once), "{name}, {:?}", x.shape());
            assert!(close(&got_twice, &want_twice), "{name}, {:?}", x.shape());
        }
    }
}

#[test]
fn grad_with_respect_to_the_terms_of_a_sum_has_their_shape() {
    let x = Tensor::variable(arr1(&[0.3, -0.7, 1.2]));
    let terms = x.exp();
    let [of_terms, of_x] = grad(&terms.sum(), &[&terms, &x]).try_into().expect("two gradients");
    assert!(close(&of_terms.to_array(), &arr1(&[1.0; 3]).into_dyn()) && close(&of_x.to_array(), &terms.to_array()));
}

#[test]
fn grad_is_zero_with_respect_to_what_the_result_does_not_depend_on() {
    let (x, y) = (Tensor::variable(arr1(&[1.0, 2.0])), Tensor::variable(arr0(3.0)));
    let gradients = grad(&x.sum(), &[&y, &x, &Tensor::ones(&[2])]);
    let data: Vec<&[f64]> = gradients.iter().map(|g| g.data()).collect();
    assert_eq!(data, [&[0.0][..], &[1.0, 1.0], &[0.0, 0.0]]);
    assert_eq!(grad(&Tensor::scalar(1.0), &[&x])[0].data(), [0.0, 0.0]);
}

#[test]
fn grad_with_respect_to_an_intermediate_result_stops_there() {
    let x = Tensor::variable(arr0(3.0));
    let square = x.square();
    let y = square.square();
    // dx⁴/dx² = 2 x²
    assert_eq!(grad(&y, &[&square])[0].item(), 18.0);
    assert_eq!(grad(&y, &[&square, &x])[1].item(), 108.0);
}

#[test]
fn nothing_is_recorded_of_constants_or_without_gradients() {
    let witness = Arc::new(());
    let constant = identity(&Tensor::scalar(1.0), &witness);
    assert!(!constant.is_tracked());
    let x = Tensor::variable(arr0(1.0));
    let inside = no_grad(|| {
        let nested = no_grad(|| identity(&x, &witness));
        assert!(!nested.is_tracked());
        identity(&x, &witness)
    });
    assert!(!inside.is_tracked() && !x.detach().is_tracked());
    assert_eq!(alive(&witness), 0);
    // Recording is on again afterwards, also after a panic inside `no_grad`.
    assert!(std::panic::catch_unwind(|| no_grad(|| panic!("inside no_grad"))).is_err());
    assert!(identity(&x, &witness).is_tracked());
}

/// y = x³ with a hand-written adjoint. It counts the calls of its reference.
#[derive(Debug)]
struct Cube {
    references: Arc<AtomicUsize>,
}
impl Kernel<f64> for Cube {
    fn name(&self) -> &'static str {
        "cube"
    }
    fn reference(&self, inputs: &[Tensor<f64>]) -> Tensor<f64> {
        self.references.fetch_add(1, Ordering::Relaxed);
        inputs[0].square() * &inputs[0]
    }
    fn vjp(&self, call: &KernelCall<'_, f64>, out: &mut GradSink<f64>) {
        let (x, g) = (call.input(0), call.cotangent());
        out.dense(0, x.data().iter().zip(g.data()).map(|(x, g)| 3.0 * x * x * g).collect::<Vec<_>>().into());
    }
}

fn cube(x: &Tensor<f64>, references: &Arc<AtomicUsize>) -> Tensor<f64> {
    Tensor::from_kernel(
        x.data().iter().map(|x| x * x * x).collect::<Vec<_>>().into(),
        x.shape(),
        &[x],
        Cube { references: references.clone() },
    )
}

#[test]
fn a_kernel_uses_its_adjoint_once_and_its_reference_for_higher_derivatives() {
    let references = Arc::new(AtomicUsize::new(0));
    let x = Tensor::variable(arr1(&[2.0, -1.0]));
    let y = cube(&x.square(), &references).sum();
    // y = x⁶
    assert_eq!(y.backward().array(&x).as_slice(), Some(&[192.0, -6.0][..]));
    assert_eq!(references.load(Ordering::Relaxed), 0);
    let slope = grad(&y, &[&x]).remove(0);
    assert_eq!(references.load(Ordering::Relaxed), 1);
    assert_eq!(slope.data(), [192.0, -6.0]);
    // 30 x⁴ and 120 x³
    let curvature = grad(&slope.sum(), &[&x]).remove(0);
    assert_eq!(curvature.data(), [480.0, 30.0]);
    assert_eq!(curvature.sum().backward().array(&x).as_slice(), Some(&[960.0, -120.0][..]));
}

/// Regression test: inside `no_grad` the reference was called and recorded no graph, so the gradient was silently lost.
#[test]
fn grad_without_recording_is_the_same_number_as_a_constant_through_kernels_too() {
    let references = Arc::new(AtomicUsize::new(0));
    let x = Tensor::variable(arr1(&[2.0, -1.0]));
    let y = cube(&x.square(), &references).sum();
    let slope = no_grad(|| grad(&y, &[&x]).remove(0));
    assert_eq!(slope.data(), [192.0, -6.0]);
    assert!(!slope.is_tracked());
}

/// Regression test: the value used to depend on tracking. A tracked extremum was a weighted sum, where weights of 1/3 round and 0 · ∞ is NaN.
#[test]
fn an_extremum_has_the_same_value_tracked_or_not_and_infinities_elsewhere_do_no_harm() {
    let x = Tensor::variable(arr1(&[0.1, f64::NEG_INFINITY, 0.1, 0.1]));
    let largest = x.max();
    assert_eq!(largest.item(), 0.1);
    assert_eq!(largest.backward().array(&x).as_slice(), Some(&[1.0 / 3.0, 0.0, 1.0 / 3.0, 1.0 / 3.0][..]));
    assert_eq!((-&x).min().item(), -0.1);
}
