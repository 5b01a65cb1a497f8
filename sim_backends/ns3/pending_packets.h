// The packets of the coordinator that are in the network, and their outcomes: arrivals with parts of the delay, drops.

#ifndef FIELDKIT_PENDING_PACKETS_H
#define FIELDKIT_PENDING_PACKETS_H

#include "configuration.h"
#include "fixed_links.h"
#include "transports.h"

namespace fieldkit
{

class PendingPackets
{
  public:
    PendingPackets(const std::vector<Station>& stations, const FrameTracker& tracker)
        : m_stations(stations),
          m_tracker(tracker)
    {
    }

    // Write the parts of the delay of each arrival to a new file.
    void OpenParts(const std::string& path)
    {
        OpenNew(m_parts, path, "delay_parts");
        m_parts << "flow,number,delay_ns,processing_ns,queueing_ns,transmission_ns,propagation_ns\n";
    }

    void Enter(const CoordinatorPacket& packet)
    {
        if (!m_packets.emplace(packet.id, packet).second)
        {
            throw Refusal("packet " + std::to_string(packet.id) + " has entered before");
        }
    }

    // Name and number of a packet. A packet that has arrived or was dropped is not in the network; its other fragments
    // get another name.
    PacketIdentity Identity(uint64_t id) const
    {
        auto entry = m_packets.find(id);
        return entry == m_packets.end() ? PacketIdentity("decided", id)
                                        : PacketIdentity(entry->second.flow, entry->second.number);
    }

    // A copy of a packet in the network.
    CoordinatorPacket Copy(uint64_t id) const
    {
        return m_packets.at(id);
    }

    void Arrive(uint64_t id)
    {
        auto entry = m_packets.find(id);
        if (entry == m_packets.end())
        {
            return;
        }
        const CoordinatorPacket& packet = entry->second;
        int64_t now_ns = NowNs();
        DelayParts parts = WithinDelay(m_tracker.PartsNow(packet.destination), now_ns - packet.enters_ns);
        m_outcomes.Arrive(id, now_ns, m_stations[packet.destination].agent, parts);
        m_checksum = m_checksum * 31 + static_cast<uint64_t>(now_ns);
        if (m_parts.is_open())
        {
            WriteParts(packet, now_ns - packet.enters_ns, parts);
        }
        m_packets.erase(entry);
    }

    void Drop(uint64_t id, const std::string& reason)
    {
        if (m_packets.erase(id) > 0)
        {
            m_outcomes.Drop(id, reason);
        }
    }

    // The outcomes since the last call, as an answer; `next_event_ns` is -1 if there is no next event.
    std::string TakeBody(int64_t to_ns, int64_t next_event_ns)
    {
        return m_outcomes.TakeBody(to_ns, next_event_ns);
    }

    // Outcomes since the last call of `TakeBody`.
    const protocol::Outcomes& outcomes() const
    {
        return m_outcomes;
    }

    // A checksum of the times of all arrivals.
    uint64_t checksum() const
    {
        return m_checksum;
    }

  private:
    // The parts of a delay. A frame may have been queued before the TCP message that it completes, so each part is
    // limited to the remaining delay.
    static DelayParts WithinDelay(DelayParts parts, int64_t delay_ns)
    {
        parts.propagation_ns = std::min(parts.propagation_ns, delay_ns);
        parts.transmission_ns = std::min(parts.transmission_ns, delay_ns - parts.propagation_ns);
        parts.queuing_ns = std::min(parts.queuing_ns, delay_ns - parts.propagation_ns - parts.transmission_ns);
        return parts;
    }

    void WriteParts(const CoordinatorPacket& packet, int64_t delay_ns, const DelayParts& parts)
    {
        int64_t processing_ns = delay_ns - parts.propagation_ns - parts.transmission_ns - parts.queuing_ns;
        std::string flow = packet.flow;
        for (size_t quote = 0; (quote = flow.find('"', quote)) != std::string::npos; quote += 2)
        {
            flow.insert(quote, 1, '"');
        }
        m_parts << '"' << flow << "\"," << packet.number << ',' << delay_ns << ',' << processing_ns << ','
                << parts.queuing_ns << ',' << parts.transmission_ns << ',' << parts.propagation_ns << '\n';
    }

    const std::vector<Station>& m_stations;
    const FrameTracker& m_tracker;
    std::unordered_map<uint64_t, CoordinatorPacket> m_packets;
    protocol::Outcomes m_outcomes;
    std::ofstream m_parts; // the file of the option `delay_parts`
    uint64_t m_checksum = 0;
};

} // namespace fieldkit

#endif
