// Options of `ns3_link`, and the Wi-Fi devices that they describe.

#ifndef FIELDKIT_NS3_LINK_WIFI_H
#define FIELDKIT_NS3_LINK_WIFI_H

#include "ns3/core-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wifi-module.h"

#include <map>
#include <type_traits>

namespace fieldkit {

using namespace ns3;

const double kTxPowerDbm = 17;
const double kNoiseFigureDb = 6;

struct Options
{
    std::string what = "link";
    std::string mode = "ErpOfdmRate54Mbps";
    uint32_t stations = 1;
    uint32_t payload = 1000;
    double seconds = 5;
    double loss_db = 60;
    uint16_t width = 20;
    uint16_t streams = 1;
    uint16_t guard_ns = 800;
    uint32_t ampdu = 0;
    uint32_t amsdu = 0;
    double between_db = 60;
    uint32_t rts = 4692480; // size of the largest frame without RTS; this one is above any frame
    bool bare = false;      // without ns-3's retry limits for aggregates, its BlockAckReqs and its short ADDBA timeout
    std::string classes = "0";
    bool txop = true;
    std::string band = "BAND_2_4GHZ";
    bool relay = false;
    bool adapt = false;
    std::string control = "ns3::TcpCubic";
    std::string recovery = "ns3::TcpPrrRecovery";
    double rate_mbit_s = 1;
    uint32_t queue = 100;
    bool cable = false;
    double delay_ms = 0;
    std::string lost_data;
    std::string lost_acks;
};

// True if objects of a type have an attribute in this version of ns-3.
inline bool HasAttribute(const std::string& type, const std::string& attribute)
{
    TypeId::AttributeInformation information;
    return TypeId::LookupByName(type).LookupAttributeByName(attribute, &information);
}

inline WifiStandard StandardOf(const std::string& mode)
{
    switch (mode[0])
    {
    case 'H':
        return mode[1] == 'e' ? WIFI_STANDARD_80211ax : WIFI_STANDARD_80211n;
    case 'V':
        return WIFI_STANDARD_80211ac;
    case 'O':
        return WIFI_STANDARD_80211a;
    default:
        return WIFI_STANDARD_80211g;
    }
}

inline NetDeviceContainer Install(const Options& options, NodeContainer nodes,
                           Ptr<MatrixPropagationLossModel> loss = CreateObject<MatrixPropagationLossModel>())
{
    auto channel = CreateObject<YansWifiChannel>();
    loss->SetDefaultLoss(options.loss_db);
    channel->SetPropagationLossModel(loss);
    channel->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());
    YansWifiPhyHelper phy;
    phy.SetChannel(channel);
    phy.SetErrorRateModel("ns3::NistErrorRateModel");
    if (options.what == "pairs")
    {
        phy.SetPreambleDetectionModel("ns3::ThresholdPreambleDetectionModel", "MinimumRssi", DoubleValue(-101));
    }
    phy.Set("TxPowerStart", DoubleValue(kTxPowerDbm));
    phy.Set("TxPowerEnd", DoubleValue(kTxPowerDbm));
    phy.Set("RxNoiseFigure", DoubleValue(kNoiseFigureDb));
    // 802.11a sends like 802.11g, but in another band; the path loss is an option, independent of the band.
    auto standard = StandardOf(options.mode);
    auto band = standard == WIFI_STANDARD_80211a ? "BAND_5GHZ" : options.band;
    bool high = band != "BAND_2_4GHZ";
    phy.Set("ChannelSettings", StringValue("{0, " + std::to_string(options.width) + ", " + band + ", 0}"));
    phy.Set("Antennas", UintegerValue(options.streams));
    phy.Set("MaxSupportedTxSpatialStreams", UintegerValue(options.streams));
    phy.Set("MaxSupportedRxSpatialStreams", UintegerValue(options.streams));
    // By default no RTS is sent, not even before aggregates of more than 65,535 bytes. The Block Ack window of 802.11ax
    // has 256 MPDUs. Its size is an attribute of the MAC in ns-3 3.43.
    Config::SetDefault("ns3::WifiRemoteStationManager::RtsCtsThreshold", UintegerValue(options.rts));
    std::string window_type = HasAttribute("ns3::WifiMac", "MpduBufferSize") ? "ns3::WifiMac" : "ns3::HeConfiguration";
    Config::SetDefault(window_type + "::MpduBufferSize", UintegerValue(256));
    Config::SetDefault("ns3::HtConfiguration::ShortGuardIntervalSupported", BooleanValue(options.guard_ns == 400));
    Config::SetDefault("ns3::HeConfiguration::GuardInterval", TimeValue(NanoSeconds(std::max<int>(options.guard_ns, 800))));
    WifiHelper wifi;
    wifi.SetStandard(standard);
    if (options.adapt)
    {
        wifi.SetRemoteStationManager("ns3::MinstrelWifiManager");
    }
    else
    {
        std::string prefix = high ? "OfdmRate" : "ErpOfdmRate";
        wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager", "DataMode", StringValue(options.mode),
                                     "ControlMode", StringValue(prefix + "24Mbps"),
                                     "NonUnicastMode", StringValue(prefix + "6Mbps"));
    }
    WifiMacHelper mac;
    auto ampdu = UintegerValue(options.ampdu);
    if (!options.relay)
    {
        mac.SetType("ns3::AdhocWifiMac", "BE_MaxAmsduSize", UintegerValue(options.amsdu), "BE_MaxAmpduSize", ampdu,
                    "BK_MaxAmpduSize", ampdu, "VI_MaxAmpduSize", ampdu, "VO_MaxAmpduSize", ampdu);
        return wifi.Install(phy, mac, nodes);
    }
    auto ssid = SsidValue(Ssid("fieldkit"));
    NodeContainer stations;
    for (uint32_t n = 0; n + 1 < nodes.GetN(); n++)
    {
        stations.Add(nodes.Get(n));
    }
    mac.SetType("ns3::StaWifiMac", "Ssid", ssid, "BE_MaxAmpduSize", ampdu,
                    "BK_MaxAmpduSize", ampdu, "VI_MaxAmpduSize", ampdu, "VO_MaxAmpduSize", ampdu);
    auto devices = wifi.Install(phy, mac, stations);
    mac.SetType("ns3::ApWifiMac", "Ssid", ssid, "BE_MaxAmpduSize", ampdu,
                    "BK_MaxAmpduSize", ampdu, "VI_MaxAmpduSize", ampdu, "VO_MaxAmpduSize", ampdu);
    devices.Add(wifi.Install(phy, mac, nodes.Get(nodes.GetN() - 1)));
    return devices;
}

// A guard interval is a number of nanoseconds in ns-3 3.37, and a Time in 3.43.
template <typename Interval>
void SetGuardInterval(WifiTxVector& vector, void (WifiTxVector::*set)(Interval), uint16_t guard_ns)
{
    if constexpr (std::is_same_v<Interval, Time>)
    {
        (vector.*set)(NanoSeconds(guard_ns));
    }
    else
    {
        (vector.*set)(guard_ns);
    }
}

// Settings of a transmission.
inline WifiTxVector Vector(const Options& options)
{
    const std::map<WifiStandard, WifiPreamble> preambles{{WIFI_STANDARD_80211n, WIFI_PREAMBLE_HT_MF},
                                                         {WIFI_STANDARD_80211ac, WIFI_PREAMBLE_VHT_SU},
                                                         {WIFI_STANDARD_80211ax, WIFI_PREAMBLE_HE_SU}};
    auto preamble = preambles.find(StandardOf(options.mode));
    WifiTxVector vector;
    vector.SetMode(WifiMode(options.mode));
    vector.SetChannelWidth(options.width);
    vector.SetNss(options.streams);
    SetGuardInterval(vector, &WifiTxVector::SetGuardInterval, options.guard_ns);
    vector.SetPreambleType(preamble == preambles.end() ? WIFI_PREAMBLE_LONG : preamble->second);
    return vector;
}

} // namespace fieldkit

#endif
