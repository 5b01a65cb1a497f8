// Prints results of ns-3 for 802.11 links and cables, for the benchmarks *_vs_ns3.py:
//
// - `errors`: frame error of a mode by SNR;
// - `durations`: airtime in ns by frame size in bytes;
// - `link`: goodput in Mbit/s, by traffic class, of saturated stations that send UDP to one receiver, all with the same
//   distance from each other;
// - `pairs`: goodput in Mbit/s of two pairs of stations, each with a saturated sender and a receiver;
// - `udp`: goodput and loss of a stream at a fixed rate;
// - `tcp`: goodput of a stream at full rate, and the events of its sender (over 802.11 only its congestion window).

#include "ns3/applications-module.h"
#include "ns3/core-module.h"
#include "ns3/internet-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/point-to-point-module.h"
#include "ns3/propagation-module.h"
#include "ns3/traffic-control-module.h"
#include "ns3/wifi-module.h"

using namespace ns3;

namespace {

const double kTxPowerDbm = 17;
const double kNoiseFigureDb = 6;
const double kWarmUpS = 1;

// A congestion control whose window grows only by newly acknowledged data. ns-3 counts SACKed data again when it is ACKed.
// So its window jumps after a timeout, when it may grow by at most a segment (RFC 3465, 2.3), and at the end of a recovery,
// when it must equal the threshold (RFC 6937, 3); and its CUBIC continues slow start beyond the threshold (RFC 5681, 3.1).
template <class Control> class Counting : public Control
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type = TypeId("Counting" + Control::GetTypeId().GetName().substr(5))
                                 .template SetParent<Control>()
                                 .template AddConstructor<Counting<Control>>();
        return type;
    }

    void CongestionStateSet(Ptr<TcpSocketState> state, const TcpSocketState::TcpCongState_t next) override
    {
        m_recovered = state->m_congState == TcpSocketState::CA_RECOVERY && next == TcpSocketState::CA_OPEN;
        Control::CongestionStateSet(state, next);
    }

    void IncreaseWindow(Ptr<TcpSocketState> state, uint32_t segments) override
    {
        if (m_recovered)
        {
            m_recovered = false;
            return;
        }
        if (state->m_congState == TcpSocketState::CA_LOSS)
        {
            segments = std::min(segments, 1U);
        }
        if (state->m_cWnd < state->m_ssThresh)
        {
            uint32_t room = state->m_ssThresh - state->m_cWnd;
            segments = std::min(segments, (room + state->m_segmentSize - 1) / state->m_segmentSize);
        }
        Control::IncreaseWindow(state, segments);
    }

    Ptr<TcpCongestionOps> Fork() override
    {
        return CopyObject<Counting<Control>>(this);
    }

  private:
    bool m_recovered = false;
};

using CountingReno = Counting<TcpLinuxReno>;
using CountingCubic = Counting<TcpCubic>;
NS_OBJECT_ENSURE_REGISTERED(CountingReno);
NS_OBJECT_ENSURE_REGISTERED(CountingCubic);

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

WifiStandard StandardOf(const std::string& mode)
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

NetDeviceContainer Install(const Options& options, NodeContainer nodes,
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
    // has 256 MPDUs.
    Config::SetDefault("ns3::WifiRemoteStationManager::RtsCtsThreshold", UintegerValue(options.rts));
    Config::SetDefault("ns3::HeConfiguration::MpduBufferSize", UintegerValue(256));
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

// Run the simulation; return the goodput at each sink after the warm-up in Mbit/s.
std::vector<double> RunAndMeasure(const std::vector<Ptr<PacketSink>>& sinks, double seconds)
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

// Goodput in Mbit/s of the stations of each traffic class.
std::vector<double> Goodputs(const Options& options)
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
        to.SetTos(classes[number]);
        PacketSinkHelper sink("ns3::UdpSocketFactory", to);
        sinks.push_back(DynamicCast<PacketSink>(sink.Install(nodes.Get(options.stations)).Get(0)));
        targets.push_back(to);
    }
    // Saturate the stations: each sends 1.1 times the rate of the mode, or three times its share of this rate if that is
    // less. A much higher rate would only add events for packets that full queues drop.
    uint64_t offered_bit_s = 70000000;
    if (options.ampdu)
    {
        double rate_bit_s = WifiMode(options.mode).GetDataRate(options.width, options.guard_ns, options.streams);
        offered_bit_s = rate_bit_s * std::min(1.1, 3.0 / options.stations);
    }
    for (uint32_t n = 0; n < options.stations; n++)
    {
        OnOffHelper source("ns3::UdpSocketFactory", targets[n % targets.size()]);
        source.SetConstantRate(DataRate(offered_bit_s), options.payload);
        source.Install(nodes.Get(n)).Start(Seconds(kWarmUpS + 0.001 * n));
    }
    return RunAndMeasure(sinks, options.seconds);
}

// Goodputs in Mbit/s of two pairs of stations: 0 sends to 1, and 2 to 3. The losses are equal, except those from the first
// pair to the second one.
std::vector<double> PairGoodputs(const Options& options)
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

// An error model that loses the packets with the given numbers: comma-separated, from 0, in the order of arrival.
Ptr<ErrorModel> Losing(const std::string& numbers)
{
    std::list<uint32_t> lost;
    std::istringstream words(numbers);
    for (std::string word; std::getline(words, word, ',');)
    {
        lost.push_back(std::stoul(word));
    }
    auto losses = CreateObject<ReceiveListErrorModel>();
    losses->SetList(lost);
    return losses;
}

// A cable that loses given packets.
Ipv4InterfaceContainer Cable(const Options& options, NodeContainer& nodes)
{
    nodes.Create(2);
    PointToPointHelper cable;
    cable.SetDeviceAttribute("DataRate", DataRateValue(DataRate(static_cast<uint64_t>(options.rate_mbit_s * 1e6))));
    cable.SetChannelAttribute("Delay", TimeValue(Seconds(options.delay_ms / 1e3)));
    cable.SetQueue("ns3::DropTailQueue", "MaxSize", QueueSizeValue(QueueSize(QueueSizeUnit::PACKETS, options.queue)));
    auto devices = cable.Install(nodes);
    devices.Get(0)->SetAttribute("ReceiveErrorModel", PointerValue(Losing(options.lost_acks)));
    devices.Get(1)->SetAttribute("ReceiveErrorModel", PointerValue(Losing(options.lost_data)));
    InternetStackHelper internet;
    internet.Install(nodes);
    auto interfaces = Ipv4AddressHelper("10.0.0.0", "255.255.255.0").Assign(devices);
    TrafficControlHelper::Default().Uninstall(devices);
    return interfaces;
}

// Two nodes, on a cable or over Wi-Fi. Over Wi-Fi packets wait only in the queue of the MAC, for up to 1000 s.
Ipv4InterfaceContainer Pair(const Options& options, NodeContainer& nodes)
{
    if (options.cable)
    {
        return Cable(options, nodes);
    }
    Config::SetDefault("ns3::WifiMacQueue::MaxSize", QueueSizeValue(QueueSize(QueueSizeUnit::PACKETS, options.queue + 1)));
    Config::SetDefault("ns3::WifiMacQueue::MaxDelay", TimeValue(Seconds(1000)));
    nodes.Create(2);
    auto devices = Install(options, nodes);
    Config::Set("/NodeList/*/DeviceList/*/$ns3::WifiNetDevice/Phy/Slot", TimeValue(MicroSeconds(9)));
    MobilityHelper mobility;
    mobility.Install(nodes);
    InternetStackHelper internet;
    internet.Install(nodes);
    auto interfaces = Ipv4AddressHelper("10.0.0.0", "255.255.255.0").Assign(devices);
    TrafficControlHelper::Default().Uninstall(devices);
    return interfaces;
}

void Udp(const Options& options)
{
    NodeContainer nodes;
    auto interfaces = Pair(options, nodes);
    auto to = InetSocketAddress(interfaces.GetAddress(1), 9);
    PacketSinkHelper sink("ns3::UdpSocketFactory", to);
    auto received = DynamicCast<PacketSink>(sink.Install(nodes.Get(1)).Get(0));
    OnOffHelper helper("ns3::UdpSocketFactory", to);
    helper.SetConstantRate(DataRate(static_cast<uint64_t>(options.rate_mbit_s * 1e6)), options.payload);
    auto source = helper.Install(nodes.Get(0)).Get(0);
    source->SetStartTime(Seconds(0));
    source->SetStopTime(Seconds(options.seconds));
    double sent = 0;
    source->TraceConnectWithoutContext("Tx", Callback<void, Ptr<const Packet>>([&](Ptr<const Packet> packet) {
        sent += packet->GetSize();
    }));
    // The additional time is for packets in the queue.
    Simulator::Stop(Seconds(options.seconds + 5));
    Simulator::Run();
    double arrived = received->GetTotalRx();
    Simulator::Destroy();
    std::cout << 8 * arrived / options.seconds / 1e6 << " " << 1 - arrived / sent << "\n";
}

template <class... Values> void Print(Values... values)
{
    std::cout << Simulator::Now().GetNanoSeconds();
    ((std::cout << " " << values), ...);
    std::cout << "\n";
}

// Prints the events of the sender: time in ns, kind, and bytes, ns or the number of the state.
void Trace(Ptr<Socket> socket, bool everything)
{
    socket->TraceConnectWithoutContext(
        "CongestionWindow", Callback<void, uint32_t, uint32_t>([](uint32_t, uint32_t now) { Print("window", now); }));
    if (!everything)
    {
        return;
    }
    socket->TraceConnectWithoutContext(
        "SlowStartThreshold",
        Callback<void, uint32_t, uint32_t>([](uint32_t, uint32_t now) { Print("threshold", now); }));
    socket->TraceConnectWithoutContext(
        "RTO", Callback<void, Time, Time>([](Time, Time now) { Print("timeout", now.GetNanoSeconds()); }));
    using State = TcpSocketState::TcpCongState_t;
    socket->TraceConnectWithoutContext(
        "CongState", Callback<void, State, State>([](State, State now) { Print("state", static_cast<int>(now)); }));
    using Sent = Callback<void, Ptr<const Packet>, const TcpHeader&, Ptr<const TcpSocketBase>>;
    socket->TraceConnectWithoutContext(
        "Tx", Sent([](Ptr<const Packet> packet, const TcpHeader& header, Ptr<const TcpSocketBase>) {
            if (packet->GetSize())
            {
                Print("sent", header.GetSequenceNumber().GetValue());
            }
        }));
}

void Tcp(const Options& options)
{
    // Use the settings of Linux, but without HyStart, which the co-simulation's TCP does not have.
    Config::SetDefault("ns3::TcpL4Protocol::SocketType", TypeIdValue(TypeId::LookupByName(options.control)));
    Config::SetDefault("ns3::TcpL4Protocol::RecoveryType", TypeIdValue(TypeId::LookupByName(options.recovery)));
    Config::SetDefault("ns3::TcpCubic::HyStart", BooleanValue(false));
    Config::SetDefault("ns3::TcpSocket::SegmentSize", UintegerValue(1448));
    Config::SetDefault("ns3::TcpSocket::InitialCwnd", UintegerValue(10));
    Config::SetDefault("ns3::TcpSocket::SndBufSize", UintegerValue(8 << 20));
    Config::SetDefault("ns3::TcpSocket::RcvBufSize", UintegerValue(3 << 20));
    Config::SetDefault("ns3::TcpSocket::DelAckCount", UintegerValue(2));
    Config::SetDefault("ns3::TcpSocket::DelAckTimeout", TimeValue(MilliSeconds(40)));
    Config::SetDefault("ns3::TcpSocket::ConnTimeout", TimeValue(Seconds(1)));
    Config::SetDefault("ns3::TcpSocket::DataRetries", UintegerValue(15));
    Config::SetDefault("ns3::TcpSocketBase::MinRto", TimeValue(MilliSeconds(200)));
    NodeContainer nodes;
    auto interfaces = Pair(options, nodes);
    auto to = InetSocketAddress(interfaces.GetAddress(1), 9);
    PacketSinkHelper sink("ns3::TcpSocketFactory", to);
    auto received = DynamicCast<PacketSink>(sink.Install(nodes.Get(1)).Get(0));
    BulkSendHelper helper("ns3::TcpSocketFactory", to);
    helper.SetAttribute("SendSize", UintegerValue(1448));
    auto source = DynamicCast<BulkSendApplication>(helper.Install(nodes.Get(0)).Get(0));
    // The application creates its socket at its start.
    Simulator::Schedule(NanoSeconds(1), [&] { Trace(source->GetSocket(), options.cable); });
    Simulator::Stop(Seconds(options.seconds));
    Simulator::Run();
    double bits = 8.0 * received->GetTotalRx();
    Simulator::Destroy();
    std::cout << bits / options.seconds / 1e6 << " 0\n";
}

WifiTxVector Vector(const Options& options)
{
    const std::map<WifiStandard, WifiPreamble> preambles{{WIFI_STANDARD_80211n, WIFI_PREAMBLE_HT_MF},
                                                         {WIFI_STANDARD_80211ac, WIFI_PREAMBLE_VHT_SU},
                                                         {WIFI_STANDARD_80211ax, WIFI_PREAMBLE_HE_SU}};
    auto preamble = preambles.find(StandardOf(options.mode));
    WifiTxVector vector;
    vector.SetMode(WifiMode(options.mode));
    vector.SetChannelWidth(options.width);
    vector.SetNss(options.streams);
    vector.SetGuardInterval(options.guard_ns);
    vector.SetPreambleType(preamble == preambles.end() ? WIFI_PREAMBLE_LONG : preamble->second);
    return vector;
}

void Durations(const Options& options)
{
    auto band = options.band == "BAND_2_4GHZ" ? WIFI_PHY_BAND_2_4GHZ
                : options.band == "BAND_5GHZ" ? WIFI_PHY_BAND_5GHZ
                                              : WIFI_PHY_BAND_6GHZ;
    for (uint32_t bytes : {14, 100, 500, 1036, 1538, 7000, 30000})
    {
        std::cout << bytes << " "
                  << WifiPhy::CalculateTxDuration(bytes, Vector(options), band).GetNanoSeconds() << "\n";
    }
}

void Errors(const Options& options)
{
    ObjectFactory factory("ns3::NistErrorRateModel");
    auto model = factory.Create<ErrorRateModel>();
    auto vector = Vector(options);
    for (int step = -50; step <= 450; step++)
    {
        double ratio_db = step / 10.0;
        double success = model->GetChunkSuccessRate(vector.GetMode(), vector, std::pow(10, ratio_db / 10), 8 * options.payload);
        std::cout << ratio_db << " " << 1 - success << "\n";
    }
}

} // namespace

int main(int argc, char** argv)
{
    Options options;
    CommandLine command;
    command.AddValue("what", "errors, durations, link, pairs, udp or tcp", options.what);
    command.AddValue("mode", "ns-3's name of the mode", options.mode);
    command.AddValue("stations", "number of stations that send", options.stations);
    command.AddValue("payload", "UDP payload of a packet, bytes", options.payload);
    command.AddValue("seconds", "duration of the measurement", options.seconds);
    command.AddValue("loss", "path loss between any two stations, dB", options.loss_db);
    command.AddValue("width", "width of the channel, MHz", options.width);
    command.AddValue("streams", "number of spatial streams", options.streams);
    command.AddValue("guard", "guard interval, ns", options.guard_ns);
    command.AddValue("ampdu", "maximum size of an A-MPDU, bytes; 0 for none", options.ampdu);
    command.AddValue("amsdu", "maximum size of an A-MSDU, bytes; 0 for none", options.amsdu);
    command.AddValue("between", "path loss from the first pair to the second one, dB", options.between_db);
    command.AddValue("rts", "size of the largest frame without RTS, bytes", options.rts);
    command.AddValue("bare", "without BlockAckReq, retry limit and short ADDBA timeout", options.bare);
    command.AddValue("classes", "traffic classes (TOS) of the stations, by turns, comma-separated", options.classes);
    command.AddValue("txop", "with the default TXOP limits of video and voice, instead of one exchange", options.txop);
    command.AddValue("band", "ns-3's name of the band", options.band);
    command.AddValue("relay", "send through an access point", options.relay);
    command.AddValue("adapt", "choose the mode by Minstrel", options.adapt);
    command.AddValue("control", "congestion control of TCP", options.control);
    command.AddValue("recovery", "loss recovery of TCP", options.recovery);
    command.AddValue("rate", "rate of the UDP stream, and of the cable, Mbit/s", options.rate_mbit_s);
    command.AddValue("queue", "queue limit, packets", options.queue);
    command.AddValue("cable", "use a cable instead of a radio, and print all TCP events", options.cable);
    command.AddValue("delay", "delay of the cable, ms", options.delay_ms);
    command.AddValue("lost-data", "numbers of the packets to the receiver that the cable drops", options.lost_data);
    command.AddValue("lost-acks", "numbers of the packets to the sender that the cable drops", options.lost_acks);
    command.Parse(argc, argv);
    // ns-3 registers the modes when a device is created.
    NodeContainer none;
    none.Create(1);
    Install(options, none);
    if (options.what == "errors")
    {
        Errors(options);
    }
    else if (options.what == "durations")
    {
        Durations(options);
    }
    else if (options.what == "udp")
    {
        Udp(options);
    }
    else if (options.what == "tcp")
    {
        Tcp(options);
    }
    else
    {
        for (double value : options.what == "pairs" ? PairGoodputs(options) : Goodputs(options))
        {
            std::cout << value << " ";
        }
        std::cout << "\n";
    }
    return 0;
}
