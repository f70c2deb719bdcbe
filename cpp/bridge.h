// What Rust sees of OpenVDB. This header must not include OpenVDB: the generated bridge code includes it and would
// take ten seconds instead of half a second to compile. Everything of OpenVDB is behind an `Impl`.
//
// Every function may throw; cxx turns the exception into a Rust error (see `trycatch` below).
#pragma once

#include "rust/cxx.h"

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <string>

namespace rust::behavior {

/// Used by the generated code around every call that returns a `Result`: also catches what is no std::exception, which
/// would otherwise end the process.
template<typename Try, typename Fail>
static void trycatch(Try&& call, Fail&& fail) noexcept
try {
    call();
} catch (const std::exception& e) {
    fail(e.what());
} catch (...) {
    fail("an exception of unknown type");
}

} // namespace rust::behavior

namespace vdb_edit {

// Shared with Rust, defined by the generated code.
struct ArchiveHeader;
struct GridHeader;
struct MetaEntry;
struct Tile;
struct TrackerOptions;

/// Registers OpenVDB's grid types. Idempotent.
void initialize();
/// Version of the library that is linked, for instance "10.0.1".
rust::String library_version();
/// The newest file format that the library reads.
std::uint32_t newest_file_version();
/// What OpenVDB logged since the last call; nothing of it reaches standard output.
rust::String take_log();
/// Limits TBB's parallelism from now on; 0 lifts the limit.
void set_threads(std::size_t threads);

/// A file's content: its metadata and its grids in file order.
class Archive {
public:
    struct Impl;
    explicit Archive(std::unique_ptr<Impl>);
    ~Archive();

    ArchiveHeader header() const;
    std::size_t grid_count() const;
    GridHeader grid_header(std::size_t index) const;

    std::unique_ptr<Impl> impl;
};

/// Reads a whole file, or only what precedes the voxels of each grid. Fails when the bytes end early, when a grid does
/// not end where the file says, and when bytes are left over.
std::unique_ptr<Archive> read_path(rust::Slice<const std::uint8_t> path, bool headers_only);
/// The same from memory.
std::unique_ptr<Archive> read_bytes(rust::Slice<const std::uint8_t> bytes, bool headers_only);

/// Lets go of the voxels of grid `index`; its name, metadata and transform stay.
void release_voxels(Archive& archive, std::size_t index);
/// Gives memory that was freed back to the system, where the C library can.
void trim_heap();

/// Reads a whole file as `read_path` does and keeps only a fingerprint of each grid's voxels, for `Output::verify`.
std::unique_ptr<Archive> fingerprint_path(rust::Slice<const std::uint8_t> path);
/// The same from memory.
std::unique_ptr<Archive> fingerprint_bytes(rust::Slice<const std::uint8_t> bytes);

/// The leaves of one float or double grid, listed once, for bulk copies. Const calls may run in parallel.
class Leaves {
public:
    struct Impl;
    explicit Leaves(std::unique_ptr<Impl>);
    ~Leaves();

    std::size_t count() const;
    double background() const;
    /// Origins of all leaves, three integers a leaf.
    void origins(rust::Slice<std::int32_t> out) const;
    /// Values (512 a leaf) and active masks (8 words a leaf) of the leaves from `first` on.
    void copy(std::size_t first, rust::Slice<float> values, rust::Slice<std::uint64_t> masks) const;

    std::size_t node_count() const;
    /// Origins of all nodes of 16^3 leaves.
    void node_origins(rust::Slice<std::int32_t> out) const;
    /// For each such node 64 words: the slots that hold a tile of negative value. Slot (x, y, z) is bit x*256+y*16+z.
    void node_inside(rust::Slice<std::uint64_t> out) const;
    /// Active tiles of every size, and inactive negative ones larger than a leaf.
    rust::Vec<Tile> tiles() const;
    /// Smallest and largest value of inactive tiles, in this order; positive infinity first when there is none.
    void inactive_tile_range(double& low, double& high) const;

    std::unique_ptr<Impl> impl;
};

/// The leaves of grid `index`, which must be of type float or double.
std::unique_ptr<Leaves> archive_leaves(const Archive& archive, std::size_t index);

/// Component 0, 1 or 2 of grid `index`, which must be of type Vec3f or Vec3d: active tiles, no nodes.
std::unique_ptr<Leaves> archive_component(const Archive& archive, std::size_t index, std::uint32_t component);

/// A float grid held by OpenVDB: what is written, and what OpenVDB's own tools work on.
class FloatGrid {
public:
    struct Impl;
    explicit FloatGrid(std::unique_ptr<Impl>);
    ~FloatGrid();

    /// Makes empty leaves at the given origins (three integers a leaf). Not parallel.
    void add_leaves(rust::Slice<const std::int32_t> origins);
    /// Fills leaves from `first` on, in the order they were added. Disjoint ranges may be filled in parallel.
    void fill(std::size_t first, rust::Slice<const float> values, rust::Slice<const std::uint64_t> masks) const;
    /// Gives the next leaf its mask, and to an output its values, which stay where they are. For all leaves or none; nothing else sees them.
    void lend(rust::Slice<const float> values, rust::Slice<const std::uint64_t> mask);
    /// Sets tiles, none of which may cover a leaf.
    void add_tiles(rust::Slice<const Tile> tiles);

    /// Row-major 4x4, points as columns.
    void set_affine(rust::Slice<const double> matrix);
    /// The name, class, metadata and, if asked, the very transform of a grid that was read.
    void carry(const Archive& archive, std::size_t index, bool with_transform);
    void set_name(rust::Str name);
    void set_creator(rust::Str creator);
    void set_half(bool half);

    std::unique_ptr<Impl> impl;
};

/// An empty level set.
std::unique_ptr<FloatGrid> new_level_set(double background);
/// An empty float grid of no class.
std::unique_ptr<FloatGrid> new_float_grid(double background);
std::unique_ptr<Leaves> float_grid_leaves(const FloatGrid& grid);

/// Grids and metadata on their way to a file.
class Output {
public:
    struct Impl;
    explicit Output(std::unique_ptr<Impl>);
    ~Output();

    void carry_metadata(const Archive& archive);
    void carry_grid(const Archive& archive, std::size_t index);
    void add_grid(std::unique_ptr<FloatGrid> grid);
    /// A grid of vectors whose components are these grids of one set of leaves.
    void add_vectors(std::unique_ptr<FloatGrid> x, std::unique_ptr<FloatGrid> y, std::unique_ptr<FloatGrid> z);
    /// Writes to an existing file; every failed write is an exception.
    void write_path(rust::Slice<const std::uint8_t> path, std::uint32_t compression);
    std::unique_ptr<std::string> write_bytes(std::uint32_t compression);
    /// Lets go of the grids and keeps what `verify` compares with.
    void seal();
    /// Empty when `archive`, of fingerprints, holds what was written, else what differs.
    rust::String verify(const Archive& archive) const;

    std::unique_ptr<Impl> impl;
};

std::unique_ptr<Output> new_output();

/// 128 bits that are equal for grids of equal topology and values (after rounding, for grids stored as half); for points that are carried over as
/// bytes, of equal bytes.
rust::String grid_fingerprint(const Archive& archive, std::size_t index);

// --- OpenVDB's own files, in reference_io.cc ---

/// Writes a grid through openvdb::io::File: neither flushed to the disk nor verified.
void plain_write(const FloatGrid& grid, rust::Slice<const std::uint8_t> path, std::uint32_t compression);
/// Reads the first float grid of a file through openvdb::io::File, voxels included.
std::unique_ptr<FloatGrid> plain_read(rust::Slice<const std::uint8_t> path);

// --- OpenVDB's own tools, in reference.cc ---

/// A mesh as OpenVDB makes it or takes it.
class RawMesh {
public:
    struct Impl;
    explicit RawMesh(std::unique_ptr<Impl>);
    ~RawMesh();
    std::size_t point_count() const;
    std::size_t triangle_count() const;
    std::size_t quad_count() const;
    void points(rust::Slice<float> out) const;
    void triangles(rust::Slice<std::uint32_t> out) const;
    void quads(rust::Slice<std::uint32_t> out) const;

    std::unique_ptr<Impl> impl;
};

std::unique_ptr<FloatGrid> copy_grid(const FloatGrid& grid);
void filter_mean_curvature(FloatGrid& grid, std::size_t steps, const TrackerOptions& tracker);
/// One step weighted by the values of `mask`, 0 to 1.
void filter_mean_curvature_masked(FloatGrid& grid, const FloatGrid& mask, const TrackerOptions& tracker);
void filter_laplacian(FloatGrid& grid, std::size_t steps, const TrackerOptions& tracker);
void filter_gaussian(FloatGrid& grid, std::int32_t width, const TrackerOptions& tracker);
void filter_mean(FloatGrid& grid, std::int32_t width, const TrackerOptions& tracker);
void filter_median(FloatGrid& grid, std::int32_t width, const TrackerOptions& tracker);
void filter_offset(FloatGrid& grid, float distance, const TrackerOptions& tracker);
void track(FloatGrid& grid, const TrackerOptions& tracker);
void normalize(FloatGrid& grid, const TrackerOptions& tracker);
std::unique_ptr<FloatGrid> csg_union(const FloatGrid& a, const FloatGrid& b);
std::unique_ptr<FloatGrid> csg_intersection(const FloatGrid& a, const FloatGrid& b);
std::unique_ptr<FloatGrid> csg_difference(const FloatGrid& a, const FloatGrid& b);
std::unique_ptr<FloatGrid> level_set_rebuild(const FloatGrid& grid, float iso, float half_width);
std::unique_ptr<FloatGrid> mesh_to_level_set(rust::Slice<const float> points, rust::Slice<const std::uint32_t> triangles,
    rust::Slice<const double> matrix, float half_width, bool renormalize);
std::unique_ptr<RawMesh> volume_to_mesh(const FloatGrid& grid, double iso, double adaptivity);
double level_set_area(const FloatGrid& grid);
double level_set_volume(const FloatGrid& grid);
/// Moves `grid` towards `target` for a time; returns the number of steps.
std::size_t morph(FloatGrid& grid, const FloatGrid& target, float time, bool weno5, std::uint32_t runge_kutta,
    const TrackerOptions& tracker);
/// Fast sweeping: the distance again in the same voxels, and in so many more layers of voxels.
std::unique_ptr<FloatGrid> sdf_to_sdf(const FloatGrid& grid, std::int32_t iterations);
std::unique_ptr<FloatGrid> dilate_sdf(const FloatGrid& grid, std::int32_t voxels, std::int32_t iterations);

} // namespace vdb_edit
