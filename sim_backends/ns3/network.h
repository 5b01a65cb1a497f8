// The network of a run: its setup from the configuration, and the requests of the coordinator.

#ifndef FIELDKIT_NETWORK_H
#define FIELDKIT_NETWORK_H

#include "fieldkit/handshake.h"
#include "fieldkit/packets.h"
#include "agents.h"
#include "captures.h"
#include "configuration.h"
#include "faults.h"
#include "medium.h"
#include "pending_packets.h"
#include "transports.h"

#include "ns3/rng-seed-manager.h"

#include <set>

namespace fieldkit
{

// Size of the RTPS headers in the datagram of a sample: message header, submessages for time stamp and data.
constexpr int64_t kRtpsHeaderBytes = 20 + 12 + 24;

// Transports of bare IP packets. The size of such a packet includes its headers.
constexpr const char* kIp = "ip";
constexpr const char* kIpBroadcast = "ip-broadcast";

class Network
{
  public:
    explicit Network(std::string version)
        : m_version(std::move(version))
    {
    }

    bool IsReady() const
    {
        return m_udp != nullptr;
    }

    std::string Hello(const std::string& body)
    {
        if (IsReady())
        {
            throw Refusal("hello was sent twice");
        }
        protocol::Hello hello = protocol::ReadHello(body, protocol::kNetwork);
        g_heartbeat.SetInterval(hello.heartbeat_ms);
        try
        {
            Configure(hello.seed, hello.agents, Json::parse(hello.configuration));
        }
        catch (const Json::exception& error)
        {
            throw Refusal(std::string("the configuration is incomplete (select the network by its name, ns3): ") +
                          error.what());
        }
        protocol::Welcome welcome;
        welcome.role = protocol::kNetwork;
        welcome.capabilities = protocol::kDeterministic | protocol::kNextEvent | protocol::kExtrapolates |
                               protocol::kAgentsDisappear | protocol::kSamplesLinks;
        welcome.step_ns = hello.step_ns;
        welcome.next_event_ns = NextEventNs();
        welcome.configuration_hash = hello.configuration_hash;
        welcome.name = "ns-3";
        welcome.software = "ns-3 " + m_version;
        welcome.transports = {"udp", "tcp", kIp, kIpBroadcast};
        if (m_options.carries_topics)
        {
            welcome.transports.push_back("topic");
        }
        std::set<uint32_t> transmitters = m_faults.jammer_carriers; // agents that forward or interfere
        if (m_medium.setup.relay >= 0)
        {
            transmitters.insert(m_agents.stations[m_medium.setup.relay].agent);
        }
        welcome.transmitters.assign(transmitters.begin(), transmitters.end());
        welcome.emitters_m = m_faults.emitters_m;
        return protocol::WelcomeBody(welcome);
    }

    std::string Advance(const std::string& body)
    {
        int64_t to_ns = Schedule(body, false);
        if (to_ns >= NowNs())
        {
            RunUntil(to_ns);
        }
        if (m_captures != nullptr)
        {
            m_captures->Flush();
        }
        return m_packets.TakeBody(to_ns, NextEventNs());
    }

    // Prepare a request, and return its `to_ns`.
    //
    // If `is_ahead`, the simulator may not have reached the start of the window, so events set the states at that time.
    int64_t Schedule(const std::string& body, bool is_ahead)
    {
        protocol::NetworkRequest request = protocol::ReadNetworkRequest(body);
        if (!request.new_agents.empty())
        {
            throw Refusal("an agent has appeared, which ns-3 does not support");
        }
        if (request.to_ns < m_toNs)
        {
            throw Refusal("time runs backwards to " + std::to_string(request.to_ns) + " ns");
        }
        int64_t from_ns = m_toNs;
        int64_t since_ns = request.since_ns;
        int64_t reckoning_ns = request.reckoning_ns;
        m_toNs = request.to_ns;
        int64_t wait_ns = is_ahead ? from_ns - NowNs() : 0;
        auto at_start = [wait_ns](auto change) {
            if (wait_ns > 0)
            {
                Simulator::Schedule(NanoSeconds(wait_ns), change);
            }
            else
            {
                change();
            }
        };
        std::vector<bool> present(m_agents.entries.size());
        for (const protocol::State& state : request.states)
        {
            uint32_t agent = state.agent;
            if (agent >= present.size())
            {
                throw Refusal("agent " + std::to_string(agent) + " was not announced");
            }
            present[agent] = true;
            auto mobility = m_agents.entries[agent].mobility;
            Vector position = VectorOf(state.position_m);
            Vector velocity = VectorOf(state.velocity_m_s);
            at_start([=] { mobility->Move(position, velocity, since_ns, reckoning_ns); });
        }
        for (uint32_t agent = 0; agent < present.size(); agent++)
        {
            AgentEntry& entry = m_agents.entries[agent];
            if (present[agent] == entry.is_present)
            {
                continue;
            }
            entry.is_present = present[agent];
            int station = entry.station;
            int change = present[agent] ? -1 : 1;
            if (station >= 0) // it has a radio
            {
                at_start([this, station, change] { m_medium.SwitchOff(station, change); });
            }
        }
        for (const protocol::Packet& packet : request.packets)
        {
            Enter(CheckedPacket(packet));
        }
        return request.to_ns;
    }

    // Samples of all radios and links at the current time.
    std::string SampleLinks()
    {
        return m_medium.SampleLinks();
    }

    const PendingPackets& packets() const
    {
        return m_packets;
    }

  private:
    void Configure(uint64_t seed, const std::vector<protocol::Agent>& agents, const Json& configuration)
    {
        const Json& scenario = configuration.at("scenario");
        const Json& radio = scenario.at("radio");
        m_options = ReadOptions(seed, configuration.at("options"));
        if (!m_options.delay_parts.empty())
        {
            m_packets.OpenParts(m_options.delay_parts);
        }
        if (m_options.carries_topics)
        {
            RefuseReliableTopics(scenario.at("traffic"));
        }
        RngSeedManager::SetSeed(1);
        RngSeedManager::SetRun(seed);
        m_agents.Add(agents, configuration.at("robots"));
        WifiSetup& setup = m_medium.setup;
        setup.ampdu_bytes = m_options.ampdu_bytes;
        setup.pcap = m_options.pcap;
        setup.standard = m_agents.are_ht ? "802.11n" : "802.11g";
        if (!m_options.standard.empty())
        {
            setup.standard = m_options.standard;
        }
        PeekScheduler::Use();
        TcpTransport::SetDefaults(scenario.at("tcp").at("congestion"));
        m_medium.tracker.on_lost = [this](uint64_t id, const std::string& reason) { m_packets.Drop(id, reason); };
        setup.queue_packets = radio.at("queue_packets");
        if (scenario.at("topology") == "master")
        {
            setup.relay = static_cast<int>(StationNamed(m_agents.stations, scenario.at("relay")));
        }
        if (configuration.contains("link"))
        {
            m_medium.UseFixedLinks(seed, configuration["link"],
                                   [this](uint64_t id) { return m_packets.Identity(id); });
        }
        else
        {
            m_medium.UseWifi(seed, radio, configuration.at("world"));
        }
        Fates fates{[this](uint64_t id) { m_packets.Arrive(id); },
                    [this](uint64_t id, const std::string& reason) { m_packets.Drop(id, reason); }};
        m_udp = std::make_unique<UdpTransport>(m_agents.stations, fates);
        m_tcp = std::make_unique<TcpTransport>(m_agents.stations, fates);
        if (configuration.contains("captures"))
        {
            m_captures = std::make_unique<IpCaptures>(configuration["captures"], m_agents.stations);
            m_tcp->on_connect = [this](Ipv4Address source, uint16_t port, const std::string& flow) {
                m_captures->Connect(source, port, flow);
            };
        }
        m_faults.AddFaults(configuration);
        m_faults.AddLifetimes(scenario.at("agents"));
        RunUntil(-1);
    }

    // Convert a packet between agents to a packet between stations; throws a refusal if ns-3 cannot carry it.
    CoordinatorPacket CheckedPacket(const protocol::Packet& entering) const
    {
        CoordinatorPacket packet;
        packet.id = entering.id;
        packet.number = entering.number;
        packet.size_bytes = entering.size_bytes;
        packet.enters_ns = entering.enters_ns;
        packet.source = m_agents.StationOf(entering.source);
        packet.destination = m_agents.StationOf(entering.destination);
        packet.flow = entering.flow;
        packet.protocol = entering.protocol;
        bool is_bare = packet.protocol == kIp || packet.protocol == kIpBroadcast;
        if (packet.protocol != "udp" && packet.protocol != "tcp" && !is_bare &&
            !(m_options.carries_topics && packet.protocol == "topic"))
        {
            throw Refusal("there is no transport " + packet.protocol);
        }
        // 65507 bytes is the largest payload of UDP over IPv4.
        uint64_t limit = packet.protocol == "tcp" ? uint64_t{1} << 30 : 65507 - kRtpsHeaderBytes;
        if (packet.size_bytes > limit)
        {
            throw Refusal("a packet of " + std::to_string(packet.size_bytes) + " bytes is too large for " +
                          packet.protocol);
        }
        return packet;
    }

    void Enter(const CoordinatorPacket& packet)
    {
        m_packets.Enter(packet);
        if (m_captures != nullptr)
        {
            m_captures->Enter(packet.id, packet.flow, packet.number);
        }
        Time after = NanoSeconds(std::max<int64_t>(packet.enters_ns - NowNs(), 0));
        uint32_t context = m_agents.stations[packet.source].node->GetId();
        Simulator::ScheduleWithContext(context, after, [this, id = packet.id] { Send(id); });
    }

    void Send(uint64_t id)
    {
        const CoordinatorPacket packet = m_packets.Copy(id); // a transport may drop the packet before it returns
        if (m_agents.stations[packet.source].off > 0)
        {
            m_packets.Drop(packet.id, "radio off");
        }
        else if (packet.protocol == "tcp")
        {
            m_tcp->Send(packet);
        }
        else if (packet.protocol == kIpBroadcast)
        {
            m_udp->SendToAll(packet);
        }
        else if (packet.protocol == kIp)
        {
            m_udp->Send(packet, -kIpAndUdpBytes);
        }
        else
        {
            m_udp->Send(packet, packet.protocol == "topic" ? kRtpsHeaderBytes : 0);
        }
    }

    static int64_t NextEventNs()
    {
        int64_t next_ns;
        return PeekScheduler::NextNs(next_ns) ? next_ns : -1;
    }

    std::string m_version;
    RunOptions m_options;
    Agents m_agents;
    Medium m_medium{m_agents.stations};
    Faults m_faults{m_agents, m_medium};
    PendingPackets m_packets{m_agents.stations, m_medium.tracker};
    std::unique_ptr<UdpTransport> m_udp;
    std::unique_ptr<TcpTransport> m_tcp;
    std::unique_ptr<IpCaptures> m_captures; // null if there are none
    int64_t m_toNs = -1; // end of the last requested window
};

} // namespace fieldkit

#endif
