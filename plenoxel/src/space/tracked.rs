//! The maps of [`Space`] as tensor ops, through which gradients flow to rays.

use super::Space;
use crate::camera::TrackedRays;
use autograd::{Real, Tensor};
use std::borrow::Cow;

impl Space {
    /// Returns [`Space::rays`] of tracked rays.
    pub fn tracked<'a, T: Real>(&self, rays: &'a TrackedRays<T>) -> Cow<'a, TrackedRays<T>> {
        match *self {
            Space::Box | Space::Contracted => Cow::Borrowed(rays),
            Space::Ndc { a, b } => {
                let [origins, directions] = ndc(&rays.origins, &rays.directions, a, b);
                Cow::Owned(TrackedRays { rays: self.rays(&rays.rays).into_owned(), origins, directions })
            }
        }
    }
}

/// Returns origins and unit directions in normalized device coordinates, both `[n, 3]`. With (u, v) = (d_x, d_y) / d_z, the ray meets the near plane z = −1
/// at p = o − (1 + o_z) (u, v, 1), and o' = (a p_x, b p_y, −1), d' ∝ (−a (u + p_x), −b (v + p_y), 2).
///
/// Rays that do not look along −z see nothing; their results are arbitrary.
fn ndc<T: Real>(origins: &Tensor<T>, directions: &Tensor<T>, a: f64, b: f64) -> [Tensor<T>; 2] {
    let scale = Tensor::from_vec([a, b].map(T::lit).to_vec(), &[2]);
    let depth = directions.narrow(1, 2, 1);
    // The division must be finite, so that the gradients of all other rays are.
    let looks_away = depth.constant_map(|z| if z < T::zero() { T::zero() } else { T::one() });
    let depth = &depth * (1.0 - &looks_away) - looks_away;
    let slope = directions.narrow(1, 0, 2) / depth;
    let near = origins.narrow(1, 0, 2) - (origins.narrow(1, 2, 1) + 1.0) * &slope;
    let constant = |value: f64| Tensor::from_vec(vec![T::lit(value); origins.shape()[0]], &[origins.shape()[0], 1]);
    let direction = Tensor::concat(&[&(-(slope + &near) * &scale), &constant(2.0)], 1);
    [Tensor::concat(&[&(near * scale), &constant(-1.0)], 1), direction.normalize(1)]
}

/// Returns positions `[m, 3]` of the world in the contracted space: [`contract`](super::contract()).
pub(crate) fn contract<T: Real>(positions: &Tensor<T>) -> Tensor<T> {
    let m = positions.abs().max_axis(1).clamp(1.0, f64::INFINITY).unsqueeze(1);
    positions * ((2.0 - 1.0 / &m) / m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Ray;
    use autograd::{gradcheck, random::Stream};
    use glam::{DVec3, dvec3};

    /// Origins in [−0.8, 0.8]³ and directions along −z.
    fn numbers() -> [Tensor<f64>; 2] {
        let numbers = |name: &str| Stream::new(4).named(name).uniform_tensor::<f64>(&[12, 3], -0.8, 0.8);
        let along = Tensor::from_vec([0.0, 0.0, -1.0].to_vec(), &[3]);
        [numbers("origins"), (numbers("directions") * 0.7 + along).normalize(1)]
    }

    #[test]
    fn tracked_rays_are_the_rays_of_normalized_device_coordinates_and_have_their_derivatives() {
        let space = Space::Ndc { a: 1.6, b: 2.1 };
        let [origins, directions] = numbers();
        let none = Ray { origin: DVec3::ZERO, direction: DVec3::Z, stretch: 1.0 };
        let rays = TrackedRays::new(origins.clone(), directions.clone(), &[none; 12]);
        let moved = space.tracked(&rays);
        for (i, ray) in moved.rays.iter().enumerate() {
            let row = |tensor: &Tensor<f64>| DVec3::from_slice(&tensor.data()[3 * i..][..3]);
            assert!(row(&moved.origins).abs_diff_eq(ray.origin, 1e-12) && row(&moved.directions).abs_diff_eq(ray.direction, 1e-12));
        }
        for which in 0..2 {
            gradcheck(|x| ndc(&x[0], &x[1], 1.6, 2.1)[which].clone(), [origins.to_array(), directions.to_array()]);
        }
        // A ray that looks away, or along the plane, must not spoil the gradients of the others.
        let away = Tensor::from_vec(vec![0.0, 1.0, 0.0, 0.6, 0.0, 0.8], &[2, 3]).into_variable();
        let gradients = ndc(&Tensor::zeros(&[2, 3]), &away, 1.6, 2.1)[1].sum().backward();
        assert!(gradients.array(&away).iter().all(|&g| f64::is_finite(g)));
    }

    #[test]
    fn tracked_positions_are_contracted_like_others_and_have_their_derivatives() {
        let positions = Stream::new(5).uniform_tensor::<f64>(&[40, 3], -3.0, 3.0);
        for (p, q) in positions.data().chunks(3).zip(contract(&positions).data().chunks(3)) {
            assert!(super::super::contract(DVec3::from_slice(p)).abs_diff_eq(dvec3(q[0], q[1], q[2]), 1e-14));
        }
        gradcheck(|x| contract(&x[0]), [positions.to_array()]);
    }
}
