// Captures of the IP packets of all stations, with the same addresses, ports and echo headers as fieldkit's captures.

#ifndef FIELDKIT_CAPTURES_H
#define FIELDKIT_CAPTURES_H

#include "frames.h"
#include "stations.h"

#include "ns3/ipv4-header.h"
#include "ns3/ipv4-l3-protocol.h"

#include <nlohmann/json.hpp>

#include <filesystem>
#include <fstream>

namespace fieldkit
{

// One pcap file per station, with time stamps in nanoseconds. The packets start with the IP header.
class IpCaptures
{
  public:
    // `setup` has the `folder`, the `addresses` of all agents, and `flows` with special headers (`port`, `ping`,
    // `reply`).
    IpCaptures(const nlohmann::json& setup, const std::vector<Station>& stations)
        : m_folder(setup.at("folder").get<std::string>()),
          m_files(stations.size())
    {
        for (const auto& [name, flow] : setup.at("flows").items())
        {
            m_flows[name] = {flow.at("port"), flow.at("ping"), flow.at("reply")};
        }
        for (size_t number = 0; number < stations.size(); number++)
        {
            const Station& station = stations[number];
            m_names.push_back(station.name);
            std::string address = setup.at("addresses").at(station.name);
            m_addresses[station.address] = Ipv4Address(address.c_str());
            auto record = [this, number](Ptr<const Packet> packet, Ptr<Ipv4>, uint32_t) { Record(number, packet); };
            auto ipv4 = station.node->GetObject<Ipv4L3Protocol>();
            for (const char* trace : {"Tx", "Rx"})
            {
                ipv4->TraceConnectWithoutContext(
                    trace, Callback<void, Ptr<const Packet>, Ptr<Ipv4>, uint32_t>(record));
            }
        }
    }

    // Record that a packet of the coordinator enters the network as one datagram.
    void Enter(uint64_t id, const std::string& flow, int64_t number)
    {
        auto entry = m_flows.find(flow);
        if (entry != m_flows.end())
        {
            m_datagrams[id] = {&entry->second, static_cast<uint16_t>(number + 1)};
        }
    }

    // Record that a connection from a port of a station carries a flow.
    void Connect(Ipv4Address source, uint16_t port, const std::string& flow)
    {
        auto entry = m_flows.find(flow);
        if (entry != m_flows.end())
        {
            m_connections[{m_addresses.at(source), port}] = entry->second.port;
        }
    }

    void Flush()
    {
        for (std::ofstream& file : m_files)
        {
            file.flush();
        }
    }

  private:
    static constexpr size_t kSnapBytes = 128; // bytes of each packet that a capture contains
    static constexpr size_t kIpBytes = 20; // size of the IP header; it has the protocol at byte 9, the checksum at 10
    static constexpr uint8_t kIcmp = 1; // IP protocol numbers
    static constexpr uint8_t kTcp = 6;

    struct Flow
    {
        uint16_t port; // 0 for the port of the transport
        uint16_t ping; // identifier of echo requests; 0 for UDP and TCP
        bool is_reply;
    };

    struct Datagram
    {
        const Flow* flow;
        uint16_t sequence;
    };

    void Record(size_t station, Ptr<const Packet> packet)
    {
        std::vector<uint8_t> bytes(std::min<size_t>(packet->GetSize(), kSnapBytes));
        packet->CopyData(bytes.data(), static_cast<uint32_t>(bytes.size()));
        Ipv4Header header;
        packet->PeekHeader(header);
        if (m_addresses.count(header.GetSource()) == 0 || m_addresses.count(header.GetDestination()) == 0)
        {
            return; // a broadcast
        }
        Ipv4Address source = m_addresses.at(header.GetSource());
        source.Serialize(&bytes[12]); // the addresses are at bytes 12 and 16 of the IP header
        m_addresses.at(header.GetDestination()).Serialize(&bytes[16]);
        IdTag tag;
        auto datagram = packet->PeekPacketTag(tag) ? m_datagrams.find(tag.number) : m_datagrams.end();
        bool is_first = header.GetFragmentOffset() == 0 && bytes.size() >= kIpBytes + 8;
        if (header.GetProtocol() == kTcp && is_first)
        {
            RenamePort(bytes, {source, Word(bytes, kIpBytes)}, kIpBytes + 2);
            RenamePort(bytes, {m_addresses.at(header.GetDestination()), Word(bytes, kIpBytes + 2)}, kIpBytes);
        }
        else if (datagram != m_datagrams.end())
        {
            SetDatagram(bytes, datagram->second, is_first);
        }
        SetWord(bytes, 10, 0);
        SetWord(bytes, 10, Checksum(bytes.data(), kIpBytes));
        Write(station, bytes, packet->GetSize());
    }

    // Replace the listener's port, at position `at`, by the port of the flow; `end` is the other end of the connection.
    void RenamePort(std::vector<uint8_t>& bytes, std::pair<Ipv4Address, uint16_t> end, size_t at) const
    {
        auto connection = m_connections.find(end);
        if (connection != m_connections.end() && connection->second != 0)
        {
            SetWord(bytes, at, connection->second);
        }
    }

    static void SetDatagram(std::vector<uint8_t>& bytes, const Datagram& datagram, bool is_first)
    {
        const Flow& flow = *datagram.flow;
        if (flow.ping == 0 && is_first)
        {
            SetWord(bytes, kIpBytes + 2, flow.port);
        }
        if (flow.ping == 0)
        {
            return;
        }
        bytes[9] = kIcmp; // an echo header is as long as the UDP header (RFC 792)
        if (is_first)
        {
            uint8_t* echo = &bytes[kIpBytes];
            echo[0] = flow.is_reply ? 0 : 8;
            echo[1] = 0;
            SetWord(bytes, kIpBytes + 2, 0);
            SetWord(bytes, kIpBytes + 4, flow.ping);
            SetWord(bytes, kIpBytes + 6, datagram.sequence);
            SetWord(bytes, kIpBytes + 2, Checksum(echo, 8)); // all data bytes are 0
        }
    }

    void Write(size_t station, const std::vector<uint8_t>& bytes, uint32_t size)
    {
        std::ofstream& file = m_files[station];
        if (!file.is_open())
        {
            std::filesystem::create_directories(m_folder);
            file.open(m_folder + "/" + m_names[station] + ".pcap", std::ios::binary | std::ios::trunc);
            protocol::Writer head; // pcap 2.4 with nanoseconds, and LINKTYPE_RAW (101)
            head.Put(uint32_t{0xA1B23C4D}).Put(uint16_t{2}).Put(uint16_t{4}).Put(uint64_t{0});
            head.Put(static_cast<uint32_t>(kSnapBytes)).Put(uint32_t{101});
            file.write(head.data.data(), static_cast<std::streamsize>(head.data.size()));
        }
        protocol::Writer record;
        record.Put(static_cast<uint32_t>(NowNs() / 1'000'000'000)).Put(static_cast<uint32_t>(NowNs() % 1'000'000'000));
        record.Put(static_cast<uint32_t>(bytes.size())).Put(size);
        record.data.append(bytes.begin(), bytes.end());
        file.write(record.data.data(), static_cast<std::streamsize>(record.data.size()));
        if (!file)
        {
            throw Refusal("the capture of " + m_names[station] + " cannot be written");
        }
    }

    static uint16_t Word(const std::vector<uint8_t>& bytes, size_t at)
    {
        return static_cast<uint16_t>(bytes[at] << 8 | bytes[at + 1]);
    }

    static void SetWord(std::vector<uint8_t>& bytes, size_t at, uint16_t value)
    {
        bytes[at] = static_cast<uint8_t>(value >> 8);
        bytes[at + 1] = static_cast<uint8_t>(value & 0xff);
    }

    // The internet checksum (RFC 1071) of an even number of bytes.
    static uint16_t Checksum(const uint8_t* bytes, size_t size)
    {
        uint32_t total = 0;
        for (size_t at = 0; at < size; at += 2)
        {
            total += static_cast<uint32_t>(bytes[at] << 8 | bytes[at + 1]);
        }
        total = (total & 0xffff) + (total >> 16);
        total = (total & 0xffff) + (total >> 16);
        return static_cast<uint16_t>(~total & 0xffff);
    }

    std::string m_folder;
    std::vector<std::string> m_names;
    std::vector<std::ofstream> m_files;
    std::map<Ipv4Address, Ipv4Address> m_addresses; // addresses in captures, by address in ns-3
    std::map<std::string, Flow> m_flows;
    std::unordered_map<uint64_t, Datagram> m_datagrams; // by packet of the coordinator
    std::map<std::pair<Ipv4Address, uint16_t>, uint16_t> m_connections; // port of the listener, by the other end
};

} // namespace fieldkit

#endif
