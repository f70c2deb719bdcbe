//! `assert`: what must hold of a level set.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::error::{EditError, Result};
use crate::levelset::{CurvatureKind, LevelSet, Violation, curvature};
use crate::ops::parse;
use crate::run::RunOptions;

/// A number, or the least and the largest that is right.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(super) enum Count {
    Exactly(i64),
    Between([i64; 2]),
}

/// The largest number that is right, or the least and the largest.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
#[schemars(inline)]
pub(super) enum Most {
    AtMost(f64),
    Between([f64; 2]),
}

/// Stop with exit code 1 unless all of this holds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub(super) struct Assertions {
    /// Connected parts of the inside: a number, or [least, largest].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub components: Option<Count>,
    /// Handles of the surface, all its parts together.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub genus: Option<Count>,
    /// Euler characteristic of the surface: 2 for each sphere, 0 for each torus.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub euler: Option<Count>,
    /// Voxels that break an invariant of level sets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub violations: Option<Count>,
    /// Volume in world units cubed, [least, largest].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume: Option<[f64; 2]>,
    /// Area in world units squared, [least, largest].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area: Option<[f64; 2]>,
    /// Largest |H| next to the surface in 1/voxel, H the mean of the principal curvatures: the largest that is right, or [least, largest].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub largest_curvature: Option<Most>,
}

impl Assertions {
    pub fn read(values: Map<String, Value>) -> Result<Self> {
        let none = values.is_empty();
        let read: Self = parse("assert", values)?;
        if none {
            let accepted = "what must hold, such as `components = 1`";
            return Err(EditError::parameter("assert", "keys", "nothing", accepted));
        }
        for (name, range) in read.ranges() {
            if let Some([least, largest]) = range
                && !(least <= largest)
            {
                let accepted = "the least value first";
                return Err(EditError::parameter("assert", name, format!("[{least}, {largest}]"), accepted));
            }
        }
        Ok(read)
    }

    /// What is asserted, by name, as least and largest value.
    fn ranges(&self) -> [(&'static str, Option<[f64; 2]>); 7] {
        let count = |count: Option<Count>| {
            count.map(|count| match count {
                Count::Exactly(n) => [n as f64; 2],
                Count::Between(range) => range.map(|n| n as f64),
            })
        };
        let most = self.largest_curvature.map(|most| match most {
            Most::AtMost(most) => [0.0, most],
            Most::Between(range) => range,
        });
        [
            ("components", count(self.components)),
            ("genus", count(self.genus)),
            ("euler", count(self.euler)),
            ("violations", count(self.violations)),
            ("volume", self.volume),
            ("area", self.area),
            ("largest_curvature", most),
        ]
    }

    /// Measures what is asserted; returns it, or all that does not hold.
    pub fn verify(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Map<String, Value>> {
        let measures = level_set.measure(run)?;
        let genus = measures.surface_components as f64 - measures.euler as f64 / 2.0;
        let mut found = Map::new();
        let mut wrong = Vec::new();
        for (name, range) in self.ranges() {
            let Some([least, largest]) = range else { continue };
            let value = match name {
                "components" => measures.components as f64,
                "genus" => genus,
                "euler" => measures.euler as f64,
                "violations" => level_set.check().iter().map(|Violation { count, .. }| *count as f64).sum(),
                "volume" => measures.volume,
                "area" => measures.area,
                _ => largest_mean_curvature(level_set, run)?,
            };
            if !(least..=largest).contains(&value) {
                wrong.push(match least == largest {
                    true => format!("{name} is {value}, not {least}"),
                    false => format!("{name} is {value}, not within {least} to {largest}"),
                });
            }
            let whole = value.fract() == 0.0 && value.abs() < 1e15;
            found.insert(name.into(), if whole { json!(value as i64) } else { json!(value) });
        }
        match wrong.is_empty() {
            true => Ok(found),
            false => Err(EditError::Unmet { operation: "assert".into(), problem: wrong.join("; ") }),
        }
    }
}

/// Largest |H| of the voxels within half a voxel of the surface, in 1/voxel. Each edge of the grid that the surface crosses has such a
/// voxel, and on the level set through it H differs from that of the surface below it by half a voxel times H².
fn largest_mean_curvature(level_set: &LevelSet, run: &RunOptions) -> Result<f64> {
    let field = curvature(level_set, CurvatureKind::Mean, run)?;
    let near = (0.5 * level_set.voxel_size()) as f32;
    let mut largest = 0f32;
    for &id in field.grid().leaves() {
        let phi = level_set.grid().values(level_set.grid().find(field.grid().origin(id)));
        let values = field.grid().values(id);
        for at in field.grid().mask(id).iter().filter(|at| phi.0[*at].abs() <= near) {
            largest = largest.max(values.0[at].abs());
        }
    }
    Ok(f64::from(largest) * level_set.voxel_size())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, torus};
    use glam::DVec3;

    fn verify(level_set: &LevelSet, values: Value) -> Result<Map<String, Value>> {
        let Value::Object(values) = values else { unreachable!() };
        Assertions::read(values)?.verify(level_set, &RunOptions::default())
    }

    #[test]
    fn what_holds_is_reported_and_what_does_not_is_named() {
        let ball = ball(DVec3::ZERO, 20.0);
        let found = verify(
            &ball,
            json!({ "components": 1, "genus": 0, "euler": 2, "violations": 0, "volume": [33400, 33600], "area": [5000, 5050],
                    "largest_curvature": [0.048, 0.054] }),
        )
        .unwrap();
        assert_eq!((&found["genus"], &found["euler"]), (&json!(0), &json!(2)));
        let error =
            verify(&ball, json!({ "components": 2, "genus": [1, 5], "area": [5000, 5050], "largest_curvature": 0.01 }));
        let error = error.unwrap_err();
        assert_eq!(error.exit_code(), 1);
        let said = error.to_string();
        assert!(said.contains("components is 1, not 2") && said.contains("genus is 0, not within 1 to 5"), "{said}");
        assert!(said.contains("largest_curvature is 0.05") && !said.contains("area"), "{said}");
        verify(&torus(20.0, 6.0), json!({ "genus": 1, "euler": 0 })).unwrap();
    }

    #[test]
    fn impossible_assertions_are_refused() {
        let ball = ball(DVec3::ZERO, 5.0);
        for (values, part) in [
            (json!({}), "components = 1"),
            (json!({ "volume": [2, 1] }), "least value first"),
            (json!({ "volume": 1 }), "volume"),
            (json!({ "components": 1.5 }), "components"),
            (json!({ "genera": 1 }), "did you mean `genus`"),
        ] {
            let error = verify(&ball, values).unwrap_err();
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains(part), "{error}");
        }
    }
}
