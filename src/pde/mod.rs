//! Partial differential equations on the narrow band: the only time loop in the house.
//!
//! [`evolve`] moves a surface with a [`SpeedFunction`], such as a [`CurvatureFlow`], [`morph_towards`] towards another one; [`filter()`] smooths the field; [`renormalize`] restores
//! |∇φ| = 1; [`track`] lets the band follow
//! the surface: dilate, renormalise, trim. A [`Tracker`] does these steps one by one.

mod advect;
mod anisotropic;
mod attract;
mod curvature_flow;
mod domain;
mod evolve;
mod filter;
mod gate;
mod morph;
mod renormalize;
mod rest;
mod sharpen;
mod speed;
mod step;
mod surface_speed;
mod threshold;
mod track;
mod tracker;

pub use advect::{VelocityField, advect};
pub use anisotropic::{AnisotropicGaussian, filter_anisotropic};
pub use attract::{Attraction, AttractionReport, Attractor, IndexBounds, Pull, REACHED, attract, leaves_around};
pub use curvature_flow::{CurvatureFlow, FlowCurvature};
pub use evolve::{Report, StopReason, Until, evolve};
pub use filter::{Filter, FilterKind, filter, offset};
pub use gate::{CutOff, Direction};
pub use morph::{MorphOptions, MorphSpeed, morph_towards};
pub use renormalize::renormalize;
pub use sharpen::sharpen;
pub use speed::SpeedFunction;
pub use surface_speed::{Foot, LeafSurface, Moment, SurfaceSpeed, Tally, move_surface};
pub use threshold::grow_by_threshold;
pub use track::track;
pub use tracker::Tracker;

pub use crate::stencil::upwind::{UpwindScheme, WenoEpsilon};

/// Explicit Runge–Kutta schemes that do not increase total variation (Shu & Osher 1988).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TimeIntegrator {
    /// Forward Euler.
    #[default]
    TvdRk1,
    /// Second order.
    TvdRk2,
    /// Third order.
    TvdRk3,
}

/// How a flow is solved, as against what is asked and how it is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolverOptions {
    /// One-sided differences of renormalisation.
    pub scheme: UpwindScheme,
    /// Time integration of renormalisation.
    pub integrator: TimeIntegrator,
    /// Renormalisation steps each time the band is tracked.
    pub normalizations: u32,
    /// What keeps the weights of WENO5 finite.
    pub weno_epsilon: WenoEpsilon,
}

impl SolverOptions {
    /// The cheapest: first-order differences, one Euler step.
    pub const FIRST_ORDER: Self = Self {
        scheme: UpwindScheme::First,
        integrator: TimeIntegrator::TvdRk1,
        normalizations: 1,
        weno_epsilon: WenoEpsilon::SCALE_FREE,
    };

    /// What OpenVDB's `LevelSetFilter` uses: HJ-WENO5, Euler, three normalisations, its ε.
    pub const OPENVDB: Self = Self {
        scheme: UpwindScheme::HjWeno5,
        integrator: TimeIntegrator::TvdRk1,
        normalizations: 3,
        weno_epsilon: WenoEpsilon::OPENVDB,
    };
}
