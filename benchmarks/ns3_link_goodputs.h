// Goodputs of saturated stations: of several that send to one receiver, and of two pairs.

#ifndef FIELDKIT_NS3_LINK_GOODPUTS_H
#define FIELDKIT_NS3_LINK_GOODPUTS_H

#include "ns3_link_wifi.h"

#include "ns3/applications-module.h"
#include "ns3/internet-module.h"

namespace fieldkit {

using namespace ns3;

const double kWarmUpS = 1;

// Run the simulation; return the goodput at each sink after the warm-up in Mbit/s.
inline std::vector<double> RunAndMeasure(const std::vector<Ptr<PacketSink>>& sinks, double seconds)
{
    std::vector<double> bits(sinks.size());
    auto count = [&](double sign) {
        for (std::size_t number = 0; number < sinks.size(); number++)
        {
            bits[number] += sign * 8.0 * sinks[number]->GetTotalRx();
        }
    };
    Simulator::Schedule(Seconds(2 * kWarmUpS), [&] { count(-1); });
    Simulator::Stop(Seconds(2 * kWarmUpS + seconds));
    Simulator::Run();
    count(1);
    Simulator::Destroy();
    for (auto& value : bits)
    {
        value /= seconds * 1e6;
    }
    return bits;
}

// Set the traffic class of packets to an address in ns-3 before 3.43; later versions have an attribute of applications.
template <typename Address>
auto SetTos(Address& to, uint8_t tos, int) -> decltype(to.SetTos(tos))
{
    to.SetTos(tos);
}

template <typename Address>
void SetTos(Address&, uint8_t, long)
{
}

// Goodput in Mbit/s of the stations of each traffic class.
inline std::vector<double> Goodputs(const Options& options)
{
    if (options.bare)
    {
        // ns-3 3.37 drops a whole aggregate after 7 failed aggregates to a receiver, even if others succeeded in between.
        // After each failed aggregate it sends a BlockAckReq, with a separate backoff.
        Config::SetDefault("ns3::QosTxop::UseExplicitBarAfterMissedBlockAck", BooleanValue(false));
        Config::SetDefault("ns3::WifiRemoteStationManager::MaxSsrc", UintegerValue(1000000));
        Config::SetDefault("ns3::WifiRemoteStationManager::MaxSlrc", UintegerValue(1000000));
        // A saturated channel often delays the ADDBA Response by more than ns-3's timeout of 1 ms, after which a station
        // sends single frames for 200 ms. Linux waits for 1 s.
        Config::SetDefault("ns3::QosTxop::AddBaResponseTimeout", TimeValue(Seconds(1)));
    }
    if (options.ampdu)
    {
        // Frames that exceed a time limit would leave gaps in the windows of the Block Acks.
        Config::SetDefault("ns3::WifiMacQueue::MaxDelay", TimeValue(Seconds(1000)));
    }
    NodeContainer nodes;
    nodes.Create(options.stations + 1 + (options.relay ? 1 : 0));
    auto devices = Install(options, nodes);
    // ns-3 uses the long slot of 802.11b, but there are no such stations.
    Config::Set("/NodeList/*/DeviceList/*/$ns3::WifiNetDevice/Phy/Slot", TimeValue(MicroSeconds(9)));
    if (!options.txop)
    {
        for (std::string category : {"VI", "VO"})
        {
            Config::Set("/NodeList/*/DeviceList/*/$ns3::WifiNetDevice/Mac/" + category + "_Txop/TxopLimit", TimeValue(Seconds(0)));
        }
    }
    MobilityHelper mobility;
    mobility.Install(nodes);
    InternetStackHelper internet;
    internet.Install(nodes);
    Ipv4AddressHelper addresses("10.0.0.0", "255.255.255.0");
    auto interfaces = addresses.Assign(devices);
    // Without it, a station whose ARP request collided would start after a timeout of 1 s.
    NeighborCacheHelper().PopulateNeighborCache(interfaces);
    std::vector<uint8_t> classes;
    std::istringstream words(options.classes);
    for (std::string word; std::getline(words, word, ',');)
    {
        classes.push_back(std::stoul(word));
    }
    std::vector<InetSocketAddress> targets;
    std::vector<Ptr<PacketSink>> sinks;
    for (std::size_t number = 0; number < classes.size(); number++)
    {
        InetSocketAddress to(interfaces.GetAddress(options.stations), 9 + number);
        SetTos(to, classes[number], 0);
        PacketSinkHelper sink("ns3::UdpSocketFactory", to);
        sinks.push_back(DynamicCast<PacketSink>(sink.Install(nodes.Get(options.stations)).Get(0)));
        targets.push_back(to);
    }
    // Saturate the stations: each sends 1.1 times the rate of the mode, or three times its share of this rate if that is
    // less. A much higher rate would only add events for packets that full queues drop.
    uint64_t offered_bit_s = 70000000;
    if (options.ampdu)
    {
        double rate_bit_s = WifiMode(options.mode).GetDataRate(Vector(options));
        offered_bit_s = rate_bit_s * std::min(1.1, 3.0 / options.stations);
    }
    bool has_tos_attribute = HasAttribute("ns3::OnOffApplication", "Tos");
    for (uint32_t n = 0; n < options.stations; n++)
    {
        OnOffHelper source("ns3::UdpSocketFactory", targets[n % targets.size()]);
        if (has_tos_attribute)
        {
            source.SetAttribute("Tos", UintegerValue(classes[n % classes.size()]));
        }
        source.SetConstantRate(DataRate(offered_bit_s), options.payload);
        source.Install(nodes.Get(n)).Start(Seconds(kWarmUpS + 0.001 * n));
    }
    return RunAndMeasure(sinks, options.seconds);
}

// Goodputs in Mbit/s of two pairs of stations: 0 sends to 1, and 2 to 3. The losses are equal, except those from the first
// pair to the second one.
inline std::vector<double> PairGoodputs(const Options& options)
{
    NodeContainer nodes;
    nodes.Create(4);
    auto loss = CreateObject<MatrixPropagationLossModel>();
    auto devices = Install(options, nodes, loss);
    Config::Set("/NodeList/*/DeviceList/*/$ns3::WifiNetDevice/Phy/Slot", TimeValue(MicroSeconds(9)));
    MobilityHelper mobility;
    mobility.Install(nodes);
    for (uint32_t from : {0, 1})
    {
        for (uint32_t to : {2, 3})
        {
            auto source = nodes.Get(from)->GetObject<MobilityModel>(), target = nodes.Get(to)->GetObject<MobilityModel>();
            loss->SetLoss(source, target, options.between_db, false);
            loss->SetLoss(target, source, options.loss_db, false);
        }
    }
    InternetStackHelper internet;
    internet.Install(nodes);
    Ipv4AddressHelper addresses("10.0.0.0", "255.255.255.0");
    auto interfaces = addresses.Assign(devices);
    NeighborCacheHelper().PopulateNeighborCache(interfaces);
    std::vector<Ptr<PacketSink>> sinks;
    for (uint32_t sender : {0, 2})
    {
        InetSocketAddress to(interfaces.GetAddress(sender + 1), 9);
        PacketSinkHelper sink("ns3::UdpSocketFactory", to);
        sinks.push_back(DynamicCast<PacketSink>(sink.Install(nodes.Get(sender + 1)).Get(0)));
        OnOffHelper source("ns3::UdpSocketFactory", to);
        source.SetConstantRate(DataRate(70000000), options.payload);
        source.Install(nodes.Get(sender)).Start(Seconds(kWarmUpS + 0.001 * sender));
    }
    return RunAndMeasure(sinks, options.seconds);
}

} // namespace fieldkit

#endif
