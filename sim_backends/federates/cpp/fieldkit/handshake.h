// The handshake of a run: hello of the coordinator, and welcome of the federate.

#ifndef FIELDKIT_FEDERATES_HANDSHAKE_H
#define FIELDKIT_FEDERATES_HANDSHAKE_H

#include "frames.h"
#include "states.h"

namespace fieldkit::protocol
{

enum Role : uint8_t
{
    kPhysics = 1,
    kNetwork = 2,
};

enum Capability : uint32_t
{
    kDeterministic = 1, // equal requests give equal answers
    kForks = 2, // it can be copied in its current state
    kNextEvent = 4, // nothing happens before `next_event_ns`, unless a new packet enters
    kExtrapolates = 8, // it moves agents by dead reckoning
    kAgentsAppear = 16, // agents that are not in hello may appear
    kAgentsDisappear = 32, // agents may disappear, and return
    kSamplesLinks = 64, // it answers requests for samples of the links of its radios
};

constexpr uint32_t kMaxAgents = 10'000;

struct Agent
{
    std::string name;
    std::string profile;
    bool flies = false;
    double antenna_m = 0; // height of the antenna above the body's position
    State start;
};

struct Hello
{
    uint32_t heartbeat_ms = 0; // interval at which a federate sends `busy` while it computes
    uint64_t seed = 0;
    int64_t step_ns = 0; // physics step that the scenario requests
    int64_t end_ns = 0; // end of the run
    std::string configuration_hash; // SHA-256 of `configuration`
    std::string token; // secret text that both sides of a connection between machines must have
    std::string name; // of the scenario
    std::vector<Agent> agents;
    std::string configuration; // JSON
};

// Return the hello in a body; it must be for a federate of this role.
inline Hello
ReadHello(const std::string& body, Role role)
{
    Reader reader(body);
    size_t position = reader.Position();
    if (reader.Bytes(8) != "FIELDKIT")
    {
        throw MalformedFrame(position, "this is not fieldkit's protocol for federates");
    }
    position = reader.Position();
    auto version = reader.Get<uint16_t>();
    if (version != kVersion)
    {
        throw MalformedFrame(position, "protocol version " + std::to_string(version) + "; this program supports " +
                                           std::to_string(kVersion));
    }
    if (reader.Get<uint8_t>() != role)
    {
        throw Refusal(std::string("this federate is a ") + (role == kPhysics ? "physics" : "network") +
                      " federate");
    }
    reader.Get<uint8_t>(); // reserved
    Hello hello;
    hello.heartbeat_ms = reader.Get<uint32_t>();
    hello.seed = reader.Get<uint64_t>();
    hello.step_ns = reader.Get<int64_t>();
    hello.end_ns = reader.Get<int64_t>();
    hello.configuration_hash = reader.Bytes(32);
    hello.token = reader.Text();
    hello.name = reader.Text();
    position = reader.Position();
    hello.agents.resize(reader.Count(2 + 2 + 1 + 8 + kStateBytes));
    if (hello.agents.size() > kMaxAgents)
    {
        throw MalformedFrame(position, std::to_string(hello.agents.size()) + " agents are more than " +
                                           std::to_string(kMaxAgents));
    }
    for (Agent& agent : hello.agents)
    {
        agent.name = reader.Text();
        agent.profile = reader.Text();
        agent.flies = reader.Get<uint8_t>() != 0;
        agent.antenna_m = reader.Get<double>();
        agent.start = ReadState(reader);
    }
    hello.configuration = reader.Bytes(reader.Count(1));
    reader.End();
    return hello;
}

struct Welcome
{
    Role role = kPhysics;
    uint32_t capabilities = 0;
    int64_t step_ns = 0; // 0 for a network
    int64_t next_event_ns = -1; // time of the first event of a network; -1 if there is none
    std::string configuration_hash; // the hash in hello
    std::string name;
    std::string software;
    std::vector<uint16_t> commands; // types of commands that it supports
    std::vector<std::string> transports; // names of transports that it supports; empty for any
    std::vector<uint32_t> transmitters; // indices of agents that forward or interfere
    std::vector<std::array<double, 3>> emitters_m; // positions of other sources of interference
};

inline std::string
WelcomeBody(const Welcome& welcome)
{
    Writer body;
    body.Put(kVersion).Put(static_cast<uint8_t>(welcome.role)).Put(uint8_t{0}).Put(welcome.capabilities);
    body.Put(welcome.step_ns).Put(welcome.next_event_ns);
    body.data += welcome.configuration_hash;
    body.PutText(welcome.name).PutText(welcome.software);
    body.Put(static_cast<uint16_t>(welcome.commands.size()));
    for (uint16_t command : welcome.commands)
    {
        body.Put(command);
    }
    body.Put(static_cast<uint16_t>(welcome.transports.size()));
    for (const std::string& transport : welcome.transports)
    {
        body.PutText(transport);
    }
    body.Put(static_cast<uint32_t>(welcome.transmitters.size()));
    for (uint32_t agent : welcome.transmitters)
    {
        body.Put(agent);
    }
    body.Put(static_cast<uint32_t>(welcome.emitters_m.size()));
    for (const auto& position_m : welcome.emitters_m)
    {
        for (double value : position_m)
        {
            body.Put(value);
        }
    }
    return body.data;
}

} // namespace fieldkit::protocol

#endif
