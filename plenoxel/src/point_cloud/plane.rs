//! Least-squares plane of points.

use crate::geometry::eigen;
use glam::{DMat3, DVec3};

/// Count, sum and sum of squares of points, from which a plane is computed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Moments {
    pub count: u32,
    sum: DVec3,
    /// xx, yy, zz and xy, yz, zx.
    squares: [DVec3; 2],
}

/// Plane, and the deviation of the points from it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plane {
    pub center: DVec3,
    /// Unit normal.
    pub normal: DVec3,
    /// Standard deviation of the points' distances to the plane, whose mean is 0: the root of the smallest eigenvalue.
    pub deviation: f64,
}

impl Moments {
    /// Adds a point. The error is smaller if the points are near the origin.
    pub fn add(&mut self, p: DVec3) {
        self.count += 1;
        self.sum += p;
        self.squares[0] += p * p;
        self.squares[1] += p * DVec3::new(p.y, p.z, p.x);
    }

    /// Adds the moments of points relative to another origin, which is at `offset`.
    pub fn add_all(&mut self, others: &Moments, offset: DVec3) {
        let turned = |p: DVec3| DVec3::new(p.y, p.z, p.x);
        let (n, sum) = (f64::from(others.count), others.sum);
        self.count += others.count;
        self.sum += sum + n * offset;
        self.squares[0] += others.squares[0] + 2.0 * offset * sum + n * offset * offset;
        self.squares[1] += others.squares[1] + offset * turned(sum) + turned(offset) * sum + n * offset * turned(offset);
    }

    /// Returns the plane with the smallest sum of squared distances: it contains the mean, and its normal is the eigenvector of the
    /// covariance with the smallest eigenvalue. Returns `None` if there are fewer than three points, or exactly three, A, B and C, with |AB
    /// × AC|² below ε = 2⁻²³, which are nearly collinear. The bound is CloudCompare's and depends on the unit of length. Four collinear
    /// points give an arbitrary plane through their line.
    pub fn plane(&self) -> Option<Plane> {
        if self.count < 3 {
            return None;
        }
        let n = f64::from(self.count);
        let center = self.sum / n;
        let squares = self.squares[0] / n - center * center;
        let products = self.squares[1] / n - center * DVec3::new(center.y, center.z, center.x);
        let covariance = DMat3::from_cols(
            DVec3::new(squares.x, products.x, products.z),
            DVec3::new(products.x, squares.y, products.y),
            DVec3::new(products.z, products.y, squares.z),
        );
        let [(smallest, normal), (middle, _), (largest, _)] = eigen(covariance);
        // For three points, |AB × AC|² = 27 λ₁ λ₂, with the two nonzero eigenvalues of the covariance.
        if self.count == 3 && 27.0 * middle * largest < f64::from(f32::EPSILON) {
            return None;
        }
        Some(Plane { center, normal: normal.normalize(), deviation: smallest.max(0.0).sqrt() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, uniform};

    #[test]
    fn points_that_were_added_up_elsewhere_have_the_plane_that_they_have_one_by_one() {
        let number = |i| 2.0 * uniform(5, Purpose::Initial, 1, i) - 1.0;
        let points: Vec<DVec3> = (0..30).map(|i| DVec3::new(number(3 * i), number(3 * i + 1), 0.1 * number(3 * i + 2))).collect();
        let (mut single, mut part, mut joined) = (Moments::default(), Moments::default(), Moments::default());
        let offset = DVec3::new(0.3, -2.0, 1.1);
        points.iter().for_each(|p| single.add(*p));
        points[..20].iter().for_each(|p| part.add(*p - offset));
        points[20..].iter().for_each(|p| joined.add(*p));
        joined.add_all(&part, offset);
        let [a, b] = [single, joined].map(|moments| moments.plane().expect("a plane"));
        assert!(joined.count == 30 && a.center.abs_diff_eq(b.center, 1e-14) && (a.deviation - b.deviation).abs() < 1e-13);
        assert!(a.normal.dot(b.normal).abs() > 1.0 - 1e-13);
    }

    #[test]
    fn three_points_on_a_line_have_no_plane_and_four_have_one_through_the_line() {
        let mut moments = Moments::default();
        (0..3).for_each(|k| moments.add(DVec3::new(0.1, 0.2, 0.7) * f64::from(k) + DVec3::X));
        assert!(moments.plane().is_none());
        moments.add(DVec3::new(0.3, 0.6, 2.1) + DVec3::X);
        let plane = moments.plane().expect("a plane");
        assert!(plane.normal.dot(DVec3::new(0.1, 0.2, 0.7)).abs() < 1e-9 && plane.deviation < 1e-7);
    }
}
