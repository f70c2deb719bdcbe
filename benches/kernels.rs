//! Bare kernels: the gather and the stencils, over every leaf of a sphere of a million voxels, on one thread.
//!
//! `cargo bench --bench kernels`. Figures are active voxels a second; what is computed is thrown away, so that no memory is
//! written but a buffer that stays in the cache. The copy of the whole grid is the bandwidth to hold them against.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use fearless_simd::{Simd, SimdBase};
use vdb_edit::LevelSet;
use vdb_edit::grid::LeafId;
use vdb_edit::ops::shape::Shape;
use vdb_edit::ops::{Operator, WorldLength};
use vdb_edit::run::RunOptions;
use vdb_edit::stencil::curvature::{laplacian, mean_curvature};
use vdb_edit::stencil::simd::{Isa, Lanes, Work, choose, dispatch};
use vdb_edit::stencil::upwind::{WenoEpsilon, godunov_first, godunov_weno5};
use vdb_edit::stencil::{FaceHalo, Halo, StarHalo};

fn main() {
    divan::main();
}

const ISAS: [Isa; 3] = [Isa::Portable, Isa::Avx2, Isa::Avx512];

fn sphere() -> LevelSet {
    let spec = "sphere radius=1".into();
    let shape = Shape { spec, voxel_size: Some(WorldLength::new(1.0 / 120.0)), ..Shape::default() };
    shape.apply(Vec::new(), &RunOptions::default()).expect("a sphere is a level set").level_set
}

/// A stencil on two rows of a leaf.
trait Stencil {
    type Buffer: Default;

    fn gather(buffer: &mut Self::Buffer, level_set: &LevelSet, id: LeafId);

    fn rows<S: Simd>(simd: S, buffer: &Self::Buffer, x: usize, y: usize, voxel_size: f32) -> Lanes<S>;
}

/// A stencil on the rows with active voxels of all leaves.
struct All<'a, K>(&'a LevelSet, std::marker::PhantomData<K>);

impl<K: Stencil> Work for All<'_, K> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (grid, voxel_size) = (self.0.grid(), self.0.voxel_size() as f32);
        let mut buffer = K::Buffer::default();
        let mut out = [0.0; 512];
        for &id in grid.leaves() {
            K::gather(&mut buffer, self.0, id);
            grid.mask(id).for_each_pair(
                #[inline(always)]
                |x, y, _| {
                    let at = x * 64 + y * 8;
                    K::rows(simd, &buffer, x, y, voxel_size).store_slice(&mut out[at..at + 16]);
                },
            );
            black_box(&out);
        }
    }
}

fn bench<K: Stencil>(bencher: Bencher, isa: Isa) {
    let level_set = sphere();
    if choose(isa) != isa {
        // This machine does not have it: nothing is reported under its name.
        return;
    }
    bencher
        .counter(ItemsCount::new(level_set.grid().active_voxels()))
        .bench_local(|| dispatch(All::<K>(&level_set, std::marker::PhantomData)));
}

macro_rules! halo_stencil {
    ($name:ident, $bench:ident, $buffer:ty, |$simd:ident, $halo:ident, $x:ident, $y:ident, $h:ident| $rows:expr) => {
        struct $name;

        impl Stencil for $name {
            type Buffer = $buffer;

            #[inline(always)]
            fn gather(buffer: &mut $buffer, level_set: &LevelSet, id: LeafId) {
                buffer.gather(level_set.grid().value_pages(), &level_set.grid().neighbours()[id.index()]);
            }

            #[inline(always)]
            fn rows<S: Simd>($simd: S, $halo: &$buffer, $x: usize, $y: usize, $h: f32) -> Lanes<S> {
                $rows
            }
        }

        #[divan::bench(args = ISAS)]
        fn $bench(bencher: Bencher, isa: Isa) {
            bench::<$name>(bencher, isa);
        }
    };
}

halo_stencil!(GatherBox, gather_27_neighbours, Halo, |simd, halo, x, y, _h| halo.rows(simd, x, y, [0; 3]));
halo_stencil!(GatherStar, gather_star_of_3, StarHalo, |simd, halo, x, y, _h| halo.centre(simd, x, y));
halo_stencil!(GatherFaces, gather_faces, FaceHalo, |simd, halo, x, y, _h| halo.centre(simd, x, y));
halo_stencil!(Laplacian, laplacian_, FaceHalo, |simd, halo, x, y, h| laplacian(simd, halo, x, y, h));
halo_stencil!(Curvature, mean_curvature_, Halo, |simd, halo, x, y, h| mean_curvature(simd, halo, x, y, h).mean);
halo_stencil!(First, godunov_first_, FaceHalo, |simd, halo, x, y, _h| godunov_first(
    simd,
    halo,
    x,
    y,
    halo.centre(simd, x, y)
));
halo_stencil!(Weno5, godunov_weno5_, StarHalo, |simd, halo, x, y, h| godunov_weno5(
    simd,
    halo,
    x,
    y,
    u16::MAX,
    halo.centre(simd, x, y),
    h,
    WenoEpsilon::SCALE_FREE
));

#[divan::bench]
fn copy_of_the_grid(bencher: Bencher) {
    let level_set = sphere();
    bencher.counter(ItemsCount::new(level_set.grid().active_voxels())).bench_local(|| level_set.grid().deep_copy());
}
