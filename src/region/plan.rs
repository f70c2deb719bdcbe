//! Regions from text: `sphere center=0,0,0 radius=1 soft=0.9,1`.

use std::path::PathBuf;

use glam::DVec3;

use super::files;
use super::{Combined, HalfSpace, Inside, Near, Painted, Part, Primitive, Region, Shape};
use crate::error::{EditError, Result};
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::run::RunOptions;
use crate::spec::Spec;

const KINDS: [&str; 13] = [
    "sphere",
    "box",
    "cylinder",
    "superellipsoid",
    "bbox",
    "halfspace",
    "levelset",
    "mesh",
    "mask",
    "fog",
    "points",
    "curve",
    "component",
];

/// Depth in voxels at which half spaces and solids have their full weight, where none is asked for (Museth et al. 2002).
const DEFAULT_DEPTH: f64 = 3.0;
/// Distances in voxels between which the weight around points and curves falls, where none are asked for: table 4 of the
/// same paper, wing blending.
const DEFAULT_REACH: [f64; 2] = [7.0, 9.0];

/// Regions as they were asked for: checked, but files not yet read and voxels not yet turned into world units.
pub struct RegionPlan(Vec<(Join, Term)>);

/// How a region goes with those before it.
#[derive(Clone, Copy, PartialEq)]
enum Join {
    And,
    Or,
    AndNot,
}

enum Term {
    Primitive(Primitive),
    /// Depth in voxels.
    HalfSpace {
        point: DVec3,
        normal: DVec3,
        depth: f64,
    },
    /// Inside a level set or a closed mesh; depth in voxels.
    Inside {
        file: FileGrid,
        depth: f64,
    },
    Painted(FileGrid),
    /// Reach in voxels.
    Points {
        file: PathBuf,
        reach: [f64; 2],
    },
    Curve {
        a: FileGrid,
        b: FileGrid,
        reach: [f64; 2],
    },
    /// From 0, the largest.
    Component(u32),
}

struct FileGrid {
    path: PathBuf,
    grid: Option<String>,
}

impl RegionPlan {
    /// The regions of several specifications, `None` for none of them. Each multiplies the ones before; one that begins
    /// with `or` is united with the ones before, one that begins with `not` leaves its inside out.
    pub fn parse(specs: &[String]) -> Result<Option<Self>> {
        let mut terms = Vec::with_capacity(specs.len());
        for text in specs {
            let text = text.trim();
            terms.push(match (text.strip_prefix("or "), text.strip_prefix("not ")) {
                (Some(rest), _) => (Join::Or, Term::parse(rest)?),
                (_, Some(rest)) => (Join::AndNot, Term::parse(rest)?),
                _ => (Join::And, Term::parse(text)?),
            });
        }
        Ok(if terms.is_empty() { None } else { Some(Self(terms)) })
    }

    /// Whether all of them are neighbourhoods of points and curves.
    pub fn is_around_curves(&self) -> bool {
        let is_curve = |(join, term): &(Join, Term)| {
            *join != Join::AndNot && matches!(term, Term::Points { .. } | Term::Curve { .. })
        };
        self.0.iter().all(is_curve)
    }

    /// The region on `level_set`, whose voxels are the unit of depths and reaches. Reads the files that are named.
    pub fn on(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Box<dyn Region>> {
        let mut whole: Option<Box<dyn Region>> = None;
        for (join, term) in &self.0 {
            run.check("region")?;
            let part = term.on(level_set, run)?;
            whole = Some(match (whole, join) {
                (None, Join::And | Join::Or) => part,
                (None, Join::AndNot) => Box::new(Combined::Not(part)),
                (Some(before), Join::And) => Box::new(Combined::All(vec![before, part])),
                (Some(before), Join::Or) => Box::new(Combined::Any(vec![before, part])),
                (Some(before), Join::AndNot) => Box::new(Combined::All(vec![before, Box::new(Combined::Not(part))])),
            });
        }
        // A plan has at least one term.
        whole.ok_or_else(|| EditError::parameter("region", "region", "", "at least one region"))
    }
}

impl Term {
    fn parse(text: &str) -> Result<Self> {
        // `component 2` is short for `component n=2`.
        let short = text.strip_prefix("component ").map(str::trim).filter(|n| n.bytes().all(|b| b.is_ascii_digit()));
        let spec = Spec::parse("region", &short.map_or(text.to_owned(), |n| format!("component n={n}")))?;
        let term = match spec.kind() {
            "halfspace" => {
                let (point, normal) = (spec.vector("point")?.unwrap_or(DVec3::ZERO), spec.required_vector("normal")?);
                let depth = depth(&spec)?;
                HalfSpace::new(point, normal, depth)?;
                Self::HalfSpace { point, normal, depth }
            }
            "levelset" | "mesh" => Self::Inside { file: FileGrid::of(&spec, "file")?, depth: depth(&spec)? },
            "mask" | "fog" => Self::Painted(FileGrid::of(&spec, "file")?),
            "points" => Self::Points { file: FileGrid::of(&spec, "file")?.path, reach: reach(&spec)? },
            "curve" => Self::Curve { a: FileGrid::of(&spec, "a")?, b: FileGrid::of(&spec, "b")?, reach: reach(&spec)? },
            "component" => match spec.number("n")? {
                Some(n) if n >= 0.0 && n.fract() == 0.0 && n <= f64::from(u32::MAX) => Self::Component(n as u32),
                _ => return Err(spec.refuse("the number of a component, 0 for the largest: `component 0`")),
            },
            _ => Self::Primitive(primitive(&spec)?),
        };
        spec.finish()?;
        Ok(term)
    }

    fn on(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Box<dyn Region>> {
        let voxel_size = level_set.voxel_size();
        Ok(match self {
            Self::Primitive(primitive) => Box::new(primitive.clone()),
            Self::HalfSpace { point, normal, depth } => Box::new(HalfSpace::new(*point, *normal, depth * voxel_size)?),
            Self::Inside { file, depth } => {
                Box::new(Inside::new(file.level_set(voxel_size, *depth, run)?, depth * voxel_size))
            }
            Self::Painted(file) => Box::new(Painted(files::volume(&file.path, file.grid.as_deref(), run)?)),
            Self::Points { file, reach } => Box::new(Near::new(&files::points(file)?, reach.map(|d| d * voxel_size))?),
            Self::Curve { a, b, reach } => {
                let [a, b] = [a, b].map(|file| file.level_set(voxel_size, DEFAULT_DEPTH, run));
                Box::new(Near::new(&a?.intersection_curve(&b?), reach.map(|d| d * voxel_size))?)
            }
            Self::Component(label) => {
                let components = level_set.components(run)?;
                let count = components.voxels().len();
                if *label as usize >= count {
                    let accepted = match count {
                        0 => "none: the level set has no inside".into(),
                        _ => format!("0 to {}: the level set has {count}, 0 the largest", count - 1),
                    };
                    return Err(EditError::parameter("region", "component", label, accepted));
                }
                Box::new(Part::new(level_set.clone(), components, *label))
            }
        })
    }
}

impl FileGrid {
    /// `key=FILE`, with `grid=` (`key` is `file`) or `key_grid=` naming the grid in it.
    fn of(spec: &Spec, key: &str) -> Result<Self> {
        let path = spec.text(key).filter(|path| !path.is_empty()).map(PathBuf::from);
        let path = path.ok_or_else(|| spec.refuse(format!("`{}` needs `{key}=` (a file)", spec.kind())))?;
        let grid = if key == "file" { spec.text("grid") } else { spec.text(&format!("{key}_grid")) };
        Ok(Self { path, grid: grid.map(str::to_owned) })
    }

    /// The level set, or that of a mesh, with a band that reaches `depth` voxels of `voxel_size`.
    fn level_set(&self, voxel_size: f64, depth: f64, run: &RunOptions) -> Result<LevelSet> {
        let half_width = DEFAULT_HALF_WIDTH.max((depth + 1.0).min(f64::from(f32::MAX)) as f32);
        files::level_set(&self.path, self.grid.as_deref(), voxel_size, half_width, run)
    }
}

/// `soft=`: voxels below the surface at which the weight is full.
fn depth(spec: &Spec) -> Result<f64> {
    match spec.number("soft")? {
        None => Ok(DEFAULT_DEPTH),
        Some(depth) if (0.0..=100.0).contains(&depth) => Ok(depth),
        Some(_) => Err(spec.refuse("`soft` is a depth of 0 to 100 voxels, such as 3")),
    }
}

/// `d=d_min,d_max` in voxels.
fn reach(spec: &Spec) -> Result<[f64; 2]> {
    let reach = spec.pair("d")?.unwrap_or(DEFAULT_REACH);
    Near::new(&[], reach)?;
    Ok(reach)
}

fn primitive(spec: &Spec) -> Result<Primitive> {
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
    Primitive::new(shape, center, spec.axes()?, soft)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(specs: &[String]) -> Box<dyn Region> {
        let ball = crate::levelset::testing::ball(DVec3::ZERO, 10.0);
        RegionPlan::parse(specs).unwrap().unwrap().on(&ball, &RunOptions::default()).unwrap()
    }

    fn weight(specs: &[&str], at: [f64; 3]) -> f32 {
        let specs: Vec<String> = specs.iter().map(|s| s.to_string()).collect();
        plan(&specs).weight(DVec3::from(at))
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
        assert!(RegionPlan::parse(&[]).unwrap().is_none());
        assert_eq!(weight(&["not sphere radius=1"], [5.0, 0.0, 0.0]), 1.0);
        assert_eq!(weight(&["halfspace normal=0,0,1"], [0.0, 0.0, -3.0]), 1.0);
        assert_eq!(weight(&["halfspace point=0,0,1 normal=0,0,1 soft=4"], [0.0, 0.0, -1.0]), 0.5);
        assert_eq!(weight(&["component 0"], [9.0, 0.0, 0.0]), 1.0);
    }

    #[test]
    fn bad_regions_are_refused_with_what_would_work() {
        for (text, part) in [
            ("spher radius=1", "did you mean `sphere`"),
            ("sphere", "needs `radius=`"),
            ("sphere radius=1 colour=red", "no key `colour`"),
            ("bbox min=1,1,1 max=0,0,0", "positive"),
            ("halfspace point=0,0,0", "needs `normal=`"),
            ("halfspace normal=0,0,0", "not zero"),
            ("levelset", "needs `file=`"),
            ("points file=a.xyz d=9,7", "the smaller first"),
            ("component n=1.5", "`component 0`"),
            ("mesh file=a.obj soft=-1", "0 to 100"),
            ("superellipsoid radii=1,1,1 exponents=0,9", "between 0.1 and 2"),
        ] {
            let error = RegionPlan::parse(&[text.to_string()]).err().unwrap().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn files_are_read_when_a_region_is_placed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.xyz");
        std::fs::write(&path, "0 0 10\n").unwrap();
        let points = format!("points file={} d=1,3", path.display());
        assert_eq!(weight(&[&points], [0.0, 0.0, 8.0]), 0.5);
        let run = RunOptions::default();
        let ball = crate::levelset::testing::ball(DVec3::ZERO, 10.0);
        let mesh = folder.path().join("ball.ply");
        crate::mesh::write(&mesh, &crate::mesh::level_set_to_mesh(&ball, 0.0, &run).unwrap()).unwrap();
        let inside = format!("mesh file={}", mesh.display());
        assert!((weight(&[&inside], [8.5, 0.0, 0.0]) - 0.5).abs() < 0.02);
        let plan = |text: &str| RegionPlan::parse(&[text.into()]).unwrap().unwrap().on(&ball, &run);
        for (text, part) in [
            ("component 7", "has 1, 0 the largest"),
            ("levelset file=/nowhere/a.vdb", "/nowhere/a.vdb"),
            ("mesh file=/nowhere/a.obj", "/nowhere/a.obj"),
        ] {
            let error = plan(text).err().unwrap().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
