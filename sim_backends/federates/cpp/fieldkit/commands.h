// Requests to a physics federate: the commands of robots.

#ifndef FIELDKIT_FEDERATES_COMMANDS_H
#define FIELDKIT_FEDERATES_COMMANDS_H

#include "bytes.h"

#include <array>
#include <cmath>
#include <vector>

namespace fieldkit::protocol
{

enum CommandType : uint16_t
{
    kTwist = 1,    // values: forward in m/s, turn in rad/s
    kVelocity = 2, // values: east, north and up in m/s, yaw in rad or NaN
};

struct Command
{
    uint32_t agent = 0;
    uint16_t type = 0;
    std::array<double, 4> values{0, 0, 0, NAN};
};

struct PhysicsRequest
{
    int64_t to_ns = 0; // simulated time to advance to
    int64_t from_ns = 0; // simulated time from which the commands apply
    std::vector<Command> commands;
};

// Return the request in a body; `agents` is the number of agents in the run.
inline PhysicsRequest
ReadPhysicsRequest(const std::string& body, size_t agents)
{
    Reader reader(body);
    PhysicsRequest request;
    request.to_ns = reader.Get<int64_t>();
    request.from_ns = reader.Get<int64_t>();
    request.commands.resize(reader.Count(4 + 2 + 2));
    for (Command& command : request.commands)
    {
        size_t position = reader.Position();
        command.agent = reader.Get<uint32_t>();
        if (command.agent >= agents)
        {
            throw MalformedFrame(position, "agent " + std::to_string(command.agent) + " was not announced");
        }
        position = reader.Position();
        command.type = reader.Get<uint16_t>();
        size_t size = reader.Get<uint16_t>();
        if (!(command.type == kTwist && size == 16) && !(command.type == kVelocity && size == 32))
        {
            throw MalformedFrame(position, "a command of type " + std::to_string(command.type) + " and " +
                                               std::to_string(size) + " bytes is not supported");
        }
        for (size_t index = 0; index < size / 8; index++)
        {
            command.values[index] = reader.Get<double>();
        }
    }
    reader.End();
    return request;
}

} // namespace fieldkit::protocol

#endif
