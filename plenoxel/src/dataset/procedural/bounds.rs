//! Bounding balls of the objects, tested together: which objects a ray may hit, and how much sky they hide.

use super::convex::Ball;
use super::still_life::Object;
use glam::DVec3;

/// Largest number of objects, for which the bounds fill whole vector registers and a set of objects is a `u32`.
pub const MOST: usize = 16;

/// Bounding ball of each object, stored by coordinate in single precision, slightly enlarged. Unused lanes have radius minus infinity.
#[derive(Debug, Clone)]
pub struct Bounds {
    x: [f32; MOST],
    y: [f32; MOST],
    z: [f32; MOST],
    radius: [f32; MOST],
    /// Squared radius of the ball that darkens neighbours; 0 for thin objects.
    shade: [f32; MOST],
}

impl Bounds {
    /// Creates the bounds of up to [`MOST`] objects.
    pub fn new(objects: &[Object]) -> Self {
        let (none, nothing) = ([0.0; MOST], [f32::NEG_INFINITY; MOST]);
        let mut bounds = Bounds { x: none, y: none, z: none, radius: nothing, shade: none };
        for (k, object) in objects.iter().enumerate() {
            let Ball { center, radius } = object.solid.bound();
            [bounds.x[k], bounds.y[k], bounds.z[k]] = center.as_vec3().to_array();
            bounds.radius[k] = radius as f32 + 1e-4;
            bounds.shade[k] = (object.shade * object.shade) as f32;
        }
        bounds
    }

    /// Returns the objects whose balls intersect a cone around the ray, whose radius is `spread` times the distance.
    #[inline]
    pub fn near(&self, origin: DVec3, direction: DVec3, spread: f32) -> u32 {
        let ([ox, oy, oz], [dx, dy, dz]) = (origin.as_vec3().to_array(), direction.as_vec3().to_array());
        let mut hit = [0_u32; MOST];
        for (k, hit) in hit.iter_mut().enumerate() {
            let (x, y, z) = (self.x[k] - ox, self.y[k] - oy, self.z[k] - oz);
            let along = x * dx + y * dy + z * dz;
            // Uses the cross product: the difference of two squares would be too inaccurate in single precision.
            let (u, v, w) = (y * dz - z * dy, z * dx - x * dz, x * dy - y * dx);
            let reach = self.radius[k] + spread * (along.abs() + self.radius[k]);
            *hit = u32::from((along > -self.radius[k]) & (u * u + v * v + w * w <= reach * reach) & (reach > 0.0));
        }
        hit.iter().enumerate().fold(0, |bits, (k, hit)| bits | hit << k)
    }

    /// Returns the fraction of the sky that is visible from the point `p` with normal `n`. Objects other than `own` are balls that each
    /// hide the form factor r² cos / d².
    #[inline]
    pub fn open_sky(&self, p: DVec3, n: DVec3, own: usize) -> f64 {
        let ([px, py, pz], [nx, ny, nz]) = (p.as_vec3().to_array(), n.as_vec3().to_array());
        let mut open = [1.0_f32; MOST];
        for (k, open) in open.iter_mut().enumerate() {
            let (x, y, z) = (self.x[k] - px, self.y[k] - py, self.z[k] - pz);
            let squared = x * x + y * y + z * z;
            let blocked = (x * nx + y * ny + z * nz).max(0.0) * self.shade[k] / (squared * squared.sqrt());
            *open = 1.0 - blocked.min(0.85);
        }
        open[own] = 1.0;
        f64::from(open.iter().product::<f32>())
    }
}
