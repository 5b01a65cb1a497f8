// Control of ns-3's simulator: time of the next event, run up to and including a time, heartbeats during a run.

#ifndef FIELDKIT_SIMULATOR_H
#define FIELDKIT_SIMULATOR_H

#include "fieldkit/serving.h"

#include "ns3/map-scheduler.h"
#include "ns3/nstime.h"
#include "ns3/object-factory.h"
#include "ns3/simulator.h"

namespace fieldkit
{

using namespace ns3;

using protocol::Refusal;

inline protocol::Heartbeat g_heartbeat;

// Time of ns-3 at time 0 of the co-simulation. It is above 0, because a node of ns-3 can send only after the simulator
// has run once. This first run ends just before time 0 of the co-simulation.
inline int64_t g_start_ns = 1'000'000;

inline int64_t
NowNs()
{
    return Simulator::Now().GetNanoSeconds() - g_start_ns;
}

// The scheduler of ns-3, with access to the next event.
class PeekScheduler : public MapScheduler
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type =
            TypeId("fieldkit::PeekScheduler").SetParent<MapScheduler>().AddConstructor<PeekScheduler>();
        return type;
    }

    PeekScheduler()
    {
        s_current = this;
    }

    Scheduler::Event RemoveNext() override
    {
        if (++m_events % 1024 == 0) // seldom, because reading the clock takes time
        {
            g_heartbeat.SendIfDue(NowNs());
        }
        return MapScheduler::RemoveNext();
    }

    // Time of the next event; false if there is none.
    static bool NextNs(int64_t& at_ns)
    {
        if (s_current->IsEmpty())
        {
            return false;
        }
        at_ns = static_cast<int64_t>(s_current->PeekNext().key.m_ts) - g_start_ns;
        return true;
    }

    static void Use()
    {
        ObjectFactory factory;
        factory.SetTypeId(GetTypeId());
        Simulator::SetScheduler(factory);
    }

  private:
    static inline PeekScheduler* s_current = nullptr;
    uint64_t m_events = 0;
};

// Process all events up to and including a time.
inline void
RunUntil(int64_t to_ns)
{
    int64_t next_ns;
    do
    {
        Simulator::Stop(NanoSeconds(to_ns - NowNs()));
        Simulator::Run();
        // An event at `to_ns` may have scheduled further events at `to_ns`, which follow the event that stops the
        // simulator.
    } while (PeekScheduler::NextNs(next_ns) && next_ns <= to_ns);
}

} // namespace fieldkit

#endif
