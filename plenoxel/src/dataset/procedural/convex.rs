//! Convex solids with exact ray intersections. A ray intersects a convex solid in one interval, which is all that a shape computes; the
//! normal is computed on demand.

use glam::DVec3;

/// Ball, used as a bounding volume.
#[derive(Debug, Clone, Copy)]
pub struct Ball {
    /// Centre.
    pub center: DVec3,
    /// Radius.
    pub radius: f64,
}

/// Convex solid.
#[derive(Debug, Clone, Copy)]
pub enum Convex {
    /// Solid sphere.
    Sphere { center: DVec3, radius: f64 },
    /// Box with the given orthonormal `axes`.
    Block { center: DVec3, half: DVec3, axes: [DVec3; 3] },
    /// Cylinder with flat ends. It extends `half` to either side of its centre along the unit `axis`.
    Cylinder { center: DVec3, axis: DVec3, half: f64, radius: f64 },
    /// Cylinder with hemispherical ends beyond the flat ends.
    Capsule { center: DVec3, axis: DVec3, half: f64, radius: f64 },
    /// Upright cone from the disc of `radius` around `base` to the tip `height` above it.
    Cone { base: DVec3, radius: f64, height: f64 },
    /// Half-space below a horizontal plane.
    Below { z: f64 },
}

/// Interval of a ray inside a convex solid.
#[derive(Clone, Copy)]
pub struct Span {
    /// Distance along the ray at the entry.
    pub enter: f64,
    /// Distance along the ray at the exit.
    pub exit: f64,
}

impl Span {
    /// The whole line.
    pub const ALL: Span = Span { enter: f64::NEG_INFINITY, exit: f64::INFINITY };

    #[inline]
    pub fn overlap(self, other: Span) -> Option<Span> {
        let both = Span { enter: self.enter.max(other.enter), exit: self.exit.min(other.exit) };
        (both.enter < both.exit).then_some(both)
    }

    /// Returns the smallest interval that contains both. It is the union if the pieces form one convex solid.
    #[inline]
    pub fn hull(a: Option<Span>, b: Option<Span>) -> Option<Span> {
        let (Some(a), Some(b)) = (a, b) else {
            return a.or(b);
        };
        Some(Span { enter: a.enter.min(b.enter), exit: a.exit.max(b.exit) })
    }

    /// Returns the interval in which a coordinate that starts at `o` and changes by `d` per unit of the ray is between -half and half.
    #[inline]
    pub fn slab(o: f64, d: f64, half: f64) -> Option<Span> {
        if d.abs() < 1e-300 {
            return (o.abs() <= half).then_some(Span::ALL);
        }
        let (a, b) = ((-half - o) / d, (half - o) / d);
        Some(Span { enter: a.min(b), exit: a.max(b) })
    }

    /// Returns the interval between the roots of a t² + 2 b t + c, for a > 0.
    #[inline]
    pub fn between_roots(a: f64, b: f64, c: f64) -> Option<Span> {
        let root = b * b - a * c;
        if root <= 0.0 {
            return None;
        }
        let root = root.sqrt();
        Some(Span { enter: (-b - root) / a, exit: (-b + root) / a })
    }

    /// Returns the ray's interval in a ball around the origin of `o`.
    #[inline]
    pub fn ball(o: DVec3, d: DVec3, radius: f64) -> Option<Span> {
        Span::between_roots(1.0, o.dot(d), o.length_squared() - radius * radius)
    }

    /// Returns the ray's interval in the infinite cylinder around the line through the origin of `o` along the unit `axis`.
    #[inline]
    pub fn tube(o: DVec3, d: DVec3, axis: DVec3, radius: f64) -> Option<Span> {
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
    /// Creates a box rotated by `yaw` radians around the vertical.
    pub fn block(center: DVec3, half: DVec3, yaw: f64) -> Self {
        let (sin, cos) = yaw.sin_cos();
        Convex::Block { center, half, axes: [DVec3::new(cos, sin, 0.0), DVec3::new(-sin, cos, 0.0), DVec3::Z] }
    }

    /// Creates a cylinder with flat ends at `a` and `b`.
    pub fn cylinder(a: DVec3, b: DVec3, radius: f64) -> Self {
        Convex::Cylinder { center: a.midpoint(b), axis: (b - a).normalize(), half: 0.5 * a.distance(b), radius }
    }

    /// Creates the solid of all points within `radius` of the segment from `a` to `b`.
    pub fn capsule(a: DVec3, b: DVec3, radius: f64) -> Self {
        Convex::Capsule { center: a.midpoint(b), axis: (b - a).normalize(), half: 0.5 * a.distance(b), radius }
    }

    /// Returns the interval in which the ray is inside.
    pub fn span(&self, origin: DVec3, d: DVec3) -> Option<Span> {
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
                // A ray that misses the infinite cylinder misses the capsule.
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

    /// Returns the outward unit normal at a point of the surface; on an edge, the normal of either face.
    pub fn normal(&self, p: DVec3) -> DVec3 {
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

    /// Returns the signed distance, negative inside. It is exact, except outside of a block, cone or cylinder at points nearest to an edge,
    /// where it is a lower bound.
    pub fn distance(&self, p: DVec3) -> f64 {
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

    /// Returns a ball that contains the solid; `None` if it is unbounded.
    pub fn bound(&self) -> Option<Ball> {
        Some(match *self {
            Convex::Sphere { center, radius } => Ball { center, radius },
            Convex::Block { center, half, .. } => Ball { center, radius: half.length() },
            Convex::Cylinder { center, half, radius, .. } => Ball { center, radius: radius.hypot(half) },
            Convex::Capsule { center, half, radius, .. } => Ball { center, radius: radius + half },
            // The ball through tip and rim, or around the rim for a flat cone.
            Convex::Cone { base, radius, height } => {
                let up = (0.5 * (height * height - radius * radius) / height).max(0.0);
                Ball { center: base + DVec3::Z * up, radius: (height - up).max(radius.hypot(up)) }
            }
            Convex::Below { .. } => return None,
        })
    }
}

/// Returns the ray's interval in a cone below its tip at the origin of `o`: h² (x² + y²) <= r² z², -h <= z <= 0. Only the lower nappe of
/// the double cone is solid.
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
