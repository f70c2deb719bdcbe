// Fingerprints: what a grid that was read back is compared with the one that was written by. Compiles in 3 s.

#include "internal.h"
#include "streams.h"

#include <openvdb/io/io.h>

#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <array>

namespace vdb_edit {

namespace vio = openvdb::io;

namespace {

using LeafHash = std::array<std::uint64_t, 2>;

/// A hash of the values of a leaf and its place in the tree's order.
LeafHash hash_leaf(const float* values, std::size_t place)
{
    Lanes lanes;
    lanes.absorb(reinterpret_cast<const char*>(values), LeafNode::SIZE * sizeof(float));
    return lanes.digest(place);
}

/// A hash of the structure of a grid, as OpenVDB would store it without compression, and of what `write_values` writes.
template<typename WriteValues>
std::string hash_grid(const openvdb::GridBase& grid, WriteValues write_values)
{
    vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
    HashBuffer hash;
    std::ostream stream(&hash);
    vio::setStreamMetadataPtr(stream, tag, /*transfer=*/false);
    grid.writeTopology(stream);
    write_values(stream);
    return hash.digest();
}

std::string hash_floats(const openvdb::FloatGrid& grid, const std::vector<LeafHash>& hashes)
{
    return hash_grid(grid, [&](std::ostream& stream) {
        const auto bytes = hashes.size() * sizeof(LeafHash);
        stream.write(reinterpret_cast<const char*>(hashes.data()), static_cast<std::streamsize>(bytes));
    });
}

} // namespace

std::string fingerprint(const openvdb::GridBase& grid, const Lent& lent)
{
    const auto* floats = dynamic_cast<const openvdb::FloatGrid*>(&grid);
    if (!floats) return hash_grid(grid, [&](std::ostream& stream) { grid.writeBuffers(stream); });
    std::vector<const LeafNode*> leaves;
    floats->tree().getNodes(leaves);
    if (grid.saveFloatAsHalf()) {
        return hash_grid(grid, [&](std::ostream& stream) {
            for (const LeafNode* leaf : leaves) write_leaf(stream, *leaf, values_of(*leaf, lent), /*half=*/true);
        });
    }
    std::vector<LeafHash> hashes(leaves.size());
    tbb::parallel_for(tbb::blocked_range<std::size_t>(0, leaves.size(), 64), [&](const auto& range) {
        for (std::size_t i = range.begin(); i != range.end(); ++i) hashes[i] = hash_leaf(values_of(*leaves[i], lent), i);
    });
    return hash_floats(*floats, hashes);
}

std::string fingerprint(const std::string& bytes)
{
    HashBuffer hash;
    hash.sputn(bytes.data(), static_cast<std::streamsize>(bytes.size()));
    return hash.digest();
}

std::string read_fingerprint(openvdb::FloatGrid& grid, std::istream& is)
{
    std::vector<LeafNode*> leaves;
    grid.tree().getNodes(leaves);
    std::vector<LeafHash> hashes;
    hashes.reserve(leaves.size());
    // One buffer for all leaves in turn.
    LeafNode::Buffer buffer;
    for (LeafNode* leaf : leaves) {
        leaf->swap(buffer);
        leaf->readBuffers(is);
        hashes.push_back(hash_leaf(leaf->buffer().data(), hashes.size()));
        leaf->swap(buffer);
    }
    return hash_floats(grid, hashes);
}

} // namespace vdb_edit
