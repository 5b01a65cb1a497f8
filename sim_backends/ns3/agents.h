// The agents of a run, which have positions, and the stations of those that have a radio.

#ifndef FIELDKIT_AGENTS_H
#define FIELDKIT_AGENTS_H

#include "stations.h"

#include "fieldkit/handshake.h"

namespace fieldkit
{

struct AgentEntry
{
    std::string name;
    int station = -1; // -1 if it has no radio
    Ptr<AgentMobility> mobility;
    bool is_present = true; // in the last states
};

inline Vector
VectorOf(const std::array<double, 3>& values)
{
    return Vector(values[0], values[1], values[2]);
}

class Agents
{
  public:
    // Add agents, and stations without devices for those that have a radio.
    void Add(const std::vector<protocol::Agent>& agents, const Json& robots)
    {
        for (const protocol::Agent& agent : agents)
        {
            const Json radio = robots.at(agent.name).at("radio");
            auto mobility = CreateObject<AgentMobility>();
            mobility->SetPosition(VectorOf(agent.start.position_m));
            entries.push_back({agent.name, radio.is_null() ? -1 : static_cast<int>(stations.size()), mobility});
            if (radio.is_null())
            {
                continue;
            }
            if (radio.contains("pattern") && !radio.at("pattern").is_null())
            {
                throw Refusal("the antenna of " + agent.name + " has a pattern, which this network does not model");
            }
            Station station;
            station.name = agent.name;
            station.agent = static_cast<uint32_t>(entries.size() - 1);
            station.tx_power_dbm = Number(radio.at("tx_power_dbm"));
            station.sensitivity_dbm = Number(radio.at("sensitivity_dbm"));
            station.mobility = mobility;
            stations.push_back(station);
            are_ht = are_ht && radio.at("standard") == "802.11n";
        }
    }

    uint32_t Named(const std::string& name) const
    {
        for (uint32_t agent = 0; agent < entries.size(); agent++)
        {
            if (entries[agent].name == name)
            {
                return agent;
            }
        }
        throw Refusal("there is no agent " + name);
    }

    // The station of an agent; throws a refusal if it has no radio.
    size_t StationOf(uint32_t agent) const
    {
        if (agent >= entries.size() || entries[agent].station < 0)
        {
            throw Refusal("agent " + std::to_string(agent) + " has no radio");
        }
        return entries[agent].station;
    }

    std::vector<AgentEntry> entries;
    std::vector<Station> stations; // callbacks of ns-3 keep references to it
    bool are_ht = true; // true if all radios have the standard 802.11n
};

} // namespace fieldkit

#endif
