// Reading whole files, every short read an error. Compiles in 4 s.
//
// OpenVDB's own File and Stream leave the stream's exceptions off: a truncated file that is not blosc-compressed then
// loads without any error, its missing voxels zero, and a full disk goes unnoticed. So the streams are ours, with
// exceptions on, and OpenVDB's archive code works on them.

#include "internal.h"
#include "streams.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#ifdef __GLIBC__
#include <malloc.h>
#endif

#include <tbb/global_control.h>

#include <map>
#include <stdexcept>

namespace vdb_edit {

namespace vio = openvdb::io;

std::unique_ptr<Leaves> leaves_of(const openvdb::GridBase::ConstPtr& grid);
std::unique_ptr<Leaves> component_of(const openvdb::GridBase::ConstPtr& grid, std::uint32_t component);

// --- the library ---

namespace {

/// Keeps what is printed to it, up to a limit, from any thread.
class LogBuffer final : public std::streambuf {
public:
    std::string take()
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        return std::exchange(text_, {});
    }

protected:
    int_type overflow(int_type c) override
    {
        if (c != traits_type::eof()) {
            const char byte = traits_type::to_char_type(c);
            xsputn(&byte, 1);
        }
        return traits_type::not_eof(c);
    }

    std::streamsize xsputn(const char* s, std::streamsize n) override
    {
        constexpr std::size_t kLimit = 1 << 16;
        const std::lock_guard<std::mutex> lock(mutex_);
        if (text_.size() < kLimit) text_.append(s, static_cast<std::size_t>(n));
        return n;
    }

private:
    std::mutex mutex_;
    std::string text_;
};

struct Quiet {
    std::mutex mutex;
    std::size_t depth = 0;
    std::streambuf* output = nullptr;
    std::streambuf* error = nullptr;
    LogBuffer log;
};

Quiet& quiet()
{
    static Quiet q;
    return q;
}

} // namespace

QuietOutput::QuietOutput()
{
    Quiet& q = quiet();
    const std::lock_guard<std::mutex> lock(q.mutex);
    if (q.depth++ > 0) return;
    q.output = std::cout.rdbuf(&q.log);
    q.error = std::cerr.rdbuf(&q.log);
}

QuietOutput::~QuietOutput()
{
    Quiet& q = quiet();
    const std::lock_guard<std::mutex> lock(q.mutex);
    if (--q.depth > 0) return;
    std::cout.rdbuf(q.output);
    std::cerr.rdbuf(q.error);
}

rust::String take_log() { return rust::String::lossy(quiet().log.take()); }

void initialize()
{
    const QuietOutput scope;
    openvdb::initialize();
}

rust::String library_version() { return openvdb::getLibraryVersionString(); }
std::uint32_t newest_file_version() { return openvdb::OPENVDB_FILE_VERSION; }

void set_threads(std::size_t threads)
{
    using Control = tbb::global_control;
    static std::mutex mutex;
    static std::unique_ptr<Control> control;
    const std::lock_guard<std::mutex> lock(mutex);
    control.reset();
    if (threads > 0) control = std::make_unique<Control>(Control::max_allowed_parallelism, threads);
}

// --- reading ---

Archive::Archive(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
Archive::~Archive() = default;

namespace {

template<typename GridT>
std::optional<double> background_of(const openvdb::GridBase& grid)
{
    const auto* typed = dynamic_cast<const GridT*>(&grid);
    if (!typed) return std::nullopt;
    return static_cast<double>(typed->background());
}

/// What is kept of a file's grids.
enum class Wanted { headers, voxels, fingerprints };

/// OpenVDB's archive code on a stream of ours.
class Reader final : public vio::Archive {
public:
    Reader(std::istream& stream, std::int64_t size) : is_(stream), size_(size)
    {
        is_.exceptions(std::ios_base::badbit | std::ios_base::failbit | std::ios_base::eofbit);
    }

    std::unique_ptr<vdb_edit::Archive::Impl> read(Wanted wanted)
    {
        auto out = std::make_unique<vdb_edit::Archive::Impl>();
        std::string where = "the header";
        try {
            readHeader(is_);
            vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
            vio::setStreamMetadataPtr(is_, tag, /*transfer=*/false);
            setFormatVersion(is_);
            setLibraryVersion(is_);
            setDataCompression(is_);
            out->file_version = fileVersion();
            out->library = libraryVersion();
            out->uuid = getUniqueTag();
            out->has_offsets = inputHasGridOffsets();
            where = "the file's metadata";
            out->metadata.readMeta(is_);
            where = "the number of grids";
            const std::int32_t count = readGridCount(is_);
            if (count < 0) throw std::runtime_error("a negative number of grids");

            NamedGridMap by_name;
            std::vector<vio::GridDescriptor> descriptors;
            for (std::int32_t i = 0; i < count; ++i) {
                where = "the description of grid " + std::to_string(i + 1) + " of " + std::to_string(count);
                vio::GridDescriptor descriptor;
                const openvdb::GridBase::Ptr grid = descriptor.read(is_);
                where = "grid `" + vio::GridDescriptor::nameAsString(descriptor.uniqueName()) + "`";
                out->entries.push_back(read_grid(grid, descriptor, wanted));
                by_name[descriptor.uniqueName()] = grid;
                descriptors.push_back(descriptor);
            }
            if (wanted == Wanted::voxels) {
                for (const auto& descriptor : descriptors) connectInstance(descriptor, by_name);
                share_opaque(out->entries);
            }
            if (position() != size_) {
                throw std::runtime_error(std::to_string(size_ - position()) + " bytes follow the last grid");
            }
        } catch (const std::ios_base::failure&) {
            throw std::runtime_error("truncated: the file ends in the middle of " + where);
        } catch (const std::exception& e) {
            throw std::runtime_error("damaged at " + where + ": " + e.what());
        }
        return out;
    }

private:
    std::int64_t position() { return static_cast<std::int64_t>(is_.tellg()); }

    vdb_edit::Archive::Impl::Entry read_grid(
        const openvdb::GridBase::Ptr& grid, const vio::GridDescriptor& descriptor, Wanted wanted)
    {
        vdb_edit::Archive::Impl::Entry entry;
        entry.grid = grid;
        entry.unique_name = descriptor.uniqueName();
        entry.instance_of = descriptor.instanceParentName();
        entry.half = descriptor.saveFloatAsHalf();

        const std::int64_t end = descriptor.getEndPos();
        if (inputHasGridOffsets()) {
            if (descriptor.getGridPos() != position()) throw std::runtime_error("it does not begin where the file says");
            if (end > size_) throw std::ios_base::failure("recorded end");
            if (end < position()) throw std::runtime_error("it ends before it begins");
        }
        if (fileVersion() >= openvdb::OPENVDB_FILE_VERSION_NODE_MASK_COMPRESSION) {
            const auto begin = is_.tellg();
            is_.read(reinterpret_cast<char*>(&entry.compression), sizeof(entry.compression));
            is_.seekg(begin);
        } else {
            entry.compression = compression();
        }

        // Before version 216 the transform is stored after the tree's structure.
        if (wanted == Wanted::headers && inputHasGridOffsets() && fileVersion() >= openvdb::OPENVDB_FILE_VERSION_GRID_INSTANCING) {
            readGridCompression(is_);
            grid->readMeta(is_);
            grid->readTransform(is_);
            if (!descriptor.isInstance()) read_background(*grid, entry);
            is_.seekg(end);
        } else if (is_opaque(*grid, descriptor)) {
            entry.opaque = read_opaque(descriptor);
            is_.seekg(descriptor.getGridPos());
            readGridCompression(is_);
            grid->readMeta(is_);
            grid->readTransform(is_);
            if (position() > descriptor.getBlockPos()) throw std::runtime_error("its values begin before it is described");
            is_.seekg(end);
            if (wanted == Wanted::fingerprints) {
                entry.fingerprint = fingerprint(*entry.opaque.bytes);
                entry.opaque = {};
            }
        } else if (wanted == Wanted::fingerprints && is_floats(*grid, descriptor)) {
            readGridCompression(is_);
            grid->readMeta(is_);
            grid->readTransform(is_);
            grid->readTopology(is_);
            entry.fingerprint = read_fingerprint(static_cast<openvdb::FloatGrid&>(*grid), is_);
            check_end(end);
            vio::setGridBackgroundValuePtr(is_, nullptr);
            grid->newTree();
        } else {
            readGrid(grid, descriptor, is_);
            entry.background = background_of<openvdb::FloatGrid>(*grid);
            if (!entry.background) entry.background = background_of<openvdb::DoubleGrid>(*grid);
            check_end(end);
            if (wanted == Wanted::fingerprints && !descriptor.isInstance()) entry.fingerprint = fingerprint(*grid);
            if (wanted != Wanted::voxels) grid->newTree();
        }
        return entry;
    }

    /// Whether points come next that can be carried over as they are: OpenVDB ends the process where an assertion about their chunks fails.
    bool is_opaque(const openvdb::GridBase& grid, const vio::GridDescriptor& descriptor) const
    {
        return is_points(grid) && !descriptor.isInstance() && inputHasGridOffsets() &&
            fileVersion() == openvdb::OPENVDB_FILE_VERSION;
    }

    /// Gives grids that share the tree of another what that one is carried over by.
    static void share_opaque(std::vector<vdb_edit::Archive::Impl::Entry>& entries)
    {
        std::map<const openvdb::TreeBase*, Opaque> known;
        for (const auto& entry : entries) {
            if (entry.opaque.bytes) known[&entry.grid->baseTree()] = entry.opaque;
        }
        for (auto& entry : entries) {
            const auto found = known.find(&entry.grid->baseTree());
            if (found != known.end()) entry.opaque = found->second;
        }
    }

    Opaque read_opaque(const vio::GridDescriptor& descriptor)
    {
        const std::int64_t begin = descriptor.getGridPos(), values = descriptor.getBlockPos(), end = descriptor.getEndPos();
        if (values < begin || values > end) throw std::runtime_error("its values begin outside of it");
        auto bytes = std::make_shared<std::string>(static_cast<std::size_t>(end - begin), '\0');
        is_.read(bytes->data(), end - begin);
        return {std::move(bytes), values - begin};
    }

    /// Whether a grid of floats comes next, with a tree of its own.
    bool is_floats(const openvdb::GridBase& grid, const vio::GridDescriptor& descriptor) const
    {
        return grid.isType<openvdb::FloatGrid>() && !descriptor.saveFloatAsHalf() && !descriptor.isInstance() &&
            fileVersion() >= openvdb::OPENVDB_FILE_VERSION_GRID_INSTANCING;
    }

    void check_end(std::int64_t end)
    {
        if (!inputHasGridOffsets() || position() == end) return;
        throw std::runtime_error("it ends at byte " + std::to_string(position()) + ", the file says " + std::to_string(end));
    }

    /// The tree begins with a count of buffers and the background.
    void read_background(const openvdb::GridBase& grid, vdb_edit::Archive::Impl::Entry& entry)
    {
        std::int32_t buffers = 0;
        is_.read(reinterpret_cast<char*>(&buffers), sizeof(buffers));
        if (grid.valueType() == "float") {
            float value = 0;
            is_.read(reinterpret_cast<char*>(&value), sizeof(value));
            entry.background = static_cast<double>(value);
        } else if (grid.valueType() == "double") {
            double value = 0;
            is_.read(reinterpret_cast<char*>(&value), sizeof(value));
            entry.background = value;
        }
    }

    std::istream& is_;
    std::int64_t size_;
};

std::unique_ptr<Archive> read_stream(std::streambuf& buffer, Wanted wanted)
{
    const QuietOutput scope;
    initialize();
    std::istream stream(&buffer);
    const auto size = buffer.pubseekoff(0, std::ios_base::end, std::ios_base::in);
    buffer.pubseekpos(0, std::ios_base::in);
    return std::make_unique<Archive>(Reader(stream, static_cast<std::int64_t>(size)).read(wanted));
}

void list_metadata(const openvdb::MetaMap& map, rust::Vec<MetaEntry>& out)
{
    for (auto it = map.beginMeta(); it != map.endMeta(); ++it) {
        if (!it->second) continue;
        out.push_back(MetaEntry{rust::String::lossy(it->first), rust::String::lossy(it->second->typeName()),
            rust::String::lossy(it->second->str())});
    }
}

} // namespace

namespace {

std::unique_ptr<Archive> read_file(rust::Slice<const std::uint8_t> path, Wanted wanted)
{
    FileBuffer file;
    errno = 0;
    if (!file.open(path_string(path), std::ios_base::in | std::ios_base::binary)) throw_errno();
    return read_stream(file, wanted);
}

std::unique_ptr<Archive> read_memory(rust::Slice<const std::uint8_t> bytes, Wanted wanted)
{
    MemoryBuffer memory(bytes);
    return read_stream(memory, wanted);
}

} // namespace

std::unique_ptr<Archive> read_path(rust::Slice<const std::uint8_t> path, bool headers_only)
{
    return read_file(path, headers_only ? Wanted::headers : Wanted::voxels);
}

std::unique_ptr<Archive> read_bytes(rust::Slice<const std::uint8_t> bytes, bool headers_only)
{
    return read_memory(bytes, headers_only ? Wanted::headers : Wanted::voxels);
}

std::unique_ptr<Archive> fingerprint_path(rust::Slice<const std::uint8_t> path)
{
    return read_file(path, Wanted::fingerprints);
}

std::unique_ptr<Archive> fingerprint_bytes(rust::Slice<const std::uint8_t> bytes)
{
    return read_memory(bytes, Wanted::fingerprints);
}

void release_voxels(Archive& archive, std::size_t index)
{
    archive.impl->entries.at(index).grid->newTree();
    trim_heap();
}

void trim_heap()
{
#ifdef __GLIBC__
    malloc_trim(0);
#endif
}

ArchiveHeader Archive::header() const
{
    ArchiveHeader out{impl->file_version, impl->library.first, impl->library.second, rust::String::lossy(impl->uuid),
        impl->has_offsets, {}};
    list_metadata(impl->metadata, out.metadata);
    return out;
}

std::size_t Archive::grid_count() const { return impl->entries.size(); }

GridHeader Archive::grid_header(std::size_t index) const
{
    const Impl::Entry& entry = impl->entries.at(index);
    const openvdb::GridBase& grid = *entry.grid;
    GridHeader out;
    // The name in the metadata; files older than its metadata have it in the descriptor alone.
    const std::string name = grid.getName();
    out.name = rust::String::lossy(name.empty() ? vio::GridDescriptor::stripSuffix(entry.unique_name) : name);
    out.unique_name = rust::String::lossy(vio::GridDescriptor::nameAsString(entry.unique_name));
    out.instance_of = rust::String::lossy(vio::GridDescriptor::nameAsString(entry.instance_of));
    out.type_name = rust::String::lossy(grid.type());
    out.value_type = rust::String::lossy(grid.valueType());
    out.grid_class = rust::String::lossy(openvdb::GridBase::gridClassToString(grid.getGridClass()));
    out.half = entry.half;
    out.compression = entry.compression;
    out.background = entry.background.value_or(std::numeric_limits<double>::quiet_NaN());
    const openvdb::math::Transform& transform = grid.constTransform();
    out.map_type = rust::String::lossy(transform.mapType());
    if (transform.isLinear()) {
        const openvdb::Mat4d m = transform.baseMap()->getAffineMap()->getMat4();
        for (int r = 0; r < 4; ++r) {
            for (int c = 0; c < 4; ++c) out.affine.push_back(m(c, r));
        }
    }
    const openvdb::Vec3d voxel = grid.voxelSize();
    out.voxel_size = {voxel[0], voxel[1], voxel[2]};
    list_metadata(grid, out.metadata);
    return out;
}

std::unique_ptr<Leaves> archive_leaves(const Archive& archive, std::size_t index)
{
    return leaves_of(archive.impl->entries.at(index).grid);
}

std::unique_ptr<Leaves> archive_component(const Archive& archive, std::size_t index, std::uint32_t component)
{
    return component_of(archive.impl->entries.at(index).grid, component);
}

rust::String grid_fingerprint(const Archive& archive, std::size_t index)
{
    const QuietOutput scope;
    const auto& entry = archive.impl->entries.at(index);
    return entry.opaque.bytes ? fingerprint(*entry.opaque.bytes) : fingerprint(*entry.grid);
}

} // namespace vdb_edit
