// Faults of the scenario that affect radios, and agents that appear or disappear.

#ifndef FIELDKIT_FAULTS_H
#define FIELDKIT_FAULTS_H

#include "agents.h"
#include "configuration.h"
#include "medium.h"

#include <set>

namespace fieldkit
{

class Faults
{
  public:
    Faults(const Agents& agents, Medium& medium)
        : m_agents(agents),
          m_medium(medium)
    {
    }

    std::set<uint32_t> jammer_carriers; // agents that carry jammers
    std::vector<Point> emitters_m;      // positions of jammers that no agent carries

    // Schedule the faults of the scenario. Kinds that do not affect radios have no effect.
    void AddFaults(const Json& configuration)
    {
        const Json& faults = configuration.at("scenario").at("faults");
        for (size_t number = 0; number < faults.size(); number++)
        {
            const Json& fault = faults[number];
            std::string kind = fault.at("kind");
            if (kind == "jammer")
            {
                AddJammer(fault, configuration.at("jammers").at(number));
            }
            else if (kind == "link-cut")
            {
                size_t first = StationNamed(m_agents.stations, fault.at("between")[0]);
                size_t second = StationNamed(m_agents.stations, fault.at("between")[1]);
                AddOutage(fault, [this, first, second](int change) { m_medium.Cut(first, second, change); });
            }
            else if (kind == "node-loss")
            {
                size_t station = StationNamed(m_agents.stations, fault.at("agent"));
                AddOutage(fault, [this, station](int change) { m_medium.SwitchOff(station, change); });
            }
        }
    }

    // Schedule the times at which agents with a radio appear and disappear; the radio of an absent agent is off.
    void AddLifetimes(const Json& plans)
    {
        for (size_t station = 0; station < m_agents.stations.size(); station++)
        {
            const Json& plan = plans.at(m_agents.stations[station].name);
            if (plan.contains("appears") && Number(plan["appears"]) > 0)
            {
                m_medium.SwitchOff(station, 1);
                Simulator::Schedule(At(plan["appears"]), [this, station] { m_medium.SwitchOff(station, -1); });
            }
            if (plan.contains("disappears"))
            {
                Simulator::Schedule(At(plan["disappears"]), [this, station] { m_medium.SwitchOff(station, 1); });
            }
        }
    }

  private:
    // Add a reason for an outage at the start of a fault, and remove it at its end.
    static void AddOutage(const Json& fault, const std::function<void(int)>& add_reason)
    {
        Simulator::Schedule(At(fault.at("from")), [add_reason] { add_reason(1); });
        if (fault.contains("to"))
        {
            Simulator::Schedule(At(fault.at("to")), [add_reason] { add_reason(-1); });
        }
    }

    // Add a jammer, which an agent carries if it has no position.
    void AddJammer(const Json& fault, const Json& position_m)
    {
        std::function<bool(Point&)> locate;
        if (position_m.is_null())
        {
            auto carrier = m_agents.Named(fault.at("agent"));
            jammer_carriers.insert(carrier);
            locate = [this, carrier](Point& at) {
                Vector here = m_agents.entries[carrier].mobility->GetPosition();
                at = {here.x, here.y, here.z};
                return m_agents.entries[carrier].is_present;
            };
        }
        else
        {
            Point fixed = position_m.get<Point>();
            emitters_m.push_back(fixed);
            locate = [fixed](Point& at) {
                at = fixed;
                return true;
            };
        }
        Time until = fault.contains("to") ? At(fault["to"]) : Time::Max();
        m_medium.jammers().Add(Number(fault.at("power_dbm")), At(fault.at("from")), until, locate);
    }

    const Agents& m_agents;
    Medium& m_medium;
};

} // namespace fieldkit

#endif
