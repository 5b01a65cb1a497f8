// States of agents, and agents that appear during a run.

#ifndef FIELDKIT_FEDERATES_STATES_H
#define FIELDKIT_FEDERATES_STATES_H

#include "bytes.h"

#include <array>
#include <vector>

namespace fieldkit::protocol
{

constexpr size_t kStateBytes = 72;

struct State
{
    uint32_t agent = 0;
    std::array<double, 3> position_m{}; // of the antenna: east, north, up
    std::array<double, 3> velocity_m_s{};
    double heading_rad = 0; // from east towards north; NaN if undefined
    double limit_m_s2 = 0;  // largest change of velocity per second; infinity if unknown
};

struct NewAgent
{
    uint32_t index = 0;
    std::string name;
};

inline State
ReadState(Reader& reader)
{
    State state;
    state.agent = reader.Get<uint32_t>();
    reader.Get<uint32_t>(); // reserved
    for (auto* values : {&state.position_m, &state.velocity_m_s})
    {
        for (double& value : *values)
        {
            value = reader.Get<double>();
        }
    }
    state.heading_rad = reader.Get<double>();
    state.limit_m_s2 = reader.Get<double>();
    return state;
}

inline std::vector<State>
ReadStates(Reader& reader)
{
    std::vector<State> states(reader.Count(kStateBytes));
    for (State& state : states)
    {
        state = ReadState(reader);
    }
    return states;
}

inline std::vector<NewAgent>
ReadNewAgents(Reader& reader)
{
    std::vector<NewAgent> agents(reader.Count(4 + 2));
    for (NewAgent& agent : agents)
    {
        agent.index = reader.Get<uint32_t>();
        agent.name = reader.Text();
    }
    return agents;
}

// Body of the answer to a request to a physics federate.
inline std::string
StatesBody(int64_t at_ns, const std::vector<State>& states, const std::vector<NewAgent>& new_agents = {})
{
    Writer body;
    body.Put(at_ns).Put(static_cast<uint32_t>(new_agents.size()));
    for (const NewAgent& agent : new_agents)
    {
        body.Put(agent.index).PutText(agent.name);
    }
    body.Put(static_cast<uint32_t>(states.size()));
    for (const State& state : states)
    {
        body.Put(state.agent).Put(uint32_t{0});
        for (const auto* values : {&state.position_m, &state.velocity_m_s})
        {
            for (double value : *values)
            {
                body.Put(value);
            }
        }
        body.Put(state.heading_rad).Put(state.limit_m_s2);
    }
    return body.data;
}

} // namespace fieldkit::protocol

#endif
