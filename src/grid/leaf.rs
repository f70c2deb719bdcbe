//! A leaf: 8³ voxels, the unit of storage, of input and output, and of parallel work.
//!
//! The layout is OpenVDB's: voxel (x, y, z) of a leaf lies at `x·64 + y·8 + z` (z fastest), so whole leaves are copied
//! to and from files. In the active mask that is bit `y·8 + z` of word `x`: a word is a slice of constant x, a byte of it
//! a row of 8 voxels along z.

use glam::IVec3;

/// Edge of a leaf in voxels.
pub const LEAF_DIM: i32 = 8;
/// Voxels in a leaf.
pub const LEAF_VOXELS: usize = 512;

/// The values of a leaf, aligned to a cache line.
#[derive(Clone, Debug, PartialEq)]
#[repr(C, align(64))]
pub struct LeafValues(pub [f32; LEAF_VOXELS]);

impl LeafValues {
    /// A leaf of one value.
    pub fn filled(value: f32) -> Self {
        Self([value; LEAF_VOXELS])
    }

    /// Whether all values are negative (`true`) or none is (`false`); `None` if they differ.
    pub fn one_sign(&self) -> Option<bool> {
        let (any, all) = self.0.iter().fold((0, u32::MAX), |(any, all), v| (any | v.to_bits(), all & v.to_bits()));
        (any >> 31 == all >> 31).then_some(any >> 31 == 1)
    }
}

impl Default for LeafValues {
    fn default() -> Self {
        Self::filled(0.0)
    }
}

/// Which voxels of a leaf are active: word x, bit `y·8 + z`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C, align(64))]
pub struct LeafMask(pub [u64; 8]);

/// In a word, the voxels with z = 0: one bit a row.
const Z_FIRST: u64 = 0x0101_0101_0101_0101;
/// In a word, the voxels with z = 7.
const Z_LAST: u64 = Z_FIRST << 7;

impl LeafMask {
    /// No voxel active.
    pub const EMPTY: Self = Self([0; 8]);
    /// Every voxel active.
    pub const FULL: Self = Self([u64::MAX; 8]);

    /// Whether no voxel is active.
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        // As an array it would be compared by a call.
        self.0.iter().fold(0, |all, word| all | word) == 0
    }

    /// Number of active voxels.
    #[inline(always)]
    pub fn count(&self) -> u32 {
        self.0.iter().map(|w| w.count_ones()).sum()
    }

    /// Whether the voxel at `offset` (0..512) is active.
    pub fn get(&self, offset: usize) -> bool {
        self.0[offset >> 6] >> (offset & 63) & 1 == 1
    }

    /// Sets the state of the voxel at `offset`.
    pub fn set(&mut self, offset: usize, active: bool) {
        let bit = 1u64 << (offset & 63);
        if active {
            self.0[offset >> 6] |= bit;
        } else {
            self.0[offset >> 6] &= !bit;
        }
    }

    /// The 8 bits of row (x, y), bit z.
    #[inline(always)]
    pub fn row(&self, x: usize, y: usize) -> u8 {
        (self.0[x] >> (y * 8)) as u8
    }

    /// Calls `f` with x and y of every pair of rows (x, y), (x, y + 1) that has no active voxel; y is even.
    #[inline(always)]
    pub fn for_each_empty_pair(&self, mut f: impl FnMut(usize, usize)) {
        for (x, &word) in self.0.iter().enumerate() {
            for pair in 0..4 {
                if (word >> (16 * pair)) as u16 == 0 {
                    f(x, 2 * pair);
                }
            }
        }
    }

    /// Calls `f` with x, y and the 16 bits of every pair of rows (x, y), (x, y + 1) that has an active voxel; y is even.
    #[inline(always)]
    pub fn for_each_pair(&self, mut f: impl FnMut(usize, usize, u16)) {
        for (x, &word) in self.0.iter().enumerate() {
            if word == 0 {
                continue;
            }
            for pair in 0..4 {
                let bits = (word >> (16 * pair)) as u16;
                if bits != 0 {
                    f(x, 2 * pair, bits);
                }
            }
        }
    }

    /// Calls `f` with the offset of every active voxel in ascending order.
    #[inline(always)]
    pub fn for_each(&self, mut f: impl FnMut(usize)) {
        for (x, &word) in self.0.iter().enumerate() {
            let mut rest = word;
            while rest != 0 {
                f(x * 64 + rest.trailing_zeros() as usize);
                rest &= rest - 1;
            }
        }
    }

    /// Offsets of the active voxels in ascending order.
    pub fn iter(self) -> impl Iterator<Item = usize> {
        self.0.into_iter().enumerate().flat_map(|(x, word)| {
            let mut rest = word;
            std::iter::from_fn(move || {
                (rest != 0).then(|| {
                    let bit = rest.trailing_zeros() as usize;
                    rest &= rest - 1;
                    x * 64 + bit
                })
            })
        })
    }

    /// Combines two masks word by word.
    #[inline(always)]
    pub fn zip(self, other: Self, f: impl Fn(u64, u64) -> u64) -> Self {
        Self(std::array::from_fn(|x| f(self.0[x], other.0[x])))
    }

    /// The voxels of this leaf that are face neighbours of its active voxels, and the active voxels themselves.
    #[inline]
    pub fn dilated(&self) -> Self {
        let m = &self.0;
        Self(std::array::from_fn(|x| {
            let w = m[x];
            let along_z = (w << 1 & !Z_FIRST) | (w >> 1 & !Z_LAST);
            let along_y = w << 8 | w >> 8;
            let along_x = if x > 0 { m[x - 1] } else { 0 } | if x < 7 { m[x + 1] } else { 0 };
            w | along_z | along_y | along_x
        }))
    }

    /// The voxels of the neighbouring leaf across `face` that are face neighbours of this leaf's active voxels.
    #[inline(always)]
    pub fn spill(&self, face: Face) -> Self {
        let m = &self.0;
        let mut out = [0; 8];
        match face {
            Face::XMinus => out[7] = m[0],
            Face::XPlus => out[0] = m[7],
            Face::YMinus => out.iter_mut().zip(m).for_each(|(o, w)| *o = w << 56),
            Face::YPlus => out.iter_mut().zip(m).for_each(|(o, w)| *o = w >> 56),
            Face::ZMinus => out.iter_mut().zip(m).for_each(|(o, w)| *o = (w & Z_FIRST) << 7),
            Face::ZPlus => out.iter_mut().zip(m).for_each(|(o, w)| *o = (w & Z_LAST) >> 7),
        }
        Self(out)
    }
}

/// A face of a leaf, named by its outward axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Face {
    /// x − 1
    XMinus,
    /// x + 1
    XPlus,
    /// y − 1
    YMinus,
    /// y + 1
    YPlus,
    /// z − 1
    ZMinus,
    /// z + 1
    ZPlus,
}

impl Face {
    /// All six.
    pub const ALL: [Self; 6] = [Self::XMinus, Self::XPlus, Self::YMinus, Self::YPlus, Self::ZMinus, Self::ZPlus];

    /// The face across.
    #[inline(always)]
    pub fn opposite(self) -> Self {
        match self {
            Self::XMinus => Self::XPlus,
            Self::XPlus => Self::XMinus,
            Self::YMinus => Self::YPlus,
            Self::YPlus => Self::YMinus,
            Self::ZMinus => Self::ZPlus,
            Self::ZPlus => Self::ZMinus,
        }
    }

    /// The outward unit step.
    #[inline(always)]
    pub fn step(self) -> IVec3 {
        match self {
            Self::XMinus => IVec3::NEG_X,
            Self::XPlus => IVec3::X,
            Self::YMinus => IVec3::NEG_Y,
            Self::YPlus => IVec3::Y,
            Self::ZMinus => IVec3::NEG_Z,
            Self::ZPlus => IVec3::Z,
        }
    }
}

/// Origin of the leaf that holds voxel `ijk`: each coordinate rounded down to a multiple of 8.
#[inline(always)]
pub fn leaf_origin(ijk: IVec3) -> IVec3 {
    IVec3::new(ijk.x & !7, ijk.y & !7, ijk.z & !7)
}

/// Offset of voxel `ijk` within its leaf.
#[inline(always)]
pub fn leaf_offset(ijk: IVec3) -> usize {
    (((ijk.x & 7) << 6) | ((ijk.y & 7) << 3) | (ijk.z & 7)) as usize
}

/// Position within the leaf of the voxel at `offset`.
#[inline(always)]
pub fn offset_to_local(offset: usize) -> IVec3 {
    IVec3::new((offset >> 6) as i32, (offset >> 3 & 7) as i32, (offset & 7) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_round_trip_and_floor_negatives() {
        for ijk in [IVec3::new(-1, 7, 8), IVec3::new(-8, -9, 1000), IVec3::ZERO] {
            let back = leaf_origin(ijk) + offset_to_local(leaf_offset(ijk));
            assert_eq!(back, ijk);
        }
        assert_eq!(leaf_origin(IVec3::new(-1, -8, -9)), IVec3::new(-8, -8, -16));
    }

    #[test]
    fn dilation_by_words_equals_dilation_by_voxels() {
        // Every single-voxel mask, and a dense one, against the definition.
        let dense = LeafMask([0x8100_0000_1800_0081, 0, u64::MAX, 1, 0, 2 << 20, 0, 0x8000_0000_0000_0001]);
        let singles = (0..LEAF_VOXELS).map(|o| {
            let mut m = LeafMask::EMPTY;
            m.set(o, true);
            m
        });
        for mask in singles.chain([dense]) {
            let mut inside = mask;
            let mut spills = [LeafMask::EMPTY; 6];
            for o in mask.iter() {
                for (f, face) in Face::ALL.into_iter().enumerate() {
                    let ijk = offset_to_local(o) + face.step();
                    let target = if leaf_origin(ijk) == IVec3::ZERO { &mut inside } else { &mut spills[f] };
                    target.set(leaf_offset(ijk), true);
                }
            }
            assert_eq!(mask.dilated(), inside);
            for (f, face) in Face::ALL.into_iter().enumerate() {
                assert_eq!(mask.spill(face), spills[f], "{face:?}");
            }
        }
    }
}
