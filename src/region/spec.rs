//! Regions from text: `sphere center=0,0,0 radius=1 soft=0.9,1`.

use glam::DVec3;

use super::{Combined, Primitive, Region, Shape};
use crate::error::Result;
use crate::spec::Spec;

const KINDS: [&str; 5] = ["sphere", "box", "cylinder", "superellipsoid", "bbox"];

/// The region of several specifications, `None` for none of them. Each multiplies the ones before; one that begins with
/// `or` is united with the ones before, one that begins with `not` leaves its inside out.
pub fn parse_regions(specs: &[String]) -> Result<Option<Box<dyn Region>>> {
    let mut whole: Option<Box<dyn Region>> = None;
    for text in specs {
        let text = text.trim();
        let next = match (text.strip_prefix("or "), text.strip_prefix("not ")) {
            (Some(rest), _) => {
                let part = parse(rest)?;
                match whole {
                    Some(before) => Box::new(Combined::Any(vec![before, part])),
                    None => part,
                }
            }
            (_, Some(rest)) => multiply(whole, Box::new(Combined::Not(parse(rest)?))),
            _ => multiply(whole, parse(text)?),
        };
        whole = Some(next);
    }
    Ok(whole)
}

fn multiply(before: Option<Box<dyn Region>>, part: Box<dyn Region>) -> Box<dyn Region> {
    match before {
        Some(before) => Box::new(Combined::All(vec![before, part])),
        None => part,
    }
}

fn parse(text: &str) -> Result<Box<dyn Region>> {
    let spec = Spec::parse("region", text)?;
    let (shape, center) = match spec.kind() {
        "sphere" => (Shape::Sphere { radius: spec.length("radius")? }, spec.center()?),
        "box" => (Shape::Box { half_size: spec.required_vector("size")? / 2.0 }, spec.center()?),
        "bbox" => {
            let (lo, hi) = (spec.required_vector("min")?, spec.required_vector("max")?);
            (Shape::Box { half_size: (hi - lo) / 2.0 }, (lo + hi) / 2.0)
        }
        "cylinder" => {
            let (radius, half_height) = (spec.length("radius")?, spec.length("height")? / 2.0);
            (Shape::Cylinder { radius, half_height }, spec.center()?)
        }
        "superellipsoid" => {
            let radii: DVec3 = spec.required_vector("radii")?;
            let exponents = spec.pair("exponents")?.unwrap_or([1.0, 1.0]);
            (Shape::Superellipsoid { radii, exponents }, spec.center()?)
        }
        _ => return Err(spec.unknown_kind(&KINDS)),
    };
    let soft = spec.pair("soft")?.unwrap_or(Primitive::DEFAULT_SOFT);
    let primitive = Primitive::new(shape, center, spec.axes()?, soft)?;
    spec.finish()?;
    Ok(Box::new(primitive))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weight(specs: &[&str], at: [f64; 3]) -> f32 {
        let specs: Vec<String> = specs.iter().map(|s| s.to_string()).collect();
        parse_regions(&specs).unwrap().unwrap().weight(DVec3::from(at))
    }

    #[test]
    fn regions_combine_in_order() {
        let ball = "sphere radius=2";
        assert_eq!(weight(&[ball], [0.0; 3]), 1.0);
        assert_eq!(weight(&[ball, "box size=1,1,1"], [1.0, 0.0, 0.0]), 0.0);
        assert_eq!(weight(&[ball, "or sphere center=9,0,0 radius=1"], [9.0, 0.0, 0.0]), 1.0);
        assert_eq!(weight(&[ball, "not sphere radius=1"], [0.0; 3]), 0.0);
        assert_eq!(weight(&[ball, "not sphere radius=1"], [1.5, 0.0, 0.0]), 1.0);
        assert_eq!(weight(&["cylinder radius=1 height=4 axis=x soft=1,1"], [1.9, 0.0, 0.0]), 1.0);
        assert_eq!(weight(&["bbox min=1,1,1 max=3,3,3"], [2.0; 3]), 1.0);
        assert!(parse_regions(&[]).unwrap().is_none());
    }

    #[test]
    fn bad_regions_are_refused_with_what_would_work() {
        for (text, part) in [
            ("spher radius=1", "did you mean `sphere`"),
            ("sphere", "needs `radius=`"),
            ("sphere radius=1 colour=red", "no key `colour`"),
            ("bbox min=1,1,1 max=0,0,0", "positive"),
            ("superellipsoid radii=1,1,1 exponents=0,9", "between 0.1 and 2"),
        ] {
            let error = parse_regions(&[text.to_string()]).err().unwrap().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
