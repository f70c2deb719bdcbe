//! The distance from the surface, and fields constant along its normals, by solving |∇φ| = 1 outwards voxel by voxel.
//!
//! Voxels beside the surface get their distance from φ and its gradient and keep it ([`seeds`]); all others get the
//! first-order upwind solution of the Eikonal equation from their neighbours ([`solve`]), the fixed point that fast sweeping
//! (Zhao 2005) and fast marching reach as well. It is reached by Jacobi's iteration over the leaves in which something still
//! changes (the fast iterative method, Jeong & Whitaker 2008): a voxel is final as soon as its upwind neighbours are, so a band of w voxels
//! takes about √3·w rounds, all voxels of a round are independent, and neither the order of leaves nor the number of threads changes a bit.
//!
//! Against exact distances ([`rebuild`](fn@crate::mesh::rebuild)): the surface stays where φ has it instead of where its polygons are,
//! and no mesh is made; but errors grow with the distance from edges and points (half a voxel and more at ten voxels from an edge). Right for
//! flows, whose fields are nearly distances, and for extending fields; offsets and bands of many voxels are better rebuilt.

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};

use super::{Field, LevelSet, background};
use crate::error::{EditError, Result};
use crate::grid::{Face, Grid, LEAF_DIM, LeafId, LeafMask, LeafSet, LeafValues, PageLeaves, Paged, neighbour_index};
use crate::run::RunOptions;
use crate::stencil::FaceHalo;
use crate::stencil::eikonal::{extend, seeds, solve, upwind_neighbours};
use crate::stencil::simd::{Lanes, Work, dispatch, with_sign};

const OPERATION: &str = "sweeping distances";

/// Bytes a leaf needs while it is swept: values twice, mask and tables.
const BYTES_A_LEAF: u64 = 2 * 2048 + 512;

/// The least that u grows from a voxel to the next, in voxels: along a diagonal of space.
const LEAST_STEP: f32 = 0.577_350_26;

/// The same surface with first-order distances in a band of `half_width` voxels, whatever |∇φ| was: only the signs of φ and
/// its values beside the surface are used. The band may be wider or narrower than it was.
pub fn sweep_distance(level_set: &LevelSet, half_width: f32, run: &RunOptions) -> Result<LevelSet> {
    if !(half_width >= 1.0 && half_width.is_finite()) {
        return Err(EditError::parameter(OPERATION, "half_width", half_width, "1 voxel or more"));
    }
    let source = level_set.grid();
    reserve(source.leaves().len(), run)?;
    let voxel_size = level_set.voxel_size() as f32;
    let background = background(half_width, level_set.transform());
    // Masks are the voxels that keep their value, until the end.
    let mut grid = source.blank(background);
    grid.update_pages(source.leaf_set(), |leaves, values, masks| {
        dispatch(Seed { source, voxel_size, background, leaves, values, masks });
    });
    let mut next = grid.value_pages().clone();
    let mut active = grid.leaf_set().clone();
    while !active.is_empty() {
        run.check(OPERATION)?;
        let changed = next.par_update_pages(&active, |leaves, page| {
            let mut changed = Vec::new();
            dispatch(Round { grid: &grid, voxel_size, leaves, page, changed: &mut changed });
            changed
        });
        grid.swap_values(&mut next);
        let changed: Vec<LeafId> = changed.into_iter().flatten().collect();
        grow(&mut grid, &mut next, &changed, voxel_size, run)?;
        // What changed is written to the other buffer in the next round: outside the active leaves, both are equal.
        active = with_face_neighbours(&grid, changed);
    }
    grid.update_all(|_, values, mask| {
        *mask = LeafMask(std::array::from_fn(|x| {
            let slice = &values.0[x * 64..][..64];
            slice.iter().enumerate().fold(0, |word, (bit, v)| word | u64::from(v.abs() < background) << bit)
        }));
    });
    let all = grid.leaf_set().clone();
    grid.prune(&all);
    Ok(LevelSet::new(grid, *level_set.transform()))
}

/// A field continued over the whole band, constant along the normals of the surface, first order: voxels beside the surface
/// keep the value that `field` has there (0 where it has none), each other voxel gets that of the surface point closest to it.
/// The band of `level_set` is the reach: [`sweep_distance`] or `rebuild` widen it.
pub fn extend_field(level_set: &LevelSet, field: &Field, run: &RunOptions) -> Result<Field> {
    let source = level_set.grid();
    reserve(source.leaves().len(), run)?;
    let voxel_size = level_set.voxel_size() as f32;
    let mut grid = source.zeroed();
    // Masks are the voxels that are to be computed, until the end.
    grid.update_pages(source.leaf_set(), |leaves, values, masks| {
        dispatch(Known { source, field: field.grid(), voxel_size, leaves, values, masks });
    });
    let mut next = grid.value_pages().clone();
    let mut active = grid.leaf_set().clone();
    while !active.is_empty() {
        run.check(OPERATION)?;
        let changed = next.par_update_pages(&active, |leaves, page| {
            let mut changed = Vec::new();
            dispatch(ExtensionRound { source, grid: &grid, leaves, page, changed: &mut changed });
            changed
        });
        grid.swap_values(&mut next);
        active = with_face_neighbours(source, changed.into_iter().flatten().collect());
    }
    grid.update_all(|id, _, mask| *mask = source.mask(id));
    Ok(Field::new(grid, *level_set.transform()))
}

fn reserve(leaves: usize, run: &RunOptions) -> Result<()> {
    run.reserve(OPERATION, leaves as u64 * BYTES_A_LEAF, "a narrower band or a coarser grid needs less")
}

/// Leaves and those that share a face with one.
fn with_face_neighbours(grid: &Grid, leaves: Vec<LeafId>) -> LeafSet {
    let around = grid.neighbours();
    let mut set = LeafSet::default();
    for id in leaves {
        set.insert(id);
        for face in Face::ALL {
            let beyond = around[id.index()][neighbour_index(face.step())];
            if !beyond.is_sentinel() {
                set.insert(beyond);
            }
        }
    }
    set
}

/// Adds the leaves that the band enters from leaves that changed.
fn grow(
    grid: &mut Grid,
    next: &mut Paged<LeafValues>,
    changed: &[LeafId],
    voxel_size: f32,
    run: &RunOptions,
) -> Result<()> {
    let around = grid.neighbours();
    let reach = grid.background() - LEAST_STEP * voxel_size;
    let mut origins = Vec::new();
    for &id in changed {
        for face in Face::ALL {
            let absent = around[id.index()][neighbour_index(face.step())].is_sentinel();
            if absent && on_face(face).any(|offset| grid.values(id).0[offset].abs() < reach) {
                origins.push(grid.origin(id) + face.step() * LEAF_DIM);
            }
        }
    }
    if origins.is_empty() {
        return Ok(());
    }
    origins.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    origins.dedup();
    reserve(grid.leaves().len() + origins.len(), run)?;
    let added = grid.add_leaves(&origins);
    next.grow(grid.value_pages().page_count(), LeafValues::default());
    for id in added {
        next.get_mut(id).clone_from(grid.values(id));
    }
    Ok(())
}

/// Offsets of the voxels of a leaf that lie on one of its faces.
fn on_face(face: Face) -> impl Iterator<Item = usize> {
    (0..64).map(move |i| match face {
        Face::XMinus => i,
        Face::XPlus => 7 * 64 + i,
        Face::YMinus => i / 8 * 64 + i % 8,
        Face::YPlus => i / 8 * 64 + 7 * 8 + i % 8,
        Face::ZMinus => i * 8,
        Face::ZPlus => i * 8 + 7,
    })
}

/// The values of two rows with `part` where a bit is set.
#[inline(always)]
fn merge<S: Simd>(simd: S, bits: u16, part: Lanes<S>, rest: Lanes<S>) -> Lanes<S> {
    mask32x16::from_bitmask(simd, u64::from(bits)).select(part, rest)
}

/// Writes the distances beside the surface and ±background elsewhere, and sets the masks of the voxels beside it.
struct Seed<'a> {
    source: &'a Grid,
    voxel_size: f32,
    background: f32,
    leaves: PageLeaves,
    values: &'a mut [LeafValues],
    masks: &'a mut [LeafMask],
}

impl Work for Seed<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut halo = FaceHalo::new();
        let far = Lanes::splat(simd, self.background);
        // A distance of 0 must not lose its sign.
        let least = Lanes::splat(simd, f32::MIN_POSITIVE);
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (values, mask) = (&mut self.values[PageLeaves::slot(id)], &mut self.masks[PageLeaves::slot(id)]);
                halo.gather(self.source.value_pages(), &self.source.neighbours()[id.index()]);
                *mask = LeafMask::EMPTY;
                LeafMask::FULL.for_each_pair(
                    #[inline(always)]
                    |x, y, _| {
                        let at = x * 64 + y * 8;
                        let phi = halo.centre(simd, x, y);
                        let found = seeds(simd, &halo, x, y, self.voxel_size);
                        let distance = merge(simd, found.beside, found.distance.max(least).min(far), far);
                        with_sign(simd, distance, phi).store_slice(&mut values.0[at..at + 16]);
                        mask.0[x] |= u64::from(found.beside) << (y * 8);
                    },
                );
            },
        );
    }
}

/// One round of distances on the leaves of a page.
struct Round<'a> {
    grid: &'a Grid,
    voxel_size: f32,
    leaves: PageLeaves,
    page: &'a mut [LeafValues],
    changed: &'a mut Vec<LeafId>,
}

impl Work for Round<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut halo = FaceHalo::new();
        let least_step = Lanes::splat(simd, LEAST_STEP * self.voxel_size);
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (out, kept) = (&mut self.page[PageLeaves::slot(id)], self.grid.mask(id));
                halo.gather(self.grid.value_pages(), &self.grid.neighbours()[id.index()]);
                out.0 = self.grid.values(id).0;
                let mut any = false;
                LeafMask::FULL.zip(kept, |_, kept| !kept).for_each_pair(
                    #[inline(always)]
                    |x, y, free| {
                        let at = x * 64 + y * 8;
                        let old = halo.centre(simd, x, y);
                        let neighbours = upwind_neighbours(simd, &halo, x, y);
                        let nearest = neighbours[0].min(neighbours[1]).min(neighbours[2]);
                        // Values only fall: where no neighbour is far enough below, there is nothing to do.
                        if (nearest + least_step).simd_lt(old.abs()).to_bitmask() & u64::from(free) == 0 {
                            return;
                        }
                        let found = solve(simd, neighbours, self.voxel_size).min(old.abs());
                        let new = merge(simd, free, with_sign(simd, found, old), old);
                        any |= new.simd_eq(old).to_bitmask() != 0xffff;
                        new.store_slice(&mut out.0[at..at + 16]);
                    },
                );
                if any {
                    self.changed.push(id);
                }
            },
        );
    }
}

/// Takes the field's values beside the surface and clears the masks there.
struct Known<'a> {
    source: &'a Grid,
    field: &'a Grid,
    voxel_size: f32,
    leaves: PageLeaves,
    values: &'a mut [LeafValues],
    masks: &'a mut [LeafMask],
}

impl Work for Known<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut halo = FaceHalo::new();
        let zero = Lanes::splat(simd, 0.0);
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let (values, mask) = (&mut self.values[PageLeaves::slot(id)], &mut self.masks[PageLeaves::slot(id)]);
                halo.gather(self.source.value_pages(), &self.source.neighbours()[id.index()]);
                let known = self.field.values(self.field.find(self.source.origin(id)));
                let active = *mask;
                active.for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let beside = seeds(simd, &halo, x, y, self.voxel_size).beside & bits;
                        merge(simd, beside, Lanes::from_slice(simd, &known.0[at..at + 16]), zero)
                            .store_slice(&mut values.0[at..at + 16]);
                        mask.0[x] &= !(u64::from(beside) << (y * 8));
                    },
                );
            },
        );
    }
}

/// One round of a field on the leaves of a page.
struct ExtensionRound<'a> {
    source: &'a Grid,
    grid: &'a Grid,
    leaves: PageLeaves,
    page: &'a mut [LeafValues],
    changed: &'a mut Vec<LeafId>,
}

impl Work for ExtensionRound<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (mut distance, mut field) = (FaceHalo::new(), FaceHalo::new());
        self.leaves.for_each(
            #[inline(always)]
            |id| {
                let out = &mut self.page[PageLeaves::slot(id)];
                let around = &self.source.neighbours()[id.index()];
                distance.gather(self.source.value_pages(), around);
                field.gather(self.grid.value_pages(), around);
                out.0 = self.grid.values(id).0;
                let mut any = false;
                self.grid.mask(id).for_each_pair(
                    #[inline(always)]
                    |x, y, bits| {
                        let at = x * 64 + y * 8;
                        let old = field.centre(simd, x, y);
                        let new = merge(simd, bits, extend(simd, &distance, &field, x, y), old);
                        any |= new.simd_eq(old).to_bitmask() != 0xffff;
                        new.store_slice(&mut out.0[at..at + 16]);
                    },
                );
                if any {
                    self.changed.push(id);
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3, IVec3};

    use super::*;
    use crate::grid::{Transform, offset_to_local};
    use crate::levelset::testing::{ball, box_distance, sampled};

    /// Mean and largest of an error over the active voxels.
    fn errors(grid: &Grid, error: impl Fn(DVec3, f64) -> f64) -> (f64, f64) {
        let (mut sum, mut worst, mut count) = (0.0, 0.0f64, 0.0);
        for &id in grid.leaves() {
            for o in grid.mask(id).iter() {
                let e = error((grid.origin(id) + offset_to_local(o)).as_dvec3(), f64::from(grid.values(id).0[o])).abs();
                (sum, worst, count) = (sum + e, worst.max(e), count + 1.0);
            }
        }
        (sum / count, worst)
    }

    fn swept(level_set: &LevelSet, half_width: f32) -> LevelSet {
        let swept = sweep_distance(level_set, half_width, &RunOptions::default()).unwrap();
        assert_eq!(swept.check(), []);
        assert_eq!(swept.half_width(), half_width);
        swept
    }

    #[test]
    fn a_ball_is_restored_from_a_distorted_field() {
        let centre = DVec3::new(0.3, 0.1, -0.2);
        let exact = |p: DVec3| (p - centre).length() - 20.0;
        // |∇φ| between 0.5 and 2, as after a flow that was never renormalised.
        let mut distorted = ball(centre, 20.0);
        let origins: Vec<_> = distorted.grid().leaves().iter().map(|&id| (id, distorted.grid().origin(id))).collect();
        distorted.grid_mut().update_all(|id, values, mask| {
            let origin = origins.iter().find(|o| o.0 == id).unwrap().1;
            for o in mask.iter() {
                let p = (origin + offset_to_local(o)).as_dvec3();
                values.0[o] = (f64::from(values.0[o]) * (1.2 + 0.7 * (p.x * 0.2).sin())).clamp(-2.99, 2.99) as f32;
            }
        });
        for level_set in [&ball(centre, 20.0), &distorted] {
            let (mean, worst) = errors(swept(level_set, 3.0).grid(), |p, v| v - exact(p));
            // First order in a band of three voxels: a dense reference in f64 gives 0.019 and 0.073 from a distance, 0.024 and 0.123 from a distorted field.
            assert!(mean < 0.03 && worst < 0.15, "{mean} {worst}");
        }
    }

    #[test]
    fn bands_widen_and_narrow() {
        let centre = DVec3::new(0.3, 0.1, -0.2);
        for half_width in [1.5, 3.0, 10.0] {
            let wide = swept(&ball(centre, 20.0), half_width);
            let (mean, worst) = errors(wide.grid(), |p, v| v - ((p - centre).length() - 20.0));
            // One-sided differences err by h/2·u_ii along axis i, which along a ray of direction n makes de/dr = h/2·g/r with
            // g = Σ|nᵢ|(1 − nᵢ²): at most 2/√3, along the diagonals of space, ¾ on average. So the error is h/2·g times the
            // logarithm of r/R, largest at the inner rim and half as large on average; and h/R for the voxels that start it.
            let w = f64::from(half_width);
            let (inner, outer) = ((20.0 / (20.0 - w)).ln(), ((20.0 + w) / 20.0).ln());
            let seeded = 1.0 / 20.0;
            assert!(worst < inner / 3f64.sqrt() + seeded, "{half_width}: {worst}");
            assert!(mean < 0.375 * (inner + outer) / 4.0 + seeded, "{half_width}: {mean}");
            // All voxels of the band are there, but those within the error of its rim.
            let shell = |w: f64| 4.0 / 3.0 * std::f64::consts::PI * ((20.0 + w).powi(3) - (20.0 - w).powi(3));
            let active = wide.grid().active_voxels() as f64;
            assert!(active > shell(w - 0.3) && active < shell(w + 0.3), "{half_width}: {active}");
        }
        let empty = LevelSet::empty(Transform::uniform(1.0), 3.0);
        assert!(sweep_distance(&empty, 5.0, &RunOptions::default()).unwrap().is_empty());
    }

    #[test]
    fn planes_are_exact_and_boxes_of_first_order() {
        // The faces of a box: planes, away from its edges. Outside the edges distances fan out. Inside, behind an edge, the
        // scheme rounds the ridge: where two neighbours are equal, u is short by 1 − 1/√2 of a voxel, and a neighbour that is
        // short by ε leaves ε²/2 to the next voxel. Four voxels from the ridge, whose depth is that of the band, 4e-7 is left.
        let half = DVec3::new(20.3, 17.6, 14.1);
        let exact = |p: DVec3| box_distance(p, half);
        let wide = swept(&sampled(26, exact), 6.0);
        let beside_a_face = |p: DVec3| (p.abs() - half).to_array().iter().filter(|d| **d > -10.0).count() == 1;
        let (_, on_faces) = errors(wide.grid(), |p, v| if beside_a_face(p) { v - exact(p) } else { 0.0 });
        assert!(on_faces < 1e-5, "{on_faces}");
        let (mean, worst) = errors(wide.grid(), |p, v| v - exact(p));
        // Largest behind a corner, where distances fan out from a point: the scheme's recursion in f64 from exact distances along
        // the faces has 0.71 at the first voxel, which is 1.21 from the corner, and 1.13 where u reaches 6, below the bound
        // 0.71 + h/√3·ln(4.63/1.21) = 1.48; voxels beside the edges, whose gradients mix two faces, add to it.
        assert!(mean < 0.08 && worst < 1.25, "{mean} {worst}");

        // The large faces of a turned slab, away from its edges: planes in no special position.
        let turn = DQuat::from_scaled_axis(DVec3::new(0.4, 0.7, -0.2));
        let slab = DVec3::new(22.0, 22.0, 7.7);
        let slanted = swept(&sampled(34, |p| box_distance(turn * p, slab)), 5.0);
        let (_, worst) = errors(slanted.grid(), |p, v| {
            let q = turn * p;
            if q.truncate().abs().max_element() < 6.0 { v - (q.z.abs() - 7.7) } else { 0.0 }
        });
        assert!(worst < 1e-4, "{worst}");
    }

    #[test]
    fn fields_are_constant_along_normals() {
        let centre = DVec3::new(0.3, 0.1, -0.2);
        let wide = swept(&ball(centre, 20.0), 8.0);
        // The x coordinate of the normal, given beside the surface and wrong elsewhere.
        let mut grid = wide.grid().zeroed();
        let origins: Vec<_> = grid.leaves().iter().map(|&id| (id, grid.origin(id))).collect();
        grid.update_all(|id, values, mask| {
            let origin = origins.iter().find(|o| o.0 == id).unwrap().1;
            for o in mask.iter() {
                let p = (origin + offset_to_local(o)).as_dvec3() - centre;
                values.0[o] = if (p.length() - 20.0).abs() < 1.1 { (p.x / p.length()) as f32 } else { 9.0 };
            }
        });
        let field = Field::new(grid, *wide.transform());
        let extended = extend_field(&wide, &field, &RunOptions::default()).unwrap();
        assert_eq!(extended.grid().active_voxels(), wide.grid().active_voxels());
        let (mean, worst) = errors(extended.grid(), |p, v| v - (p - centre).x / (p - centre).length());
        // First order: the upwind average smears by about the root of the distance, over which the value bends by 1/R².
        assert!(mean < 0.01 && worst < 0.08, "{mean} {worst}");
        // The largest principle: no value beyond those given.
        let (least, most) = extended.range().unwrap();
        assert!(least >= -1.0 && most <= 1.0);
    }

    #[test]
    fn numbers_of_threads_and_instruction_sets_change_no_bit() {
        use crate::stencil::simd::{Isa, choose};
        let level_set = ball(DVec3::new(0.3, 0.1, -0.2), 20.0);
        let run = |isa, threads: usize| {
            choose(isa);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let wide = sweep_distance(&level_set, 6.0, &RunOptions::default()).unwrap();
                let field = Field::new(wide.grid().clone(), *wide.transform());
                let field = extend_field(&wide, &field, &RunOptions::default()).unwrap();
                (wide, field)
            })
        };
        let first = run(Isa::Portable, 1);
        for (isa, threads) in [(Isa::Avx2, 2), (Isa::Avx512, 3)] {
            let other = run(isa, threads);
            for (a, b) in [(first.0.grid(), other.0.grid()), (first.1.grid(), other.1.grid())] {
                assert_eq!(a.leaves().len(), b.leaves().len());
                for (&i, &j) in a.leaves().iter().zip(b.leaves()) {
                    assert!(a.origin(i) == b.origin(j) && a.values(i) == b.values(j) && a.mask(i) == b.mask(j));
                }
            }
        }
        choose(Isa::detect());
        assert_eq!(first.0.grid().voxel(IVec3::ZERO), (-6.0, false));
    }
}
