//! Solids with exact ray intersections: convex pieces in closed form, and what can be cut from them.
//!
//! A ray meets a convex solid in one interval, so intersections are the overlap of intervals and a hole is an interval to
//! jump over. That is all of the constructive geometry the scene needs. Only the torus is not convex; it is sphere-traced
//! inside a tight bound and finished by Newton's method.

use glam::DVec3;

/// A ball in space, used as a bound.
#[derive(Debug, Clone, Copy)]
pub struct Ball {
    /// Its centre.
    pub center: DVec3,
    /// Its radius.
    pub radius: f64,
}

/// Where a ray first meets a surface.
#[derive(Debug, Clone, Copy)]
pub struct Hit {
    /// Distance along the unit ray.
    pub t: f64,
    /// Outward unit normal.
    pub normal: DVec3,
    /// True on the wall of a hole.
    pub carved: bool,
}

/// A convex solid.
#[derive(Debug, Clone, Copy)]
pub enum Convex {
    /// A sphere with its inside.
    Sphere { center: DVec3, radius: f64 },
    /// A box with the given orthonormal `axes`.
    Block { center: DVec3, half: DVec3, axes: [DVec3; 3] },
    /// A cylinder with flat ends, `half` long to either side of its middle along the unit `axis`.
    Cylinder { center: DVec3, axis: DVec3, half: f64, radius: f64 },
    /// The same with round ends beyond the flat ones.
    Capsule { center: DVec3, axis: DVec3, half: f64, radius: f64 },
    /// An upright cone from the disc of `radius` about `base` to the tip `height` above it.
    Cone { base: DVec3, radius: f64, height: f64 },
    /// Everything below a horizontal plane.
    Below { z: f64 },
}

/// A solid of the scene.
#[derive(Debug, Clone)]
pub enum Solid {
    /// What all of `body` share, without what any of `holes` covers.
    Carved { body: Vec<Convex>, holes: Vec<Convex> },
    /// A ring of tube radius `tube` about the circle of `radius` around the unit `axis`.
    Torus { center: DVec3, axis: DVec3, radius: f64, tube: f64 },
}

/// The interval in which a ray is inside a convex solid.
#[derive(Clone, Copy)]
struct Span {
    enter: f64,
    exit: f64,
}

impl Span {
    const ALL: Span = Span { enter: f64::NEG_INFINITY, exit: f64::INFINITY };

    #[inline]
    fn overlap(self, other: Span) -> Option<Span> {
        let both = Span { enter: self.enter.max(other.enter), exit: self.exit.min(other.exit) };
        (both.enter < both.exit).then_some(both)
    }

    /// The smallest interval with both: the union, where pieces of one convex solid overlap.
    #[inline]
    fn hull(a: Option<Span>, b: Option<Span>) -> Option<Span> {
        let (Some(a), Some(b)) = (a, b) else { return a.or(b) };
        Some(Span { enter: a.enter.min(b.enter), exit: a.exit.max(b.exit) })
    }

    /// Where a coordinate that starts at `o` and changes by `d` per unit of the ray is between -half and half.
    #[inline]
    fn slab(o: f64, d: f64, half: f64) -> Option<Span> {
        if d.abs() < 1e-300 {
            return (o.abs() <= half).then_some(Span::ALL);
        }
        let (a, b) = ((-half - o) / d, (half - o) / d);
        Some(Span { enter: a.min(b), exit: a.max(b) })
    }

    /// Between the roots of a t² + 2 b t + c, for a > 0.
    #[inline]
    fn between_roots(a: f64, b: f64, c: f64) -> Option<Span> {
        let root = b * b - a * c;
        if root <= 0.0 {
            return None;
        }
        let root = root.sqrt();
        Some(Span { enter: (-b - root) / a, exit: (-b + root) / a })
    }

    /// The ray's interval in a ball about the origin of `o`.
    #[inline]
    fn ball(o: DVec3, d: DVec3, radius: f64) -> Option<Span> {
        Span::between_roots(1.0, o.dot(d), o.length_squared() - radius * radius)
    }

    /// The ray's interval in the infinite cylinder about the line through the origin of `o` along the unit `axis`.
    #[inline]
    fn tube(o: DVec3, d: DVec3, axis: DVec3, radius: f64) -> Option<Span> {
        let (along_o, along_d) = (axis.dot(o), axis.dot(d));
        let a = 1.0 - along_d * along_d;
        let c = o.length_squared() - along_o * along_o - radius * radius;
        if a < 1e-14 {
            return (c <= 0.0).then_some(Span::ALL);
        }
        Span::between_roots(a, o.dot(d) - along_o * along_d, c)
    }
}

impl Convex {
    /// A box turned by `yaw` radians about the vertical.
    pub fn block(center: DVec3, half: DVec3, yaw: f64) -> Self {
        let (sin, cos) = yaw.sin_cos();
        Convex::Block { center, half, axes: [DVec3::new(cos, sin, 0.0), DVec3::new(-sin, cos, 0.0), DVec3::Z] }
    }

    /// A cylinder with flat ends at `a` and `b`.
    pub fn cylinder(a: DVec3, b: DVec3, radius: f64) -> Self {
        Convex::Cylinder { center: a.midpoint(b), axis: (b - a).normalize(), half: 0.5 * a.distance(b), radius }
    }

    /// All points within `radius` of the segment from `a` to `b`.
    pub fn capsule(a: DVec3, b: DVec3, radius: f64) -> Self {
        Convex::Capsule { center: a.midpoint(b), axis: (b - a).normalize(), half: 0.5 * a.distance(b), radius }
    }

    fn span(&self, origin: DVec3, d: DVec3) -> Option<Span> {
        match *self {
            Convex::Sphere { center, radius } => Span::ball(origin - center, d, radius),
            Convex::Block { center, half, axes } => {
                let o = origin - center;
                let mut span = Span::ALL;
                for (axis, half) in axes.into_iter().zip(half.to_array()) {
                    span = span.overlap(Span::slab(axis.dot(o), axis.dot(d), half)?)?;
                }
                Some(span)
            }
            Convex::Cylinder { center, axis, half, radius } => {
                let o = origin - center;
                Span::slab(axis.dot(o), axis.dot(d), half)?.overlap(Span::tube(o, d, axis, radius)?)
            }
            Convex::Capsule { center, axis, half, radius } => {
                let o = origin - center;
                // A ray that misses the infinite tube misses everything in it.
                let tube = Span::tube(o, d, axis, radius)?;
                let sides = Span::slab(axis.dot(o), axis.dot(d), half).and_then(|slab| slab.overlap(tube));
                let caps = Span::hull(Span::ball(o - axis * half, d, radius), Span::ball(o + axis * half, d, radius));
                Span::hull(caps, sides)
            }
            Convex::Cone { base, radius, height } => cone_span(origin - base - DVec3::Z * height, d, radius, height),
            Convex::Below { z } => {
                let t = (z - origin.z) / d.z;
                match d.z {
                    0.0 => (origin.z <= z).then_some(Span::ALL),
                    rise if rise > 0.0 => Some(Span { exit: t, ..Span::ALL }),
                    _ => Some(Span { enter: t, ..Span::ALL }),
                }
            }
        }
    }

    /// Outward unit normal at a point of the surface; on an edge, that of either face.
    fn normal(&self, p: DVec3) -> DVec3 {
        match *self {
            Convex::Sphere { center, .. } => (p - center).normalize(),
            Convex::Block { center, half, axes } => {
                let along = axes.map(|axis| axis.dot(p - center));
                let beyond = |k: usize| along[k].abs() - half[k];
                let face = (1..3).fold(0, |face, k| if beyond(k) > beyond(face) { k } else { face });
                axes[face] * along[face].signum()
            }
            Convex::Cylinder { center, axis, half, radius } => {
                let along = axis.dot(p - center);
                let out = p - center - axis * along;
                if along.abs() - half > out.length() - radius { axis * along.signum() } else { out.normalize() }
            }
            Convex::Capsule { center, axis, half, .. } => (p - center - axis * axis.dot(p - center).clamp(-half, half)).normalize(),
            Convex::Cone { base, radius, height } => {
                let o = p - base;
                let across = o.truncate().length();
                let side = (across * height + (o.z - height) * radius) / radius.hypot(height);
                if -o.z > side { DVec3::NEG_Z } else { DVec3::new(o.x * height, o.y * height, across * radius).normalize_or(DVec3::Z) }
            }
            Convex::Below { .. } => DVec3::Z,
        }
    }

    /// Signed distance, negative inside: exact but for the places outside of a block, cone or cylinder that are nearest to an edge,
    /// where it is a lower bound.
    fn distance(&self, p: DVec3) -> f64 {
        match *self {
            Convex::Sphere { center, radius } => p.distance(center) - radius,
            Convex::Block { center, half, axes } => {
                let q = axes.map(|axis| axis.dot(p - center));
                (0..3).map(|k| q[k].abs() - half[k]).fold(f64::NEG_INFINITY, f64::max)
            }
            Convex::Cylinder { center, axis, half, radius } => {
                let along = axis.dot(p - center);
                ((p - center - axis * along).length() - radius).max(along.abs() - half)
            }
            Convex::Capsule { center, axis, half, radius } => {
                let along = axis.dot(p - center).clamp(-half, half);
                p.distance(center + axis * along) - radius
            }
            Convex::Cone { base, radius, height } => {
                let o = p - base;
                let slope = radius.hypot(height);
                ((o.truncate().length() * height + (o.z - height) * radius) / slope).max(-o.z)
            }
            Convex::Below { z } => p.z - z,
        }
    }

    fn bound(&self) -> Option<Ball> {
        Some(match *self {
            Convex::Sphere { center, radius } => Ball { center, radius },
            Convex::Block { center, half, .. } => Ball { center, radius: half.length() },
            Convex::Cylinder { center, half, radius, .. } => Ball { center, radius: radius.hypot(half) },
            Convex::Capsule { center, half, radius, .. } => Ball { center, radius: radius + half },
            // The ball through the tip and the rim, or the rim's own for a flat cone.
            Convex::Cone { base, radius, height } => {
                let up = (0.5 * (height * height - radius * radius) / height).max(0.0);
                Ball { center: base + DVec3::Z * up, radius: (height - up).max(radius.hypot(up)) }
            }
            Convex::Below { .. } => return None,
        })
    }
}

impl Solid {
    /// Where the ray from `origin` along the unit `direction` first meets the surface from outside, at t > 0.
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
                // Jump over each hole that covers the present point, until none does.
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

    /// Signed distance, negative inside. Its sign is exact; outside it never exceeds the true distance.
    pub fn distance(&self, p: DVec3) -> f64 {
        match self {
            Solid::Carved { body, holes } => {
                let outside = body.iter().map(|piece| piece.distance(p)).fold(f64::NEG_INFINITY, f64::max);
                holes.iter().fold(outside, |distance, hole| distance.max(-hole.distance(p)))
            }
            Solid::Torus { center, axis, radius, tube } => torus_distance(p - center, *axis, *radius, *tube).0,
        }
    }

    /// A ball that contains the solid.
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

/// The ray's interval in a cone hanging from its tip at the origin of `o`: h² (x² + y²) <= r² z², -h <= z <= 0. Of the double
/// cone only the lower nappe counts.
fn cone_span(o: DVec3, d: DVec3, radius: f64, height: f64) -> Option<Span> {
    let slab = Span::slab(o.z + 0.5 * height, d.z, 0.5 * height)?;
    let k = (radius / height).powi(2);
    let a = d.x * d.x + d.y * d.y - k * d.z * d.z;
    let b = o.x * d.x + o.y * d.y - k * o.z * d.z;
    let c = o.x * o.x + o.y * o.y - k * o.z * o.z;
    if a.abs() < 1e-12 {
        // Parallel to a line of the cone: one crossing, and the ray is inside on the side where 2 b t + c < 0.
        let t = -0.5 * c / b;
        let side = if b > 0.0 { Span { exit: t, ..Span::ALL } } else { Span { enter: t, ..Span::ALL } };
        return if t.is_finite() { side.overlap(slab) } else { None };
    }
    if a > 0.0 {
        // Across the cone: inside between the crossings, both on one nappe; the slab removes the upper one.
        return Span::between_roots(a, b, c)?.overlap(slab);
    }
    // Steeper than the cone: outside between the crossings, one on each nappe; the lower nappe is the one against z.
    let outside = Span::between_roots(-a, -b, -c)?;
    let side = if d.z > 0.0 { Span { exit: outside.enter, ..Span::ALL } } else { Span { enter: outside.exit, ..Span::ALL } };
    side.overlap(slab)
}

/// Signed distance to a torus about the origin, exact, and the direction in which it grows.
fn torus_distance(p: DVec3, axis: DVec3, radius: f64, tube: f64) -> (f64, DVec3) {
    let flat = p - axis * axis.dot(p);
    let from_circle = p - flat.normalize_or_zero() * radius;
    let length = from_circle.length();
    (length - tube, from_circle / length)
}

fn torus_hit(o: DVec3, d: DVec3, axis: DVec3, radius: f64, tube: f64) -> Option<Hit> {
    // The ring fits between two planes, inside one cylinder and outside another: most rays are settled here.
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
    // Sphere tracing (Hart 1996) approaches but never passes the surface. It is slow only along grazing rays, and those it
    // gives up pass within a millionth of the ring.
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
            // Leaving, or gliding past: a step that keeps the ray moving.
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
            Solid::Carved { body: vec![Convex::Sphere { center: at, radius: 0.7 }, Convex::Below { z: 0.4 }], holes: vec![Convex::Sphere { center: at, radius: 0.6 }] },
            Solid::Carved { body: vec![Convex::block(at, DVec3::splat(0.5), 0.2)], holes: vec![hole, Convex::Sphere { center: at, radius: 0.3 }] },
            Solid::Torus { center: at, axis: DVec3::new(0.3, 0.4, 1.0).normalize(), radius: 0.5, tube: 0.1 },
        ]
    }

    /// Evenly spread unit vectors (golden angle).
    fn directions(count: usize) -> impl Iterator<Item = DVec3> {
        (0..count).map(move |k| {
            let z = 1.0 - 2.0 * (k as f64 + 0.5) / count as f64;
            let (sin, cos) = (2.399963229728653 * k as f64).sin_cos();
            DVec3::new((1.0 - z * z).sqrt() * cos, (1.0 - z * z).sqrt() * sin, z)
        })
    }

    /// Closed forms and distance functions are written independently of each other, so their agreement says both are right.
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
                            assert!(solid.distance(place + 1e-5 * hit.normal) > 0.0 && solid.distance(place - 1e-5 * hit.normal) < 0.0 || nearest < 1e-6 || edge(solid, place));
                        }
                        None => assert!(t > 6.0 || nearest > -1e-7 && nearest.abs() < 1e-4 && t > 0.0 && grazing(solid, origin, direction), "solid {which}, ray {k}: missed at {t}"),
                    }
                }
            }
            assert!(hits > 200, "solid {which}: only {hits} rays hit");
        }
    }

    /// True if the ray stays within 2e-4 of the surface or outside: rounding may then decide either way.
    fn grazing(solid: &Solid, origin: DVec3, direction: DVec3) -> bool {
        (0..6000).all(|k| solid.distance(origin + k as f64 * 1e-3 * direction) > -2e-4)
    }

    /// True close to an edge, where a step along the normal may cross another face.
    fn edge(solid: &Solid, p: DVec3) -> bool {
        let h = 1e-4;
        let gradient = DVec3::from_array([DVec3::X, DVec3::Y, DVec3::Z].map(|e| (solid.distance(p + h * e) - solid.distance(p - h * e)) / (2.0 * h)));
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
