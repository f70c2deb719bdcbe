//! Options that flows by curvature share: which curvature, within which limits, in which direction.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::words;
use crate::error::{EditError, Result};
use crate::pde::{CurvatureFlow, CutOff, Direction, FlowCurvature};

words! {
    /// Settings of the examples of Museth et al. 2002, table 4.
    Preset {
        /// Of `blend`: d 7 to 9 voxels, curvature above 0.04 to 0.06, add.
        WingBlend = "wing-blend",
        /// Of `smooth`: curvature above 0.04 to 0.07, remove.
        EyeSmoothing = "eye-smoothing",
        /// Of `smooth`: curvature above 0.1 to 0.13, add.
        SpoutSmoothing = "spout-smoothing",
        /// Of `sharpen`: curvature above 0.01 to 0.013 and below 0.8 to 0.9.
        HairSharpening = "hair-sharpening",
        /// Of `emboss`: cosine of the angle above 0.8 to 0.9.
        TeapotEmboss = "teapot-emboss",
    }
}

impl Preset {
    /// The operator that it belongs to, and its name.
    fn place(self) -> (&'static str, &'static str) {
        match self {
            Self::WingBlend => ("blend", "wing-blend"),
            Self::EyeSmoothing => ("smooth", "eye-smoothing"),
            Self::SpoutSmoothing => ("smooth", "spout-smoothing"),
            Self::HairSharpening => ("sharpen", "hair-sharpening"),
            Self::TeapotEmboss => ("emboss", "teapot-emboss"),
        }
    }

    /// Refuses a preset of another operator.
    pub fn validate(self, operation: &str) -> Result<()> {
        let (operator, name) = self.place();
        if operator == operation {
            return Ok(());
        }
        Err(EditError::parameter(operation, "preset", name, format!("only with `{operator}`, whose values it has")))
    }

    /// Lower and upper limits and direction: of the curvature, or of the cosine for `emboss`.
    pub fn gate(self) -> ([Option<[f64; 2]>; 2], Direction) {
        match self {
            Self::WingBlend => ([Some([0.04, 0.06]), None], Direction::Add),
            Self::EyeSmoothing => ([Some([0.04, 0.07]), None], Direction::Remove),
            Self::SpoutSmoothing => ([Some([0.1, 0.13]), None], Direction::Add),
            Self::HairSharpening => ([Some([0.01, 0.013]), Some([0.8, 0.9])], Direction::Both),
            Self::TeapotEmboss => ([Some([0.8, 0.9]), None], Direction::Both),
        }
    }
}

/// Which curvature moves a surface, between which limits, and which way. What is not given is the preset's, then the operator's own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct CurvatureOptions {
    /// Values of a published example, each replaced by what is given beside it: `wing-blend` (blend: d 7 to 9, curvature above 0.04 to 0.06, add),
    /// `eye-smoothing` (smooth: above 0.04 to 0.07, remove), `spout-smoothing` (smooth: above 0.1 to 0.13, add), `hair-sharpening` (sharpen: above
    /// 0.01 to 0.013, below 0.8 to 0.9, both), `teapot-emboss` (emboss: angle limits 0.8 to 0.9).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preset: Option<Preset>,
    /// The curvature that the speed follows: `mean` (κ₁ + κ₂)/2, `gaussian` sign(H)·√(κ₁κ₂), `max` and `min` one principal curvature, `convex` and
    /// `concave` the sum of those above or below 0. The operator's own if not given: mean, or concave for fillets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub curvature: Option<FlowCurvature>,
    /// Rest where the curvature is below `a`, act in full above `b`, in 1/voxel: what is rounder than a radius of 1/a voxels stays.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub curvature_low: Option<[f64; 2]>,
    /// Act in full where the curvature is below `a`, rest above `b`, in 1/voxel: what is sharper than a radius of 1/b voxels stays.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub curvature_high: Option<[f64; 2]>,
    /// Which way the surface may move: outwards, inwards or both.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub direction: Option<Direction>,
}

/// A sphere of this curvature, in 1/voxel, has a radius of two voxels: below that a grid does not hold a surface reliably.
const RESOLVED: f64 = 0.5;

impl CurvatureOptions {
    /// What was asked for, over the preset, over `own`, the operator's defaults. Refuses what cannot work.
    pub fn flow(&self, operation: &str, own: CurvatureFlow) -> Result<CurvatureFlow> {
        let ([mut low, mut high], mut direction) = ([own.cut_off.low(), own.cut_off.high()], own.direction);
        if let Some(preset) = self.preset {
            preset.validate(operation)?;
            ([low, high], direction) = preset.gate();
        }
        let refuse = |field: &str, [a, b]: [f64; 2]| {
            let value = format!("{a},{b}");
            let operation = operation.to_owned();
            let field = field.to_owned();
            move |accepted: &'static str| EditError::parameter(&operation, &field, value, accepted)
        };
        (low, high) = (self.curvature_low.or(low), self.curvature_high.or(high));
        // A limit that is given takes a default out of its way.
        if let (Some(given), Some(default), None) = (self.curvature_low, high, self.curvature_high)
            && given[1] > default[0]
        {
            high = None;
        }
        if let (Some(given), Some(default), None) = (self.curvature_high, low, self.curvature_low)
            && given[0] < default[1]
        {
            low = None;
        }
        let mut cut_off = CutOff::NONE;
        if let Some(limits) = low {
            cut_off = cut_off.with_low(limits).map_err(refuse("curvature_low", limits))?;
        }
        if let Some(limits) = high {
            cut_off = cut_off.with_high(limits).map_err(refuse("curvature_high", limits))?;
        }
        let curvature = self.curvature.unwrap_or(own.curvature);
        Ok(CurvatureFlow { curvature, cut_off, direction: self.direction.unwrap_or(direction) })
    }
}

impl CurvatureOptions {
    /// Refuses a curvature other than `wanted`, which is what the operator is about.
    pub(super) fn only(&self, operation: &str, wanted: FlowCurvature, accepted: &str) -> Result<()> {
        match self.curvature {
            Some(curvature) if curvature != wanted => {
                let value = serde_json::to_value(curvature).unwrap_or_default();
                Err(EditError::parameter(operation, "curvature", value, accepted))
            }
            _ => Ok(()),
        }
    }

    /// The error for options that have no use here: they belong `where_to`.
    pub(super) fn misplaced(&self, operation: &str, where_to: &str) -> EditError {
        let (field, value) = match serde_json::to_value(self) {
            Ok(serde_json::Value::Object(given)) => given.into_iter().next().unwrap_or_default(),
            _ => Default::default(),
        };
        EditError::parameter(operation, &field, value, format!("only {where_to}"))
    }
}

/// What to tell the user of limits that no grid resolves.
pub(super) fn unresolved(cut_off: &CutOff) -> Option<String> {
    let largest = [cut_off.low(), cut_off.high()].into_iter().flatten().map(|[_, b]| b).fold(0.0, f64::max);
    (largest > RESOLVED).then(|| {
        format!(
            "a curvature limit of {largest}/voxel is beyond what the grid resolves, {RESOLVED} (a radius of two voxels)"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN: CurvatureFlow = CurvatureFlow::MEAN;

    #[test]
    fn what_is_given_goes_before_the_preset_before_the_default() {
        let sharp = CurvatureFlow { cut_off: CutOff::NONE.with_high([0.15, 0.25]).unwrap(), ..OWN };
        let hair = CurvatureOptions { preset: Some(Preset::HairSharpening), ..Default::default() };
        let flow = hair.flow("sharpen", sharp).unwrap();
        assert_eq!((flow.cut_off.low(), flow.cut_off.high()), (Some([0.01, 0.013]), Some([0.8, 0.9])));
        assert!(unresolved(&flow.cut_off).unwrap().contains("0.9"));
        let mine = CurvatureOptions { curvature_high: Some([0.1, 0.2]), direction: Some(Direction::Add), ..hair };
        let flow = mine.flow("sharpen", sharp).unwrap();
        assert_eq!((flow.cut_off.low(), flow.cut_off.high()), (Some([0.01, 0.013]), Some([0.1, 0.2])));
        assert_eq!((flow.direction, unresolved(&flow.cut_off)), (Direction::Add, None));
        assert_eq!(CurvatureOptions::default().flow("sharpen", sharp).unwrap(), sharp);
        // A lower limit above the default's upper ones stands alone.
        let low = CurvatureOptions { curvature_low: Some([0.2, 0.3]), ..Default::default() };
        assert_eq!(low.flow("sharpen", sharp).unwrap().cut_off.high(), None);
    }

    #[test]
    fn presets_belong_to_their_operators_and_limits_have_an_order() {
        let refused =
            |operation: &str, options: CurvatureOptions| options.flow(operation, OWN).unwrap_err().to_string();
        let wing = CurvatureOptions { preset: Some(Preset::WingBlend), ..Default::default() };
        assert!(wing.flow("blend", OWN).is_ok() && refused("smooth", wing).contains("only with `blend`"));
        let crossed = CurvatureOptions { curvature_low: Some([0.06, 0.04]), ..Default::default() };
        assert!(refused("smooth", crossed).contains("curvature_low = 0.06,0.04"));
        let crossed = CurvatureOptions {
            curvature_low: Some([0.04, 0.06]),
            curvature_high: Some([0.05, 0.07]),
            ..Default::default()
        };
        assert!(refused("smooth", crossed).contains("curvature_high = 0.05,0.07"));
    }
}
