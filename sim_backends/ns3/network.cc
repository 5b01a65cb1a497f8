// The network federate of ns-3: docs/ns3.md. Standard input and output carry the protocol of docs/federates.md.
//
//     network VERSION                 serve one run
//     network VERSION alone FILE      simulate the requests of a recorded run, and print the processor time
//     network VERSION losses          print the losses of links, for tests

#include "fieldkit/handshake.h"
#include "fieldkit/links.h"
#include "fieldkit/packets.h"
#include "captures.h"
#include "fixed_links.h"
#include "jammers.h"
#include "transports.h"

#include "ns3/rng-seed-manager.h"

#include <fstream>
#include <iostream>
#include <set>

namespace fieldkit
{

// Size of the RTPS headers in the datagram of a sample: message header, submessages for time stamp and data.
constexpr int64_t kRtpsHeaderBytes = 20 + 12 + 24;

// Transports of bare IP packets. The size of such a packet includes its headers.
constexpr const char* kIp = "ip";
constexpr const char* kIpBroadcast = "ip-broadcast";

// Time before the start of the co-simulation in which stations scan, and associate with their access point.
constexpr int64_t kAssociationNs = 1'000'000'000;

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
        if (m_carriesTopics)
        {
            welcome.transports.push_back("topic");
        }
        welcome.transmitters.assign(m_transmitters.begin(), m_transmitters.end());
        welcome.emitters_m = m_emitters_m;
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
        return m_outcomes.TakeBody(to_ns, NextEventNs());
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
        std::vector<bool> present(m_agents.size());
        for (const protocol::State& state : request.states)
        {
            uint32_t agent = state.agent;
            if (agent >= m_agents.size())
            {
                throw Refusal("agent " + std::to_string(agent) + " was not announced");
            }
            present[agent] = true;
            auto mobility = m_agents[agent].mobility;
            Vector position = VectorOf(state.position_m);
            Vector velocity = VectorOf(state.velocity_m_s);
            if (is_ahead && from_ns > NowNs())
            {
                Simulator::Schedule(NanoSeconds(from_ns - NowNs()), [=] {
                    mobility->Move(position, velocity, since_ns, reckoning_ns);
                });
            }
            else
            {
                mobility->Move(position, velocity, since_ns, reckoning_ns);
            }
        }
        for (uint32_t agent = 0; agent < m_agents.size(); agent++)
        {
            if (present[agent] == m_agents[agent].is_present)
            {
                continue;
            }
            m_agents[agent].is_present = present[agent];
            int station = m_agents[agent].station;
            int change = present[agent] ? -1 : 1;
            if (station < 0)
            {
                continue; // it has no radio
            }
            if (is_ahead && from_ns > NowNs())
            {
                Simulator::Schedule(NanoSeconds(from_ns - NowNs()),
                                    [this, station, change] { SwitchOff(station, change); });
            }
            else
            {
                SwitchOff(station, change);
            }
        }
        for (const protocol::Packet& packet : request.packets)
        {
            Enter(CheckedPacket(packet));
        }
        return request.to_ns;
    }

    // Samples of all radios, and of their links to the stations to which they send frames, at the current time.
    std::string SampleLinks()
    {
        std::vector<protocol::RadioSample> radios;
        std::vector<protocol::LinkSample> links;
        for (size_t number = 0; number < m_stations.size(); number++)
        {
            if (m_links != nullptr)
            {
                radios.push_back({m_stations[number].agent});
            }
            else
            {
                radios.push_back({m_stations[number].agent, m_setup.noise_dbm, NowNs(), m_tracker.BusyNs(number)});
            }
            bool is_client = m_links == nullptr && m_setup.relay >= 0 && static_cast<size_t>(m_setup.relay) != number;
            for (size_t peer = 0; peer < m_stations.size(); peer++)
            {
                if (peer != number && (!is_client || static_cast<size_t>(m_setup.relay) == peer))
                {
                    links.push_back(SampleLink(number, peer));
                }
            }
        }
        return protocol::LinksBody(radios, links);
    }

    size_t arrivals() const
    {
        return m_outcomes.Arrivals();
    }

    size_t drops() const
    {
        return m_outcomes.Drops();
    }

    // A checksum of the times of all arrivals.
    uint64_t checksum() const
    {
        return m_checksum;
    }

  private:
    struct AgentEntry
    {
        std::string name;
        int station = -1; // -1 if it has no radio
        Ptr<AgentMobility> mobility;
        bool is_present = true; // in the last states
    };

    void Configure(uint64_t seed, const std::vector<protocol::Agent>& agents, const Json& configuration)
    {
        const Json& scenario = configuration.at("scenario");
        const Json& radio = scenario.at("radio");
        ReadOptions(seed, configuration.at("options"), scenario);
        RngSeedManager::SetSeed(1);
        RngSeedManager::SetRun(seed);
        AddStations(agents, configuration.at("robots"));
        PeekScheduler::Use();
        TcpTransport::SetDefaults(scenario.at("tcp").at("congestion"));
        m_tracker.on_lost = [this](uint64_t id, const std::string& reason) { Drop(id, reason); };
        m_setup.queue_packets = radio.at("queue_packets");
        if (scenario.at("topology") == "master")
        {
            m_setup.relay = static_cast<int>(StationNamed(scenario.at("relay")));
            m_transmitters.insert(m_stations[m_setup.relay].agent);
        }
        if (configuration.contains("link"))
        {
            AddFixedLinks(seed, configuration["link"]);
        }
        else
        {
            AddWifi(seed, radio, configuration.at("world"));
        }
        Fates fates{[this](uint64_t id) { Arrive(id); },
                    [this](uint64_t id, const std::string& reason) { Drop(id, reason); }};
        m_udp = std::make_unique<UdpTransport>(m_stations, fates);
        m_tcp = std::make_unique<TcpTransport>(m_stations, fates);
        if (configuration.contains("captures"))
        {
            m_captures = std::make_unique<IpCaptures>(configuration["captures"], m_stations);
            m_tcp->on_connect = [this](Ipv4Address source, uint16_t port, const std::string& flow) {
                m_captures->Connect(source, port, flow);
            };
        }
        const Json& faults = scenario.at("faults");
        for (size_t number = 0; number < faults.size(); number++)
        {
            std::string kind = faults[number].at("kind");
            if (kind == "jammer")
            {
                AddJammer(faults[number], configuration.at("jammers").at(number));
            }
            else
            {
                AddFault(kind, faults[number]);
            }
        }
        for (size_t number = 0; number < m_stations.size(); number++)
        {
            AddLifetime(number, scenario.at("agents").at(m_stations[number].name));
        }
        RunUntil(-1);
    }

    // Create links with the parameters in the configuration, which `ns3_options.py` has computed.
    void AddFixedLinks(uint64_t seed, const Json& link)
    {
        m_links = CreateObject<FixedLinks>();
        m_links->seed = seed;
        m_links->relay = m_setup.relay;
        m_links->parameters.rate_bit_s = link.at("rate_bit_s").is_null() ? 0 : link["rate_bit_s"].get<int64_t>();
        m_links->parameters.delay_ns = link.at("delay_ns");
        m_links->parameters.jitter_ns = link.at("jitter_ns");
        m_links->parameters.loss = link.at("loss");
        m_links->parameters.queue_packets = m_setup.queue_packets;
        m_links->tracker = &m_tracker;
        m_links->identity_of = [this](uint64_t id) {
            auto packet = m_pending.find(id);
            // A packet that has arrived or was dropped is not pending; its other fragments get this identity.
            return packet == m_pending.end() ? PacketIdentity("decided", id)
                                             : PacketIdentity(packet->second.flow, packet->second.number);
        };
        InstallFixedLinks(m_stations, m_links, m_tracker);
    }

    void AddWifi(uint64_t seed, const Json& radio, const Json& world)
    {
        if (!m_setup.pcap.empty() && !m_stations.empty())
        {
            // Open the first file here to report an error: ns-3 aborts if it cannot open a file.
            std::ofstream first;
            OpenNew(first, m_setup.pcap + m_stations[0].name + ".pcap", "pcap");
        }
        m_setup.mode = radio.value("mode", "");
        if (m_setup.mode.substr(0, 1) == "n" && m_setup.standard != "802.11n")
        {
            throw Refusal("the mode " + m_setup.mode + " needs the standard 802.11n in all radios");
        }
        m_setup.noise_dbm = Number(radio.at("noise_floor_dbm"));
        if (m_setup.relay >= 0)
        {
            g_start_ns = kAssociationNs;
            if (m_setup.ampdu_bytes == 0)
            {
                m_tracker.relay = m_setup.relay;
            }
        }
        std::vector<std::string> names;
        for (const Station& station : m_stations)
        {
            names.push_back(station.name);
        }
        m_channel = std::make_unique<Channel>(seed, radio, world, names);
        Install(m_stations, m_setup, *m_channel, m_tracker);
        m_jammers = std::make_unique<Jammers>(m_stations, *m_channel, m_setup.noise_dbm);
    }

    // Add a jammer, which an agent carries if it has no position.
    void AddJammer(const Json& fault, const Json& position_m)
    {
        std::function<bool(Point&)> locate;
        if (position_m.is_null())
        {
            auto carrier = AgentNamed(fault.at("agent"));
            m_transmitters.insert(carrier);
            locate = [this, carrier](Point& at) {
                Vector here = m_agents[carrier].mobility->GetPosition();
                at = {here.x, here.y, here.z};
                return m_agents[carrier].is_present;
            };
        }
        else
        {
            Point fixed = position_m.get<Point>();
            m_emitters_m.push_back(fixed);
            locate = [fixed](Point& at) {
                at = fixed;
                return true;
            };
        }
        Time until = fault.contains("to") ? At(fault["to"]) : Time::Max();
        m_jammers->Add(Number(fault.at("power_dbm")), At(fault.at("from")), until, locate);
    }

    protocol::LinkSample SampleLink(size_t number, size_t peer)
    {
        const Station& station = m_stations[number];
        const Station& other = m_stations[peer];
        const LinkCounters& sent = m_tracker.Counters(number, peer);
        const LinkCounters& reverse = m_tracker.Counters(peer, number);
        protocol::LinkSample sample{station.agent, other.agent};
        sample.tx_rate_bit_s = sent.rate_bit_s;
        sample.rx_rate_bit_s = reverse.rate_bit_s;
        sample.tx_packets = sent.frames;
        sample.rx_packets = reverse.delivered;
        sample.tx_retries = sent.retries;
        sample.tx_failures = sent.failures;
        if (m_channel == nullptr)
        {
            return sample;
        }
        Vector here = station.mobility->GetPosition();
        Vector there = other.mobility->GetPosition();
        double loss_db =
            m_channel->LossDb(NowNs(), peer, {there.x, there.y, there.z}, number, {here.x, here.y, here.z});
        double mean_db = m_channel->MeanLossDb(peer, number);
        bool is_in_range = other.tx_power_dbm - mean_db >= station.sensitivity_dbm &&
                           station.tx_power_dbm - mean_db >= other.sensitivity_dbm;
        sample.signal_dbm = is_in_range ? other.tx_power_dbm - loss_db : NAN;
        return sample;
    }

    // Add `change` to the number of reasons why the radio of a station is off; it is on if there are none.
    void SwitchOff(size_t station, int change)
    {
        m_stations[station].off += change;
        if (m_links != nullptr && change > 0 && m_stations[station].off == 1)
        {
            m_links->SwitchOff(station);
        }
        for (size_t other = 0; m_channel != nullptr && other < m_stations.size(); other++)
        {
            if (other != station)
            {
                m_channel->Cut(station, other, change);
            }
        }
    }

    void Cut(size_t first, size_t second, int change)
    {
        if (m_links != nullptr)
        {
            m_links->Cut(first, second, change);
        }
        else
        {
            m_channel->Cut(first, second, change);
        }
    }

    // ns-3's time at a time of the scenario, which is given in seconds.
    static Time At(const Json& seconds)
    {
        return NanoSeconds(g_start_ns + std::llround(Number(seconds) * 1e9));
    }

    // The radio of an agent is off before it appears, and after it has disappeared.
    void AddLifetime(size_t station, const Json& plan)
    {
        if (plan.contains("appears") && Number(plan["appears"]) > 0)
        {
            SwitchOff(station, 1);
            Simulator::Schedule(At(plan["appears"]), [this, station] { SwitchOff(station, -1); });
        }
        if (plan.contains("disappears"))
        {
            Simulator::Schedule(At(plan["disappears"]), [this, station] { SwitchOff(station, 1); });
        }
    }

    // Read `network.options` of the scenario, which `ns3_options.py` has validated and completed.
    void ReadOptions(uint64_t seed, const Json& options, const Json& scenario)
    {
        m_setup.ampdu_bytes = options.at("ampdu_bytes");
        m_hasStandard = options.contains("standard");
        m_setup.standard = options.value("standard", m_setup.standard);
        m_carriesTopics = options.contains("topics");
        if (options.contains("delay_parts"))
        {
            OpenNew(m_parts, OutputPath(options["delay_parts"], seed), "delay_parts");
            m_parts << "flow,number,delay_ns,processing_ns,queueing_ns,transmission_ns,propagation_ns\n";
        }
        if (options.contains("pcap"))
        {
            m_setup.pcap = OutputPath(options["pcap"], seed);
        }
        for (const Json& traffic : scenario.at("traffic"))
        {
            bool is_reliable =
                !traffic.contains("qos") || traffic["qos"].value("reliability", "reliable") == "reliable";
            if (m_carriesTopics && traffic.at("protocol") == "topic" && is_reliable)
            {
                throw Refusal("topics: udp carries best_effort topics only, but " +
                              traffic.at("from").get<std::string>() + " publishes a reliable topic");
            }
        }
    }

    // A path in which the first {seed} is replaced by the seed.
    static std::string OutputPath(std::string path, uint64_t seed)
    {
        const std::string placeholder = "{seed}";
        auto at = path.find(placeholder);
        if (at != std::string::npos)
        {
            path.replace(at, placeholder.size(), std::to_string(seed));
        }
        return path;
    }

    static void OpenNew(std::ofstream& file, const std::string& path, const std::string& option)
    {
        file.open(path, std::ios::trunc);
        if (!file)
        {
            throw Refusal("the file of " + option + " cannot be written: " + path);
        }
    }

    void AddStations(const std::vector<protocol::Agent>& agents, const Json& robots)
    {
        bool is_ht = true;
        for (const protocol::Agent& agent : agents)
        {
            const Json radio = robots.at(agent.name).at("radio");
            auto mobility = CreateObject<AgentMobility>();
            mobility->SetPosition(VectorOf(agent.start.position_m));
            m_agents.push_back({agent.name, radio.is_null() ? -1 : static_cast<int>(m_stations.size()), mobility});
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
            station.agent = static_cast<uint32_t>(m_agents.size() - 1);
            station.tx_power_dbm = Number(radio.at("tx_power_dbm"));
            station.sensitivity_dbm = Number(radio.at("sensitivity_dbm"));
            station.mobility = mobility;
            m_stations.push_back(station);
            is_ht = is_ht && radio.at("standard") == "802.11n";
        }
        if (!m_hasStandard && !is_ht)
        {
            m_setup.standard = "802.11g";
        }
    }

    size_t StationNamed(const std::string& name) const
    {
        for (size_t number = 0; number < m_stations.size(); number++)
        {
            if (m_stations[number].name == name)
            {
                return number;
            }
        }
        throw Refusal("there is no station " + name);
    }

    uint32_t AgentNamed(const std::string& name) const
    {
        for (uint32_t agent = 0; agent < m_agents.size(); agent++)
        {
            if (m_agents[agent].name == name)
            {
                return agent;
            }
        }
        throw Refusal("there is no agent " + name);
    }

    void AddFault(const std::string& kind, const Json& fault)
    {
        std::function<void(int)> add_reason;
        if (kind == "link-cut")
        {
            size_t first = StationNamed(fault.at("between")[0]), second = StationNamed(fault.at("between")[1]);
            add_reason = [this, first, second](int change) { Cut(first, second, change); };
        }
        else if (kind == "node-loss")
        {
            size_t station = StationNamed(fault.at("agent"));
            add_reason = [this, station](int change) { SwitchOff(station, change); };
        }
        else
        {
            return; // the fault does not affect radios
        }
        Simulator::Schedule(At(fault.at("from")), [add_reason] { add_reason(1); });
        if (fault.contains("to"))
        {
            Simulator::Schedule(At(fault.at("to")), [add_reason] { add_reason(-1); });
        }
    }

    // Convert a packet between agents to a packet between stations; throws a refusal if ns-3 cannot carry it.
    CoordinatorPacket CheckedPacket(const protocol::Packet& entering) const
    {
        CoordinatorPacket packet;
        packet.id = entering.id;
        packet.number = entering.number;
        packet.size_bytes = entering.size_bytes;
        packet.enters_ns = entering.enters_ns;
        packet.source = StationOf(entering.source);
        packet.destination = StationOf(entering.destination);
        packet.flow = entering.flow;
        packet.protocol = entering.protocol;
        bool is_bare = packet.protocol == kIp || packet.protocol == kIpBroadcast;
        if (packet.protocol != "udp" && packet.protocol != "tcp" && !is_bare &&
            !(m_carriesTopics && packet.protocol == "topic"))
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

    size_t StationOf(uint32_t agent) const
    {
        if (agent >= m_agents.size() || m_agents[agent].station < 0)
        {
            throw Refusal("agent " + std::to_string(agent) + " has no radio");
        }
        return m_agents[agent].station;
    }

    void Enter(const CoordinatorPacket& packet)
    {
        if (!m_pending.emplace(packet.id, packet).second)
        {
            throw Refusal("packet " + std::to_string(packet.id) + " has entered before");
        }
        if (m_captures != nullptr)
        {
            m_captures->Enter(packet.id, packet.flow, packet.number);
        }
        Time after = NanoSeconds(std::max<int64_t>(packet.enters_ns - NowNs(), 0));
        uint32_t context = m_stations[packet.source].node->GetId();
        Simulator::ScheduleWithContext(context, after, [this, id = packet.id] { Send(m_pending.at(id)); });
    }

    void Send(const CoordinatorPacket packet)
    {
        if (m_stations[packet.source].off > 0)
        {
            Drop(packet.id, "radio off");
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

    void Arrive(uint64_t id)
    {
        auto entry = m_pending.find(id);
        if (entry == m_pending.end())
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
        m_pending.erase(entry);
    }

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

    void Drop(uint64_t id, const std::string& reason)
    {
        if (m_pending.erase(id) > 0)
        {
            m_outcomes.Drop(id, reason);
        }
    }

    static Vector VectorOf(const std::array<double, 3>& values)
    {
        return Vector(values[0], values[1], values[2]);
    }

    static int64_t NextEventNs()
    {
        int64_t next_ns;
        return PeekScheduler::NextNs(next_ns) ? next_ns : -1;
    }

    std::string m_version;
    WifiSetup m_setup;
    bool m_hasStandard = false;
    bool m_carriesTopics = false;
    std::ofstream m_parts; // the file of the option `delay_parts`
    std::vector<Station> m_stations;
    std::vector<AgentEntry> m_agents;
    std::set<uint32_t> m_transmitters; // agents that forward or interfere
    std::vector<Point> m_emitters_m;   // positions of jammers that no agent carries
    std::unique_ptr<Channel> m_channel; // null with fixed links
    std::unique_ptr<Jammers> m_jammers; // null with fixed links
    Ptr<FixedLinks> m_links;            // null with Wi-Fi
    FrameTracker m_tracker;
    std::unique_ptr<UdpTransport> m_udp;
    std::unique_ptr<TcpTransport> m_tcp;
    std::unique_ptr<IpCaptures> m_captures; // null if there are none
    int64_t m_toNs = -1; // end of the last requested window
    std::unordered_map<uint64_t, CoordinatorPacket> m_pending; // packets that have neither arrived nor been dropped
    protocol::Outcomes m_outcomes;
    uint64_t m_checksum = 0;
};

// Answer a request of the coordinator.
protocol::Answer
AnswerTo(Network& network, const protocol::Frame& request)
{
    switch (request.kind)
    {
    case protocol::kHello:
        return {protocol::kWelcome, network.Hello(request.body)};
    case protocol::kAdvanceNetwork:
        if (!network.IsReady() || request.copy != 0)
        {
            throw Refusal("hello is missing, or there is no such copy");
        }
        return {protocol::kOutcomes, network.Advance(request.body)};
    case protocol::kSampleLinks:
        if (!network.IsReady() || request.copy != 0 || !request.body.empty())
        {
            throw Refusal("hello is missing, there is no such copy, or bytes follow the message");
        }
        return {protocol::kLinks, network.SampleLinks()};
    default:
        throw Refusal("the request is not supported");
    }
}

// Simulate the requests of a file without a coordinator.
int
RunAlone(Network& network, const char* path)
{
    std::FILE* stream = std::fopen(path, "rb");
    protocol::Frame frame;
    int64_t to_ns = -1;
    std::clock_t started = 0;
    while (stream != nullptr && protocol::ReadFrame(stream, frame))
    {
        if (frame.kind == protocol::kHello)
        {
            network.Hello(frame.body);
            started = std::clock();
        }
        else if (frame.kind == protocol::kAdvanceNetwork)
        {
            to_ns = network.Schedule(frame.body, true);
        }
    }
    RunUntil(to_ns);
    double spent_s = static_cast<double>(std::clock() - started) / CLOCKS_PER_SEC;
    std::cout << Json{{"arrivals", network.arrivals()},
                      {"drops", network.drops()},
                      {"checksum", network.checksum()},
                      {"spent_s", spent_s}}
              << "\n";
    return stream == nullptr;
}

// Print losses in dB for a JSON text with seed, radio, world and names: first for each row of `links` (a time, two
// indices and two positions), then for each row of `places` (two positions).
int
PrintLosses()
{
    auto request = Json::parse(std::cin);
    Channel channel(request.at("seed"), request.at("radio"), request.at("world"), request.at("names"));
    Json losses_db;
    for (const Json& row : request.at("links"))
    {
        losses_db.push_back(channel.LossDb(row[0], row[1], row[2], row[3], row[4]));
    }
    for (const Json& row : request.at("places"))
    {
        losses_db.push_back(channel.MeanLossDb(row[0].get<Point>(), row[1].get<Point>()));
    }
    std::cout << losses_db << "\n";
    return 0;
}

} // namespace fieldkit

int
main(int count, char** words)
{
    std::string task = count > 2 ? words[2] : "serve";
    if (task == "losses")
    {
        return fieldkit::PrintLosses();
    }
    fieldkit::Network network(count > 1 ? words[1] : "");
    if (task == "alone" && count > 3)
    {
        return fieldkit::RunAlone(network, words[3]);
    }
    std::FILE* output = fieldkit::protocol::RedirectStandardOutput();
    bool is_complete = fieldkit::protocol::Serve(
        stdin, output, fieldkit::g_heartbeat,
        [&network](const fieldkit::protocol::Frame& request) { return fieldkit::AnswerTo(network, request); });
    return is_complete ? 0 : 1;
}
