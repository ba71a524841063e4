//! Objects of the still life: positions and paints.

use super::convex::Convex;
use super::paint::{Paint, Pattern};
use super::solid::Solid;
use glam::{DVec3, dvec3};
use std::f64::consts::PI;

/// Height of the table's top.
pub const TABLE: f64 = -0.45;
/// Solid with its paint.
#[derive(Debug, Clone)]
pub struct Object {
    /// Shape.
    pub solid: Solid,
    /// Paint of the outside.
    pub skin: Paint,
    /// Paint of the holes' walls, always matt.
    pub lining: Paint,
    /// Fraction of the sky's light that reaches the walls of the holes. Inside a sphere the opening has the same form factor from every
    /// point of the wall: the opening's share of the sphere.
    pub openness: f64,
    /// Radius of the ball that represents the object when it darkens others; 0 for thin objects.
    pub shade: f64,
    /// False if the object never shades others.
    pub casts: bool,
}

/// Returns the objects of the still life.
pub fn objects() -> Vec<Object> {
    let matt = |pattern, first: [f64; 3], second: [f64; 3]| Paint { pattern, colors: [first.into(), second.into()], gloss: 0.0 };
    let plain = |color: [f64; 3], gloss| Paint { pattern: Pattern::Plain, colors: [color.into(); 2], gloss };
    let whole = |piece: Convex, skin: Paint, shade: f64| Object {
        solid: Solid::Carved { body: vec![piece], holes: vec![] },
        skin,
        lining: skin,
        openness: 1.0,
        shade,
        casts: true,
    };
    let ring = |center, axis: DVec3, radius, tube, skin: Paint| Object {
        solid: Solid::Torus { center, axis: axis.normalize(), radius, tube },
        skin,
        lining: skin,
        openness: 1.0,
        shade: 0.0,
        casts: true,
    };
    let up = |x: f64, y: f64, above: f64| dvec3(x, y, TABLE + above);
    let toward = |yaw: f64| dvec3(yaw.cos(), yaw.sin(), 0.0);
    let stripes = f64::INFINITY;

    let bowl = up(-0.47, -0.40, 0.42);
    let yaw = 0.6;
    let block = up(0.46, 0.50, 0.31);
    let dimple = |side: DVec3| Convex::Sphere { center: block + 0.365 * side, radius: 0.21 };
    let globe = dvec3(0.0, 0.08, 0.62);
    let brass = plain([0.62, 0.34, 0.05], 0.35);
    let leg = |x: f64, y: f64| whole(Convex::capsule(up(x, y, 0.02), globe, 0.025), plain([0.05, 0.03, 0.02], 0.0), 0.0);
    let table = whole(
        Convex::cylinder(up(0.0, 0.0, -0.12), up(0.0, 0.0, 0.0), 1.14),
        matt(
            Pattern::Checker { center: up(0.0, 0.0, -0.5), across: toward(0.35), side: dvec3(0.19, 0.19, stripes) },
            [0.02, 0.13, 0.17],
            [0.74, 0.42, 0.10],
        ),
        0.0,
    );

    vec![
        // The table: a round board with a checkered top and edge.
        Object { casts: false, ..table },
        // The bowl: blue outside, a matt globe pattern inside.
        Object {
            solid: Solid::Carved {
                body: vec![Convex::Sphere { center: bowl, radius: 0.44 }, Convex::Below { z: bowl.z + 0.02 }],
                holes: vec![Convex::Sphere { center: bowl, radius: 0.385 }],
            },
            skin: matt(Pattern::Spiral { center: bowl, turns: 0.0, rise: 6.0 }, [0.03, 0.07, 0.36], [0.30, 0.46, 0.70]),
            lining: matt(Pattern::Globe { center: bowl, meridians: 12.0, belts: 8.0 }, [0.85, 0.22, 0.03], [0.95, 0.80, 0.45]),
            openness: 0.47, // half the sphere, less what the rim 0.02 above its middle hides
            shade: 0.38,
            casts: true,
        },
        // The glossy ball.
        whole(Convex::Sphere { center: up(0.50, -0.44, 0.37), radius: 0.37 }, plain([0.36, 0.015, 0.03], 1.0), 0.37),
        // The block with spherical dimples in three sides and the top.
        Object {
            solid: Solid::Carved {
                body: vec![Convex::block(block, DVec3::splat(0.31), yaw)],
                holes: vec![dimple(toward(yaw - PI / 2.0)), dimple(toward(yaw)), dimple(toward(yaw + PI)), dimple(DVec3::Z)],
            },
            skin: matt(
                Pattern::Checker { center: block + DVec3::Z * 0.08, across: toward(yaw), side: dvec3(stripes, stripes, 0.155) },
                [0.20, 0.015, 0.26],
                [0.62, 0.16, 0.52],
            ),
            lining: plain([0.95, 0.70, 0.06], 0.0),
            openness: 0.63, // the hollow is 0.155 of the sphere's 0.42 high, so this share of the sphere is open
            shade: 0.36,
            casts: true,
        },
        // The cone with a spiral.
        whole(
            Convex::Cone { base: up(-0.48, 0.48, 0.0), radius: 0.34, height: 1.05 },
            matt(Pattern::Spiral { center: up(-0.48, 0.48, 0.0), turns: 2.0, rise: 5.5 }, [0.78, 0.05, 0.04], [0.92, 0.88, 0.80]),
            0.29,
        ),
        // A globe with two hoops on a tripod: glossy and thin.
        whole(Convex::Sphere { center: globe, radius: 0.17 }, plain([0.015, 0.16, 0.07], 1.0), 0.17),
        leg(0.21, 0.04),
        leg(-0.18, 0.27),
        leg(-0.11, -0.15),
        ring(globe, dvec3(0.25, -0.2, 1.0), 0.30, 0.023, brass),
        ring(globe, dvec3(1.0, 0.3, 0.15), 0.255, 0.023, brass),
        // A candle, a ring on the table, two marbles.
        whole(
            Convex::cylinder(up(0.04, -0.84, 0.0), up(0.04, -0.84, 0.48), 0.12),
            matt(Pattern::Spiral { center: up(0.04, -0.84, 0.02), turns: 0.0, rise: 7.5 }, [0.02, 0.02, 0.025], [0.93, 0.66, 0.04]),
            0.13,
        ),
        ring(up(0.86, 0.04, 0.05), DVec3::Z, 0.14, 0.05, plain([0.02, 0.30, 0.12], 0.0)),
        whole(Convex::Sphere { center: up(-0.90, 0.10, 0.13), radius: 0.13 }, plain([0.04, 0.10, 0.42], 1.0), 0.13),
        whole(
            Convex::Sphere { center: up(0.0, 0.82, 0.16), radius: 0.16 },
            matt(Pattern::Globe { center: up(0.0, 0.82, 0.16), meridians: 6.0, belts: 4.0 }, [0.02, 0.02, 0.02], [0.90, 0.90, 0.86]),
            0.16,
        ),
    ]
}
