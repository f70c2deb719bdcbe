//! The raw bridge to OpenVDB. What each function does is said in `cpp/bridge.h`; everything outside this module uses
//! the safe API of its other files.

#![allow(missing_docs)] // generated items

#[cxx::bridge(namespace = "vdb_edit")]
pub(super) mod ffi {
    /// One metadata item: its type as OpenVDB names it and its value as text.
    #[derive(Clone, Debug, PartialEq)]
    struct MetaEntry {
        name: String,
        type_name: String,
        value: String,
    }

    struct ArchiveHeader {
        file_version: u32,
        library_major: u32,
        library_minor: u32,
        uuid: String,
        has_offsets: bool,
        metadata: Vec<MetaEntry>,
    }

    struct GridHeader {
        name: String,
        unique_name: String,
        instance_of: String,
        type_name: String,
        value_type: String,
        grid_class: String,
        half: bool,
        compression: u32,
        /// NaN when it is not stored before the voxels or not a scalar.
        background: f64,
        map_type: String,
        /// Row-major 4x4, points as columns; empty when the map is not linear.
        affine: Vec<f64>,
        voxel_size: [f64; 3],
        metadata: Vec<MetaEntry>,
    }

    struct Tile {
        x: i32,
        y: i32,
        z: i32,
        /// Edge in voxels: 8, 128 or 4096.
        size: u32,
        value: f32,
        active: bool,
    }

    /// How OpenVDB's level set tracker works.
    struct TrackerOptions {
        /// Whether HJ-WENO5 instead of first-order upwind differences are used.
        weno5: bool,
        /// Order of the TVD Runge-Kutta integrator, 1 to 3.
        runge_kutta: u32,
        /// Normalisations a track.
        normalizations: u32,
    }

    unsafe extern "C++" {
        include!("bridge.h");

        fn library_version() -> Result<String>;
        fn newest_file_version() -> u32;
        fn take_log() -> Result<String>;
        fn set_threads(threads: usize) -> Result<()>;

        type Archive;
        fn header(self: &Archive) -> Result<ArchiveHeader>;
        fn grid_count(self: &Archive) -> usize;
        fn grid_header(self: &Archive, index: usize) -> Result<GridHeader>;
        fn read_path(path: &[u8], headers_only: bool) -> Result<UniquePtr<Archive>>;
        fn read_bytes(bytes: &[u8], headers_only: bool) -> Result<UniquePtr<Archive>>;
        fn fingerprint_path(path: &[u8]) -> Result<UniquePtr<Archive>>;
        fn fingerprint_bytes(bytes: &[u8]) -> Result<UniquePtr<Archive>>;
        fn release_voxels(archive: Pin<&mut Archive>, index: usize) -> Result<()>;
        fn trim_heap();
        fn grid_fingerprint(archive: &Archive, index: usize) -> Result<String>;

        type Leaves;
        fn count(self: &Leaves) -> usize;
        fn background(self: &Leaves) -> f64;
        fn origins(self: &Leaves, out: &mut [i32]) -> Result<()>;
        fn copy(self: &Leaves, first: usize, values: &mut [f32], masks: &mut [u64]) -> Result<()>;
        fn node_count(self: &Leaves) -> usize;
        fn node_origins(self: &Leaves, out: &mut [i32]) -> Result<()>;
        fn node_inside(self: &Leaves, out: &mut [u64]) -> Result<()>;
        fn tiles(self: &Leaves) -> Result<Vec<Tile>>;
        fn inactive_tile_range(self: &Leaves, low: &mut f64, high: &mut f64) -> Result<()>;
        fn archive_leaves(archive: &Archive, index: usize) -> Result<UniquePtr<Leaves>>;
        fn archive_component(archive: &Archive, index: usize, component: u32) -> Result<UniquePtr<Leaves>>;

        type FloatGrid;
        fn add_leaves(self: Pin<&mut FloatGrid>, origins: &[i32]) -> Result<()>;
        /// # Safety
        /// No two calls at a time may cover the same leaf.
        unsafe fn fill(self: &FloatGrid, first: usize, values: &[f32], masks: &[u64]) -> Result<()>;
        /// # Safety
        /// The values stay where they are, unchanged, until an output that takes the grid is sealed or gone.
        unsafe fn lend(self: Pin<&mut FloatGrid>, values: &[f32], mask: &[u64]) -> Result<()>;
        fn add_tiles(self: Pin<&mut FloatGrid>, tiles: &[Tile]) -> Result<()>;
        fn set_affine(self: Pin<&mut FloatGrid>, matrix: &[f64]) -> Result<()>;
        fn carry(self: Pin<&mut FloatGrid>, archive: &Archive, index: usize, with_transform: bool) -> Result<()>;
        fn set_name(self: Pin<&mut FloatGrid>, name: &str) -> Result<()>;
        fn set_creator(self: Pin<&mut FloatGrid>, creator: &str) -> Result<()>;
        fn set_half(self: Pin<&mut FloatGrid>, half: bool) -> Result<()>;
        fn new_level_set(background: f64) -> Result<UniquePtr<FloatGrid>>;
        fn new_float_grid(background: f64) -> Result<UniquePtr<FloatGrid>>;
        fn float_grid_leaves(grid: &FloatGrid) -> Result<UniquePtr<Leaves>>;

        type Output;
        fn new_output() -> Result<UniquePtr<Output>>;
        fn carry_metadata(self: Pin<&mut Output>, archive: &Archive) -> Result<()>;
        fn carry_grid(self: Pin<&mut Output>, archive: &Archive, index: usize) -> Result<()>;
        fn add_grid(self: Pin<&mut Output>, grid: UniquePtr<FloatGrid>) -> Result<()>;
        fn add_vectors(
            self: Pin<&mut Output>,
            x: UniquePtr<FloatGrid>,
            y: UniquePtr<FloatGrid>,
            z: UniquePtr<FloatGrid>,
        ) -> Result<()>;
        fn write_path(self: Pin<&mut Output>, path: &[u8], compression: u32) -> Result<()>;
        fn write_bytes(self: Pin<&mut Output>, compression: u32) -> Result<UniquePtr<CxxString>>;
        fn seal(self: Pin<&mut Output>) -> Result<()>;
        fn verify(self: &Output, archive: &Archive) -> Result<String>;

        fn plain_write(grid: &FloatGrid, path: &[u8], compression: u32) -> Result<()>;
        fn plain_read(path: &[u8]) -> Result<UniquePtr<FloatGrid>>;

        type RawMesh;
        fn point_count(self: &RawMesh) -> usize;
        fn triangle_count(self: &RawMesh) -> usize;
        fn quad_count(self: &RawMesh) -> usize;
        fn points(self: &RawMesh, out: &mut [f32]) -> Result<()>;
        fn triangles(self: &RawMesh, out: &mut [u32]) -> Result<()>;
        fn quads(self: &RawMesh, out: &mut [u32]) -> Result<()>;
        fn copy_grid(grid: &FloatGrid) -> Result<UniquePtr<FloatGrid>>;
        fn filter_mean_curvature(grid: Pin<&mut FloatGrid>, steps: usize, tracker: &TrackerOptions) -> Result<()>;
        fn filter_mean_curvature_masked(
            grid: Pin<&mut FloatGrid>,
            mask: &FloatGrid,
            tracker: &TrackerOptions,
        ) -> Result<()>;
        fn filter_laplacian(grid: Pin<&mut FloatGrid>, steps: usize, tracker: &TrackerOptions) -> Result<()>;
        fn filter_gaussian(grid: Pin<&mut FloatGrid>, width: i32, tracker: &TrackerOptions) -> Result<()>;
        fn filter_mean(grid: Pin<&mut FloatGrid>, width: i32, tracker: &TrackerOptions) -> Result<()>;
        fn filter_median(grid: Pin<&mut FloatGrid>, width: i32, tracker: &TrackerOptions) -> Result<()>;
        fn filter_offset(grid: Pin<&mut FloatGrid>, distance: f32, tracker: &TrackerOptions) -> Result<()>;
        fn track(grid: Pin<&mut FloatGrid>, tracker: &TrackerOptions) -> Result<()>;
        fn normalize(grid: Pin<&mut FloatGrid>, tracker: &TrackerOptions) -> Result<()>;
        fn csg_union(a: &FloatGrid, b: &FloatGrid) -> Result<UniquePtr<FloatGrid>>;
        fn csg_intersection(a: &FloatGrid, b: &FloatGrid) -> Result<UniquePtr<FloatGrid>>;
        fn csg_difference(a: &FloatGrid, b: &FloatGrid) -> Result<UniquePtr<FloatGrid>>;
        fn level_set_rebuild(grid: &FloatGrid, iso: f32, half_width: f32) -> Result<UniquePtr<FloatGrid>>;
        fn mesh_to_level_set(
            points: &[f32],
            triangles: &[u32],
            matrix: &[f64],
            half_width: f32,
            renormalize: bool,
        ) -> Result<UniquePtr<FloatGrid>>;
        fn volume_to_mesh(grid: &FloatGrid, iso: f64, adaptivity: f64) -> Result<UniquePtr<RawMesh>>;
        fn level_set_area(grid: &FloatGrid) -> Result<f64>;
        fn level_set_volume(grid: &FloatGrid) -> Result<f64>;
        fn morph(
            grid: Pin<&mut FloatGrid>,
            target: &FloatGrid,
            time: f32,
            weno5: bool,
            runge_kutta: u32,
            tracker: &TrackerOptions,
        ) -> Result<usize>;
        fn sdf_to_sdf(grid: &FloatGrid, iterations: i32) -> Result<UniquePtr<FloatGrid>>;
        fn dilate_sdf(grid: &FloatGrid, voxels: i32, iterations: i32) -> Result<UniquePtr<FloatGrid>>;
    }
}

// SAFETY: an archive is an ordinary heap object without ties to the thread that made it. Its `&self` functions only read
// grids whose voxels are all in memory (delayed loading, the one case of mutation behind const, is never used).
unsafe impl Send for ffi::Archive {}
// SAFETY: see above.
unsafe impl Sync for ffi::Archive {}
// SAFETY: holds a shared pointer to a grid (atomic count) and a list of its leaves; `&self` functions read only.
unsafe impl Send for ffi::Leaves {}
// SAFETY: see above.
unsafe impl Sync for ffi::Leaves {}
// SAFETY: a heap object without ties to its thread.
unsafe impl Send for ffi::FloatGrid {}
// SAFETY: `&self` functions read, except `fill`, which writes leaves that the caller in `write` keeps disjoint.
unsafe impl Sync for ffi::FloatGrid {}
