// Numbers and texts in the body of a frame; they are little endian on every machine.

#ifndef FIELDKIT_FEDERATES_BYTES_H
#define FIELDKIT_FEDERATES_BYTES_H

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <type_traits>

namespace fieldkit::protocol
{

constexpr size_t kHeaderBytes = 16;
constexpr size_t kMaxTextBytes = 1000;

// A request that the federate refuses; the session ends, and the coordinator shows the text.
struct Refusal : std::runtime_error
{
    using std::runtime_error::runtime_error;
};

// A frame that does not follow the protocol; positions are counted from the beginning of the frame.
struct MalformedFrame : Refusal
{
    MalformedFrame(size_t position, const std::string& what)
        : Refusal("byte " + std::to_string(position) + ": " + what)
    {
    }
};

// Reads a body in order, and checks each length before it is used. The body must outlive the reader.
class Reader
{
  public:
    explicit Reader(const std::string& body, size_t position = kHeaderBytes)
        : m_body(body),
          m_start(position)
    {
    }

    // Position of the next byte, from the beginning of the frame.
    size_t Position() const
    {
        return m_start + m_offset;
    }

    std::string Bytes(size_t count)
    {
        return std::string(Consume(count), count);
    }

    template <class Value> Value Get()
    {
        static_assert(std::is_arithmetic_v<Value>);
        const char* bytes = Consume(sizeof(Value));
        uint64_t bits = 0;
        for (size_t byte_index = sizeof(Value); byte_index-- > 0;)
        {
            bits = bits << 8 | static_cast<uint8_t>(bytes[byte_index]);
        }
        if constexpr (std::is_floating_point_v<Value>)
        {
            static_assert(sizeof(Value) == sizeof bits);
            Value value;
            std::memcpy(&value, &bits, sizeof value);
            return value;
        }
        else
        {
            return static_cast<Value>(bits);
        }
    }

    std::string Text()
    {
        size_t position = Position();
        auto size = Get<uint16_t>();
        if (size > kMaxTextBytes)
        {
            throw MalformedFrame(position, "a text of " + std::to_string(size) + " bytes is longer than " +
                                               std::to_string(kMaxTextBytes));
        }
        return Bytes(size);
    }

    // Read the number of items that follow; each item has at least `item_bytes`.
    uint32_t Count(size_t item_bytes)
    {
        size_t position = Position();
        auto count = Get<uint32_t>();
        if (count > (m_body.size() - m_offset) / item_bytes)
        {
            throw MalformedFrame(position, std::to_string(count) + " items of at least " + std::to_string(item_bytes) +
                                               " bytes do not fit in the rest of the frame");
        }
        return count;
    }

    // Check that there are no more bytes.
    void End() const
    {
        if (m_offset != m_body.size())
        {
            throw MalformedFrame(Position(), std::to_string(m_body.size() - m_offset) + " bytes follow the message");
        }
    }

  private:
    const char* Consume(size_t count)
    {
        if (count > m_body.size() - m_offset)
        {
            throw MalformedFrame(m_start + m_body.size(), "the frame ends too early");
        }
        m_offset += count;
        return m_body.data() + m_offset - count;
    }

    const std::string& m_body;
    size_t m_start;
    size_t m_offset = 0;
};

// Writes a body in order.
class Writer
{
  public:
    template <class Value> Writer& Put(Value value)
    {
        static_assert(std::is_arithmetic_v<Value>);
        uint64_t bits;
        if constexpr (std::is_floating_point_v<Value>)
        {
            static_assert(sizeof value == sizeof bits);
            std::memcpy(&bits, &value, sizeof bits);
        }
        else
        {
            bits = static_cast<uint64_t>(value);
        }
        for (size_t byte_index = 0; byte_index < sizeof value; byte_index++)
        {
            data.push_back(static_cast<char>(bits >> 8 * byte_index & 0xff));
        }
        return *this;
    }

    // A text that is too long is truncated between two characters.
    Writer& PutText(const std::string& text)
    {
        size_t size = text.size();
        if (size > kMaxTextBytes)
        {
            size = kMaxTextBytes;
            while (size > 0 && (text[size] & 0xc0) == 0x80)
            {
                size--;
            }
        }
        Put(static_cast<uint16_t>(size));
        data.append(text, 0, size);
        return *this;
    }

    std::string data;
};

} // namespace fieldkit::protocol

#endif
