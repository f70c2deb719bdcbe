// Compressed chunks of values are looked at before OpenVDB decodes them. Compiles in 2 s.
//
// A chunk begins with its size. OpenVDB 10 reads as many bytes as that says, negated for values that are stored as they are, into a buffer of the
// size that the values have, and compares the sizes afterwards; of a chunk by blosc it trusts the sizes in the chunk's own
// header. One wrong byte in a file could end the process. The two functions of its library that do so are replaced: the linker
// lets an executable's definition of a function stand for that of a shared library. What is sound is handed on to the
// library's own.

#include <openvdb/Exceptions.h>
#include <openvdb/io/Compression.h>
#include <openvdb/version.h>

#include <dlfcn.h>

#include <cstdint>
#include <cstring>
#include <istream>
#include <string>
#include <vector>

#define VDB_EDIT_TEXT(name) #name
#define VDB_EDIT_TEXT_OF(macro) VDB_EDIT_TEXT(macro)

namespace {

using Decode = void (*)(std::istream&, char*, std::size_t);

/// The library's own definition of `openvdb::io::<name>(std::istream&, char*, std::size_t)`.
Decode library_function(const std::string& name)
{
    const std::string version = VDB_EDIT_TEXT_OF(OPENVDB_VERSION_NAME);
    const std::string mangled = "_ZN7openvdb" + std::to_string(version.size()) + version + "2io" +
        std::to_string(name.size()) + name + "ERSiPcm";
    return reinterpret_cast<Decode>(dlsym(RTLD_NEXT, mangled.c_str()));
}

/// A chunk in memory as a stream.
class ChunkStream final : private std::streambuf, public std::istream {
public:
    ChunkStream() : std::istream(static_cast<std::streambuf*>(this)) { exceptions(badbit | failbit | eofbit); }

    void set(std::vector<char>& bytes)
    {
        setg(bytes.data(), bytes.data(), bytes.data() + bytes.size());
        clear();
    }
};

std::uint32_t word(const std::vector<char>& bytes, std::size_t at)
{
    std::uint32_t value = 0;
    std::memcpy(&value, bytes.data() + at, sizeof(value));
    return value;
}

/// Reads a chunk that must hold `wanted` bytes of values, which go to `data`, or nowhere.
void read_chunk(std::istream& is, char* data, std::size_t wanted, Decode decode, bool blosc)
{
    constexpr std::size_t kSize = sizeof(std::int64_t), kBloscHeader = 16;
    std::int64_t stored = 0;
    is.read(reinterpret_cast<char*>(&stored), kSize);
    const bool packed = stored > 0;
    // Negated as unsigned: the least number has no counterpart.
    const auto size = packed ? static_cast<std::uint64_t>(stored) : 0 - static_cast<std::uint64_t>(stored);
    // What does not become smaller is stored as it is; blosc may add its header.
    if (packed ? size > wanted + kBloscHeader : size != wanted) {
        OPENVDB_THROW(openvdb::IoError,
            "a chunk of " + std::to_string(size) + " bytes for " + std::to_string(wanted) + " bytes of values");
    }
    if (data == nullptr) {
        is.seekg(static_cast<std::streamoff>(size), std::ios_base::cur);
        return;
    }
    if (!packed) {
        is.read(data, static_cast<std::streamsize>(size));
        return;
    }
    static thread_local std::vector<char> chunk;
    static thread_local ChunkStream stream;
    chunk.resize(kSize + size);
    std::memcpy(chunk.data(), &stored, kSize);
    is.read(chunk.data() + kSize, static_cast<std::streamsize>(size));
    if (blosc) {
        // Version, flags, two bytes; then the sizes of the values, of a block, of the chunk.
        const bool sound = size >= kBloscHeader && word(chunk, kSize + 4) == wanted && word(chunk, kSize + 12) == size;
        if (!sound) OPENVDB_THROW(openvdb::IoError, "the header of a chunk by blosc contradicts its size");
    }
    if (!decode) OPENVDB_THROW(openvdb::IoError, "this build of OpenVDB hides the decoder of compressed chunks");
    stream.set(chunk);
    decode(stream, data, wanted);
}

} // namespace

namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {
namespace io {

void unzipFromStream(std::istream& is, char* data, std::size_t wanted)
{
    static const Decode decode = library_function("unzipFromStream");
    read_chunk(is, data, wanted, decode, /*blosc=*/false);
}

void bloscFromStream(std::istream& is, char* data, std::size_t wanted)
{
    static const Decode decode = library_function("bloscFromStream");
    read_chunk(is, data, wanted, decode, /*blosc=*/true);
}

} // namespace io
} // namespace OPENVDB_VERSION_NAME
} // namespace openvdb
