//! Whether a level set is one: its invariants, verified voxel by voxel and pair by pair.
//!
//! A valid field passes: exact distances of any shape, sharp or thin, and plain min/max of valid fields, whose values
//! are bounds of the distance but not distances. Such fields are 1-Lipschitz, and the |∇φ| of a bound may vanish on
//! one side of the surface (on the seam between two united solids) but not on both. So steepness is judged between
//! face neighbours everywhere, and flatness only across the surface, on the steeper side of each crossed grid edge,
//! by Godunov's upwind |∇φ|.
//!
//! One pass over the leaves, in parallel; counts and examples do not depend on the number of threads.

use fearless_simd::{Simd, SimdBase};
use glam::IVec3;
use rayon::prelude::*;

use super::LevelSet;
use super::violation::{FLATTEST, STEEPEST, Violation, ViolationKind};
use crate::grid::{Face, Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, neighbour_index, offset_to_local};
use crate::stencil::simd::{Work, dispatch};
use crate::stencil::upwind::godunov_first;
use crate::stencil::{Halo, Row};

/// Part of all crossed edges, and a number besides, that may be flatter on both sides: where three or more surfaces
/// of a CSG expression meet, single ones are (measured: up to 1.4 % in random expressions of seven solids, none in
/// exact fields).
const FLAT_FRACTION: f64 = 0.05;
const FLAT_ALWAYS: f64 = 8.0;

impl LevelSet {
    /// Every invariant that does not hold, in the order of [`ViolationKind`]; empty for a valid level set.
    pub fn check(&self) -> Vec<Violation> {
        let grid = self.grid();
        let voxel_size = self.voxel_size() as f32;
        let leaves = grid.leaves().par_iter().with_min_len(64).fold(Findings::default, |mut findings, &id| {
            LeafCheck { grid, voxel_size, id, origin: grid.origin(id), findings: &mut findings }.run();
            findings
        });
        // Rayon keeps the order of the leaves, in whatever pieces they come: the first example stays the first.
        let mut findings = leaves.reduce(Findings::default, Findings::merge).merge(check_tiles(grid));
        if (findings.found[ViolationKind::TooFlat as usize].count as f64)
            <= FLAT_ALWAYS + FLAT_FRACTION * findings.crossed as f64
        {
            findings.found[ViolationKind::TooFlat as usize] = Found::default();
        }
        ViolationKind::ALL
            .into_iter()
            .filter_map(|kind| {
                let Found { count, example, worst, .. } = findings.found[kind as usize];
                example.map(|example_ijk| Violation { kind, count, example_ijk, worst })
            })
            .collect()
    }
}

/// What was found of one kind.
#[derive(Clone, Copy, Default)]
struct Found {
    count: u64,
    example: Option<IVec3>,
    worst: f32,
    badness: f32,
}

/// What was found in some leaves.
#[derive(Default)]
struct Findings {
    found: [Found; ViolationKind::ALL.len()],
    /// Grid edges that the surface crosses within the band.
    crossed: u64,
}

impl Findings {
    /// Notes a violation with its value; the greatest `badness` is the worst.
    #[cold]
    fn add(&mut self, kind: ViolationKind, ijk: IVec3, value: f32, badness: f32) {
        self.found[kind as usize].merge(Found { count: 1, example: Some(ijk), worst: value, badness });
    }

    fn merge(mut self, later: Self) -> Self {
        for (found, other) in self.found.iter_mut().zip(later.found) {
            found.merge(other);
        }
        self.crossed += later.crossed;
        self
    }
}

impl Found {
    fn merge(&mut self, later: Self) {
        if later.example.is_none() {
            return;
        }
        if self.example.is_none() || later.badness > self.badness {
            self.worst = later.worst;
            self.badness = later.badness;
        }
        self.count += later.count;
        self.example = self.example.or(later.example);
    }
}

/// The check of one leaf, and of its pairs with the leaves around.
struct LeafCheck<'a> {
    grid: &'a Grid,
    voxel_size: f32,
    id: LeafId,
    origin: IVec3,
    findings: &'a mut Findings,
}

/// Eight voxels beside another eight.
struct RowPair<'a> {
    values: [&'a Row; 2],
    active: [u8; 2],
    /// Whether the second row lies in an absent leaf, a bit a voxel.
    absent: u8,
}

impl LeafCheck<'_> {
    fn run(mut self) {
        self.voxels();
        let around = &self.grid.neighbours()[self.id.index()];
        let mut halo = Halo::new();
        halo.gather(self.grid.value_pages(), around);
        for (f, face) in Face::ALL.into_iter().enumerate() {
            let beyond = around[neighbour_index(face.step())];
            // Each pair belongs to its lower voxel's leaf, or to the upper one's where the lower leaf is absent.
            if f % 2 == 1 || beyond.is_sentinel() {
                self.pairs(&halo, face, beyond);
            }
        }
        self.flatness(&halo);
    }

    fn voxels(&mut self) {
        let mask = self.grid.mask(self.id);
        let background = self.grid.background();
        let values = &self.grid.values(self.id).0;
        for (row, eight) in values.chunks_exact(8).enumerate() {
            let active = mask.row(row / 8, row % 8);
            let (mut non_finite, mut within, mut at) = (0u8, 0u8, 0u8);
            for (z, v) in eight.iter().enumerate() {
                non_finite |= u8::from(!v.is_finite()) << z;
                within |= u8::from(v.abs() < background) << z;
                at |= u8::from(v.abs() == background) << z;
            }
            for (kind, bits) in [
                (ViolationKind::NonFinite, non_finite),
                (ViolationKind::ActiveOutsideBand, active & !within & !non_finite),
                (ViolationKind::InactiveNotBackground, !active & !at & !non_finite),
            ] {
                for_each_bit(bits, |z| {
                    let (ijk, value) = (self.origin + offset_to_local(row * 8 + z), eight[z]);
                    self.findings.add(kind, ijk, value / self.voxel_size, (value.abs() - background).abs());
                });
            }
        }
        let inside = values[0] < 0.0;
        if mask.is_empty() && values.iter().all(|v| (*v < 0.0) == inside) {
            self.findings.add(ViolationKind::EmptyLeaf, self.origin, 0.0, 0.0);
        }
    }

    /// Checks the pairs across `face`: all of the leaf on an upper side, only those with the absent leaf on a lower
    /// side.
    fn pairs(&mut self, halo: &Halo, face: Face, beyond: LeafId) {
        let mask = self.grid.mask(self.id);
        let other = self.grid.mask(beyond);
        let [dx, dy, dz] = face.step().to_array().map(|d| d as isize);
        let upper = dx + dy + dz > 0;
        let inner = |i: usize, d: isize| i.checked_add_signed(d).filter(|i| *i < 8);
        for x in 0..8 {
            for y in 0..8 {
                let (nx, ny) = (inner(x, dx), inner(y, dy));
                let within = nx.is_some() && ny.is_some();
                if !upper && dz == 0 && within {
                    continue;
                }
                let (wx, wy) = (x.wrapping_add_signed(dx) & 7, y.wrapping_add_signed(dy) & 7);
                let beside = if within { mask.row(wx, wy) } else { other.row(wx, wy) };
                // Along z the row shifts within itself, and one voxel comes from beyond.
                let (next, end) = match dz {
                    1 => (beside >> 1 | (other.row(x, y) & 1) << 7, 0x80),
                    -1 => (beside << 1 | other.row(x, y) >> 7, 0x01),
                    _ => (beside, if within { 0 } else { 0xff }),
                };
                let pair = RowPair {
                    values: [halo.row(x, y, [0; 3]), halo.row(x, y, [dx, dy, dz])],
                    active: [mask.row(x, y), next],
                    absent: if beyond.is_sentinel() { end } else { 0 },
                };
                let asked = if upper { 0xff } else { end };
                self.row(&pair, asked, x * 64 + y * 8);
            }
        }
    }

    /// Checks the pairs of a row whose bits are set in `asked`; `first` is the offset of its first voxel.
    #[inline(always)]
    fn row(&mut self, pair: &RowPair, asked: u8, first: usize) {
        let [values, others] = pair.values;
        let [own, beside] = pair.active;
        let limit = STEEPEST * self.voxel_size;
        let (mut steep, mut crossed) = (0u8, 0u8);
        for z in 0..8 {
            steep |= u8::from((values[z] - others[z]).abs() > limit) << z;
            crossed |= u8::from((values[z] < 0.0) != (others[z] < 0.0)) << z;
        }
        let both = own & beside;
        self.findings.crossed += u64::from((crossed & both & asked).count_ones());
        let broken = crossed & !both;
        let mismatch = broken & pair.absent & !own;
        let one_active = own ^ beside;
        for (kind, bits) in [
            (ViolationKind::HoleInBand, broken & !mismatch),
            (ViolationKind::SignMismatch, mismatch),
            (ViolationKind::TooSteep, steep & both),
            (ViolationKind::BandTooNarrow, steep & one_active & !crossed),
        ] {
            for_each_bit(bits & asked, |z| {
                let difference = (values[z] - others[z]).abs() / self.voxel_size;
                self.findings.add(kind, self.origin + offset_to_local(first + z), difference, difference);
            });
        }
    }

    /// Checks |∇φ| on the steeper side of each crossed edge within the leaf. Edges between leaves are left out: no
    /// leaf has the gradient on both sides, and the inner ones are enough to judge the field.
    fn flatness(&mut self, halo: &Halo) {
        let mask = self.grid.mask(self.id);
        let values = &self.grid.values(self.id).0;
        let inside = LeafMask(std::array::from_fn(|x| {
            values[x * 64..(x + 1) * 64].iter().enumerate().fold(0, |w, (b, v)| w | u64::from(*v < 0.0) << b)
        }));
        let outside = LeafMask(inside.0.map(|w| !w));
        let [crossed_inside, crossed_outside] =
            [(inside, outside), (outside, inside)].map(|(side, other)| side.zip(other.dilated(), |a, b| a & b));
        let crossed = crossed_inside.zip(crossed_outside, |a, b| a | b);
        if crossed.is_empty() {
            return;
        }
        let mut squared = [0.0; LEAF_VOXELS];
        dispatch(SquaredGradients { halo, rows: crossed, squared: &mut squared });
        let at = |p: IVec3| squared[crate::grid::leaf_offset(p)];
        for offset in crossed_inside.zip(mask, |s, a| s & a).iter() {
            let voxel = offset_to_local(offset);
            for face in Face::ALL {
                let beside = voxel + face.step();
                let within = beside.min_element() >= 0 && beside.max_element() < LEAF_DIM;
                let other = crate::grid::leaf_offset(beside);
                if !within || inside.get(other) || !mask.get(other) {
                    continue;
                }
                let gradient = at(voxel).max(at(beside)).sqrt() / self.voxel_size;
                if gradient < FLATTEST {
                    self.findings.add(ViolationKind::TooFlat, self.origin + voxel, gradient, -gradient);
                }
            }
        }
    }
}

/// Godunov's |Dφ|² of the pairs of rows that have a bit in `rows`.
struct SquaredGradients<'a> {
    halo: &'a Halo,
    rows: LeafMask,
    squared: &'a mut [f32; LEAF_VOXELS],
}

impl Work for SquaredGradients<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        self.rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let phi = self.halo.rows(simd, x, y, [0; 3]);
                godunov_first(simd, self.halo, x, y, phi).store_slice(&mut self.squared[at..at + 16]);
            },
        );
    }
}

/// Calls `f` with the place of each bit that is set.
#[inline(always)]
fn for_each_bit(mut bits: u8, mut f: impl FnMut(usize)) {
    while bits != 0 {
        f(bits.trailing_zeros() as usize);
        bits &= bits - 1;
    }
}

/// Pairs of absent leaves of opposite sign.
fn check_tiles(grid: &Grid) -> Findings {
    grid.inside_tiles()
        .par_iter()
        .fold(Findings::default, |mut findings, &(origin, edge)| {
            for face in Face::ALL {
                let step = face.step();
                // The layer of leaves just beyond the face of this box.
                let lo = origin + step.max(IVec3::ZERO) * edge + step.min(IVec3::ZERO) * LEAF_DIM;
                let hi = lo + step.abs() * LEAF_DIM + (IVec3::ONE - step.abs()) * edge;
                for x in (lo.x..hi.x).step_by(LEAF_DIM as usize) {
                    for y in (lo.y..hi.y).step_by(LEAF_DIM as usize) {
                        for z in (lo.z..hi.z).step_by(LEAF_DIM as usize) {
                            if grid.find(IVec3::new(x, y, z)) == LeafId::OUTSIDE {
                                findings.add(ViolationKind::SignMismatch, IVec3::new(x, y, z), 0.0, 0.0);
                            }
                        }
                    }
                }
            }
            findings
        })
        .reduce(Findings::default, Findings::merge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::leaf_origin;
    use crate::levelset::testing::{ball, box_distance, sampled, torus};
    use glam::DVec3;

    fn kinds(level_set: &LevelSet) -> Vec<ViolationKind> {
        level_set.check().iter().map(|v| v.kind).collect()
    }

    /// Changes φ and the state of every voxel of the leaves.
    fn changed(level_set: &LevelSet, f: impl Fn(IVec3, &mut f32) -> Option<bool> + Sync) -> LevelSet {
        let mut out = level_set.clone();
        let origins: Vec<_> = out.grid().leaves().iter().map(|&id| (id, level_set.grid().origin(id))).collect();
        out.grid_mut().update_all(|id, values, mask| {
            let origin = origins.iter().find(|o| o.0 == id).unwrap().1;
            for (offset, v) in values.0.iter_mut().enumerate() {
                if let Some(active) = f(origin + offset_to_local(offset), v) {
                    mask.set(offset, active);
                }
            }
        });
        out
    }

    #[test]
    fn exact_thin_sharp_and_combined_fields_pass() {
        let boxes = |a: f64| move |p: DVec3| box_distance(p, DVec3::splat(a));
        let shift = DVec3::new(7.3, 5.1, -3.7);
        let plates = [0.3, 0.5, 0.8, 1.0, 1.7].map(|t| sampled(24, move |p| box_distance(p, DVec3::new(14.2, 9.9, t))));
        for plate in &plates {
            assert_eq!(plate.check(), [], "thin plates");
        }
        let ball = |c: DVec3, r: f64| move |p: DVec3| (p - c).length() - r;
        let (a, b) = (ball(DVec3::ZERO, 9.2), ball(shift, 8.0));
        let touching = ball(DVec3::X * 18.4, 9.2);
        let seam =
            |p: DVec3| box_distance(p, DVec3::splat(6.0)).min(box_distance(p - DVec3::X * 12.0, DVec3::splat(6.0)));
        for (name, level_set) in [
            ("box", sampled(20, boxes(12.0))),
            ("box between voxels", sampled(20, boxes(11.4))),
            ("union", sampled(24, move |p| a(p).min(b(p)))),
            ("intersection", sampled(24, move |p| a(p).max(b(p)))),
            ("difference", sampled(24, move |p| a(p).max(-b(p)))),
            ("touching balls", sampled(32, move |p| a(p).min(touching(p)))),
            ("abutting boxes", sampled(32, seam)),
            ("shell", sampled(16, move |p| (a(p)).abs() - 0.4)),
            ("cut of a cut", sampled(24, move |p| a(p).min(boxes(7.3)(p + shift)).max(-b(p)).min(touching(p)))),
            ("torus", torus(20.0, 6.0)),
            ("one voxel", sampled(8, ball(DVec3::splat(0.1), 0.4))),
            ("nothing", LevelSet::empty(crate::grid::Transform::uniform(1.0), 3.0)),
        ] {
            assert_eq!(level_set.check(), [], "{name}");
        }
    }

    #[test]
    fn any_csg_expression_passes() {
        let mut state = 1u64;
        let mut random = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1u32 << 31)
        };
        for trial in 0..30 {
            // Half of the expressions stand on whole voxels, where faces coincide.
            let place = |r: f64, scale: f64| if trial % 2 == 0 { (r * scale).round() } else { r * scale };
            let parts: Vec<_> = (0..7)
                .map(|_| {
                    let mut v = || place(random(), 16.0) - 8.0;
                    let centre = DVec3::new(v(), v(), v());
                    let half = DVec3::new(v(), v(), v()).abs() * 0.75 + 1.0;
                    (centre, half, (random() * 6.0) as u32)
                })
                .collect();
            let level_set = sampled(24, |p| {
                parts.iter().fold(f64::INFINITY, |phi, &(centre, half, kind)| {
                    let part = if kind < 3 { box_distance(p - centre, half) } else { (p - centre).length() - half.x };
                    match kind % 3 {
                        0 | 1 => phi.min(part),
                        _ => phi.max(-part),
                    }
                })
            });
            assert_eq!(level_set.check(), [], "expression {trial}: {parts:?}");
        }
    }

    #[test]
    fn wrong_data_is_named() {
        use ViolationKind::*;
        let good = ball(DVec3::ZERO, 20.0);
        let scaled = |k: f32| {
            changed(&good, move |_, v| {
                *v = (*v * k).clamp(-3.0, 3.0);
                Some(v.abs() < 3.0)
            })
        };
        assert!(kinds(&scaled(3.0)).contains(&TooSteep));
        assert!(kinds(&scaled(0.3)).contains(&TooFlat) && kinds(&scaled(0.3)).contains(&BandTooNarrow));
        let flat = changed(&good, |_, v| {
            *v = v.signum() * 0.1;
            None
        });
        assert!(kinds(&flat).contains(&TooFlat));
        // A fog volume: density 1 inside falling to 0 outside, everything else 0.
        let fog = changed(&good, |_, v| {
            *v = (0.5 - *v / 6.0).clamp(0.0, 1.0);
            None
        });
        assert!(kinds(&fog).contains(&InactiveNotBackground), "{:?}", kinds(&fog));
        let one_sided = changed(&good, |_, v| {
            (*v < -1.0).then(|| {
                *v = -3.0;
                false
            })
        });
        // Leaves that held nothing but the band's inner part are empty now.
        assert_eq!(kinds(&one_sided), [BandTooNarrow, EmptyLeaf]);
        let v = &one_sided.check()[0];
        assert!(v.worst > 2.5 && v.worst <= 3.0 && v.to_string().contains("widens"), "{v}");
    }

    #[test]
    fn single_faults_are_found_and_placed() {
        use ViolationKind::*;
        let good = ball(DVec3::ZERO, 20.0);
        let at = IVec3::new(0, 0, 20);
        let with = |value: f32, active: bool| {
            changed(&good, move |ijk, v| {
                (ijk == at).then(|| {
                    *v = value;
                    active
                })
            })
        };
        let nan = with(f32::NAN, true).check();
        assert_eq!((nan[0].kind, nan[0].count, nan[0].example_ijk), (NonFinite, 1, at));
        assert_eq!(kinds(&with(f32::INFINITY, true))[0], NonFinite);
        assert_eq!(kinds(&with(5.0, true)), [ActiveOutsideBand, TooSteep]);
        let hole = with(-3.0, false).check();
        let found = hole.iter().find(|v| v.kind == HoleInBand).unwrap();
        assert!(found.count >= 1 && (found.example_ijk - at).abs().element_sum() <= 1, "{hole:?}");

        // The sign of the space beside the band, turned over; and an outer leaf that says inside.
        let mut wrong_tile = good.clone();
        wrong_tile.grid_mut().set_sign(IVec3::new(32, 0, 0), IVec3::new(40, 8, 8), true);
        assert_eq!(kinds(&wrong_tile), [SignMismatch]);
        let mut hollow = good.clone();
        hollow.grid_mut().set_sign(IVec3::splat(-8), IVec3::splat(8), false);
        assert!(kinds(&hollow).contains(&SignMismatch));

        let mut empty = good.clone();
        let far = leaf_origin(IVec3::new(80, 0, 0));
        empty.grid_mut().add_leaves(&[far]);
        let violations = empty.check();
        assert_eq!((violations[0].kind, violations[0].example_ijk, violations.len()), (EmptyLeaf, far, 1));
    }

    #[test]
    fn threads_do_not_change_the_answer() {
        let noisy = changed(&torus(20.0, 6.0), |ijk, v| {
            *v += (ijk.x * 31 + ijk.y * 17 + ijk.z * 7).rem_euclid(13) as f32 * 0.2;
            None
        });
        let check =
            |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| noisy.check());
        let one = check(1);
        assert!(one.len() >= 3);
        assert_eq!(one, check(3));
    }
}
