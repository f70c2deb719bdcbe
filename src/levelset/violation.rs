//! What can be wrong with a level set, and what to do about it.

use std::fmt;

use glam::IVec3;
use serde::Serialize;

/// Largest difference between face neighbours, in voxels. Exact fields reach 1, evolved ones a little more where a
/// front sharpens; the limit is that of OpenVDB's own checker for |∇φ|.
pub(super) const STEEPEST: f32 = 1.5;

/// Smallest |∇φ| at the surface: OpenVDB's limit.
pub(super) const FLATTEST: f32 = 0.5;

/// Which invariant does not hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum ViolationKind {
    /// A value is NaN or infinite.
    NonFinite,
    /// An active voxel has |φ| ≥ background.
    ActiveOutsideBand,
    /// An inactive voxel of a leaf is neither +background nor −background.
    InactiveNotBackground,
    /// φ changes its sign between face neighbours of which at least one is inactive: the surface leaves the band.
    HoleInBand,
    /// An inactive voxel or an absent leaf differs in sign from the absent leaf beside it.
    SignMismatch,
    /// Active face neighbours differ by more than 1.5 voxels.
    TooSteep,
    /// |∇φ| < 0.5 on both sides of the surface.
    TooFlat,
    /// The band ends before |φ| reaches the background.
    BandTooNarrow,
    /// A leaf without active voxels and of one sign is stored.
    EmptyLeaf,
}

impl ViolationKind {
    /// All of them, in order.
    pub const ALL: [Self; 9] = [
        Self::NonFinite,
        Self::ActiveOutsideBand,
        Self::InactiveNotBackground,
        Self::HoleInBand,
        Self::SignMismatch,
        Self::TooSteep,
        Self::TooFlat,
        Self::BandTooNarrow,
        Self::EmptyLeaf,
    ];
}

/// One invariant that does not hold, and where.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// The invariant.
    pub kind: ViolationKind,
    /// How often: voxels, pairs of voxels, or leaves.
    pub count: u64,
    /// The first place, by leaf.
    pub example_ijk: IVec3,
    /// The worst value found: φ, the difference of a pair, both in voxels, or |∇φ|.
    pub worst: f32,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { kind, count, worst, example_ijk: IVec3 { x, y, z } } = self;
        match kind {
            ViolationKind::NonFinite => write!(f, "{count} values are not finite")?,
            ViolationKind::ActiveOutsideBand => {
                write!(f, "{count} active voxels are not below the background (phi of up to {worst:.3} voxels)")?;
            }
            ViolationKind::InactiveNotBackground => {
                write!(f, "{count} inactive voxels are not +-background (one is {worst:.3} voxels)")?;
            }
            ViolationKind::HoleInBand => write!(f, "the surface leaves the band between {count} pairs of voxels")?,
            ViolationKind::SignMismatch => write!(f, "the space beside {count} voxels has the opposite sign")?,
            ViolationKind::TooSteep => {
                write!(f, "{count} pairs of neighbours differ by over {STEEPEST} voxels (up to {worst:.3})")?;
            }
            ViolationKind::TooFlat => {
                write!(f, "|grad phi| < {FLATTEST} at {count} places of the surface (down to {worst:.3})")?;
            }
            ViolationKind::BandTooNarrow => {
                write!(f, "the band ends {worst:.3} voxels short of the background beside {count} voxels")?;
            }
            ViolationKind::EmptyLeaf => write!(f, "{count} leaves without active voxels are stored")?,
        }
        let remedy = match kind {
            ViolationKind::NonFinite | ViolationKind::HoleInBand => "--repair rebuilds it where the surface is closed",
            ViolationKind::SignMismatch => "--repair fills the signs again",
            ViolationKind::EmptyLeaf => "harmless; --repair removes them",
            ViolationKind::ActiveOutsideBand | ViolationKind::InactiveNotBackground => {
                "--repair trims the band, `rebuild` makes it anew"
            }
            ViolationKind::TooSteep | ViolationKind::TooFlat => {
                "not a distance: `renormalize` restores small errors, `rebuild` or --repair any"
            }
            ViolationKind::BandTooNarrow => "`rebuild` or --repair widens it",
        };
        write!(f, ", first at voxel {x},{y},{z}; {remedy}")
    }
}
