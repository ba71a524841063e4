//! Solids composed of convex pieces: an intersection of pieces, minus holes. Intersections are overlaps of intervals; a hole is an interval
//! to skip. The torus is the only other solid: it is sphere-traced inside a tight bound and refined by Newton's method.

use super::convex::{Ball, Convex, Span};
use glam::DVec3;

/// First intersection of a ray with a surface.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Distance along the unit ray.
    pub t: f64,
    /// Outward unit normal.
    pub normal: DVec3,
    /// True on the wall of a hole.
    pub carved: bool,
}

/// Solid of the scene.
#[derive(Debug, Clone)]
pub enum Solid {
    /// Intersection of all pieces of `body`, minus the union of `holes`.
    Carved { body: Vec<Convex>, holes: Vec<Convex> },
    /// Torus with tube radius `tube` around the circle of `radius` around the unit `axis`.
    Torus { center: DVec3, axis: DVec3, radius: f64, tube: f64 },
}

impl Solid {
    /// Returns the first point at t > 0 where the ray from `origin` along the unit `direction` enters the surface from outside.
    pub fn first_hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        match self {
            Solid::Carved { body, holes } => {
                let mut inside = Span::ALL;
                let mut surface = (None, false);
                for piece in body {
                    let span = piece.span(origin, direction)?;
                    if span.enter > inside.enter {
                        surface = (Some(piece), false);
                    }
                    inside = inside.overlap(span)?;
                }
                if inside.exit <= 0.0 {
                    return None;
                }
                let mut t = inside.enter;
                // Skip each hole that contains the current point, until no hole does.
                let covering = |t: f64| {
                    let spans = holes.iter().filter_map(|hole| Some((hole, hole.span(origin, direction)?)));
                    spans.into_iter().find(|(_, span)| span.enter <= t && t < span.exit)
                };
                while let Some((hole, span)) = covering(t.max(0.0)) {
                    (t, surface) = (span.exit, (Some(hole), true));
                }
                if t <= 0.0 || t >= inside.exit {
                    return None;
                }
                let (piece, carved) = (surface.0?, surface.1);
                let outward = piece.normal(origin + t * direction);
                Some(Hit { t, normal: if carved { -outward } else { outward }, carved })
            }
            Solid::Torus { center, axis, radius, tube } => torus_hit(origin - center, direction, *axis, *radius, *tube),
        }
    }

    /// Returns the signed distance, negative inside. The sign is exact. Outside, the value never exceeds the true distance.
    pub fn distance(&self, p: DVec3) -> f64 {
        match self {
            Solid::Carved { body, holes } => {
                let outside = body.iter().map(|piece| piece.distance(p)).fold(f64::NEG_INFINITY, f64::max);
                holes.iter().fold(outside, |distance, hole| distance.max(-hole.distance(p)))
            }
            Solid::Torus { center, axis, radius, tube } => torus_distance(p - center, *axis, *radius, *tube).0,
        }
    }

    /// Returns true in a hole, inside the body that it was cut out of.
    pub fn in_hollow(&self, p: DVec3) -> bool {
        match self {
            Solid::Carved { body, holes } => {
                let within = |piece: &Convex| piece.distance(p) < 0.0;
                body.iter().all(within) && holes.iter().any(within)
            }
            Solid::Torus { .. } => false,
        }
    }

    /// Returns true if no ray can leave the solid and enter it again.
    pub fn convex(&self) -> bool {
        matches!(self, Solid::Carved { holes, .. } if holes.is_empty())
    }

    /// Returns a ball that contains the solid.
    pub fn bound(&self) -> Ball {
        match self {
            Solid::Carved { body, .. } => {
                let all = Ball { center: DVec3::ZERO, radius: f64::INFINITY };
                body.iter().filter_map(Convex::bound).fold(all, |a, b| if b.radius < a.radius { b } else { a })
            }
            Solid::Torus { center, radius, tube, .. } => Ball { center: *center, radius: radius + tube },
        }
    }
}

/// Returns the exact signed distance to a torus around the origin, and its gradient.
fn torus_distance(p: DVec3, axis: DVec3, radius: f64, tube: f64) -> (f64, DVec3) {
    let flat = p - axis * axis.dot(p);
    let from_circle = p - flat.normalize_or_zero() * radius;
    let length = from_circle.length();
    (length - tube, from_circle / length)
}

fn torus_hit(o: DVec3, d: DVec3, axis: DVec3, radius: f64, tube: f64) -> Option<Hit> {
    // The ring lies between two planes, inside one cylinder and outside another. Most rays are decided here.
    let planes = Span::slab(axis.dot(o), axis.dot(d), tube)?;
    let bound = Span::tube(o, d, axis, radius + tube)?.overlap(planes)?;
    let mut t = bound.enter.max(0.0);
    if let Some(hole) = Span::tube(o, d, axis, radius - tube).filter(|hole| hole.enter <= t) {
        t = t.max(hole.exit);
    }
    if t >= bound.exit {
        return None;
    }
    if torus_distance(o + t * d, axis, radius, tube).0 < 0.0 {
        return None;
    }
    // Sphere tracing (Hart 1996) approaches the surface but never passes it. It is slow only for grazing rays; rays that it gives up on
    // pass within a millionth of the ring.
    for _ in 0..256 {
        let (distance, gradient) = torus_distance(o + t * d, axis, radius, tube);
        if distance < 1e-6 {
            let closing = gradient.dot(d);
            if closing < -1e-3 {
                t -= distance / closing;
                t -= torus_distance(o + t * d, axis, radius, tube).0 / closing;
                let normal = torus_distance(o + t * d, axis, radius, tube).1;
                return (t > 0.0).then_some(Hit { t, normal, carved: false });
            }
            // The ray leaves or grazes the surface: a small step keeps it moving.
            t += 1e-5;
        }
        t += distance.max(0.0);
        if t > bound.exit {
            return None;
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn solids() -> Vec<Solid> {
        let at = DVec3::new(0.1, -0.2, 0.3);
        let convex = |piece: Convex| Solid::Carved { body: vec![piece], holes: vec![] };
        let hole = Convex::Sphere { center: at + DVec3::X * 0.5, radius: 0.35 };
        vec![
            convex(Convex::Sphere { center: at, radius: 0.6 }),
            convex(Convex::block(at, DVec3::new(0.5, 0.3, 0.4), 0.4)),
            convex(Convex::cylinder(at, DVec3::new(-0.3, 0.4, 0.9), 0.25)),
            convex(Convex::capsule(at, DVec3::new(-0.5, 0.4, 0.9), 0.15)),
            convex(Convex::Cone { base: at - DVec3::Z * 0.5, radius: 0.5, height: 1.1 }),
            Solid::Carved {
                body: vec![Convex::Sphere { center: at, radius: 0.7 }, Convex::Below { z: 0.4 }],
                holes: vec![Convex::Sphere { center: at, radius: 0.6 }],
            },
            Solid::Carved {
                body: vec![Convex::block(at, DVec3::splat(0.5), 0.2)],
                holes: vec![hole, Convex::Sphere { center: at, radius: 0.3 }],
            },
            Solid::Torus { center: at, axis: DVec3::new(0.3, 0.4, 1.0).normalize(), radius: 0.5, tube: 0.1 },
        ]
    }

    /// Returns evenly spread unit vectors (golden angle).
    fn directions(count: usize) -> impl Iterator<Item = DVec3> {
        (0..count).map(move |k| {
            let z = 1.0 - 2.0 * (k as f64 + 0.5) / count as f64;
            let (sin, cos) = (2.399963229728653 * k as f64).sin_cos();
            DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
        })
    }

    /// Closed forms and distance functions are written independently, so their agreement verifies both.
    #[test]
    fn first_hits_are_where_sphere_tracing_arrives() {
        for (which, solid) in solids().iter().enumerate() {
            let mut hits = 0;
            for (k, from) in directions(60).enumerate() {
                for aim in directions(40) {
                    let origin = 3.0 * from;
                    let direction = (0.8 * aim - origin).normalize();
                    let mut t = 0.0;
                    let mut nearest = f64::INFINITY;
                    for _ in 0..20_000 {
                        let distance = solid.distance(origin + t * direction);
                        nearest = nearest.min(distance);
                        t += distance.max(0.0);
                        if distance < 1e-11 || t > 6.0 {
                            break;
                        }
                    }
                    match solid.first_hit(origin, direction) {
                        Some(hit) => {
                            hits += 1;
                            let place = origin + hit.t * direction;
                            assert!((hit.t - t).abs() < 1e-6 || nearest < 1e-6, "solid {which}, ray {k}: {} against {t}", hit.t);
                            assert!(solid.distance(place).abs() < 1e-8, "solid {which}: not on the surface");
                            assert!((hit.normal.length() - 1.0).abs() < 1e-6 && hit.normal.dot(direction) < 1e-6);
                            assert!(
                                solid.distance(place + 1e-5 * hit.normal) > 0.0 && solid.distance(place - 1e-5 * hit.normal) < 0.0
                                    || nearest < 1e-6
                                    || edge(solid, place)
                            );
                        }
                        None => assert!(
                            t > 6.0 || nearest > -1e-7 && nearest.abs() < 1e-4 && t > 0.0 && grazing(solid, origin, direction),
                            "solid {which}, ray {k}: missed at {t}"
                        ),
                    }
                }
            }
            assert!(hits > 200, "solid {which}: only {hits} rays hit");
        }
    }

    /// Returns true if the ray stays outside or within 2e-4 of the surface: rounding may then decide either way.
    fn grazing(solid: &Solid, origin: DVec3, direction: DVec3) -> bool {
        (0..6000).all(|k| solid.distance(origin + k as f64 * 1e-3 * direction) > -2e-4)
    }

    /// Returns true near an edge, where a step along the normal may cross another face.
    fn edge(solid: &Solid, p: DVec3) -> bool {
        let h = 1e-4;
        let gradient =
            DVec3::from_array([DVec3::X, DVec3::Y, DVec3::Z].map(|e| (solid.distance(p + h * e) - solid.distance(p - h * e)) / (2.0 * h)));
        (gradient.length() - 1.0).abs() > 1e-3
    }

    #[test]
    fn bounds_contain_their_solids() {
        for solid in solids() {
            let ball = solid.bound();
            for direction in directions(500) {
                assert!(solid.distance(ball.center + direction * (ball.radius + 1e-9)) >= 0.0);
            }
        }
    }

    #[test]
    fn a_ray_that_starts_on_a_wall_and_leaves_meets_nothing() {
        let bowl = &solids()[5];
        let hit = bowl.first_hit(DVec3::new(0.1, -0.2, 3.0), DVec3::NEG_Z).unwrap();
        assert!(hit.carved && (hit.t - 3.3).abs() < 1e-12); // the hole's lowest point: 0.3 - 0.6 = -0.3
        let wall = DVec3::new(0.1, -0.2, 3.0 - hit.t) + 1e-6 * hit.normal;
        assert!(bowl.first_hit(wall, DVec3::Z).is_none());
        assert!(bowl.first_hit(wall, DVec3::X).is_some());
    }
}
