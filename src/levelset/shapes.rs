//! Analytic solids by their exact signed distance (Hart 1996; Quilez's catalogue for box, torus, cylinder, capsule).

use glam::{DMat3, DVec3};

use crate::error::Result;
use crate::spec::Spec;

/// A solid that has a closed-form distance, or an implicit function from which one is rebuilt.
pub struct Solid {
    center: DVec3,
    axes: DMat3,
    form: Form,
}

enum Form {
    Sphere { radius: f64 },
    Box { half_size: DVec3, round: f64 },
    Torus { major: f64, minor: f64 },
    Cylinder { radius: f64, half_height: f64 },
    Capsule { a: DVec3, b: DVec3, radius: f64 },
    Superellipsoid { radii: DVec3, exponents: [f64; 2] },
    Supertoroid { radii: DVec3, alpha: f64, exponents: [f64; 2] },
}

/// The kinds of solids.
pub const KINDS: [&str; 7] = ["sphere", "box", "torus", "cylinder", "capsule", "superellipsoid", "supertoroid"];

impl Solid {
    /// A solid from its specification, such as `torus major=1 minor=0.3 axis=z`; lengths in world units.
    pub fn parse(text: &str) -> Result<Self> {
        let spec = Spec::parse("shape", text)?;
        let exponents = || -> Result<[f64; 2]> {
            let e = spec.pair("exponents")?.unwrap_or([1.0, 1.0]);
            if e.iter().all(|e| (0.1..=2.0).contains(e)) {
                Ok(e)
            } else {
                Err(spec.refuse("exponents between 0.1 and 2"))
            }
        };
        let positive = |key: &str| -> Result<DVec3> {
            let v = spec.required_vector(key)?;
            if v.min_element() > 0.0 { Ok(v) } else { Err(spec.refuse(format!("every part of `{key}` positive"))) }
        };
        let form = match spec.kind() {
            "sphere" => Form::Sphere { radius: spec.length("radius")? },
            "box" => {
                let half_size = positive("size")? / 2.0;
                let round = spec.number("round")?.unwrap_or(0.0);
                if !(0.0..=half_size.min_element()).contains(&round) {
                    return Err(spec
                        .refuse(format!("`round` from 0 to half of the smallest edge, {}", half_size.min_element())));
                }
                Form::Box { half_size, round }
            }
            "torus" => {
                let (major, minor) = (spec.length("major")?, spec.length("minor")?);
                if minor > major {
                    return Err(spec.refuse("`minor` not larger than `major`: the tube would run through itself"));
                }
                Form::Torus { major, minor }
            }
            "cylinder" => Form::Cylinder { radius: spec.length("radius")?, half_height: spec.length("height")? / 2.0 },
            "capsule" => Form::Capsule {
                a: spec.required_vector("a")?,
                b: spec.required_vector("b")?,
                radius: spec.length("radius")?,
            },
            "superellipsoid" => Form::Superellipsoid { radii: positive("radii")?, exponents: exponents()? },
            "supertoroid" => {
                let alpha = spec.length("alpha")?;
                if alpha < 1.0 {
                    return Err(spec.refuse("`alpha` (radius of the ring over radius of the tube) 1 or more"));
                }
                Form::Supertoroid { radii: positive("radii")?, alpha, exponents: exponents()? }
            }
            _ => return Err(spec.unknown_kind(&KINDS)),
        };
        let (center, axes) = match form {
            // A capsule is placed by its ends.
            Form::Capsule { .. } => (DVec3::ZERO, DMat3::IDENTITY),
            _ => (spec.center()?, spec.axes()?),
        };
        spec.finish()?;
        Ok(Self { center, axes, form })
    }

    /// Whether [`value`](Self::value) is the exact distance. If not, a true distance must be rebuilt from its zero set.
    pub fn is_distance(&self) -> bool {
        !matches!(self.form, Form::Superellipsoid { .. } | Form::Supertoroid { .. })
    }

    /// World-space box around the solid.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let extent = match self.form {
            Form::Sphere { radius } => DVec3::splat(radius),
            Form::Box { half_size, .. } => half_size,
            Form::Torus { major, minor } => DVec3::new(major + minor, major + minor, minor),
            Form::Cylinder { radius, half_height } => DVec3::new(radius, radius, half_height),
            Form::Capsule { a, b, radius } => return (a.min(b) - radius, a.max(b) + radius),
            Form::Superellipsoid { radii, .. } => radii,
            Form::Supertoroid { radii, alpha, .. } => radii * DVec3::new(alpha + 1.0, alpha + 1.0, 1.0),
        };
        let abs = DMat3::from_cols(self.axes.x_axis.abs(), self.axes.y_axis.abs(), self.axes.z_axis.abs());
        (self.center - abs * extent, self.center + abs * extent)
    }

    /// Signed distance at a world position, negative inside; for the superquadrics a field of the same zero set whose
    /// slope at the surface is of the order of one.
    pub fn value(&self, xyz: DVec3) -> f64 {
        let q = self.axes.transpose() * (xyz - self.center);
        match self.form {
            Form::Sphere { radius } => q.length() - radius,
            Form::Box { half_size, round } => {
                let d = q.abs() - (half_size - round);
                d.max(DVec3::ZERO).length() + d.max_element().min(0.0) - round
            }
            Form::Torus { major, minor } => (q.x.hypot(q.y) - major).hypot(q.z) - minor,
            Form::Cylinder { radius, half_height } => {
                let (r, h) = (q.x.hypot(q.y) - radius, q.z.abs() - half_height);
                r.max(0.0).hypot(h.max(0.0)) + r.max(h).min(0.0)
            }
            Form::Capsule { a, b, radius } => {
                let (p, axis) = (xyz - a, b - a);
                let t = if axis == DVec3::ZERO { 0.0 } else { (p.dot(axis) / axis.length_squared()).clamp(0.0, 1.0) };
                (p - axis * t).length() - radius
            }
            Form::Superellipsoid { radii, exponents: [e1, e2] } => {
                // s − 1 with the homogeneous s of Barr 1981, whose slope is at most `steepness` over the smallest radius: never
                // more than the distance, however long the solid is.
                let s = lp(lp(q.x / radii.x, q.y / radii.y, e2), q.z / radii.z, e1);
                (s - 1.0) * radii.min_element() / steepness([e1, e2])
            }
            Form::Supertoroid { radii, alpha, exponents: [e1, e2] } => {
                let ring = lp(q.x / radii.x, q.y / radii.y, e2) - alpha;
                (lp(ring, q.z / radii.z, e1) - 1.0) * radii.min_element() / steepness([e1, e2])
            }
        }
    }
}

/// Largest slope of two nested [`lp`]: 1 for exponents up to 1, up to √2 each above, where edges point outwards.
fn steepness(exponents: [f64; 2]) -> f64 {
    exponents.iter().map(|e| if *e > 1.0 { std::f64::consts::SQRT_2 } else { 1.0 }).product()
}

/// (|a|^(2/e) + |b|^(2/e))^(e/2), with the larger part taken out so that no power overflows.
fn lp(a: f64, b: f64, e: f64) -> f64 {
    let (a, b) = (a.abs(), b.abs());
    let m = a.max(b);
    if m == 0.0 { 0.0 } else { m * ((a / m).powf(2.0 / e) + (b / m).powf(2.0 / e)).powf(e / 2.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, p: [f64; 3]) -> f64 {
        Solid::parse(text).unwrap().value(DVec3::from(p))
    }

    #[test]
    fn distances_at_known_points() {
        for (text, p, d) in [
            ("sphere radius=2 center=1,0,0", [4.0, 0.0, 0.0], 1.0),
            ("box size=2,4,6", [2.0, 3.0, 3.0], 2f64.sqrt()),
            ("box size=2,4,6", [0.0, 0.0, 0.0], -1.0),
            ("box size=2,2,2 round=0.5", [1.5, 1.5, 0.0], 2f64.sqrt() - 0.5),
            ("torus major=3 minor=1", [3.0, 0.0, 2.0], 1.0),
            ("torus major=3 minor=1 axis=y", [3.0, 2.0, 0.0], 1.0),
            ("cylinder radius=1 height=4", [4.0, 0.0, 6.0], 5.0),
            ("cylinder radius=1 height=4 axis=x", [0.0, 0.25, 0.0], -0.75),
            ("capsule a=0,0,0 b=0,0,5 radius=1", [0.0, 3.0, 2.0], 2.0),
            ("superellipsoid radii=3,2,1", [3.0, 0.0, 0.0], 0.0),
            ("superellipsoid radii=3,2,1 exponents=0.2,0.2", [3.3, 0.0, 0.0], 0.1),
            ("supertoroid radii=1,1,1 alpha=3", [4.0, 0.0, 0.0], 0.0),
        ] {
            assert!((value(text, p) - d).abs() < 1e-12, "{text} {p:?}: {}", value(text, p));
        }
    }

    #[test]
    fn bounds_hold_the_solid() {
        for text in [
            "torus major=3 minor=1 axis=1,1,0 center=1,2,3",
            "box size=1,2,3 rotate=x,30",
            "supertoroid radii=1,2,0.5 alpha=2 exponents=0.5,1.5 rotate=y,20",
        ] {
            let solid = Solid::parse(text).unwrap();
            let (lo, hi) = solid.bounds();
            let steps = 60;
            for i in 0..steps * steps * steps {
                let t = DVec3::new((i % steps) as f64, (i / steps % steps) as f64, (i / steps / steps) as f64) / 59.0;
                // A box twice as large: what lies inside the solid must lie inside its bounds.
                let p = lo + (hi - lo) * (t * 2.0 - 0.5);
                if solid.value(p) < 0.0 {
                    assert!(p.cmpge(lo - 1e-9).all() && p.cmple(hi + 1e-9).all(), "{text} {p}");
                }
            }
        }
    }

    #[test]
    fn refuses_impossible_solids() {
        for text in [
            "cube size=1,1,1",
            "sphere radius=0",
            "box size=1,1,1 round=0.6",
            "torus major=1 minor=2",
            "supertoroid radii=1,1,1 alpha=0.5",
            "superellipsoid radii=1,-1,1",
            "capsule a=0,0,0 b=1,0,0 radius=1 center=1,1,1",
        ] {
            assert!(Solid::parse(text).is_err(), "{text}");
        }
    }
}
