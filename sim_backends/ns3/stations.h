// The stations of a scenario: nodes with Wi-Fi, IP and positions, on the channel of fieldkit.

#ifndef FIELDKIT_STATIONS_H
#define FIELDKIT_STATIONS_H

#include "channel.h"
#include "frames.h"

#include "ns3/arp-cache.h"
#include "ns3/boolean.h"
#include "ns3/config.h"
#include "ns3/double.h"
#include "ns3/internet-stack-helper.h"
#include "ns3/ipv4-address-helper.h"
#include "ns3/ipv4-interface.h"
#include "ns3/ipv4-l3-protocol.h"
#include "ns3/net-device-queue-interface.h"
#include "ns3/propagation-loss-model.h"
#include "ns3/queue-size.h"
#include "ns3/ssid.h"
#include "ns3/string.h"
#include "ns3/traffic-control-helper.h"
#include "ns3/traffic-control-layer.h"
#include "ns3/uinteger.h"
#include "ns3/wifi-helper.h"
#include "ns3/wifi-mac-helper.h"
#include "ns3/yans-wifi-helper.h"

namespace fieldkit
{

// A position that the coordinator sets, with dead reckoning in steps.
class AgentMobility : public MobilityModel
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type = TypeId("fieldkit::AgentMobility").SetParent<MobilityModel>().AddConstructor<AgentMobility>();
        return type;
    }

    void Move(const Vector& position, const Vector& velocity, int64_t since_ns, int64_t step_ns)
    {
        m_position = position;
        m_velocity = velocity;
        m_sinceNs = since_ns;
        m_stepNs = step_ns;
    }

    // ns-3 3.48 requires this function.
    virtual Ptr<MobilityModel> Copy() const
    {
        return CreateObject<AgentMobility>(*this);
    }

    size_t station = 0; // index of the station

  private:
    Vector DoGetPosition() const override
    {
        if (m_stepNs <= 0)
        {
            return m_position;
        }
        int64_t steps = std::max<int64_t>((NowNs() - m_sinceNs) / m_stepNs, 0);
        double after_s = static_cast<double>(steps * m_stepNs) / 1e9;
        return Vector(m_position.x + after_s * m_velocity.x, m_position.y + after_s * m_velocity.y,
                      m_position.z + after_s * m_velocity.z);
    }

    void DoSetPosition(const Vector& position) override
    {
        m_position = position;
    }

    Vector DoGetVelocity() const override
    {
        return m_velocity;
    }

    Vector m_position, m_velocity;
    int64_t m_sinceNs = 0;
    int64_t m_stepNs = 0;
};

// The path loss of fieldkit's channel.
class ChannelLoss : public PropagationLossModel
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type =
            TypeId("fieldkit::ChannelLoss").SetParent<PropagationLossModel>().AddConstructor<ChannelLoss>();
        return type;
    }

    Channel* channel = nullptr;

  private:
    double DoCalcRxPower(double power_dbm, Ptr<MobilityModel> from, Ptr<MobilityModel> to) const override
    {
        auto a = static_cast<const AgentMobility*>(PeekPointer(from));
        auto b = static_cast<const AgentMobility*>(PeekPointer(to));
        Vector at_a = from->GetPosition();
        Vector at_b = to->GetPosition();
        double loss_db = channel->LossDb(NowNs(), a->station, {at_a.x, at_a.y, at_a.z}, b->station,
                                         {at_b.x, at_b.y, at_b.z});
        return std::max(power_dbm - loss_db, -1000.0);
    }

    int64_t DoAssignStreams(int64_t) override
    {
        return 0;
    }
};

struct Station
{
    std::string name;
    uint32_t agent = 0;
    double tx_power_dbm = 0;
    double sensitivity_dbm = 0;
    int off = 0; // number of reasons (faults, absence) why its radio is off
    Ptr<Node> node;
    Ptr<AgentMobility> mobility;
    Ptr<NetDevice> device;
    Ipv4Address address;
};

inline size_t
StationNamed(const std::vector<Station>& stations, const std::string& name)
{
    for (size_t number = 0; number < stations.size(); number++)
    {
        if (stations[number].name == name)
        {
            return number;
        }
    }
    throw Refusal("there is no station " + name);
}

struct WifiSetup
{
    std::string standard = "802.11n";
    std::string mode; // fieldkit's name of a fixed mode; empty if the rate is adapted
    double noise_dbm = -95;
    uint32_t queue_packets = 1000;
    uint32_t ampdu_bytes = 0;
    int relay = -1; // station with the access point; -1 if stations send directly
    std::string pcap; // beginning of the names of capture files; empty for none
};

// ns-3's name of a mode of fieldkit.
inline std::string
ModeName(const std::string& mode, bool is_high_band)
{
    std::string number = mode.substr(1);
    return mode[0] == 'n' ? "HtMcs" + number : (is_high_band ? "OfdmRate" : "ErpOfdmRate") + number + "Mbps";
}

// Add the addresses of all other stations to the ARP cache of a station, because fieldkit's network has no ARP.
inline void
FillArpCache(const Station& station, const std::vector<Station>& stations)
{
    auto ipv4 = station.node->GetObject<Ipv4L3Protocol>();
    auto cache = ipv4->GetInterface(ipv4->GetInterfaceForDevice(station.device))->GetArpCache();
    for (const Station& other : stations)
    {
        if (&other != &station && cache->Lookup(other.address) == nullptr)
        {
            auto entry = cache->Add(other.address);
            entry->SetMacAddress(other.device->GetAddress());
            entry->MarkPermanent();
        }
    }
}

// Give IP addresses to the stations, which have devices; callbacks of ns-3 keep references to `stations`.
inline void
InstallIp(std::vector<Station>& stations, FrameTracker& tracker)
{
    InternetStackHelper internet;
    internet.SetIpv6StackInstall(false);
    Ipv4AddressHelper addresses("10.0.0.0", "255.255.0.0");
    for (Station& station : stations)
    {
        NetDeviceContainer devices(station.device);
        station.device->SetMtu(1500);
        internet.Install(station.node);
        station.address = addresses.Assign(devices).GetAddress(0);
        if (station.device->GetObject<NetDeviceQueueInterface>() != nullptr)
        {
            TrafficControlHelper::Default().Uninstall(devices);
        }
    }
    for (Station& station : stations)
    {
        auto ipv4 = station.node->GetObject<Ipv4L3Protocol>();
        ipv4->TraceConnectWithoutContext(
            "Drop", Callback<void, const Ipv4Header&, Ptr<const Packet>, Ipv4L3Protocol::DropReason, Ptr<Ipv4>, uint32_t>(
                        [&tracker](const Ipv4Header&, Ptr<const Packet> packet, Ipv4L3Protocol::DropReason reason,
                                   Ptr<Ipv4>, uint32_t) {
                            tracker.Lost(packet, reason == Ipv4L3Protocol::DROP_FRAGMENT_TIMEOUT
                                                     ? "reassembly timed out"
                                                     : "no route");
                        }));
        // If the queue of the MAC is full, ns-3 stops the device, and its traffic control layer drops the packets.
        station.node->GetObject<TrafficControlLayer>()->TraceConnectWithoutContext(
            "TcDrop",
            Callback<void, Ptr<const Packet>>([&tracker](Ptr<const Packet> packet) { tracker.Lost(packet, "queue full"); }));
        FillArpCache(station, stations);
        // A change of the link, for example an association, empties the cache.
        station.device->AddLinkChangeCallback(
            Callback<void>([&station, &stations] { FillArpCache(station, stations); }));
    }
}

// Give the stations Wi-Fi, IP addresses and positions; callbacks of ns-3 keep references to `stations`.
inline void
Install(std::vector<Station>& stations, const WifiSetup& setup, Channel& channel, FrameTracker& tracker)
{
    bool is_ht = setup.standard == "802.11n";
    bool is_high_band = setup.standard == "802.11a";
    // Packets wait only in the queue of the MAC, for up to 1000 s. The frame on the air is in the queue too.
    Config::SetDefault("ns3::WifiMacQueue::MaxSize",
                       QueueSizeValue(QueueSize(QueueSizeUnit::PACKETS, setup.queue_packets + 1)));
    Config::SetDefault("ns3::WifiMacQueue::MaxDelay", TimeValue(Seconds(1000)));
    auto air = CreateObject<YansWifiChannel>();
    auto loss = CreateObject<ChannelLoss>();
    loss->channel = &channel;
    air->SetPropagationLossModel(loss);
    air->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());
    YansWifiPhyHelper phy;
    phy.SetChannel(air);
    phy.SetErrorRateModel("ns3::NistErrorRateModel");
    phy.Set("ChannelSettings", StringValue(is_high_band ? "{36, 20, BAND_5GHZ, 0}" : "{6, 20, BAND_2_4GHZ, 0}"));
    // ns-3 adds the noise figure to the thermal noise of 20 MHz at 290 K.
    phy.Set("RxNoiseFigure", DoubleValue(setup.noise_dbm - 10 * std::log10(1.3803e-23 * 290 * 20e6 * 1e3)));
    WifiHelper wifi;
    wifi.SetStandard(is_ht ? WIFI_STANDARD_80211n : is_high_band ? WIFI_STANDARD_80211a : WIFI_STANDARD_80211g);
    if (!setup.mode.empty())
    {
        wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager", "DataMode",
                                     StringValue(ModeName(setup.mode, is_high_band)), "NonUnicastMode",
                                     StringValue(ModeName("g6", is_high_band)));
    }
    else
    {
        wifi.SetRemoteStationManager(is_ht ? "ns3::MinstrelHtWifiManager" : "ns3::MinstrelWifiManager");
    }
    auto ssid = SsidValue(Ssid("fieldkit"));
    for (size_t number = 0; number < stations.size(); number++)
    {
        Station& station = stations[number];
        station.node = CreateObject<Node>();
        station.mobility->station = number;
        station.node->AggregateObject(station.mobility);
        phy.Set("TxPowerStart", DoubleValue(station.tx_power_dbm));
        phy.Set("TxPowerEnd", DoubleValue(station.tx_power_dbm));
        phy.Set("RxSensitivity", DoubleValue(station.sensitivity_dbm));
        phy.SetPreambleDetectionModel("ns3::ThresholdPreambleDetectionModel", "MinimumRssi",
                                      DoubleValue(station.sensitivity_dbm), "Threshold", DoubleValue(4));
        WifiMacHelper mac;
        auto ampdu = UintegerValue(setup.ampdu_bytes);
        auto qos = BooleanValue(is_ht);
        if (setup.relay < 0)
        {
            mac.SetType("ns3::AdhocWifiMac", "QosSupported", qos, "BE_MaxAmpduSize", ampdu);
        }
        else
        {
            bool is_relay = static_cast<size_t>(setup.relay) == number;
            mac.SetType(is_relay ? "ns3::ApWifiMac" : "ns3::StaWifiMac", "Ssid", ssid, "QosSupported", qos,
                        "BE_MaxAmpduSize", ampdu);
        }
        auto devices = wifi.Install(phy, mac, station.node);
        if (!setup.pcap.empty())
        {
            phy.SetPcapDataLinkType(WifiPhyHelper::DLT_IEEE802_11_RADIO);
            phy.EnablePcap(setup.pcap + station.name + ".pcap", devices.Get(0), true, true);
        }
        // Each station has its own random streams, which other stations do not change.
        wifi.AssignStreams(devices, 1000 * static_cast<int64_t>(number));
        station.device = devices.Get(0);
        auto device = DynamicCast<WifiNetDevice>(station.device);
        // ns-3 uses a long slot for stations of 802.11b, which do not exist here.
        device->GetPhy()->SetAttribute("Slot", TimeValue(MicroSeconds(9)));
        tracker.Add(device, station.mobility);
        g_heartbeat.SendIfDue(NowNs());
    }
    InstallIp(stations, tracker);
}

} // namespace fieldkit

#endif
