// Files as any program writes and reads them through OpenVDB's own interface: what ours are timed against.

#include "internal.h"
#include "streams.h"

#include <openvdb/io/File.h>

#include <stdexcept>

namespace vdb_edit {

void plain_write(const FloatGrid& grid, rust::Slice<const std::uint8_t> path, std::uint32_t compression)
{
    const QuietOutput scope;
    openvdb::io::File file(path_string(path));
    file.setCompression(compression);
    file.write(openvdb::GridCPtrVec{grid.impl->grid});
    file.close();
}

std::unique_ptr<FloatGrid> plain_read(rust::Slice<const std::uint8_t> path)
{
    const QuietOutput scope;
    initialize();
    openvdb::io::File file(path_string(path));
    // Not when voxels are first asked for: now.
    file.open(/*delayLoad=*/false);
    const openvdb::GridPtrVecPtr grids = file.getGrids();
    for (const auto& grid : *grids) {
        if (auto found = openvdb::gridPtrCast<openvdb::FloatGrid>(grid)) return wrap(std::move(found));
    }
    throw std::runtime_error("the file holds no float grid");
}

} // namespace vdb_edit
