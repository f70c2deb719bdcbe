// Writing whole files, every failed write an error, and comparing what is read back. Compiles in 5 s.
//
// OpenVDB compresses each leaf twice, once to know its size, which a file says before the values, and then one leaf after the other. Here the
// leaves of grids of floats are compressed once, side by side, and the file is the same to the byte. Their values may be lent: then they are
// never copied into OpenVDB's tree.

#include "internal.h"
#include "streams.h"

#include <openvdb/io/Archive.h>
#include <openvdb/io/Compression.h>
#include <openvdb/io/DelayedLoadMetadata.h>
#include <openvdb/io/GridDescriptor.h>
#include <openvdb/io/io.h>

#include <tbb/parallel_for.h>

#include <algorithm>
#include <map>
#include <set>

namespace vdb_edit {

namespace vio = openvdb::io;

struct Output::Impl {
    struct Outgoing {
        openvdb::GridBase::ConstPtr grid;
        Lent lent;
        Opaque opaque;
    };

    struct Sealed {
        std::string type, name, digest;
        openvdb::MetaMap metadata;
        openvdb::math::Transform::ConstPtr transform;
    };

    std::vector<Outgoing> grids;
    openvdb::MetaMap metadata;
    std::vector<Sealed> sealed;
};

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

// --- writing ---

void write_leaf(std::ostream& stream, const LeafNode& leaf, const float* values, bool half)
{
    using Mask = LeafNode::NodeMaskType;
    leaf.getValueMask().save(stream);
    // The function reads the values only; its parameter is not const.
    vio::writeCompressedValues(
        stream, const_cast<float*>(values), LeafNode::SIZE, leaf.getValueMask(), /*childMask=*/Mask(), half);
}

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

/// What the leaves of a grid of floats are in a file.
struct StoredLeaves {
    /// Some leaves each, in the order of the tree.
    std::vector<std::string> blocks;
    /// For readers that load leaves when they are first asked for: how each is stored, and its size.
    vio::DelayedLoadMetadata index;
};

/// How the inactive values of the stored leaf that begins at a byte are told from each other.
std::int8_t kind_of(const std::string& bytes, std::size_t begin) { return bytes[begin + sizeof(LeafNode::NodeMaskType)]; }

/// Where the active values of a stored leaf begin: after its mask, its kind, up to two inactive values, and which of the two is where.
std::size_t values_begin(std::int8_t kind)
{
    constexpr std::size_t kMask = sizeof(LeafNode::NodeMaskType), kValue = sizeof(float);
    switch (kind) {
    case vio::NO_MASK_AND_ONE_INACTIVE_VAL: return kMask + 1 + kValue;
    case vio::MASK_AND_NO_INACTIVE_VALS: return kMask + 1 + kMask;
    case vio::MASK_AND_ONE_INACTIVE_VAL: return kMask + 1 + kValue + kMask;
    case vio::MASK_AND_TWO_INACTIVE_VALS: return kMask + 1 + 2 * kValue + kMask;
    default: return kMask + 1;
    }
}

/// Compresses the leaves of a grid as `of_grid` says, in a file whose grids are compressed as `of_file` says where their class allows it.
StoredLeaves store_leaves(
    const openvdb::FloatGrid& grid, const Lent& lent, std::uint32_t of_grid, std::uint32_t of_file)
{
    constexpr std::size_t kBlockLeaves = 64;
    constexpr std::uint32_t kSized = vio::COMPRESS_BLOSC | vio::COMPRESS_ZIP;
    std::vector<const LeafNode*> leaves;
    grid.tree().getNodes(leaves);
    StoredLeaves out;
    if (leaves.empty()) return out;
    out.index.resizeMask(leaves.size());
    if (of_file & kSized) out.index.resizeCompressedSize(leaves.size());
    out.blocks.resize((leaves.size() + kBlockLeaves - 1) / kBlockLeaves);
    const float background = grid.background();
    const bool half = grid.saveFloatAsHalf();
    tbb::parallel_for(std::size_t(0), out.blocks.size(), [&](std::size_t block) {
        vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
        BytesBuffer buffer;
        std::ostream stream(&buffer);
        // What the buffer throws is passed on.
        stream.exceptions(std::ios_base::badbit | std::ios_base::failbit);
        vio::setStreamMetadataPtr(stream, tag, /*transfer=*/false);
        vio::setDataCompression(stream, of_grid);
        vio::setGridBackgroundValuePtr(stream, &background);
        const std::size_t end = std::min(leaves.size(), (block + 1) * kBlockLeaves);
        for (std::size_t i = block * kBlockLeaves; i < end; ++i) {
            const std::size_t begin = buffer.bytes.size();
            const float* values = values_of(*leaves[i], lent);
            write_leaf(stream, *leaves[i], values, half);
            const std::int8_t kind = kind_of(buffer.bytes, begin);
            out.index.setMask(i, kind);
            if (!(of_file & kSized)) continue;
            // With its own size of eight bytes before it.
            std::size_t size = buffer.bytes.size() - begin - values_begin(kind);
            if (!(of_grid & kSized)) {
                // OpenVDB notes what zip would have made of a level set, which it does not zip.
                size = 8 + vio::writeCompressedValuesSize(values, LeafNode::SIZE, leaves[i]->getValueMask(),
                               static_cast<std::uint8_t>(kind), half, of_file);
            }
            // Where no voxel is active, halves have no size in the file, but one in the index.
            out.index.setCompressedSize(i, static_cast<std::int64_t>(std::max<std::size_t>(size, 8)));
        }
        buffer.bytes.shrink_to_fit();
        out.blocks[block] = std::move(buffer.bytes);
    });
    return out;
}

class Writer final : public vio::Archive {
public:
    void write_to(std::streambuf& buffer, const Output::Impl& content, std::uint32_t compression)
    {
        const QuietOutput scope;
        IdentifiedBuffer identified(buffer);
        std::ostream stream(&identified);
        stream.exceptions(std::ios_base::badbit | std::ios_base::failbit);
        setCompression(compression);
        vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
        vio::setStreamMetadataPtr(stream, tag, /*transfer=*/false);
        vio::setWriteGridStatsMetadata(stream, isGridStatsMetadataEnabled());
        writeHeader(stream, /*seekable=*/true);
        content.metadata.writeMeta(stream);
        const auto count = static_cast<std::int32_t>(content.grids.size());
        stream.write(reinterpret_cast<const char*>(&count), sizeof(count));
        write_grids(stream, content.grids);
        stream.flush();
        identified.identify(getUniqueTag());
    }

    /// A grid as a file with blosc holds it.
    Opaque store(const openvdb::GridBase::ConstPtr& grid)
    {
        std::stringbuf buffer(std::ios_base::in | std::ios_base::out | std::ios_base::binary);
        std::ostream stream(&buffer);
        stream.exceptions(std::ios_base::badbit | std::ios_base::failbit);
        vio::StreamMetadata::Ptr tag(new vio::StreamMetadata);
        vio::setStreamMetadataPtr(stream, tag, /*transfer=*/false);
        setCompression(vio::COMPRESS_BLOSC | vio::COMPRESS_ACTIVE_MASK);
        vio::setDataCompression(stream, compression());
        vio::setWriteGridStatsMetadata(stream, isGridStatsMetadataEnabled());
        vio::GridDescriptor descriptor(grid->getName(), grid->type(), grid->saveFloatAsHalf());
        writeGrid(descriptor, grid, stream, /*seekable=*/true);
        const std::int64_t begin = descriptor.getGridPos(), end = descriptor.getEndPos();
        const std::string all = buffer.str();
        auto bytes = std::make_shared<std::string>(all.substr(static_cast<std::size_t>(begin), static_cast<std::size_t>(end - begin)));
        return {std::move(bytes), descriptor.getBlockPos() - begin};
    }

private:
    using Outgoing = Output::Impl::Outgoing;

    void write_grids(std::ostream& stream, const std::vector<Outgoing>& grids)
    {
        std::map<std::string, int> uses;
        for (const Outgoing& outgoing : grids) ++uses[outgoing.grid->getName()];
        std::set<std::string> taken;
        std::map<const openvdb::TreeBase*, vio::GridDescriptor> written;
        for (const Outgoing& outgoing : grids) {
            const auto& grid = outgoing.grid;
            // The last grid may be of a class that is not compressed as the file is.
            vio::setDataCompression(stream, compression());
            // Grids without a name, and those of one name, are numbered.
            const std::string plain = grid->getName();
            std::string name = plain.empty() || uses[plain] > 1 ? vio::GridDescriptor::addSuffix(plain, 0) : plain;
            for (int n = 1; !taken.insert(name).second; ++n) name = vio::GridDescriptor::addSuffix(plain, n);
            vio::GridDescriptor descriptor(name, grid->type(), grid->saveFloatAsHalf());
            const auto same_tree = written.find(&grid->baseTree());
            if (same_tree != written.end() && same_tree->second.saveFloatAsHalf() == descriptor.saveFloatAsHalf()) {
                descriptor.setInstanceParentName(same_tree->second.uniqueName());
                writeGridInstance(descriptor, grid, stream, /*seekable=*/true);
                continue;
            }
            written[&grid->baseTree()] = descriptor;
            if (outgoing.opaque.bytes) {
                write_opaque(stream, descriptor, outgoing.opaque);
            } else if (const auto* floats = dynamic_cast<const openvdb::FloatGrid*>(grid.get())) {
                write_floats(stream, descriptor, *floats, outgoing.lent);
            } else {
                writeGrid(descriptor, grid, stream, /*seekable=*/true);
            }
        }
    }

    /// Writes a grid between its description and its offsets, which are known when it is written. `write_content` sets where its values begin.
    template<typename WriteContent>
    void with_offsets(std::ostream& stream, vio::GridDescriptor& descriptor, WriteContent write_content)
    {
        descriptor.writeHeader(stream);
        const std::streampos offsets = stream.tellp();
        descriptor.writeStreamPos(stream);
        descriptor.setGridPos(stream.tellp());
        write_content();
        descriptor.setEndPos(stream.tellp());
        stream.seekp(offsets);
        descriptor.writeStreamPos(stream);
        descriptor.seekToEnd(stream);
    }

    void write_opaque(std::ostream& stream, vio::GridDescriptor& descriptor, const Opaque& opaque)
    {
        with_offsets(stream, descriptor, [&] {
            descriptor.setBlockPos(descriptor.getGridPos() + opaque.values);
            stream.write(opaque.bytes->data(), static_cast<std::streamsize>(opaque.bytes->size()));
        });
    }

    /// As OpenVDB's `writeGrid`.
    void write_floats(
        std::ostream& stream, vio::GridDescriptor& descriptor, const openvdb::FloatGrid& grid, const Lent& lent)
    {
        with_offsets(stream, descriptor, [&] { write_content(stream, descriptor, grid, lent); });
        vio::setGridBackgroundValuePtr(stream, nullptr);
    }

    void write_content(
        std::ostream& stream, vio::GridDescriptor& descriptor, const openvdb::FloatGrid& grid, const Lent& lent)
    {
        setGridCompression(stream, grid);
        StoredLeaves leaves = store_leaves(grid, lent, vio::getDataCompression(stream), compression());

        const openvdb::GridBase& base = grid;
        const auto described = openvdb::ConstPtrCast<openvdb::GridBase>(base.copyGrid());
        described->insertMeta(openvdb::GridBase::META_FILE_DELAYED_LOAD, leaves.index);
        described->addStatsMetadata();
        // Lent values do not count otherwise.
        const std::size_t more = lent.size() * LeafNode::SIZE * sizeof(float);
        const auto memory = static_cast<std::int64_t>(base.memUsage() + more);
        described->insertMeta(openvdb::GridBase::META_FILE_MEM_BYTES, openvdb::Int64Metadata(memory));
        const std::string how = vio::compressionToString(vio::getDataCompression(stream));
        described->insertMeta(openvdb::GridBase::META_FILE_COMPRESSION, openvdb::StringMetadata(how));
        described->writeMeta(stream);
        base.writeTransform(stream);
        base.writeTopology(stream);

        descriptor.setBlockPos(stream.tellp());
        for (std::string& block : leaves.blocks) {
            stream.write(block.data(), static_cast<std::streamsize>(block.size()));
            std::string().swap(block);
        }
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
    const auto& entry = archive.impl->entries.at(index);
    const QuietOutput scope;
    const bool is_decoded = is_points(*entry.grid) && !entry.opaque.bytes;
    impl->grids.push_back({entry.grid, {}, is_decoded ? Writer().store(entry.grid) : entry.opaque});
}

void Output::add_grid(std::unique_ptr<FloatGrid> grid)
{
    const Lent& lent = grid->impl->lent;
    require(lent.empty() || lent.size() == grid->impl->leaves.size(), "add_grid: not all leaves were lent");
    impl->grids.push_back({grid->impl->grid, std::move(grid->impl->lent), {}});
}

void Output::add_vectors(std::unique_ptr<FloatGrid> x, std::unique_ptr<FloatGrid> y, std::unique_ptr<FloatGrid> z)
{
    impl->grids.push_back({vectors_of(*x, *y, *z), {}, {}});
}

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
    // Grids that share a tree are one in the file.
    std::map<const openvdb::TreeBase*, std::string> digests;
    for (const auto& [grid, lent, opaque] : impl->grids) {
        std::string& digest = digests[&grid->baseTree()];
        if (digest.empty()) digest = opaque.bytes ? fingerprint(*opaque.bytes) : fingerprint(*grid, lent);
        impl->sealed.push_back({grid->type(), grid->getName(), digest, *grid, grid->constTransformPtr()});
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