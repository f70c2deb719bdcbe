//! Flows by curvature.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which curvature drives a flow. All have the unit 1/length and grow with the curvature matrix, so that the flow by each is parabolic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub enum FlowCurvature {
    /// H = (κ₁ + κ₂)/2.
    #[default]
    Mean,
    /// sign(H) √max(K, 0), K = κ₁κ₂.
    Gaussian,
    /// κ₂, the smaller principal curvature.
    Min,
    /// κ₁, the larger principal curvature.
    Max,
    /// max(κ₁, 0) + max(κ₂, 0): convex parts alone.
    Convex,
    /// min(κ₁, 0) + min(κ₂, 0): concave parts alone.
    Concave,
}
