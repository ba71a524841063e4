use super::*;
use crate::random::{Purpose, uniform};

fn number(seed: u64, i: usize) -> f64 {
    uniform(seed, Purpose::Initial, 7, i as u64)
}

/// Rounds a point to 32 bits, as in files.
fn rounded(p: DVec3) -> DVec3 {
    p.as_vec3().as_dvec3()
}

/// Returns random points near a curved surface, some of them twice, and a few far away.
fn scattered(n: usize, seed: u64) -> Vec<DVec3> {
    let point = |i: usize| {
        let [u, v, w] = [0, 1, 2].map(|a| number(seed, 3 * i + a));
        match i % 50 {
            49 => DVec3::new(u, v, w) * 8.0,
            _ => DVec3::new(u, v, 0.3 * (3.0 * u).sin() + 0.04 * w),
        }
    };
    (0..n).map(|i| rounded(point(if i % 40 == 39 { i - 1 } else { i }))).collect()
}

/// Returns a ball of voxels with holes, in world coordinates of a grid.
fn lattice(seed: u64) -> Vec<DVec3> {
    let (n, side) = (11, 0.0234375 * 1.1);
    let voxels = (0..n * n * n).map(|v| DVec3::new((v / (n * n)) as f64, (v / n % n) as f64, (v % n) as f64));
    let inside = voxels.enumerate().filter(|&(v, p)| (p - 5.0).length() < 5.2 && number(seed, v) < 0.8);
    inside.map(|(_, p)| rounded((p + 0.5) * side - 1.4)).collect()
}

fn kept(points: &[DVec3], filters: &Filters) -> Vec<u32> {
    filters.apply(points, None).unwrap().0
}

/// Computes outliers by definition, from the sorted list of all distances without the point itself.
fn outliers_by_definition(points: &[DVec3], k: usize, sigma: f64) -> Vec<u32> {
    let mut means = Vec::new();
    for (i, p) in points.iter().enumerate() {
        let others = points.iter().enumerate().filter(|(j, _)| *j != i);
        let mut distances: Vec<f64> = others.map(|(_, q)| (q.as_vec3() - p.as_vec3()).as_dvec3().length_squared().sqrt()).collect();
        distances.sort_by(f64::total_cmp);
        means.push((distances[..k - 1].iter().sum::<f64>() / (k - 1) as f64) as f32);
    }
    let n = points.len() as f64;
    let mean = means.iter().map(|&d| f64::from(d)).sum::<f64>() / n;
    let mean_square = means.iter().map(|&d| f64::from(d * d)).sum::<f64>() / n;
    let limit = mean + sigma * (mean_square - mean * mean).abs().sqrt();
    (0..points.len() as u32).filter(|&i| f64::from(means[i as usize]) <= limit).collect()
}

/// Returns the smallest eigenvalue of a symmetric matrix in closed form (Smith 1961), and an eigenvector: the largest cross product of two
/// rows of the matrix minus the eigenvalue.
fn smallest_eigen(a: glam::DMat3) -> (f64, DVec3) {
    let q = (a.x_axis.x + a.y_axis.y + a.z_axis.z) / 3.0;
    let b = a - glam::DMat3::from_diagonal(DVec3::splat(q));
    let p = ((0..3).map(|c| b.col(c).length_squared()).sum::<f64>() / 6.0).sqrt();
    let r = ((b * (1.0 / p)).determinant() / 2.0).clamp(-1.0, 1.0);
    let value = q + 2.0 * p * (r.acos() / 3.0 + std::f64::consts::TAU / 3.0).cos();
    let c = a - glam::DMat3::from_diagonal(DVec3::splat(value));
    let crosses = [c.x_axis.cross(c.y_axis), c.y_axis.cross(c.z_axis), c.z_axis.cross(c.x_axis)];
    let vector = crosses.into_iter().max_by(|a, b| a.length().total_cmp(&b.length())).unwrap();
    (value, vector.normalize())
}

/// Computes noise by definition, from all points and each deviation: the distance of each point beyond the limit. Infinite for isolated
/// points, 1 for points whose three neighbours define no plane.
fn noise_by_definition(points: &[DVec3], radius: f64, error: NoiseError) -> Vec<f64> {
    let one = |i: usize| {
        let near = |q: &DVec3| f64::from((q.as_vec3() - points[i].as_vec3()).length()) <= radius;
        let others: Vec<DVec3> = (0..points.len()).filter(|j| *j != i).map(|j| points[j]).filter(near).collect();
        if others.len() < 3 {
            return f64::INFINITY;
        }
        if others.len() == 3 && (others[1] - others[0]).cross(others[2] - others[0]).length_squared() < f64::from(f32::EPSILON) {
            return 1.0;
        }
        let n = others.len() as f64;
        let center = others.iter().sum::<DVec3>() / n;
        let outer = |v: DVec3| glam::DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        let covariance = others.iter().fold(glam::DMat3::ZERO, |sum, q| sum + outer(*q - center)) * (1.0 / n);
        let (_, normal) = smallest_eigen(covariance);
        let limit = match error {
            NoiseError::Absolute(limit) => limit,
            NoiseError::Relative(sigma) => {
                let distances: Vec<f64> = others.iter().map(|q| normal.dot(*q - center)).collect();
                let mean = distances.iter().sum::<f64>() / n;
                sigma * (distances.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / n).sqrt()
            }
        };
        normal.dot(points[i] - center).abs() - limit
    };
    (0..points.len()).map(one).collect()
}

#[test]
fn outliers_are_those_of_the_definition() {
    for (points, name) in [(scattered(700, 1), "scattered"), (lattice(2), "lattice")] {
        for (neighbours, sigma) in [(2, 0.5), (6, 1.0), (6, 0.2), (12, 2.0), (40, -0.3)] {
            let got = kept(&points, &Filters { outliers: Some(Outliers { neighbours, sigma }), ..Filters::default() });
            assert_eq!(got, outliers_by_definition(&points, neighbours, sigma), "{name}, {neighbours} neighbours, {sigma} sigma");
            assert!(got.len() < points.len() || name == "lattice", "the setting removes something");
        }
    }
}

#[test]
fn noise_is_that_of_the_definition() {
    let points = scattered(700, 3);
    for error in [NoiseError::Absolute(0.01), NoiseError::Relative(1.0), NoiseError::Relative(0.4)] {
        // Few neighbours, many, nearly all, all: the cloud is 14 across.
        for radius in [0.05, 0.12, 0.5, 5.0, 20.0] {
            let beyond = noise_by_definition(&points, radius, error);
            // On the limit up to rounding: the filter keeps these. It allows for 8 ε of the largest coordinate, which is 8.
            let undecided = |b: f64| b > -1e-7 && b < 1e-5;
            assert!(beyond.iter().filter(|b| b.abs() > 1e-7 && undecided(**b)).count() <= 3, "{radius} {error:?}");
            for remove_isolated in [false, true] {
                let got = kept(&points, &Filters { noise: Some(Noise { radius, error, remove_isolated }), ..Filters::default() });
                let stays = |b: f64| if b == f64::INFINITY { !remove_isolated } else { b <= 0.0 };
                let wrong = (0..points.len() as u32).filter(|i| {
                    let b = beyond[*i as usize];
                    !undecided(b) && stays(b) != got.binary_search(i).is_ok()
                });
                assert_eq!(wrong.collect::<Vec<_>>(), [0; 0], "radius {radius}, {error:?}, isolated removed: {remove_isolated}");
            }
        }
    }
}

#[test]
fn a_radius_that_holds_the_whole_cloud_is_not_asked_of_each_pair() {
    // Comparing 10¹⁰ pairs would take minutes.
    let points = scattered(100_000, 12);
    let noise = |radius| Noise { radius, error: NoiseError::Relative(1.0), remove_isolated: true };
    let [all, more] = [20.0, 1e9].map(|radius| kept(&points, &Filters { noise: Some(noise(radius)), ..Filters::default() }));
    assert!(all == more && all.len() > 50_000, "{} are left", all.len());
}

#[test]
fn of_a_solid_cube_of_voxels_the_noise_filter_takes_the_corners() {
    // With a radius of 1.28 sides, the neighbours are those across a face. Inside, on faces and on edges the point is as close to their
    // plane as they are. On an edge with neighbours ±x, +y, +z the plane has the normal (0, 1, 1) / √2, and the distances from the mean are
    // ±1 / (2 √2), also for the point: equal up to rounding. At a corner the three neighbours lie in a plane at distance 1 / √3.
    for (side, origin) in [(1.0, 0.0), (0.0234375, -1.47), (0.1, 3.3)] {
        let voxels = (0..64).map(|v| DVec3::new(f64::from(v / 16), f64::from(v / 4 % 4), f64::from(v % 4)));
        let points: Vec<DVec3> = voxels.map(|p| rounded((p + 0.5) * side + origin)).collect();
        let noise = Noise { radius: 1.28 * side, error: NoiseError::Relative(1.0), remove_isolated: false };
        let got = kept(&points, &Filters { noise: Some(noise), ..Filters::default() });
        let corner = |v: &u32| [v / 16, v / 4 % 4, v % 4].iter().all(|c| c % 3 == 0);
        assert_eq!(got, (0..64).filter(|v| !corner(v)).collect::<Vec<_>>(), "side {side}");
    }
}

#[test]
fn filters_are_applied_one_after_the_other_and_say_what_they_did() {
    let mut points = scattered(400, 5);
    points[7].y = f64::NAN;
    points[9].x = f64::INFINITY;
    let mut values: Vec<f32> = (0..400).map(|i| number(6, i) as f32).collect();
    values[11] = f32::NAN;
    let filters = Filters {
        within: Some(Aabb { min: DVec3::splat(-0.5), max: DVec3::new(1.0, 0.9, 2.0) }),
        value: Some(Range { low: 0.25, high: f64::INFINITY }),
        noise: Some(Noise { radius: 0.2, error: NoiseError::Relative(1.5), remove_isolated: true }),
        outliers: Some(Outliers { neighbours: 6, sigma: 1.0 }),
    };
    let (got, report) = filters.apply(&points, Some(&values)).unwrap();
    assert_eq!(report.iter().map(|kept| kept.filter).collect::<Vec<_>>(), ["finite", "bbox", "value", "noise", "sor"]);
    assert!((report[0].before, report[0].after) == (400, 398) && report[4].after == got.len());
    assert!(report.windows(2).all(|pair| pair[0].after == pair[1].before && pair[1].after < pair[1].before), "{report:?}");

    // The same filters, applied one by one.
    let chosen = |left: &[u32]| left.iter().map(|&i| points[i as usize]).collect::<Vec<_>>();
    let within = |i: &u32| points[*i as usize].y <= 0.9 && points[*i as usize].x <= 1.0 && points[*i as usize].max_element() <= 2.0;
    let first: Vec<u32> = (0..400).filter(|i| points[*i as usize].is_finite() && within(i) && values[*i as usize] >= 0.25).collect();
    let noise = kept(&chosen(&first), &Filters { noise: filters.noise, ..Filters::default() });
    let second: Vec<u32> = noise.iter().map(|&i| first[i as usize]).collect();
    let last = outliers_by_definition(&chosen(&second), 6, 1.0);
    assert_eq!(got, last.iter().map(|&i| second[i as usize]).collect::<Vec<_>>());
    assert_eq!(Filters::default().apply(&points[..7], None).unwrap(), ((0..7).collect(), vec![]));
}

#[test]
fn points_far_from_the_origin_are_filtered_like_those_near_it() {
    // Multiples of 2⁻¹⁰ are exact in 32 bits near the origin, and in 64 bits anywhere.
    let near: Vec<DVec3> = scattered(500, 8).iter().map(|p| (p * 1024.0).round() / 1024.0).collect();
    let far: Vec<DVec3> = near.iter().map(|p| p + DVec3::new(431_000.0, 5_412_000.0, 300.0)).collect();
    let outliers = Filters { outliers: Some(Outliers { neighbours: 6, sigma: 1.0 }), ..Filters::default() };
    assert_eq!(kept(&far, &outliers), kept(&near, &outliers));
}

#[test]
fn threads_do_not_change_what_is_kept_and_points_that_coincide_do_no_harm() {
    let mut points = scattered(40_000, 9);
    points.extend(vec![DVec3::new(0.5, 0.5, 0.1); 3000]);
    points.push(DVec3::splat(1e6));
    let filters = Filters {
        noise: Some(Noise { radius: 0.004, error: NoiseError::Relative(1.0), remove_isolated: false }),
        outliers: Some(Outliers { neighbours: 6, sigma: 1.0 }),
        ..Filters::default()
    };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| kept(&points, &filters))
    };
    let one = with(1);
    assert_eq!(one, with(3));
    assert!(one.len() > 20_000 && !one.contains(&43_000), "the point far away is an outlier");
}

#[test]
fn settings_that_fit_no_point_are_refused() {
    let points = scattered(5, 10);
    let outliers = |neighbours| Filters { outliers: Some(Outliers { neighbours, sigma: 1.0 }), ..Filters::default() };
    for neighbours in [0, 1, 5, 6] {
        let error = outliers(neighbours).apply(&points, None).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("fewer than the 5 points"), "{error}");
    }
    assert!(outliers(4).apply(&points, None).is_ok());
    let value = Filters { value: Some(Range { low: 0.0, high: 1.0 }), ..Filters::default() };
    assert_eq!(value.apply(&points, None).unwrap_err().exit_code(), 2);
    let noise = Noise { radius: 1.0, error: NoiseError::Relative(1.0), remove_isolated: true };
    assert_eq!(Filters { noise: Some(noise), ..Filters::default() }.apply(&[], None).unwrap().0, [0; 0]);
}

#[test]
fn points_that_32_bits_do_not_hold_go_and_do_no_harm() {
    // Regression test: the noise filter counted -1 neighbours of such a point.
    let mut points = scattered(50, 3);
    points.extend([DVec3::new(1e39, 0.0, 0.0), DVec3::new(0.0, -1e308, 0.0), DVec3::new(3e38, 0.0, -3e38), DVec3::splat(f64::INFINITY)]);
    let noise = Noise { radius: 0.75, error: NoiseError::Relative(1.0), remove_isolated: false };
    let filters = Filters { noise: Some(noise), outliers: Some(Outliers { neighbours: 6, sigma: 1.0 }), ..Filters::default() };
    assert_eq!(kept(&points, &filters), kept(&points[..50], &filters));
}
