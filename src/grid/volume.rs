//! A volume of numbers that is no level set: leaves, constant tiles and a background, for painted masks and densities.

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::{LEAF_DIM, LeafValues, MAX_COORD, Transform, leaf_offset, leaf_origin};

/// Numbers on a lattice.
pub struct Volume {
    transform: Transform,
    background: f32,
    leaves: FxHashMap<IVec3, Box<LeafValues>>,
    /// By edge in voxels, then by first voxel.
    tiles: Vec<(i32, FxHashMap<IVec3, f32>)>,
}

impl Volume {
    /// A volume that is `background` everywhere.
    pub fn new(transform: Transform, background: f32) -> Self {
        Self { transform, background, leaves: FxHashMap::default(), tiles: Vec::new() }
    }

    /// Puts a leaf at `origin`.
    pub fn insert_leaf(&mut self, origin: IVec3, values: Box<LeafValues>) {
        self.leaves.insert(origin, values);
    }

    /// Makes the cube of edge `size` (a power of two) from `origin` (a multiple of it) on constant.
    pub fn insert_tile(&mut self, origin: IVec3, size: i32, value: f32) {
        let place = self.tiles.iter().position(|t| t.0 == size).unwrap_or_else(|| {
            self.tiles.push((size, FxHashMap::default()));
            self.tiles.len() - 1
        });
        self.tiles[place].1.insert(origin, value);
    }

    /// Index space ↔ world space.
    pub fn transform(&self) -> &Transform {
        &self.transform
    }

    /// The value where nothing is stored.
    pub fn background(&self) -> f32 {
        self.background
    }

    /// The value of a voxel.
    pub fn value(&self, ijk: IVec3) -> f32 {
        if let Some(leaf) = self.leaves.get(&leaf_origin(ijk)) {
            return leaf.0[leaf_offset(ijk)];
        }
        let tile = self.tiles.iter().find_map(|(size, tiles)| tiles.get(&(ijk & -*size)));
        tile.copied().unwrap_or(self.background)
    }

    /// Trilinear interpolation at a world position; NaN counts as 0.
    pub fn trilinear(&self, xyz: DVec3) -> f32 {
        let p = self.transform.world_to_index(xyz);
        if p.is_nan() || p.abs().max_element() >= f64::from(MAX_COORD - 2) {
            return self.background;
        }
        let floor = p.floor();
        let (cell, t) = (floor.as_ivec3(), p - floor);
        let at = |x: i32, y: i32, z: i32| {
            let value = self.value(cell + IVec3::new(x, y, z));
            if value.is_nan() { 0.0 } else { f64::from(value) }
        };
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let row = |x: i32, y: i32| lerp(at(x, y, 0), at(x, y, 1), t.z);
        let slab = |x: i32| lerp(row(x, 0), row(x, 1), t.y);
        lerp(slab(0), slab(1), t.x) as f32
    }

    /// First and last voxel of everything that is stored; `None` if nothing is.
    pub fn index_bounds(&self) -> Option<(IVec3, IVec3)> {
        let leaves = self.leaves.keys().map(|&o| (o, LEAF_DIM));
        let tiles = self.tiles.iter().flat_map(|(size, tiles)| tiles.keys().map(|&o| (o, *size)));
        let boxes = leaves.chain(tiles).map(|(o, size)| (o, o + (size - 1)));
        boxes.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// World-space box around everything that is stored, with a voxel's rim; `None` if nothing is.
    pub fn world_bounds(&self) -> Option<(DVec3, DVec3)> {
        let (lo, hi) = self.index_bounds()?;
        let (lo, hi) = (lo - 1, hi + 1);
        let corners = (0..8).map(|i| {
            let pick = |axis: usize| if i >> axis & 1 == 1 { hi[axis] } else { lo[axis] };
            self.transform.voxel_to_world(IVec3::new(pick(0), pick(1), pick(2)))
        });
        corners.map(|p| (p, p)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }
}

/// Vectors on a lattice.
pub struct VectorVolume {
    /// Their components along the axes of the world.
    pub components: [Volume; 3],
    /// Whether component i lies half a voxel before the middle of its voxel along axis i, as solvers of fluids store it.
    pub staggered: bool,
}

impl VectorVolume {
    /// Trilinear interpolation at a world position.
    pub fn trilinear(&self, xyz: DVec3) -> DVec3 {
        let at = |axis: usize| {
            let volume = &self.components[axis];
            let shift = if self.staggered { volume.transform.to_world().matrix3.col(axis) * 0.5 } else { DVec3::ZERO };
            f64::from(volume.trilinear(xyz + shift))
        };
        DVec3::new(at(0), at(1), at(2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_tiles_and_background() {
        let mut volume = Volume::new(Transform::uniform(0.5), 0.0);
        let mut leaf = Box::new(LeafValues::default());
        leaf.0.fill(0.5);
        volume.insert_leaf(IVec3::ZERO, leaf);
        volume.insert_tile(IVec3::new(128, 0, -128), 128, 1.0);
        for (ijk, value) in [
            ([0, 0, 0], 0.5),
            ([7, 7, 7], 0.5),
            ([8, 0, 0], 0.0),
            ([128, 0, -1], 1.0),
            ([255, 127, -128], 1.0),
            ([256, 0, -1], 0.0),
        ] {
            assert_eq!(volume.value(IVec3::from(ijk)), value, "{ijk:?}");
        }
        assert_eq!(volume.trilinear(DVec3::new(3.75, 1.0, 1.0)), 0.25);
        assert_eq!(volume.trilinear(DVec3::splat(1e300)), 0.0);
        let (lo, hi) = volume.world_bounds().unwrap();
        assert_eq!((lo, hi), (DVec3::new(-0.5, -0.5, -64.5), DVec3::new(128.0, 64.0, 4.0)));
    }

    #[test]
    fn staggered_components_lie_on_the_faces() {
        let ramp = |axis: usize| {
            let mut volume = Volume::new(Transform::uniform(0.5), 0.0);
            let mut leaf = Box::new(LeafValues::default());
            (0..512).for_each(|o| leaf.0[o] = crate::grid::offset_to_local(o)[axis] as f32);
            volume.insert_leaf(IVec3::ZERO, leaf);
            volume
        };
        let mut vectors = VectorVolume { components: [ramp(0), ramp(1), ramp(2)], staggered: false };
        let p = DVec3::new(1.0, 1.5, 2.0);
        assert_eq!(vectors.trilinear(p), DVec3::new(2.0, 3.0, 4.0));
        vectors.staggered = true;
        // The value of voxel i is that at i − ½.
        assert_eq!(vectors.trilinear(p), DVec3::new(2.5, 3.5, 4.5));
    }
}
