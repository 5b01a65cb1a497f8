// Frames of the wire protocol of federates, version 1 (docs/federates.md), on streams.

#ifndef FIELDKIT_FEDERATES_FRAMES_H
#define FIELDKIT_FEDERATES_FRAMES_H

#include "bytes.h"

#include <cstdio>

namespace fieldkit::protocol
{

enum Kind : uint16_t
{
    kJoin = 1,
    kHello = 2,
    kWelcome = 3,
    kAdvancePhysics = 4,
    kStates = 5,
    kAdvanceNetwork = 6,
    kOutcomes = 7,
    kPing = 8,
    kPong = 9,
    kBusy = 10,
    kFork = 11,
    kDone = 12,
    kRelease = 13,
    kError = 14,
    kBye = 15,
    kSampleLinks = 16,
    kLinks = 17,
};

constexpr uint16_t kVersion = 1;
constexpr uint32_t kMaxFrameBytes = 16u << 20;
constexpr uint32_t kMaxHelloBytes = 4u << 20;

struct Frame
{
    uint16_t kind = 0;
    uint32_t request = 0;
    uint32_t copy = 0;
    std::string body;
};

// Read a frame; return false at the end of the stream, also if it ends within the frame.
inline bool
ReadFrame(std::FILE* stream, Frame& frame)
{
    std::string header(kHeaderBytes, '\0');
    if (std::fread(header.data(), 1, header.size(), stream) != header.size())
    {
        return false;
    }
    Reader fields(header, 0);
    auto size = fields.Get<uint32_t>();
    frame.kind = fields.Get<uint16_t>();
    auto reserved = fields.Get<uint16_t>();
    frame.request = fields.Get<uint32_t>();
    frame.copy = fields.Get<uint32_t>();
    if (frame.kind < kJoin || frame.kind > kLinks)
    {
        throw MalformedFrame(4, "there is no kind of message " + std::to_string(frame.kind));
    }
    uint32_t limit = frame.kind == kHello ? kMaxHelloBytes : kMaxFrameBytes;
    if (size > limit)
    {
        throw MalformedFrame(0, "a size of " + std::to_string(size) + " bytes is above " + std::to_string(limit));
    }
    if (reserved != 0)
    {
        throw MalformedFrame(6, "the reserved field is " + std::to_string(reserved) + ", not 0");
    }
    frame.body.resize(size);
    return std::fread(frame.body.data(), 1, size, stream) == size;
}

// Write the answer to a request; return false if the coordinator has closed the connection.
inline bool
WriteFrame(std::FILE* stream, const Frame& request, Kind kind, const std::string& body)
{
    Writer frame;
    frame.Put(static_cast<uint32_t>(body.size())).Put(static_cast<uint16_t>(kind)).Put(uint16_t{0});
    frame.Put(request.request).Put(request.copy);
    frame.data += body;
    return std::fwrite(frame.data.data(), 1, frame.data.size(), stream) == frame.data.size() &&
           std::fflush(stream) == 0;
}

} // namespace fieldkit::protocol

#endif
