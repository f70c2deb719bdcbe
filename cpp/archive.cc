// Whole files: reading with every short read an error, writing with every failed write an error, comparing.
// Compiles in 4 s.
//
// OpenVDB's own File and Stream leave the stream's exceptions off: a truncated file that is not blosc-compressed then
// loads without any error, its missing voxels zero, and a full disk goes unnoticed. So the streams are ours, with
// exceptions on, and OpenVDB's archive code works on them.

#include "internal.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#ifdef __GLIBC__
#include <malloc.h>
#endif

#include <tbb/blocked_range.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <iomanip>
#include <map>
#include <optional>
#include <sstream>
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
    };

    std::uint32_t file_version = 0;
    openvdb::VersionId library;
    std::string uuid;
    bool has_offsets = false;
    openvdb::MetaMap metadata;
    std::vector<Entry> entries;
};

Archive::Archive(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
Archive::~Archive() = default;

namespace {

/// A file with a buffer of many leaves: the library's own takes a call to the system for every few of them.
class FileBuffer final : public std::filebuf {
public:
    FileBuffer() { pubsetbuf(buffer_.get(), kBytes); }

    // Closed while the buffer is still there. Whoever writes closes before, and learns of failures.
    ~FileBuffer() override
    {
        try {
            close();
        } catch (...) {
        }
    }

private:
    static constexpr std::streamsize kBytes = 1 << 20;
    std::unique_ptr<char[]> buffer_{new char[kBytes]};
};

/// Bytes in memory as a seekable input.
class MemoryBuffer final : public std::streambuf {
public:
    explicit MemoryBuffer(rust::Slice<const std::uint8_t> bytes)
    {
        // The interface wants mutable characters; an input buffer never writes to them.
        auto* begin = const_cast<char*>(reinterpret_cast<const char*>(bytes.data()));
        setg(begin, begin, begin + bytes.size());
    }

protected:
    pos_type seekoff(off_type offset, std::ios_base::seekdir dir, std::ios_base::openmode) override
    {
        const off_type base = dir == std::ios_base::beg ? 0 : dir == std::ios_base::cur ? gptr() - eback() : egptr() - eback();
        return seekpos(base + offset, std::ios_base::in);
    }

    pos_type seekpos(pos_type pos, std::ios_base::openmode) override
    {
        const off_type at = pos;
        if (at < 0 || at > egptr() - eback()) return pos_type(off_type(-1));
        setg(eback(), eback() + at, egptr());
        return pos;
    }
};

/// 128 bits that depend on all bytes taken in and their order.
class Lanes {
public:
    /// Takes in `n` bytes, a multiple of 32.
    void absorb(const char* bytes, std::size_t n)
    {
        for (std::size_t at = 0; at < n; at += 32) {
            std::array<std::uint64_t, 4> words;
            std::memcpy(words.data(), bytes + at, 32);
            for (std::size_t lane = 0; lane < 4; ++lane) lanes_[lane] = mix(lanes_[lane] + words[lane]) + lane;
        }
    }

    std::array<std::uint64_t, 2> digest(std::uint64_t salt) const
    {
        std::uint64_t low = salt, high = ~salt;
        for (const std::uint64_t lane : lanes_) {
            low = mix(low ^ lane);
            high = mix(high + lane);
        }
        return {low, high};
    }

private:
    static std::uint64_t mix(std::uint64_t x)
    {
        x = (x ^ (x >> 32)) * 0x9fb21c651e98df25;
        return x ^ (x >> 28);
    }

    std::array<std::uint64_t, 4> lanes_{1, 2, 3, 4};
};

/// Hashes what is written to it.
class HashBuffer final : public std::streambuf {
public:
    HashBuffer() { setp(block_.data(), block_.data() + block_.size()); }

    /// 32 hexadecimal digits.
    std::string digest()
    {
        absorb();
        const auto [low, high] = lanes_.digest(length_);
        std::ostringstream text;
        text << std::hex << std::setfill('0') << std::setw(16) << high << std::setw(16) << low;
        return text.str();
    }

protected:
    int_type overflow(int_type c) override
    {
        absorb();
        if (c != traits_type::eof()) sputc(traits_type::to_char_type(c));
        return traits_type::not_eof(c);
    }

    /// Writers ask where they are, and never go elsewhere without offsets.
    pos_type seekoff(off_type offset, std::ios_base::seekdir dir, std::ios_base::openmode) override
    {
        if (offset != 0 || dir != std::ios_base::cur) return pos_type(off_type(-1));
        return pos_type(static_cast<off_type>(length_) + (pptr() - pbase()));
    }

private:
    void absorb()
    {
        const std::size_t n = static_cast<std::size_t>(pptr() - pbase());
        // The rest of the last word is zero; the length tells blocks apart that differ only there.
        const std::size_t padded = (n + 31) / 32 * 32;
        std::memset(block_.data() + n, 0, padded - n);
        lanes_.absorb(block_.data(), padded);
        length_ += n;
        setp(block_.data(), block_.data() + block_.size());
    }

    std::array<char, 1 << 15> block_;
    Lanes lanes_;
    std::uint64_t length_ = 0;
};

using LeafHash = std::array<std::uint64_t, 2>;

/// A hash of the values of a leaf and its place in the tree's order.
LeafHash hash_leaf(const LeafNode& leaf, std::size_t place)
{
    Lanes lanes;
    lanes.absorb(reinterpret_cast<const char*>(leaf.buffer().data()), LeafNode::SIZE * sizeof(float));
    return lanes.digest(place);
}

/// The grid as one of floats that are stored as such: its values are hashed leaf by leaf.
const openvdb::FloatGrid* as_floats(const openvdb::GridBase& grid)
{
    return grid.saveFloatAsHalf() ? nullptr : dynamic_cast<const openvdb::FloatGrid*>(&grid);
}

/// A hash of a grid of any type, as OpenVDB would store it without compression; grids stored as half compare as rounded.
/// Of a grid of floats the structure is, and the hashes of its leaves stand for the values.
std::string fingerprint(const openvdb::GridBase& grid, const std::vector<LeafHash>& hashes)
{
    vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
    HashBuffer hash;
    std::ostream stream(&hash);
    vio::setStreamMetadataPtr(stream, tag, /*transfer=*/false);
    grid.writeTopology(stream);
    if (as_floats(grid)) {
        const auto bytes = hashes.size() * sizeof(LeafHash);
        stream.write(reinterpret_cast<const char*>(hashes.data()), static_cast<std::streamsize>(bytes));
    } else {
        grid.writeBuffers(stream);
    }
    return hash.digest();
}

/// The fingerprint of a grid in memory.
std::string fingerprint(const openvdb::GridBase& grid)
{
    std::vector<LeafHash> hashes;
    if (const auto* floats = as_floats(grid)) {
        std::vector<const LeafNode*> leaves;
        floats->tree().getNodes(leaves);
        hashes.resize(leaves.size());
        tbb::parallel_for(tbb::blocked_range<std::size_t>(0, leaves.size(), 64), [&](const auto& range) {
            for (std::size_t i = range.begin(); i != range.end(); ++i) hashes[i] = hash_leaf(*leaves[i], i);
        });
    }
    return fingerprint(grid, hashes);
}

/// Reads the voxels of a grid whose structure was read, and keeps nothing of them but the fingerprint.
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
        hashes.push_back(hash_leaf(*leaf, hashes.size()));
        leaf->swap(buffer);
    }
    return fingerprint(grid, hashes);
}

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

std::string path_string(rust::Slice<const std::uint8_t> path)
{
    return {reinterpret_cast<const char*>(path.data()), path.size()};
}

[[noreturn]] void throw_errno() { throw std::runtime_error(errno ? std::strerror(errno) : "the device refused it"); }

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
#ifdef __GLIBC__
    // Millions of small blocks stay with the C library otherwise, in the pool of a thread that does not need them again.
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

// --- comparing ---

namespace {

/// Facts about the content that OpenVDB recomputes at every write.
bool is_statistic(const std::string& name) { return name.rfind("file_", 0) == 0; }

/// The first item in which `a` and `b` differ, empty when they agree.
std::string metadata_difference(const openvdb::MetaMap& a, const openvdb::MetaMap& b)
{
    const auto missing = [](const openvdb::MetaMap& from, const openvdb::MetaMap& in) -> std::string {
        for (auto it = from.beginMeta(); it != from.endMeta(); ++it) {
            if (!it->second || is_statistic(it->first)) continue;
            const openvdb::Metadata::ConstPtr other = in[it->first];
            if (!other || !(*other == *it->second)) return it->first;
        }
        return {};
    };
    const std::string first = missing(a, b);
    return first.empty() ? missing(b, a) : first;
}

/// Equal to the last bit where linear; OpenVDB's own comparison has a tolerance.
bool same_transform(const openvdb::math::Transform& a, const openvdb::math::Transform& b)
{
    if (!a.isLinear() || !b.isLinear()) return a == b;
    const openvdb::Mat4d m = a.baseMap()->getAffineMap()->getMat4(), n = b.baseMap()->getAffineMap()->getMat4();
    return std::equal(m.asPointer(), m.asPointer() + 16, n.asPointer());
}

} // namespace

rust::String grid_fingerprint(const Archive& archive, std::size_t index)
{
    const QuietOutput scope;
    return fingerprint(*archive.impl->entries.at(index).grid);
}

// --- writing ---

struct Output::Impl {
    struct Sealed {
        std::string type, name, digest;
        openvdb::MetaMap metadata;
        openvdb::math::Transform::ConstPtr transform;
    };

    openvdb::GridCPtrVec grids;
    openvdb::MetaMap metadata;
    std::vector<Sealed> sealed;
};

namespace {

/// Passes a file on and takes its bytes in, all but its identity: OpenVDB makes that up anew for every file. One that follows from
/// the content makes equal results equal files.
class IdentifiedBuffer final : public std::streambuf {
public:
    explicit IdentifiedBuffer(std::streambuf& file) : file_(file) {}

    /// Writes the identity in place of `made_up`. If that is not where this version of the format has it, it stays.
    void identify(const std::string& made_up)
    {
        if (made_up.size() != kLength || made_up != seen_) return;
        // A version 8 UUID (RFC 9562): digits of a vendor's own.
        std::string id = hash_.digest();
        id[12] = id[16] = '8';
        for (const std::size_t at : {8, 13, 18, 23}) id.insert(at, 1, '-');
        const auto end = file_.pubseekoff(0, std::ios_base::cur, std::ios_base::out);
        const bool written = file_.pubseekpos(kPlace, std::ios_base::out) == pos_type(kPlace) &&
            file_.sputn(id.data(), kLength) == kLength && file_.pubseekpos(end, std::ios_base::out) == end;
        if (!written) throw std::ios_base::failure("the identity of the file");
    }

protected:
    int_type overflow(int_type c) override
    {
        const char byte = traits_type::to_char_type(c);
        return !traits_type::eq_int_type(c, traits_type::eof()) && xsputn(&byte, 1) == 1 ? c : traits_type::eof();
    }

    std::streamsize xsputn(const char* bytes, std::streamsize n) override
    {
        // The first bytes are written in order.
        for (std::streamsize i = 0; i < n && at_ + i < kPlace + kLength; ++i) {
            if (at_ + i >= kPlace) seen_.push_back(bytes[i]);
        }
        const std::streamsize known = std::clamp<std::streamsize>(kPlace + kLength - at_, 0, n);
        hash_.sputn(bytes + known, n - known);
        at_ += n;
        return file_.sputn(bytes, n);
    }

    pos_type seekoff(off_type offset, std::ios_base::seekdir dir, std::ios_base::openmode mode) override
    {
        return at(file_.pubseekoff(offset, dir, mode));
    }

    pos_type seekpos(pos_type pos, std::ios_base::openmode mode) override { return at(file_.pubseekpos(pos, mode)); }

    int sync() override { return file_.pubsync(); }

private:
    pos_type at(pos_type pos)
    {
        if (pos != pos_type(off_type(-1))) at_ = static_cast<std::streamoff>(pos);
        return pos;
    }

    /// After the magic number, three versions and the flag of offsets.
    static constexpr std::streamoff kPlace = 21, kLength = 36;
    std::streambuf& file_;
    std::streamoff at_ = 0;
    std::string seen_;
    HashBuffer hash_;
};

class Writer final : public vio::Archive {
public:
    void write_to(std::streambuf& buffer, const Output::Impl& content, std::uint32_t compression)
    {
        const QuietOutput scope;
        IdentifiedBuffer identified(buffer);
        std::ostream stream(&identified);
        stream.exceptions(std::ios_base::badbit | std::ios_base::failbit);
        setCompression(compression);
        vio::Archive::write(stream, content.grids, /*seekable=*/true, content.metadata);
        stream.flush();
        identified.identify(getUniqueTag());
    }
};

} // namespace

Output::Output(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
Output::~Output() = default;

std::unique_ptr<Output> new_output()
{
    initialize();
    return std::make_unique<Output>(std::make_unique<Output::Impl>());
}

void Output::carry_metadata(const Archive& archive) { impl->metadata = archive.impl->metadata; }

void Output::carry_grid(const Archive& archive, std::size_t index)
{
    impl->grids.push_back(archive.impl->entries.at(index).grid);
}

void Output::add_grid(std::unique_ptr<FloatGrid> grid) { impl->grids.push_back(grid->impl->grid); }

void FloatGrid::carry(const Archive& archive, std::size_t index, bool with_transform)
{
    openvdb::GridBase& source = *archive.impl->entries.at(index).grid;
    for (auto it = source.beginMeta(); it != source.endMeta(); ++it) {
        if (it->second && !is_statistic(it->first)) impl->grid->insertMeta(it->first, *it->second);
    }
    impl->grid->setGridClass(openvdb::GRID_LEVEL_SET);
    // Shared, and changed by nobody: OpenVDB's copy of a transform with a large translation is off in the last digits.
    if (with_transform) impl->grid->setTransform(source.transformPtr());
}

void Output::write_path(rust::Slice<const std::uint8_t> path, std::uint32_t compression)
{
    FileBuffer file;
    errno = 0;
    if (!file.open(path_string(path), std::ios_base::out | std::ios_base::trunc | std::ios_base::binary)) throw_errno();
    try {
        Writer().write_to(file, *impl, compression);
    } catch (const std::ios_base::failure&) {
        throw_errno();
    }
    if (!file.close()) throw_errno();
}

std::unique_ptr<std::string> Output::write_bytes(std::uint32_t compression)
{
    std::stringbuf buffer(std::ios_base::in | std::ios_base::out | std::ios_base::binary);
    Writer().write_to(buffer, *impl, compression);
    return std::make_unique<std::string>(buffer.str());
}

void Output::seal()
{
    const QuietOutput scope;
    for (const auto& grid : impl->grids) {
        impl->sealed.push_back(
            {grid->type(), grid->getName(), fingerprint(*grid), *grid, grid->constTransformPtr()});
    }
    impl->grids.clear();
}

rust::String Output::verify(const Archive& archive) const
{
    const QuietOutput scope;
    const auto& entries = archive.impl->entries;
    if (entries.size() != impl->sealed.size()) return "it holds another number of grids";
    const std::string file_item = metadata_difference(impl->metadata, archive.impl->metadata);
    if (!file_item.empty()) return rust::String::lossy("the file's metadata `" + file_item + "` differs");
    // Another name for the tree of a grid before it; that one was read once.
    const auto digest_of = [&](std::size_t i) {
        for (const auto& parent : entries) {
            if (!entries[i].instance_of.empty() && parent.unique_name == entries[i].instance_of) return parent.fingerprint;
        }
        return entries[i].fingerprint;
    };
    for (std::size_t i = 0; i < entries.size(); ++i) {
        const Impl::Sealed& wanted = impl->sealed[i];
        const openvdb::GridBase& found = *entries[i].grid;
        const auto differs = [&](const std::string& what) {
            return rust::String::lossy("grid `" + wanted.name + "`: its " + what + " differs");
        };
        if (found.type() != wanted.type) return differs("type");
        if (found.getName() != wanted.name) return differs("name");
        if (!same_transform(found.constTransform(), *wanted.transform)) return differs("transform");
        const std::string item = metadata_difference(wanted.metadata, found);
        if (!item.empty()) return differs("metadata `" + item + "`");
        if (digest_of(i) != wanted.digest) return differs("content");
    }
    return {};
}

} // namespace vdb_edit
