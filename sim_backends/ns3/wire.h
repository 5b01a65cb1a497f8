// The wire protocol of federates, version 1 (docs/federates.md): numbers and texts in frames, little endian.

#ifndef FIELDKIT_WIRE_H
#define FIELDKIT_WIRE_H

#include <cstdint>
#include <cstdio>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

namespace fieldkit
{

enum Kind : uint16_t
{
    kHello = 2,
    kWelcome = 3,
    kAdvanceNetwork = 6,
    kOutcomes = 7,
    kPing = 8,
    kPong = 9,
    kBusy = 10,
    kRelease = 13,
    kError = 14,
    kBye = 15,
};

constexpr uint16_t kVersion = 1;
constexpr uint8_t kNetworkRole = 2;
constexpr uint32_t kMaxFrameBytes = 16u << 20;
constexpr size_t kStateBytes = 72;
constexpr size_t kPacketBytes = 52;

// A request that the federate refuses; the session ends with its text.
struct Refusal : std::runtime_error
{
    using std::runtime_error::runtime_error;
};

class Reader
{
  public:
    explicit Reader(const std::string& data)
        : m_data(data)
    {
    }

    std::string Bytes(size_t count)
    {
        if (count > m_data.size() - m_at)
        {
            throw Refusal("the request is too short: byte " + std::to_string(m_data.size()) + " is missing");
        }
        m_at += count;
        return m_data.substr(m_at - count, count);
    }

    template <class Value> Value Get()
    {
        if (sizeof(Value) > m_data.size() - m_at)
        {
            throw Refusal("the request is too short: byte " + std::to_string(m_data.size()) + " is missing");
        }
        uint64_t bits = 0;
        for (size_t byte = sizeof(Value); byte-- > 0;)
        {
            bits = bits << 8 | static_cast<uint8_t>(m_data[m_at + byte]);
        }
        m_at += sizeof(Value);
        Value value;
        std::memcpy(&value, &bits, sizeof value); // this machine is little endian, as all of ns-3's on Debian
        return value;
    }

    std::string Text()
    {
        return Bytes(Get<uint16_t>());
    }

    // A number of records, each of at least `size` bytes.
    uint32_t Count(size_t size)
    {
        auto count = Get<uint32_t>();
        if (count > (m_data.size() - m_at) / size)
        {
            throw Refusal("the count at byte " + std::to_string(m_at - 4) + " is larger than the request");
        }
        return count;
    }

    void End() const
    {
        if (m_at != m_data.size())
        {
            throw Refusal("the request is too long from byte " + std::to_string(m_at) + " on");
        }
    }

  private:
    const std::string& m_data;
    size_t m_at = 0;
};

class Writer
{
  public:
    template <class Value> Writer& Put(Value value)
    {
        char bytes[sizeof value];
        std::memcpy(bytes, &value, sizeof value);
        data.append(bytes, sizeof value);
        return *this;
    }

    Writer& PutText(const std::string& text)
    {
        Put(static_cast<uint16_t>(text.size()));
        data += text;
        return *this;
    }

    std::string data;
};

struct Frame
{
    uint16_t kind = 0;
    uint32_t request = 0;
    uint32_t copy = 0;
    std::string body;
};

// Read a frame; false at the end of the stream.
inline bool
ReadFrame(std::FILE* stream, Frame& frame)
{
    std::string header(16, '\0');
    if (std::fread(header.data(), 1, header.size(), stream) != header.size())
    {
        return false;
    }
    Reader fields(header);
    auto size = fields.Get<uint32_t>();
    frame.kind = fields.Get<uint16_t>();
    fields.Get<uint16_t>();
    frame.request = fields.Get<uint32_t>();
    frame.copy = fields.Get<uint32_t>();
    if (size > kMaxFrameBytes)
    {
        throw Refusal("a frame of " + std::to_string(size) + " bytes is too large");
    }
    frame.body.resize(size);
    return std::fread(frame.body.data(), 1, size, stream) == size;
}

// Write the answer to a frame; false if the coordinator has closed the connection.
inline bool
WriteFrame(std::FILE* stream, const Frame& request, uint16_t kind, const std::string& body)
{
    Writer header;
    header.Put(static_cast<uint32_t>(body.size())).Put(kind).Put(uint16_t{0}).Put(request.request).Put(request.copy);
    std::string bytes = header.data + body;
    return std::fwrite(bytes.data(), 1, bytes.size(), stream) == bytes.size() && std::fflush(stream) == 0;
}

} // namespace fieldkit

#endif
