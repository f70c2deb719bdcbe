//! Solids made of analytic ones by constructive geometry: `difference(box size=2,2,2, sphere radius=1.2)`.
//!
//! An expression is a solid ([`Solid`]), or `union`, `intersection` or `difference` of expressions in parentheses, separated by commas.
//! `smooth-union(radius=0.2, …)` and its like round the edges between their parts ([`BlendForm`]); `function=`, `exponent=`, `alpha=` and
//! `order=` choose the form. A comma before a letter separates parts, any other belongs to a value.

use glam::DVec3;

use super::shapes::{KINDS, Solid};
use super::smooth_csg::{BlendForm, Combine};
use crate::error::{EditError, Result};
use crate::spec::{Spec, suggest};

/// A solid, or a combination of solids.
pub enum Expression {
    /// One with a formula.
    Solid(Solid),
    /// One made of others.
    Combined(Combined),
}

/// Parts and how they are combined.
pub struct Combined {
    combine: Combine,
    /// How the edges between the parts are rounded, if they are.
    form: Option<BlendForm>,
    parts: Vec<Expression>,
}

const COMBINATIONS: [(&str, Combine, bool); 6] = [
    ("union", Combine::Union, false),
    ("intersection", Combine::Intersection, false),
    ("difference", Combine::Difference, false),
    ("smooth-union", Combine::Union, true),
    ("smooth-intersection", Combine::Intersection, true),
    ("smooth-difference", Combine::Difference, true),
];

/// Deepest nesting: a recursion that no text can drive into the stack's end.
const DEEPEST: usize = 64;

impl Expression {
    /// An expression from its text; lengths in world units.
    pub fn parse(text: &str) -> Result<Self> {
        Self::nested(text.trim(), 0)
    }

    fn nested(text: &str, depth: usize) -> Result<Self> {
        let refuse = |accepted: String| EditError::parameter("shape", "specification", format!("`{text}`"), accepted);
        let Some(open) = text.find(['(', '"', '=']).filter(|at| text[*at..].starts_with('(')) else {
            return Solid::parse(text).map(Self::Solid);
        };
        let name = text[..open].trim();
        let Some(&(_, combine, smooth)) = COMBINATIONS.iter().find(|(known, ..)| *known == name) else {
            let known = COMBINATIONS.iter().map(|c| c.0).chain(KINDS);
            return Err(refuse(suggest(name, known)));
        };
        if depth == DEEPEST {
            return Err(refuse(format!("up to {DEEPEST} levels of parentheses")));
        }
        let inner =
            text[open + 1..].strip_suffix(')').ok_or_else(|| refuse("a closing parenthesis at its end".into()))?;
        let pieces = pieces(inner).ok_or_else(|| refuse("parentheses and double quotes in pairs".into()))?;
        // Parts begin with a kind, options with a key.
        let is_option =
            |piece: &&str| piece.split(['=', ' ', '(']).next().is_some_and(|word| piece[word.len()..].starts_with('='));
        let (options, parts): (Vec<&str>, Vec<&str>) = pieces.into_iter().partition(is_option);
        let form = form(name, &options)?;
        if smooth != form.is_some() {
            return Err(refuse(match smooth {
                true => format!("`{name}(radius=…, …)`: the radius of a fillet in world units"),
                false => format!("no options; `smooth-{name}(radius=…, …)` rounds edges"),
            }));
        }
        if parts.len() < 2 {
            return Err(refuse(format!("`{name}(A, B, …)` with two or more solids, separated by commas")));
        }
        let parts = parts.into_iter().map(|part| Self::nested(part, depth + 1)).collect::<Result<_>>()?;
        Ok(Self::Combined(Combined { combine, form, parts }))
    }

    /// Whether [`value`](Self::value) is the exact distance.
    pub fn is_distance(&self) -> bool {
        matches!(self, Self::Solid(solid) if solid.is_distance())
    }

    /// Negative inside, zero on the surface; at most the distance in magnitude, where the solids' own values are.
    pub fn value(&self, xyz: DVec3) -> f64 {
        match self {
            Self::Solid(solid) => solid.value(xyz),
            Self::Combined(combined) => combined.value(xyz),
        }
    }

    /// World-space box around it; `None` if there is nothing inside.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        match self {
            Self::Solid(solid) => Some(solid.bounds()),
            Self::Combined(combined) => combined.bounds(),
        }
    }
}

impl Combined {
    fn value(&self, xyz: DVec3) -> f64 {
        let values: smallvec::SmallVec<[f64; 8]> = self.parts.iter().map(|part| part.value(xyz)).collect();
        let others = || values.iter().skip(1).copied();
        let first = values.first().copied().unwrap_or(f64::INFINITY);
        let sharp = match self.combine {
            Combine::Union => others().fold(first, f64::min),
            Combine::Intersection => others().fold(first, f64::max),
            Combine::Difference => others().map(|v| -v).fold(first, f64::max),
        };
        match self.form {
            None => sharp,
            // Their zero set is that of the minimum, their slope is not bounded.
            Some(form @ BlendForm::R { .. }) => form.combine(self.combine, &values).clamp(-sharp.abs(), sharp.abs()),
            // |Σ aᵢ ∇fᵢ| with Σ aᵢ² ≤ 1 (exponent 2; less above): at most the root of their number.
            Some(form @ BlendForm::SuperElliptic { .. }) => {
                form.combine(self.combine, &values) / (values.len() as f64).sqrt()
            }
            // Means of their slopes.
            Some(form) => form.combine(self.combine, &values),
        }
    }

    fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let mut boxes = self.parts.iter().map(Expression::bounds);
        match self.combine {
            Combine::Union => {
                let (lo, hi) = boxes.flatten().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))?;
                // Each further part may add to what the ones before have filled.
                let depth = self.form.map_or(0.0, |form| form.largest_depth()) * (self.parts.len() - 1) as f64;
                Some((lo - depth, hi + depth))
            }
            Combine::Difference => boxes.next()?,
            Combine::Intersection => {
                let (lo, hi) = boxes.try_fold((DVec3::NEG_INFINITY, DVec3::INFINITY), |all, b| {
                    b.map(|b| (all.0.max(b.0), all.1.min(b.1)))
                })?;
                lo.cmple(hi).all().then_some((lo, hi))
            }
        }
    }
}

/// What the options of a smooth combination say; `None` without any.
fn form(name: &str, options: &[&str]) -> Result<Option<BlendForm>> {
    if options.is_empty() {
        return Ok(None);
    }
    let spec = Spec::parse("shape", &format!("{name} {}", options.join(" ")))?;
    let exponent = spec.number("exponent")?;
    let form = match spec.text("function").unwrap_or("superelliptic") {
        "superelliptic" => {
            BlendForm::SuperElliptic { radius: spec.length("radius")?, exponent: exponent.unwrap_or(2.0) }
        }
        "exponential" => BlendForm::Exponential { radius: spec.length("radius")? },
        "hyperbolic" => BlendForm::Hyperbolic { radius: spec.length("radius")? },
        "r" => {
            let order = spec.number("order")?.unwrap_or(0.0);
            if !((0.0..=8.0).contains(&order) && order.fract() == 0.0) {
                return Err(spec.refuse("`order` a whole number from 0 to 8"));
            }
            BlendForm::R { alpha: spec.number("alpha")?.unwrap_or(0.0), order: order as u32 }
        }
        other => {
            return Err(spec.refuse(suggest(other, ["superelliptic", "exponential", "hyperbolic", "r"].into_iter())));
        }
    };
    spec.finish()?;
    form.validate("shape")?;
    Ok(Some(form))
}

/// Splits at commas before letters, outside parentheses and double quotes; `None` if those are not in pairs.
fn pieces(text: &str) -> Option<Vec<&str>> {
    let (mut depth, mut quoted, mut start, mut pieces) = (0usize, false, 0, Vec::new());
    for (at, c) in text.char_indices() {
        match c {
            '"' => quoted = !quoted,
            '(' if !quoted => depth += 1,
            ')' if !quoted => depth = depth.checked_sub(1)?,
            ',' if !quoted && depth == 0 => {
                let rest = text[at + 1..].trim_start();
                if rest.starts_with(|c: char| c.is_ascii_alphabetic()) {
                    pieces.push(text[start..at].trim());
                    start = at + 1;
                }
            }
            _ => {}
        }
    }
    let last = text[start..].trim();
    if !last.is_empty() {
        pieces.push(last);
    }
    (depth == 0 && !quoted).then_some(pieces)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str, p: [f64; 3]) -> f64 {
        Expression::parse(text).unwrap().value(DVec3::from(p))
    }

    #[test]
    fn expressions_combine_the_values_of_their_parts() {
        let two = "sphere radius=1, box center=2,0,0 size=1,1,1";
        for (text, p, expected) in [
            (format!("union({two})"), [2.0, 0.0, 0.0], -0.5),
            (format!("union({two})"), [0.0, 3.0, 0.0], 2.0),
            (format!("intersection({two})"), [0.0, 0.0, 0.0], 1.5),
            (format!("difference({two})"), [0.0, 0.0, 0.0], -1.0),
            ("difference(box size=2,2,2, sphere radius=0.5, sphere center=1,1,1 radius=0.25)".into(), [0.0; 3], 0.5),
            (format!("union(difference({two}), capsule a=0,0,0 b=0,0,5 radius=0.5)"), [0.0, 0.0, 5.0], -0.5),
            (format!("smooth-union( radius=0.25 , {two} )"), [0.0, -3.0, 0.0], 2.0 / 2f64.sqrt()),
        ] {
            assert!((value(&text, p) - expected).abs() < 1e-12, "{text}: {}", value(&text, p));
        }
        // In the edge between two faces at right angles the surface is (1 − 1/√2) r off either.
        let edge = "box center=-5,0,0 size=10,30,30, box center=0,-5,0 size=30,10,30";
        let depth = (1.0 - 0.5f64.sqrt()) * 0.5;
        for function in ["superelliptic", "exponential", "hyperbolic"] {
            let text = format!("smooth-union(radius=0.5 function={function}, {edge})");
            assert!(value(&text, [depth, depth, 0.0]).abs() < 1e-12, "{function}");
            let text = format!("smooth-intersection(radius=0.5, function={function}, {edge})");
            assert!(value(&text, [-depth, -depth, 0.0]).abs() < 1e-12, "{function}");
        }
        // R-functions keep the surface of the minimum.
        assert_eq!(value(&format!("smooth-union(function=r, {edge})"), [0.0, 1.0, 0.0]), 0.0);
    }

    #[test]
    fn values_never_exceed_the_distance_and_bounds_hold_the_inside() {
        for text in [
            "smooth-union(radius=0.6, sphere radius=1, sphere center=1.2,0,0 radius=0.7, box center=0,1,0 size=1,1,1)",
            "smooth-difference(radius=0.3 exponent=4, box size=2,2,2, cylinder radius=0.5 height=3)",
            "smooth-union(radius=0.6 function=exponential, sphere radius=1, sphere center=1.2,0,0 radius=0.7)",
            "smooth-union(radius=0.6 function=hyperbolic, sphere radius=1, sphere center=1.2,0,0 radius=0.7)",
            "smooth-intersection(function=r order=2, sphere radius=1, sphere center=0.5,0,0 radius=1)",
        ] {
            let expression = Expression::parse(text).unwrap();
            let (lo, hi) = expression.bounds().unwrap();
            let at = |i: i32| (f64::from(i) / 30.0 - 0.25) * 2.0;
            for i in 0..30 * 30 * 30 {
                let p = lo + (hi - lo) * DVec3::new(at(i % 30), at(i / 30 % 30), at(i / 900));
                let value = expression.value(p);
                assert!(value >= 0.0 || (p.cmpge(lo).all() && p.cmple(hi).all()), "{text} {p}");
                // Along a step of 0.02 in three directions.
                for step in [DVec3::X, DVec3::new(0.6, 0.0, 0.8), DVec3::new(1.0, -1.0, 1.0).normalize()] {
                    let next = expression.value(p + step * 0.02);
                    let crosses = (value < 0.0) != (next < 0.0);
                    assert!(!crosses || value.abs() <= 0.02 + 1e-12, "{text} {p}: {value} {next}");
                }
            }
        }
    }

    #[test]
    fn what_cannot_be_understood_is_refused_with_what_would_work() {
        for (text, part) in [
            ("onion(sphere radius=1, sphere radius=2)", "did you mean `union`"),
            ("union(sphere radius=1)", "two or more"),
            ("union(sphere radius=1, sphere radius=2", "closing parenthesis"),
            ("union(sphere radius=1), sphere radius=2)", "in pairs"),
            ("union(radius=1, sphere radius=1, sphere radius=2)", "smooth-union"),
            ("smooth-union(sphere radius=1, sphere radius=2)", "radius=…"),
            ("smooth-union(radius=-1, sphere radius=1, sphere radius=2)", "positive"),
            ("smooth-union(radius=1 function=soft, sphere radius=1, sphere radius=2)", "superelliptic"),
            ("smooth-union(radius=1 colour=2, sphere radius=1, sphere radius=2)", "colour"),
            ("union(sphere radius=1, ball radius=2)", "sphere"),
        ] {
            let error = Expression::parse(text).err().unwrap().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
        let deep = format!("{}sphere radius=1{}", "union(sphere radius=1, ".repeat(80), ")".repeat(80));
        assert!(Expression::parse(&deep).err().unwrap().to_string().contains("levels"));
        assert!(
            Expression::parse("intersection(sphere radius=1, sphere center=9,0,0 radius=1)")
                .unwrap()
                .bounds()
                .is_none()
        );
    }
}
