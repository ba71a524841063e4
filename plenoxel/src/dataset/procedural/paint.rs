//! The colors of surfaces and of the sky.

use glam::{DVec3, dvec3};
use std::f64::consts::{PI, TAU};

/// Albedo (linear) in two colors, and how strongly the surface mirrors.
#[derive(Debug, Clone, Copy)]
pub struct Paint {
    /// Where the second color goes.
    pub pattern: Pattern,
    /// Linear albedo.
    pub colors: [DVec3; 2],
    /// 0 for matt paint, 1 for the strongest highlights and reflections.
    pub gloss: f64,
}

/// Where the second color goes.
#[derive(Debug, Clone, Copy)]
pub enum Pattern {
    /// Nowhere.
    Plain,
    /// Cells of `side` along axes turned about the vertical through `center`, of which `across` is the first; an infinite side
    /// makes stripes.
    Checker { center: DVec3, across: DVec3, side: DVec3 },
    /// Stripes that go `turns` times around the vertical through `center` and `rise` times per unit of height.
    Spiral { center: DVec3, turns: f64, rise: f64 },
    /// Meridians and parallels of a globe.
    Globe { center: DVec3, meridians: f64, belts: f64 },
}

impl Pattern {
    /// True where a point has the second color.
    pub fn second(&self, p: DVec3) -> bool {
        let azimuth = |o: DVec3| o.y.atan2(o.x) / TAU;
        let cell = match *self {
            Pattern::Plain => 0.0,
            Pattern::Checker { center, across, side } => {
                let o = p - center;
                let cells = (dvec3(across.dot(o), across.x * o.y - across.y * o.x, o.z) / side).floor();
                cells.x + cells.y + cells.z
            }
            Pattern::Spiral { center, turns: 0.0, rise } => (rise * (p.z - center.z)).floor(),
            Pattern::Spiral { center, turns, rise } => (turns * azimuth(p - center) + rise * (p.z - center.z)).floor(),
            Pattern::Globe { center, meridians, belts } => {
                let o = p - center;
                let polar = (o.z / o.length()).clamp(-1.0, 1.0).acos() / PI;
                (meridians * azimuth(o)).floor() + (belts * polar).floor()
            }
        };
        cell.rem_euclid(2.0) >= 1.0
    }
}

/// The sky seen in a mirror that reflects into a direction of the given height (cosine to the vertical).
pub fn sky_color(height: f64) -> DVec3 {
    let (ground, horizon, zenith) = (dvec3(0.10, 0.06, 0.04), dvec3(0.95, 0.85, 0.72), dvec3(0.22, 0.45, 0.95));
    if height < 0.15 {
        let s = ((height + 0.55) / 0.7).clamp(0.0, 1.0);
        ground.lerp(horizon, s * s * (3.0 - 2.0 * s))
    } else {
        horizon.lerp(zenith, (height - 0.15) / 0.85)
    }
}
