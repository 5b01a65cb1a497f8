// A session with the coordinator: requests and their answers on streams, and `busy` messages during long requests.

#ifndef FIELDKIT_FEDERATES_SERVING_H
#define FIELDKIT_FEDERATES_SERVING_H

#include "frames.h"

#include <algorithm>
#include <chrono>
#include <functional>
#include <unistd.h>

namespace fieldkit::protocol
{

// Sends `busy` at an interval while a request is computed.
class Heartbeat
{
  public:
    using Clock = std::chrono::steady_clock;

    void SetInterval(uint32_t milliseconds)
    {
        m_interval = std::chrono::milliseconds(std::clamp<uint32_t>(milliseconds, 1, 60'000));
    }

    // Start the interval of a request whose answer is written to `stream`.
    void Begin(std::FILE* stream, const Frame& request)
    {
        m_stream = stream;
        m_request = {request.kind, request.request, request.copy, {}};
        m_last = Clock::now();
    }

    // Return the time at which the next `busy` message is due.
    Clock::time_point Due() const
    {
        return m_last + m_interval;
    }

    // Send `busy` with the simulated time `at_ns` that the run has reached, if the next message is due.
    void SendIfDue(int64_t at_ns)
    {
        if (Clock::now() >= Due())
        {
            Send(at_ns);
        }
    }

    void Send(int64_t at_ns)
    {
        m_last = Clock::now();
        if (m_stream != nullptr && !WriteFrame(m_stream, m_request, kBusy, Writer().Put(at_ns).data))
        {
            throw Refusal("the coordinator has closed the connection");
        }
    }

  private:
    std::chrono::milliseconds m_interval{1000};
    std::FILE* m_stream = nullptr;
    Frame m_request;
    Clock::time_point m_last = Clock::now();
};

struct Answer
{
    Kind kind;
    std::string body;
};

// Return the stream of the protocol. Redirect standard output to standard error, because libraries may print to it.
inline std::FILE*
RedirectStandardOutput()
{
    std::FILE* stream = ::fdopen(::dup(STDOUT_FILENO), "wb");
    ::dup2(STDERR_FILENO, STDOUT_FILENO);
    return stream;
}

// Answer requests until the coordinator ends the run; return false if a request was refused.
//
// `answer` is called with each request other than ping, release and bye; its exceptions are sent to the coordinator.
inline bool
Serve(std::FILE* input, std::FILE* output, Heartbeat& heartbeat, const std::function<Answer(const Frame&)>& answer)
{
    for (;;)
    {
        Frame request;
        try
        {
            if (!ReadFrame(input, request) || request.kind == kBye)
            {
                return true;
            }
            if (request.kind == kRelease)
            {
                continue;
            }
            heartbeat.Begin(output, request);
            Answer result{kPong, request.body};
            if (request.kind != kPing)
            {
                result = answer(request);
            }
            else if (request.body.size() != 8)
            {
                throw MalformedFrame(kHeaderBytes + std::min<size_t>(request.body.size(), 8), "ping has 8 bytes");
            }
            if (!WriteFrame(output, request, result.kind, result.body))
            {
                return true; // the coordinator has closed the connection
            }
        }
        catch (const std::exception& error)
        {
            WriteFrame(output, request, kError, Writer().PutText(error.what()).data);
            return false;
        }
    }
}

} // namespace fieldkit::protocol

#endif
