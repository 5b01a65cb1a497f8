// Links with a given rate, delay, jitter and loss instead of Wi-Fi: the model of
// sim_backends/radio/models/fixed_links.py below ns-3's IP layer, with the same random draws for packets with an IdTag.

#ifndef FIELDKIT_FIXED_LINKS_H
#define FIELDKIT_FIXED_LINKS_H

#include "frames.h"
#include "keyed_random.h"
#include "stations.h"

#include "ns3/ipv4-header.h"
#include "ns3/simple-channel.h"
#include "ns3/simple-net-device.h"

#include <deque>

namespace fieldkit
{

struct LinkParameters
{
    int64_t rate_bit_s = 0; // 0 means unlimited
    int64_t delay_ns = 0;
    int64_t jitter_ns = 0;
    double loss = 0;
    size_t queue_packets = 0; // without the packet that is being sent

    // The time for which a packet occupies a link, rounded up.
    int64_t SerializationNs(uint64_t size_bytes) const
    {
        auto bits = static_cast<unsigned __int128>(8 * size_bytes) * 1'000'000'000;
        return rate_bit_s == 0 ? 0 : static_cast<int64_t>((bits + rate_bit_s - 1) / rate_bit_s);
    }
};

// Name and number of a packet, which key its random draws.
using PacketIdentity = std::pair<std::string, int64_t>;

// All links of the stations, in both directions. With a relay, a packet between two other stations crosses two links.
class FixedLinks : public SimpleChannel
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type = TypeId("fieldkit::FixedLinks").SetParent<SimpleChannel>().AddConstructor<FixedLinks>();
        return type;
    }

    uint64_t seed = 0;
    int relay = -1;
    LinkParameters parameters;
    FrameTracker* tracker = nullptr;
    std::function<PacketIdentity(uint64_t)> identity_of; // identity of a packet in transit, by its id

    void Connect(std::vector<Station>& stations)
    {
        m_stations = &stations;
        m_links.resize(stations.size() * stations.size());
        for (size_t number = 0; number < stations.size(); number++)
        {
            m_numbers[Mac48Address::ConvertFrom(stations[number].device->GetAddress())] = number;
        }
    }

    // Add `change` to the number of reasons why two stations cannot receive each other.
    void Cut(size_t a, size_t b, int change)
    {
        LinkOf(a, b).cuts += change;
        LinkOf(b, a).cuts += change;
    }

    // Empty the queues of a station whose radio is switched off.
    void SwitchOff(size_t station)
    {
        for (size_t other = 0; other < m_stations->size(); other++)
        {
            Link& link = LinkOf(station, other);
            link.off_ns = link.free_ns = NowNs();
            link.starts_ns.clear();
            link.last_ns = std::min(link.last_ns, NowNs() + parameters.delay_ns + parameters.jitter_ns);
        }
    }

    void Send(Ptr<Packet> packet, uint16_t protocol, Mac48Address to, Mac48Address from, Ptr<SimpleNetDevice>) override
    {
        Hop hop;
        hop.packet = packet;
        hop.protocol = protocol;
        hop.destination = to;
        hop.source = from;
        hop.from = m_numbers.at(from);
        hop.identity = IdentityOf(packet, hop.from);
        bool has_relay = relay >= 0 && static_cast<size_t>(relay) != hop.from;
        auto receiver = m_numbers.find(to);
        for (size_t number = 0; number < m_stations->size(); number++)
        {
            if (number != hop.from && (receiver == m_numbers.end() || receiver->second == number))
            {
                hop.receivers.push_back(number);
            }
        }
        if (has_relay && (receiver == m_numbers.end() || receiver->second != static_cast<size_t>(relay)))
        {
            hop.to = relay;
            Transmit(hop);
            return;
        }
        // The loop uses a separate vector, because it changes the receivers of the hop.
        for (size_t number : std::vector<size_t>(std::move(hop.receivers)))
        {
            hop.to = number;
            hop.receivers = {number};
            Transmit(hop);
        }
    }

  private:
    struct Link
    {
        int cuts = 0;
        int64_t free_ns = 0; // end of the last transmission
        int64_t last_ns = 0; // last arrival
        int64_t off_ns = -1; // time at which the transmitter was switched off
        std::deque<int64_t> starts_ns; // start times of the transmissions of queued packets
    };

    // A packet on one link.
    struct Hop
    {
        Ptr<Packet> packet;
        uint16_t protocol = 0;
        Mac48Address destination, source;
        size_t from = 0, to = 0;
        std::vector<size_t> receivers; // its final receivers, including those to which the relay forwards it
        PacketIdentity identity;
        DelayParts parts;
    };

    Link& LinkOf(size_t from, size_t to)
    {
        return m_links[from * m_stations->size() + to];
    }

    // The identity of a packet with an IdTag, as in sim_backends/network/ip.py; other packets, such as TCP segments and
    // broadcasts, are numbered.
    PacketIdentity IdentityOf(Ptr<const Packet> packet, size_t station)
    {
        IdTag tag;
        if (!packet->PeekPacketTag(tag))
        {
            return {(*m_stations)[station].name + " ns-3", m_sent++};
        }
        PacketIdentity identity = identity_of(tag.number);
        Ipv4Header header;
        packet->PeekHeader(header);
        constexpr uint16_t kFragmentBytes = 1480; // payload of a full fragment with an MTU of 1500 bytes
        if (int fragment = header.GetFragmentOffset() / kFragmentBytes)
        {
            identity.first += " fragment " + std::to_string(fragment);
        }
        return identity;
    }

    double Draw(const Hop& hop, const std::string& purpose)
    {
        const std::string& from = (*m_stations)[hop.from].name;
        const std::string& to = (*m_stations)[hop.to].name;
        auto key = std::make_tuple(hop.from, hop.to, purpose, hop.identity.first);
        auto stream = m_streams.find(key);
        if (stream == m_streams.end())
        {
            stream = m_streams.emplace(key, RandomStream(seed, {from, to, purpose, hop.identity.first, "0"})).first;
        }
        return stream->second.Draw(static_cast<uint64_t>(hop.identity.second));
    }

    bool IsOff(size_t station) const
    {
        return (*m_stations)[station].off > 0;
    }

    void Transmit(Hop hop)
    {
        Link& link = LinkOf(hop.from, hop.to);
        LinkCounters& counters = tracker->Counters(hop.from, hop.to);
        counters.rate_bit_s = parameters.rate_bit_s == 0 ? NAN : static_cast<double>(parameters.rate_bit_s);
        if (link.cuts > 0 || IsOff(hop.from) || IsOff(hop.to))
        {
            counters.frames++;
            return tracker->Lost(hop.packet, "out of range");
        }
        int64_t now_ns = NowNs();
        int64_t transmission_ns = parameters.SerializationNs(hop.packet->GetSize());
        int64_t start_ns = now_ns;
        if (parameters.rate_bit_s > 0)
        {
            while (!link.starts_ns.empty() && link.starts_ns.front() <= now_ns)
            {
                link.starts_ns.pop_front();
            }
            if (link.free_ns > now_ns)
            {
                if (link.starts_ns.size() >= parameters.queue_packets)
                {
                    return tracker->Lost(hop.packet, "queue full");
                }
                start_ns = link.free_ns;
                link.starts_ns.push_back(start_ns);
            }
            link.free_ns = start_ns + transmission_ns;
        }
        counters.frames++;
        if (parameters.loss > 0 && Draw(hop, "loss") < parameters.loss)
        {
            return tracker->Lost(hop.packet, "lost on the link");
        }
        int64_t sent_ns = start_ns + transmission_ns;
        int64_t at_ns = sent_ns + parameters.delay_ns;
        if (parameters.jitter_ns > 0)
        {
            at_ns += static_cast<int64_t>(Draw(hop, "jitter") * static_cast<double>(parameters.jitter_ns));
        }
        at_ns = link.last_ns = std::max(at_ns, link.last_ns); // packets do not overtake each other
        hop.parts.queuing_ns += start_ns - now_ns;
        hop.parts.transmission_ns += transmission_ns;
        hop.parts.propagation_ns += at_ns - sent_ns;
        uint32_t context = (*m_stations)[hop.to].node->GetId();
        Simulator::ScheduleWithContext(context, NanoSeconds(at_ns - now_ns), [this, hop, now_ns, sent_ns] {
            int64_t off_ns = LinkOf(hop.from, hop.to).off_ns;
            if (off_ns >= now_ns && off_ns < sent_ns)
            {
                return tracker->Lost(hop.packet, "radio off");
            }
            tracker->Counters(hop.from, hop.to).delivered++;
            Arrive(hop);
        });
    }

    void Arrive(const Hop& hop)
    {
        for (size_t receiver : hop.receivers)
        {
            if (receiver != hop.to)
            {
                Hop next = hop;
                next.from = hop.to;
                next.to = receiver;
                next.receivers = {receiver};
                next.packet = hop.packet->Copy();
                Transmit(next);
            }
            else if (IsOff(receiver))
            {
                tracker->Lost(hop.packet, "radio off");
            }
            else
            {
                tracker->SetParts(receiver, hop.parts);
                auto device = DynamicCast<SimpleNetDevice>((*m_stations)[receiver].device);
                device->Receive(hop.packet->Copy(), hop.protocol, hop.destination, hop.source);
            }
        }
    }

    std::vector<Station>* m_stations = nullptr;
    std::map<Mac48Address, size_t> m_numbers;
    std::vector<Link> m_links; // by transmitter and receiver
    std::map<std::tuple<size_t, size_t, std::string, std::string>, RandomStream> m_streams;
    int64_t m_sent = 0; // number of packets without an IdTag
};

// Give the stations IP addresses and links; callbacks of ns-3 keep references to `stations`.
inline void
InstallFixedLinks(std::vector<Station>& stations, Ptr<FixedLinks> links, FrameTracker& tracker)
{
    Config::SetDefault("ns3::DropTailQueue<Packet>::MaxSize", QueueSizeValue(QueueSize("1000000p"))); // links have queues
    for (Station& station : stations)
    {
        station.node = CreateObject<Node>();
        station.node->AggregateObject(station.mobility);
        auto device = CreateObject<SimpleNetDevice>();
        device->SetAddress(Mac48Address::Allocate());
        device->SetChannel(links);
        station.node->AddDevice(device);
        station.device = device;
        tracker.AddStation(station.mobility);
    }
    links->Connect(stations);
    InstallIp(stations, tracker);
}

} // namespace fieldkit

#endif
