// Frames in transit: the parts of their delays, and the frames that are lost.

#ifndef FIELDKIT_FRAMES_H
#define FIELDKIT_FRAMES_H

#include "simulator.h"

#include "fieldkit/packets.h"

#include "ns3/mobility-model.h"
#include "ns3/propagation-delay-model.h"
#include "ns3/tag.h"
#include "ns3/wifi-mac-queue.h"
#include "ns3/wifi-mac.h"
#include "ns3/wifi-net-device.h"
#include "ns3/wifi-mpdu.h"
#include "ns3/wifi-phy-state-helper.h"
#include "ns3/wifi-phy.h"
#include "ns3/wifi-psdu.h"

#include <cmath>
#include <functional>
#include <map>
#include <unordered_map>

namespace fieldkit
{

// A number that is attached to a packet of ns-3, and adds no bytes to it.
class NumberTag : public Tag
{
  public:
    uint32_t GetSerializedSize() const override
    {
        return sizeof number;
    }

    void Serialize(TagBuffer buffer) const override
    {
        buffer.WriteU64(number);
    }

    void Deserialize(TagBuffer buffer) override
    {
        number = buffer.ReadU64();
    }

    void Print(std::ostream& stream) const override
    {
        stream << number;
    }

    uint64_t number = 0;
};

// The id of a packet of the coordinator, on all its IP fragments.
class IdTag : public NumberTag
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type = TypeId("fieldkit::IdTag").SetParent<Tag>().AddConstructor<IdTag>();
        return type;
    }

    TypeId GetInstanceTypeId() const override
    {
        return GetTypeId();
    }
};

// The number of a broadcast, which is one IP packet for all its receivers.
class BroadcastTag : public NumberTag
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type =
            TypeId("fieldkit::BroadcastTag").SetParent<Tag>().AddConstructor<BroadcastTag>();
        return type;
    }

    TypeId GetInstanceTypeId() const override
    {
        return GetTypeId();
    }
};

// The number of a frame on one hop.
class FrameTag : public NumberTag
{
  public:
    static TypeId GetTypeId()
    {
        static TypeId type = TypeId("fieldkit::FrameTag").SetParent<Tag>().AddConstructor<FrameTag>();
        return type;
    }

    TypeId GetInstanceTypeId() const override
    {
        return GetTypeId();
    }
};

using protocol::DelayParts;

// Counters of the frames from one station to another, like the counters of a radio's driver.
struct LinkCounters
{
    uint64_t frames = 0; // frames whose first attempt has started; on fixed links also frames that are out of range
    uint64_t retries = 0;
    uint64_t failures = 0; // frames given up after the last retry
    uint64_t delivered = 0;
    double rate_bit_s = NAN; // rate of the last attempt; NAN before the first attempt, and on links without a rate
};

// Tracks the frames of all stations with ns-3's traces.
class FrameTracker
{
  public:
    static constexpr size_t kNoStation = SIZE_MAX;

    // Station with the access point, if the access point forwards a frame before it acknowledges the frame. It does so
    // if frames are not aggregated.
    size_t relay = kNoStation;

    // Called when a frame with an IdTag is lost, with the id of its packet and the reason.
    std::function<void(uint64_t, const std::string&)> on_lost;

    // Add the next station without tracking Wi-Fi frames.
    size_t AddStation(Ptr<MobilityModel> mobility)
    {
        m_mobilities.push_back(mobility);
        m_last.emplace_back();
        m_busy.emplace_back();
        return m_mobilities.size() - 1;
    }

    // Add the next station, and track its Wi-Fi frames; `mobility` has its position.
    void Add(Ptr<WifiNetDevice> device, Ptr<MobilityModel> mobility)
    {
        size_t station = AddStation(mobility);
        m_stations[Mac48Address::ConvertFrom(device->GetAddress())] = station;
        using OnMpdu = Callback<void, Ptr<const WifiMpdu>>;
        auto mac = device->GetMac();
        for (AcIndex access : {AC_BE, AC_BE_NQOS})
        {
            if (auto queue = mac->GetTxopQueue(access))
            {
                queue->TraceConnectWithoutContext(
                    "Enqueue", OnMpdu([this, station](Ptr<const WifiMpdu> mpdu) { Enqueued(station, mpdu); }));
                queue->TraceConnectWithoutContext("DropBeforeEnqueue", OnMpdu([this](Ptr<const WifiMpdu> mpdu) {
                                                      Lost(mpdu->GetPacket(), "queue full");
                                                  }));
            }
        }
        mac->TraceConnectWithoutContext("AckedMpdu",
                                        OnMpdu([this](Ptr<const WifiMpdu> mpdu) { Acknowledged(mpdu->GetPacket()); }));
        mac->TraceConnectWithoutContext(
            "DroppedMpdu", Callback<void, WifiMacDropReason, Ptr<const WifiMpdu>>(
                               [this](WifiMacDropReason reason, Ptr<const WifiMpdu> mpdu) { Dropped(reason, mpdu); }));
        mac->TraceConnectWithoutContext("MacTxDrop", Callback<void, Ptr<const Packet>>([this](Ptr<const Packet> packet) {
                                            Lost(packet, "not associated");
                                        }));
        device->GetPhy()->TraceConnectWithoutContext(
            "PhyTxPsduBegin", Callback<void, WifiConstPsduMap, WifiTxVector, double>(
                                  [this, station](WifiConstPsduMap frames, WifiTxVector settings, double) {
                                      Transmitted(station, frames, settings);
                                  }));
        device->GetPhy()->GetState()->TraceConnectWithoutContext(
            "State", Callback<void, Time, Time, WifiPhyState>([this, station](Time start, Time duration, WifiPhyState state) {
                if (state == WifiPhyState::TX || state == WifiPhyState::RX || state == WifiPhyState::CCA_BUSY)
                {
                    m_busy[station].Add(start.GetNanoSeconds(), (start + duration).GetNanoSeconds());
                }
            }));
        // A frame is passed to the host in the order of sequence numbers, possibly after its acknowledgement.
        mac->TraceConnectWithoutContext("MacRx", Callback<void, Ptr<const Packet>>([this, station](Ptr<const Packet> packet) {
                                            Received(station, packet);
                                        }));
    }

    // The parts of the delay of the frame that a station receives now; all are 0 if it receives none now.
    DelayParts PartsNow(size_t station) const
    {
        const auto& [at_ns, parts] = m_last[station];
        return at_ns == NowNs() ? parts : DelayParts();
    }

    // Set the parts of the delay of the frame that a station receives now.
    void SetParts(size_t station, const DelayParts& parts)
    {
        m_last[station] = {NowNs(), parts};
    }

    // Counters of the frames from one station to another.
    LinkCounters& Counters(size_t from, size_t to)
    {
        return m_links[{from, to}];
    }

    // The time for which the channel of a station has been busy.
    int64_t BusyNs(size_t station) const
    {
        const Busy& busy = m_busy[station];
        return busy.total_ns - std::max<int64_t>(busy.until_ns - Simulator::Now().GetNanoSeconds(), 0);
    }

    // Report the packet of a frame or IP packet as lost, if it has an IdTag.
    void Lost(Ptr<const Packet> packet, const std::string& reason)
    {
        IdTag tag;
        if (packet->PeekPacketTag(tag))
        {
            on_lost(tag.number, reason);
        }
    }

  private:
    struct HopFrame
    {
        size_t from = kNoStation;
        size_t to = kNoStation;
        int64_t enqueued_ns = 0;
        int64_t first_ns = -1; // start of its first attempt
        int64_t propagation_ns = 0;
        bool is_received = false;
        bool is_acknowledged = false;
        DelayParts parts; // parts of the earlier hops, and after reception also of this hop
    };

    // Time for which a channel was busy. ns-3 reports a transmission at its start, and other states at their ends.
    struct Busy
    {
        void Add(int64_t start_ns, int64_t end_ns)
        {
            total_ns += std::max<int64_t>(end_ns - std::max(start_ns, until_ns), 0);
            until_ns = std::max(until_ns, end_ns);
        }

        int64_t total_ns = 0;
        int64_t until_ns = 0;
    };

    void Enqueued(size_t station, Ptr<const WifiMpdu> mpdu)
    {
        if (!mpdu->GetHeader().IsData())
        {
            return;
        }
        auto packet = ConstCast<Packet>(mpdu->GetPacket());
        HopFrame frame;
        FrameTag tag;
        if (packet->PeekPacketTag(tag))
        {
            auto previous = m_frames.find(tag.number);
            if (previous != m_frames.end() && previous->second.to != station)
            {
                return; // the queue has replaced the same frame
            }
            if (previous != m_frames.end()) // the access point forwards it
            {
                Complete(previous->second);
                frame.parts = previous->second.parts;
            }
            packet->RemovePacketTag(tag);
        }
        auto to = m_stations.find(mpdu->GetHeader().GetAddr1());
        frame.to = to == m_stations.end() ? kNoStation : to->second;
        frame.from = station;
        frame.enqueued_ns = NowNs();
        tag.number = ++m_count;
        m_frames[tag.number] = frame;
        packet->AddPacketTag(tag);
    }

    void Transmitted(size_t station, const WifiConstPsduMap& frames, const WifiTxVector& settings)
    {
        for (const auto& [receiver, frame] : frames)
        {
            for (const auto& mpdu : *PeekPointer(frame))
            {
                if (mpdu->GetHeader().IsData())
                {
                    Transmitted(station, mpdu->GetPacket(), settings);
                }
            }
        }
    }

    void Transmitted(size_t station, Ptr<const Packet> packet, const WifiTxVector& settings)
    {
        FrameTag tag;
        auto entry = packet->PeekPacketTag(tag) ? m_frames.find(tag.number) : m_frames.end();
        if (entry == m_frames.end())
        {
            return;
        }
        HopFrame& frame = entry->second;
        bool is_first = frame.first_ns < 0;
        if (is_first)
        {
            frame.first_ns = NowNs();
        }
        if (frame.to != kNoStation)
        {
            frame.propagation_ns =
                m_delay->GetDelay(m_mobilities[station], m_mobilities[frame.to]).GetNanoSeconds();
            LinkCounters& counters = m_links[{station, frame.to}];
            (is_first ? counters.frames : counters.retries)++;
            counters.rate_bit_s = static_cast<double>(settings.GetMode().GetDataRate(settings));
        }
    }

    void Received(size_t station, Ptr<const Packet> packet)
    {
        FrameTag tag;
        auto entry = packet->PeekPacketTag(tag) ? m_frames.find(tag.number) : m_frames.end();
        if (entry == m_frames.end() || entry->second.to != station)
        {
            return;
        }
        Complete(entry->second);
        m_last[station] = {NowNs(), entry->second.parts};
        if (entry->second.is_acknowledged)
        {
            m_frames.erase(entry);
        }
    }

    // Add the parts of a hop that ends now, unless the frame was received before.
    void Complete(HopFrame& frame)
    {
        if (!frame.is_received)
        {
            m_links[{frame.from, frame.to}].delivered++;
            frame.is_received = true;
            frame.parts.queuing_ns += frame.first_ns - frame.enqueued_ns;
            frame.parts.propagation_ns += frame.propagation_ns;
            frame.parts.transmission_ns += NowNs() - frame.first_ns - frame.propagation_ns;
        }
    }

    void Acknowledged(Ptr<const Packet> packet)
    {
        FrameTag tag;
        auto entry = packet->PeekPacketTag(tag) ? m_frames.find(tag.number) : m_frames.end();
        if (entry != m_frames.end() && entry->second.is_received)
        {
            m_frames.erase(entry);
        }
        else if (entry != m_frames.end() && entry->second.to == relay)
        {
            Lost(packet, "receiver not associated"); // the access point has neither forwarded it nor passed it to its host
            m_frames.erase(entry);
        }
        else if (entry != m_frames.end())
        {
            entry->second.is_acknowledged = true;
        }
    }

    void Dropped(WifiMacDropReason reason, Ptr<const WifiMpdu> mpdu)
    {
        if (reason == WIFI_MAC_DROP_FAILED_ENQUEUE)
        {
            return Lost(mpdu->GetPacket(), "queue full");
        }
        bool is_unanswered = reason == WIFI_MAC_DROP_REACHED_RETRY_LIMIT;
        FrameTag tag;
        if (mpdu->GetPacket()->PeekPacketTag(tag))
        {
            auto entry = m_frames.find(tag.number);
            bool is_received = entry != m_frames.end() && entry->second.is_received;
            if (entry != m_frames.end() && entry->second.to != kNoStation && is_unanswered)
            {
                m_links[{entry->second.from, entry->second.to}].failures++;
            }
            m_frames.erase(tag.number);
            if (is_received) // only its acknowledgements were lost
            {
                return;
            }
        }
        Lost(mpdu->GetPacket(), is_unanswered ? "retries exhausted" : "dropped by the MAC");
    }

    uint64_t m_count = 0;
    std::unordered_map<uint64_t, HopFrame> m_frames;
    std::map<Mac48Address, size_t> m_stations;
    std::vector<Ptr<MobilityModel>> m_mobilities;
    std::map<std::pair<size_t, size_t>, LinkCounters> m_links; // by transmitter and receiver
    std::vector<Busy> m_busy;
    std::vector<std::pair<int64_t, DelayParts>> m_last; // time and parts of the last frame that each station received
    Ptr<ConstantSpeedPropagationDelayModel> m_delay = CreateObject<ConstantSpeedPropagationDelayModel>();
};

} // namespace fieldkit

#endif
