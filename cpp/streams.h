// Streams of bytes for OpenVDB's archive code: files, memory, and hashes of what is written. Without OpenVDB.
#pragma once

#include "rust/cxx.h"

#include <array>
#include <cerrno>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <iomanip>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <streambuf>
#include <string>

namespace vdb_edit {

inline std::string path_string(rust::Slice<const std::uint8_t> path)
{
    return {reinterpret_cast<const char*>(path.data()), path.size()};
}

[[noreturn]] inline void throw_errno() { throw std::runtime_error(errno ? std::strerror(errno) : "the device refused it"); }

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

/// Keeps what is written to it.
class BytesBuffer final : public std::streambuf {
public:
    std::string bytes;

protected:
    int_type overflow(int_type c) override
    {
        if (!traits_type::eq_int_type(c, traits_type::eof())) bytes.push_back(traits_type::to_char_type(c));
        return traits_type::not_eof(c);
    }

    std::streamsize xsputn(const char* s, std::streamsize n) override
    {
        bytes.append(s, static_cast<std::size_t>(n));
        return n;
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

} // namespace vdb_edit
