// Shared by the translation units that do see OpenVDB.
#pragma once

#include "bridge.h"
#include "vdb-edit/src/vdb/bridge.rs.h"

#include <openvdb/openvdb.h>

#include <iostream>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace vdb_edit {

using LeafNode = openvdb::FloatTree::LeafNodeType;

constexpr std::size_t kLeafVoxels = 512;
constexpr std::size_t kMaskWords = 8;

inline void require(bool holds, const char* what)
{
    if (!holds) throw std::invalid_argument(what);
}

struct Leaves::Impl {
    virtual ~Impl() = default;
    virtual std::size_t count() const = 0;
    virtual double background() const = 0;
    virtual void origins(rust::Slice<std::int32_t>) const = 0;
    virtual void copy(std::size_t, rust::Slice<float>, rust::Slice<std::uint64_t>) const = 0;
    virtual std::size_t node_count() const = 0;
    virtual void node_origins(rust::Slice<std::int32_t>) const = 0;
    virtual void node_inside(rust::Slice<std::uint64_t>) const = 0;
    virtual void tiles(rust::Vec<Tile>&) const = 0;
    virtual void inactive_tile_range(double&, double&) const = 0;
};

template<typename NodeT>
void write_origins(const std::vector<const NodeT*>& nodes, rust::Slice<std::int32_t> out)
{
    require(out.size() == nodes.size() * 3, "origins: wrong length");
    auto* o = out.data();
    for (const auto* node : nodes) {
        const openvdb::Coord origin = node->origin();
        for (int axis = 0; axis < 3; ++axis) *o++ = origin[axis];
    }
}

/// What a file holds of a grid that is carried over without being decoded, from the compression to the end.
struct Opaque {
    /// Null if the grid is not carried over so.
    std::shared_ptr<const std::string> bytes;
    /// Where in it the values begin.
    std::int64_t values = 0;
};

struct Archive::Impl {
    struct Entry {
        openvdb::GridBase::Ptr grid;
        std::string unique_name;
        std::string instance_of;
        bool half = false;
        std::uint32_t compression = 0;
        std::optional<double> background;
        /// Where only that was wanted of the voxels.
        std::string fingerprint;
        Opaque opaque;
    };

    std::uint32_t file_version = 0;
    openvdb::VersionId library;
    std::string uuid;
    bool has_offsets = false;
    openvdb::MetaMap metadata;
    std::vector<Entry> entries;
};

/// The values of a grid's leaves if they are not in the leaves themselves: in the order in which these were added, which their transient data tell.
using Lent = std::vector<const float*>;

inline const float* values_of(const LeafNode& leaf, const Lent& lent)
{
    return lent.empty() ? leaf.buffer().data() : lent.at(leaf.transientData());
}

struct FloatGrid::Impl {
    openvdb::FloatGrid::Ptr grid;
    std::vector<LeafNode*> leaves; // in the order they were added; owned by the tree
    Lent lent;
};

inline std::unique_ptr<FloatGrid> wrap(openvdb::FloatGrid::Ptr grid)
{
    auto impl = std::make_unique<FloatGrid::Impl>();
    impl->grid = std::move(grid);
    return std::make_unique<FloatGrid>(std::move(impl));
}

/// An empty float grid. Made through the registry: FloatGrid::create() would instantiate every virtual function of the
/// tree here, which costs 12 to 15 s of compilation.
openvdb::FloatGrid::Ptr make_float_grid(double background);

/// A grid of vectors whose components are these grids of one set of leaves, with the name, metadata and transform of the first.
openvdb::GridBase::Ptr vectors_of(const FloatGrid& x, const FloatGrid& y, const FloatGrid& z);

/// Writes a leaf as the stream's compression says.
void write_leaf(std::ostream& stream, const LeafNode& leaf, const float* values, bool half);

/// 128 bits, as hexadecimal digits, of a grid of any type; grids stored as half compare as rounded. Of a grid of floats hashes of its leaves stand
/// for the values.
std::string fingerprint(const openvdb::GridBase& grid, const Lent& lent = {});

inline bool is_points(const openvdb::GridBase& grid)
{
    const std::string type = grid.valueType();
    return type == "ptdataidx32" || type == "ptidx32";
}

/// 128 bits of bytes, as hexadecimal digits.
std::string fingerprint(const std::string& bytes);

/// Reads the voxels of a grid whose structure was read, and keeps nothing of them but the fingerprint.
std::string read_fingerprint(openvdb::FloatGrid& grid, std::istream& stream);

/// The linear transform of a row-major 4x4 matrix that acts on columns.
openvdb::math::Transform::Ptr linear_transform(rust::Slice<const double> matrix);

/// While one exists, what OpenVDB prints goes to the log that `take_log` returns. Debian's library logs warnings through
/// log4cplus to std::cout, which would break programs whose standard output is data; its headers log to std::cerr.
class QuietOutput {
public:
    QuietOutput();
    ~QuietOutput();
    QuietOutput(const QuietOutput&) = delete;
    QuietOutput& operator=(const QuietOutput&) = delete;
};

} // namespace vdb_edit
