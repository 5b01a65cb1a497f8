// Streams of UDP and TCP between two nodes, on a cable or over Wi-Fi.

#ifndef FIELDKIT_NS3_LINK_STREAMS_H
#define FIELDKIT_NS3_LINK_STREAMS_H

#include "ns3_link_wifi.h"

#include "ns3/applications-module.h"
#include "ns3/internet-module.h"
#include "ns3/point-to-point-module.h"
#include "ns3/traffic-control-module.h"

namespace fieldkit {

using namespace ns3;

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

// An error model that loses the packets with the given numbers: comma-separated, from 0, in the order of arrival.
inline Ptr<ErrorModel> Losing(const std::string& numbers)
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
inline Ipv4InterfaceContainer Cable(const Options& options, NodeContainer& nodes)
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
inline Ipv4InterfaceContainer Pair(const Options& options, NodeContainer& nodes)
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

inline void Udp(const Options& options)
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
inline void Trace(Ptr<Socket> socket, bool everything)
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

inline void Tcp(const Options& options)
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

} // namespace fieldkit

#endif
