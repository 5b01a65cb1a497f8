// Requests to a network, with the packets that enter it; and its answers, with arrivals and drops.

#ifndef FIELDKIT_FEDERATES_PACKETS_H
#define FIELDKIT_FEDERATES_PACKETS_H

#include "states.h"

namespace fieldkit::protocol
{

constexpr size_t kPacketBytes = 52; // smallest size of a packet: five numbers, two indices, and two empty texts

struct Packet
{
    uint64_t id = 0; // number of the packet in the run
    int64_t number = 0; // number of the packet in its flow
    uint64_t size_bytes = 0;
    int64_t sent_ns = 0; // when its program sent it
    int64_t enters_ns = 0; // when it enters the network
    uint32_t source = 0; // index of an agent
    uint32_t destination = 0; // index of an agent
    std::string flow;
    std::string protocol; // name of a transport: udp, tcp, topic, ros1, ip or ip-broadcast
};

struct NetworkRequest
{
    int64_t to_ns = 0; // simulated time to advance to
    int64_t since_ns = 0; // time of `states`; only dead reckoning uses it
    int64_t reckoning_ns = 0; // step of dead reckoning; 0 if agents do not move until the next request
    std::vector<NewAgent> new_agents;
    std::vector<State> states;
    std::vector<Packet> packets;
};

inline NetworkRequest
ReadNetworkRequest(const std::string& body)
{
    Reader reader(body);
    NetworkRequest request;
    request.to_ns = reader.Get<int64_t>();
    request.since_ns = reader.Get<int64_t>();
    request.reckoning_ns = reader.Get<int64_t>();
    request.new_agents = ReadNewAgents(reader);
    request.states = ReadStates(reader);
    request.packets.resize(reader.Count(kPacketBytes));
    for (Packet& packet : request.packets)
    {
        packet.id = reader.Get<uint64_t>();
        packet.number = reader.Get<int64_t>();
        packet.size_bytes = reader.Get<uint64_t>();
        packet.sent_ns = reader.Get<int64_t>();
        packet.enters_ns = reader.Get<int64_t>();
        packet.source = reader.Get<uint32_t>();
        packet.destination = reader.Get<uint32_t>();
        packet.flow = reader.Text();
        packet.protocol = reader.Text();
    }
    reader.End();
    return request;
}

// Parts of the delay of a packet in the network; the rest of the delay is processing in hosts.
struct DelayParts
{
    int64_t queuing_ns = 0;
    int64_t transmission_ns = 0;
    int64_t propagation_ns = 0;
};

// Collects arrivals and drops for the next answer. Both must be added in order of time.
class Outcomes
{
  public:
    void Arrive(uint64_t id, int64_t at_ns, uint32_t agent)
    {
        m_arrivals.Put(id).Put(at_ns).Put(agent).Put(uint32_t{0});
        m_arrivalCount++;
    }

    // As above, with the parts of the delay. A network must report the parts of all arrivals or of none.
    void Arrive(uint64_t id, int64_t at_ns, uint32_t agent, const DelayParts& parts)
    {
        Arrive(id, at_ns, agent);
        m_parts.Put(parts.queuing_ns).Put(parts.transmission_ns).Put(parts.propagation_ns);
    }

    void Drop(uint64_t id, const std::string& reason)
    {
        m_drops.Put(id).PutText(reason);
        m_dropCount++;
    }

    uint32_t Arrivals() const
    {
        return m_arrivalCount;
    }

    uint32_t Drops() const
    {
        return m_dropCount;
    }

    // Return the body of the answer, and clear the collection. `next_event_ns` is -1 if there is no next event.
    std::string TakeBody(int64_t to_ns, int64_t next_event_ns)
    {
        Writer body;
        body.Put(to_ns).Put(next_event_ns).Put(m_arrivalCount);
        body.data += m_arrivals.data;
        body.Put(m_dropCount);
        body.data += m_drops.data;
        body.data += m_parts.data;
        *this = Outcomes();
        return body.data;
    }

  private:
    Writer m_arrivals, m_drops, m_parts;
    uint32_t m_arrivalCount = 0, m_dropCount = 0;
};

} // namespace fieldkit::protocol

#endif
