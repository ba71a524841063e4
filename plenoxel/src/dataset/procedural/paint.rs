//! Colors of surfaces and of the sky.

use glam::{DVec3, dvec3};
use std::f64::consts::{PI, TAU};

/// Paint of a surface: two linear albedos in a pattern, and gloss.
#[derive(Debug, Clone, Copy)]
pub struct Paint {
    /// Pattern of the second color.
    pub pattern: Pattern,
    /// Linear albedo.
    pub colors: [DVec3; 2],
    /// Gloss, from 0 for matt paint to 1 for the strongest highlights and reflections.
    pub gloss: f64,
}

/// Pattern of the second color.
#[derive(Debug, Clone, Copy)]
pub enum Pattern {
    /// No second color.
    Plain,
    /// Cells of `side` along axes rotated around the vertical through `center`; `across` is the first axis. An infinite side makes stripes.
    Checker { center: DVec3, across: DVec3, side: DVec3 },
    /// Stripes around the vertical through `center`: `turns` per revolution and `rise` per unit of height.
    Spiral { center: DVec3, turns: f64, rise: f64 },
    /// Meridians and parallels of a globe.
    Globe { center: DVec3, meridians: f64, belts: f64 },
}

impl Pattern {
    /// Returns true if a point has the second color.
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

/// Returns the color of the sky reflected in a direction of the given height (cosine to the vertical).
pub fn sky_color(height: f64) -> DVec3 {
    let (ground, horizon, zenith) = (dvec3(0.10, 0.06, 0.04), dvec3(0.95, 0.85, 0.72), dvec3(0.22, 0.45, 0.95));
    if height < 0.15 {
        let s = ((height + 0.55) / 0.7).clamp(0.0, 1.0);
        ground.lerp(horizon, s * s * (3.0 - 2.0 * s))
    } else {
        horizon.lerp(zenith, (height - 0.15) / 0.85)
    }
}
