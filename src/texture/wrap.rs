//! A texture in the space above a patch.
//!
//! A place x has the value ψ(x) = φ_A(Φ(x)) of the texture, Φ the map back into it. ψ is divided by the most that Φ stretches, so that it is nowhere more than
//! the distance: leaves whose middle is far from the texture's surface are left out, and the work grows with that surface, not with the space.
//! Only the zero set of ψ counts in the end: distances are made exact from it.

use std::collections::BTreeMap;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;

use super::OPERATION;
use super::implicit::{Implicit, Rbf};
use super::leaves::{ADVICE, Found, Leaves, Made, block, closed, radius};
use super::space::Patch;
use crate::error::{EditError, Result};
use crate::grid::{LEAF_DIM, MAX_COORD, Transform};
use crate::levelset::{BYTES_A_LEAF, LevelSet, Sampler, grid_of_leaves};
use crate::mesh::{Rebuild, TriangleMesh, level_set_of_mesh, level_set_to_mesh, rebuild, with_half_width};
use crate::run::RunOptions;

/// Half width of the band of a texture that is looked up, in its voxels: it tells blocks of voxels without its surface.
const BAND: f32 = 12.0;

/// That of the band which is made of its polygons first.
const NARROW: f32 = 3.0;

/// Which map takes places to the texture, or the texture to places.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Map {
    /// The polygons of the texture are moved.
    SemiImplicit,
    /// The exact inverse of that map, found in the cells between the particles.
    Inverse,
    /// Radial basis functions through the particles.
    Implicit(Rbf),
}

/// How φ of the texture is found between its voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sampling {
    /// From the 8 voxels around: second order.
    Linear,
    /// From the 64 voxels around, by Catmull and Rom's splines.
    Cubic,
}

/// How a texture is laid on a patch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Laying {
    /// How often it is repeated along u and v.
    pub tile: [u32; 2],
    /// How far it is pushed into the surface in voxels, or out of it if it goes down, so that the two are sure to meet: its faces there then go on
    /// behind the surface. 0 lays it as it is.
    pub push: f64,
    /// The map.
    pub map: Map,
    /// Between the voxels of the texture.
    pub sampling: Sampling,
}

/// A texture laid on a patch.
pub struct Wrapped {
    /// On the lattice of the base and with its half width; exact distances.
    pub level_set: LevelSet,
    /// Of the implicit map: distances to particles that were evaluated, and how many a global evaluation over the space above the patch takes.
    pub kernels: Option<[u64; 2]>,
}

/// A texture that is laid on patches: its polygons, and its distances on lattices as fine as the patches need, made when they are first asked for.
pub struct Source {
    mesh: TriangleMesh,
    bounds: (DVec3, DVec3),
    given: LevelSet,
    lattices: BTreeMap<i32, LevelSet>,
}

impl Source {
    /// Refuses a texture without a surface.
    pub fn new(texture: LevelSet, run: &RunOptions) -> Result<Self> {
        let mesh = level_set_to_mesh(&texture, 0.0, run)?;
        let Some(bounds) = mesh.bounding_box() else {
            let accepted =
                "a solid with a surface: this one is empty; give its mesh finer voxels (`convert --resolution`)";
            return Err(EditError::parameter(OPERATION, "texture", "an empty level set", accepted));
        };
        Ok(Self { mesh, bounds, given: texture, lattices: BTreeMap::new() })
    }

    /// Its polygons.
    pub fn mesh(&self) -> &TriangleMesh {
        &self.mesh
    }

    /// Lengths of the box around the surface.
    pub fn size(&self) -> DVec3 {
        self.bounds.1 - self.bounds.0
    }

    /// For a map by which a voxel of the base is about `stretch` world units of the texture: voxels of half of that up to all of it, or those that it came
    /// with, if those are no finer. Finer ones would fall between the voxels of the base.
    fn lattice(&mut self, stretch: f64, run: &RunOptions) -> Result<LevelSet> {
        let power = stretch.log2().floor();
        let key = if power.exp2() > self.given.voxel_size() { power as i32 } else { i32::MIN };
        if let Some(made) = self.lattices.get(&key) {
            return Ok(made.clone());
        }
        let made = match key {
            i32::MIN => with_half_width(&self.given, BAND.max(self.given.half_width()), run)?,
            _ => {
                // The band widened from the coarser polygons, which are fewer.
                let narrow = level_set_of_mesh(self.mesh.clone(), &Transform::uniform(power.exp2()), NARROW, run)?;
                with_half_width(&narrow, BAND, run)?
            }
        };
        self.lattices.insert(key, made.clone());
        Ok(made)
    }
}

/// The texture as it lies on the patch of `base`. Its bounding box becomes the patch: x → u, y → v, z → w.
pub fn wrapped(
    base: &LevelSet,
    texture: &mut Source,
    patch: &Patch,
    laying: &Laying,
    run: &RunOptions,
) -> Result<Wrapped> {
    if laying.map == Map::SemiImplicit {
        let moved = warped(&texture.mesh, texture.bounds, base, patch, laying);
        let level_set = level_set_of_mesh(moved, base.transform(), base.half_width(), run)?;
        return Ok(Wrapped { level_set, kernels: None });
    }
    let solid = Solid::new(texture, base, patch, laying, run)?;
    let leaves = patch.cells().leaves();
    run.reserve(OPERATION, leaves.len() as u64 * BYTES_A_LEAF, ADVICE)?;
    let (made, kernels) = match laying.map {
        Map::Implicit(rbf) => {
            let implicit = Implicit::new(patch, rbf)?;
            let voxels = leaves.len() as u64 * 512;
            let (made, sums) = implicit.leaves(&solid, leaves, run)?;
            (made, Some([sums, voxels * implicit.particles()]))
        }
        Map::SemiImplicit | Map::Inverse => (by_inverse(&solid, patch, leaves, run)?, None),
    };
    let background = (base.voxel_size() * f64::from(base.half_width())) as f32;
    let sampled = LevelSet::new(grid_of_leaves(background, made), *base.transform());
    let level_set = rebuild(&sampled, &Rebuild::band(base.half_width()), run)?;
    Ok(Wrapped { level_set, kernels })
}

/// The polygons of a texture as they lie on a patch of `base` (world units), by the semi-implicit map; colours, texture coordinates and normals go along. `bounds` is the
/// box of the texture that becomes the patch.
pub fn warped(
    mesh: &TriangleMesh,
    bounds: (DVec3, DVec3),
    base: &LevelSet,
    patch: &Patch,
    laying: &Laying,
) -> TriangleMesh {
    let (lo, size) = (bounds.0, (bounds.1 - bounds.0).max(DVec3::splat(f64::MIN_POSITIVE)));
    let transform = base.transform();
    let push = laying.push / patch.lengths().z;
    let [nu, nv] = laying.tile.map(|n| n.max(1));
    let mut all = TriangleMesh::default();
    for tile in 0..nu * nv {
        let (i, j) = (f64::from(tile / nv), f64::from(tile % nv));
        let place = |p: &DVec3| {
            let t = (*p - lo) / size;
            let uvw = DVec3::new((t.x + i) / f64::from(nu), (t.y + j) / f64::from(nv), t.z - push);
            transform.index_to_world(patch.place(uvw))
        };
        let positions = mesh.positions.par_iter().with_min_len(4096).map(place).collect();
        let (colors, uvs) = (mesh.colors.clone(), mesh.uvs.clone());
        // A normal is the cross product of two directions on the surface: it goes by the cofactors of the map's derivative.
        let turned = |(p, n): (&DVec3, &[f32; 3])| {
            let along = |axis: DVec3| place(&(*p + axis * size * STEP)) - place(&(*p - axis * size * STEP));
            let [a, b, c] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| along(axis) / (axis.dot(size)));
            let n = Vec3::from_array(*n).as_dvec3();
            let turned = b.cross(c) * n.x + c.cross(a) * n.y + a.cross(b) * n.z;
            (turned * a.cross(b).dot(c).signum()).normalize_or_zero().as_vec3().to_array()
        };
        let normals = mesh.normals.as_ref();
        let normals = normals.map(|all| mesh.positions.par_iter().zip(all).with_min_len(4096).map(turned).collect());
        all.append(TriangleMesh { positions, triangles: mesh.triangles.clone(), colors, uvs, normals });
    }
    all
}

/// A texture to be looked up by (u, v, w).
pub(super) struct Solid<'a> {
    texture: LevelSet,
    pub base: &'a LevelSet,
    patch: &'a Patch,
    lo: DVec3,
    size: DVec3,
    tile: [f64; 2],
    /// In w, and how near to its faces on the surface the texture is looked up at most.
    push: f64,
    rim: DVec3,
    raised: bool,
    /// Height in voxels, and how far the texture goes on behind the surface.
    height: f64,
    depth: f64,
    sampling: Sampling,
    /// World units of the texture a voxel of the base, at most.
    pub stretch: f64,
}

/// What a texture and its base are looked up with.
pub(super) struct Probe<'a>(Sampler<'a>, Sampler<'a>);

impl<'a> Solid<'a> {
    pub fn new(
        texture: &mut Source,
        base: &'a LevelSet,
        patch: &'a Patch,
        laying: &Laying,
        run: &RunOptions,
    ) -> Result<Self> {
        let (lo, size) = (texture.bounds.0, texture.size());
        let tile = laying.tile.map(|n| f64::from(n.max(1)));
        let [typical, stretch] = patch.cells().stretch(size * DVec3::new(tile[0], tile[1], 1.0));
        let texture = texture.lattice(typical, run)?;
        let height = patch.lengths().z;
        Ok(Self {
            lo,
            size,
            tile,
            push: laying.push / height,
            rim: (RIM * typical / size).min(DVec3::splat(0.5)),
            raised: patch.raised,
            height,
            depth: patch.depth - 1.5,
            sampling: laying.sampling,
            stretch,
            base,
            patch,
            texture,
        })
    }

    pub fn probe(&self) -> Probe<'_> {
        Probe(self.texture.sampler(), self.base.sampler())
    }

    /// Half width of the band of the base, in voxels.
    pub fn half_width(&self) -> f64 {
        f64::from(self.base.half_width())
    }

    /// World units of the texture along the whole of u, v and w.
    pub fn extent(&self) -> DVec3 {
        self.size * DVec3::new(self.tile[0], self.tile[1], 1.0)
    }

    /// Voxel size of the texture.
    pub fn voxel_size(&self) -> f64 {
        self.texture.voxel_size()
    }

    /// ψ of a voxel whose (u, v, w) are known, in voxels of the base; at most the distance.
    pub fn distance(&self, probe: &mut Probe, ijk: DVec3, uvw: DVec3) -> f64 {
        let roots = self.push > 0.0;
        // The faces on the surface go on behind it: what is just inside of them.
        let w = if roots { (uvw.z + self.push).max(self.rim.z) } else { uvw.z };
        let (u, v) = (self.repeated(uvw.x, 0), self.repeated(uvw.y, 1));
        let [own, inner, face] = [0, 1, 2].map(|k| DVec3::new(u[k], v[k], w));
        // By a face between tiles that the solid touches it goes on into the next tile: faces that meet are no gap. What ends before the face is one.
        let touches = own != inner && self.value(probe, face) < ROUNDED * self.texture.voxel_size();
        let value = self.value(probe, if touches { inner } else { own });
        let phi = value / self.stretch;
        if !roots || phi >= 0.0 {
            return phi;
        }
        let behind = -uvw.z * self.height;
        let phi = phi.max(behind - self.depth);
        if self.raised && behind > SKIN {
            let (base, slope) = probe.1.value_and_gradient(ijk);
            let along = self.patch.place(uvw + DVec3::Z / self.height) - self.patch.place(uvw);
            if slope.dot(along) < 0.0 {
                // Not out of the other side of a thin wall.
                return phi.max(f64::from(base) / self.base.voxel_size());
            }
        }
        phi
    }

    /// φ at a place of the texture's box, 0..1³.
    fn value(&self, probe: &mut Probe, t: DVec3) -> f64 {
        let at = self.texture.transform().world_to_index(self.lo + self.size * t);
        match self.sampling {
            Sampling::Linear => f64::from(probe.0.trilinear(at)),
            Sampling::Cubic => cubic(&mut probe.0, at),
        }
    }

    /// The place in the texture of u or v, that place kept away from the faces between tiles, and the one just inside of such a face if it is by one.
    fn repeated(&self, t: f64, axis: usize) -> [f64; 3] {
        let n = self.tile[axis];
        let cell = (t * n).floor().clamp(0.0, n - 1.0);
        let (own, rim) = (t * n - cell, self.rim[axis]);
        let skin = (0.5 * self.texture.voxel_size() / self.size[axis]).min(rim);
        if cell > 0.0 && own < rim {
            [own, rim, skin]
        } else if cell < n - 1.0 && own > 1.0 - rim {
            [own, 1.0 - rim, 1.0 - skin]
        } else {
            [own; 3]
        }
    }
}

/// Weights of the values at −1, 0, 1 and 2 for the place `t` between 0 and 1, of the cubic that has at 0 and 1 the slopes of the chords around (Catmull and
/// Rom 1974).
pub(super) fn catmull_rom(t: f64) -> [f64; 4] {
    let (square, cube) = (t * t, t * t * t);
    [
        0.5 * (2.0 * square - t - cube),
        0.5 * (3.0 * cube - 5.0 * square) + 1.0,
        0.5 * (t + 4.0 * square - 3.0 * cube),
        0.5 * (cube - square),
    ]
}

/// Step of differences of the map, as a part of the texture's box.
const STEP: f64 = 1e-4;

/// How far the surface may lie below the particles' net, in voxels: as far a texture goes on behind it in any case.
const SKIN: f64 = 1.5;

/// What voxels round off the edges of a solid by, in those voxels.
const ROUNDED: f64 = 0.3;

/// How far inside of a face that goes on the texture is looked up, in voxels of the base: nearer, its distance would be lost between them.
const RIM: f64 = 1.5;

/// φ between voxels by Catmull and Rom's splines along each axis.
fn cubic(sampler: &mut Sampler, ijk: DVec3) -> f64 {
    let is_far = !ijk.is_finite() || ijk.abs().max_element() > f64::from(MAX_COORD - 4);
    if is_far {
        return f64::from(sampler.trilinear(ijk));
    }
    let base = ijk.floor();
    let weights = (ijk - base).to_array().map(catmull_rom);
    let first = base.as_ivec3() - 1;
    let mut along = |i: i32, j: i32| {
        (0..4).zip(weights[2]).map(|(k, c)| f64::from(sampler.voxel(first + IVec3::new(i, j, k))) * c).sum::<f64>()
    };
    let mut sum = 0.0;
    for (i, a) in (0..4).zip(weights[0]) {
        for (j, b) in (0..4).zip(weights[1]) {
            sum += along(i, j) * (a * b);
        }
    }
    sum
}

/// Blocks in which a leaf is looked at first.
const BLOCK: i32 = 4;

/// By the exact inverse of the map. Where cells of it fold or lie in each other, a place has the least of its values: what is inside by one of them is inside.
fn by_inverse(solid: &Solid, patch: &Patch, leaves: Vec<IVec3>, run: &RunOptions) -> Result<Leaves> {
    let cells = patch.cells();
    let task = run.task("wrapping", leaves.len() as u64);
    let far = |d: f64, edge: i32| d.abs() > radius(edge) + solid.half_width();
    let middle = |edge: i32| DVec3::splat(f64::from(edge - 1) / 2.0);
    let in_full = |probe: &mut Probe, origin: IVec3| {
        let mut made = Made::new(solid.base);
        let mut finder = cells.finder();
        let folds = cells.folds_in(origin);
        for local in block(LEAF_DIM) {
            let ijk = (origin + local).as_dvec3();
            let d = if folds {
                cells.all(ijk).map(|uvw| solid.distance(probe, ijk, uvw)).reduce(f64::min)
            } else {
                finder.find(ijk).map(|uvw| solid.distance(probe, ijk, uvw))
            };
            if let Some(d) = d {
                made.set(local, d);
            }
        }
        made
    };
    let found = leaves.into_par_iter().map_init(
        || solid.probe(),
        |probe, origin| {
            if run.is_cancelled() {
                return Found::Whole(origin, false);
            }
            task.advance(1);
            if cells.folds_in(origin) {
                return in_full(probe, origin).found(origin);
            }
            // Anew in each leaf: what it holds must not depend on the one before.
            let mut finder = cells.finder();
            let mut at = |ijk: DVec3| finder.find(ijk).map(|uvw| solid.distance(probe, ijk, uvw));
            if let Some(d) = at(origin.as_dvec3() + middle(LEAF_DIM)).filter(|d| far(*d, LEAF_DIM)) {
                return Found::Whole(origin, d < 0.0);
            }
            let mut made = Made::new(solid.base);
            for corner in block(LEAF_DIM / BLOCK).map(|c| c * BLOCK) {
                if let Some(d) = at((origin + corner).as_dvec3() + middle(BLOCK))
                    && far(d, BLOCK)
                {
                    made.fill(corner, BLOCK, d < 0.0);
                    continue;
                }
                for local in block(BLOCK).map(|c| corner + c) {
                    if let Some(d) = at((origin + local).as_dvec3()) {
                        made.set(local, d);
                    }
                }
            }
            made.found(origin)
        },
    );
    let found = found.collect();
    run.check(OPERATION)?;
    closed(found, |origin| in_full(&mut solid.probe(), origin), run)
}
