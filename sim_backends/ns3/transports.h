// The transports of packets: ns-3's UDP and TCP sockets.

#ifndef FIELDKIT_TRANSPORTS_H
#define FIELDKIT_TRANSPORTS_H

#include "stations.h"

#include "ns3/inet-socket-address.h"
#include "ns3/socket.h"
#include "ns3/tcp-socket-factory.h"
#include "ns3/udp-socket-factory.h"

#include <deque>
#include <memory>

namespace fieldkit
{

struct CoordinatorPacket
{
    uint64_t id = 0;
    int64_t number = 0;
    uint64_t size_bytes = 0;
    int64_t enters_ns = 0;
    size_t source = 0;      // index of the sending station
    size_t destination = 0; // index of the receiving station
    std::string flow;
    std::string protocol;
};

// Functions that are called with the id of a packet that has arrived, or was dropped for a reason.
struct Fates
{
    std::function<void(uint64_t)> arrive;
    std::function<void(uint64_t, const std::string&)> drop;
};

// Size of the headers that ns-3 adds to a datagram; a bare IP packet already contains them.
constexpr int64_t kIpAndUdpBytes = 28;

// Time after which a broadcast is lost for each station that has not received it, even if its frame is still queued.
constexpr int64_t kBroadcastNs = 1'000'000'000;

constexpr uint16_t kUdpPort = 7411;
constexpr uint16_t kTcpPort = 7412;

// Sends each packet as one datagram, and all packets of a broadcast as one. The IP layer fragments a large datagram.
class UdpTransport
{
  public:
    UdpTransport(const std::vector<Station>& stations, Fates fates)
        : m_stations(stations),
          m_fates(std::move(fates))
    {
        for (const Station& station : stations)
        {
            auto socket = Socket::CreateSocket(station.node, UdpSocketFactory::GetTypeId());
            socket->Bind(InetSocketAddress(Ipv4Address::GetAny(), kUdpPort));
            socket->SetAllowBroadcast(true);
            socket->SetRecvCallback(MakeCallback(&UdpTransport::Receive, this));
            m_sockets.push_back(socket);
            m_stationOf[station.node->GetId()] = m_sockets.size() - 1;
        }
    }

    // Send a packet as a datagram of its size plus `more_bytes`, which may be negative.
    void Send(const CoordinatorPacket& packet, int64_t more_bytes)
    {
        auto datagram = Datagram(packet, more_bytes);
        IdTag tag;
        tag.number = packet.id;
        datagram->AddPacketTag(tag);
        InetSocketAddress to(m_stations[packet.destination].address, kUdpPort);
        if (m_sockets[packet.source]->SendTo(datagram, 0, to) < 0)
        {
            m_fates.drop(packet.id, "no route");
        }
    }

    // Send a broadcast. The coordinator has one packet per receiver, all with the same source and number. The first
    // of them sends the frame.
    void SendToAll(const CoordinatorPacket& packet)
    {
        auto key = std::make_pair(packet.source, packet.number);
        bool is_first = m_broadcasts.count(key) == 0;
        m_broadcasts[key][packet.destination] = packet.id;
        if (!is_first)
        {
            return;
        }
        auto datagram = Datagram(packet, -kIpAndUdpBytes);
        BroadcastTag tag; // its number contains the number of the packet and the source; see ReceiveBroadcast
        tag.number = static_cast<uint64_t>(packet.number) * m_sockets.size() + packet.source;
        datagram->AddPacketTag(tag);
        m_sockets[packet.source]->SendTo(datagram, 0, InetSocketAddress(Ipv4Address::GetBroadcast(), kUdpPort));
        Simulator::Schedule(NanoSeconds(kBroadcastNs), [this, key] {
            for (const auto& [station, id] : m_broadcasts[key])
            {
                m_fates.drop(id, "broadcast not decoded");
            }
            m_broadcasts.erase(key);
        });
    }

  private:
    static Ptr<Packet> Datagram(const CoordinatorPacket& packet, int64_t more_bytes)
    {
        int64_t bytes = static_cast<int64_t>(packet.size_bytes) + more_bytes;
        return Create<Packet>(static_cast<uint32_t>(std::max<int64_t>(bytes, 0)));
    }

    void ReceiveBroadcast(uint64_t number, size_t station)
    {
        auto broadcast =
            m_broadcasts.find({number % m_sockets.size(), static_cast<int64_t>(number / m_sockets.size())});
        if (broadcast == m_broadcasts.end())
        {
            return;
        }
        auto packet = broadcast->second.find(station);
        if (packet != broadcast->second.end())
        {
            m_fates.arrive(packet->second);
            broadcast->second.erase(packet);
        }
    }

    void Receive(Ptr<Socket> socket)
    {
        while (auto datagram = socket->Recv())
        {
            BroadcastTag broadcast;
            if (datagram->PeekPacketTag(broadcast))
            {
                ReceiveBroadcast(broadcast.number, m_stationOf.at(socket->GetNode()->GetId()));
            }
            IdTag tag;
            if (datagram->PeekPacketTag(tag))
            {
                m_fates.arrive(tag.number);
            }
        }
    }

    const std::vector<Station>& m_stations;
    Fates m_fates;
    std::vector<Ptr<Socket>> m_sockets;
    std::map<uint32_t, size_t> m_stationOf; // index of a station, by the id of its node
    // Packets of a broadcast by receiver, for each source and number of the broadcast.
    std::map<std::pair<size_t, int64_t>, std::map<size_t, uint64_t>> m_broadcasts;
};

// Each flow has a connection, which its first message opens. A message arrives when its last byte has been read.
class TcpTransport
{
  public:
    static void SetDefaults(const std::string& congestion)
    {
        bool is_newreno = congestion == "newreno";
        auto type = TypeId::LookupByName(is_newreno ? "ns3::TcpLinuxReno" : "ns3::TcpCubic");
        // The values of fieldkit's own TCP (sim_backends/network/tcp/tcp_options.py), which has no HyStart and no limit
        // of the send buffer. Here the buffer is larger than the receiver's.
        Config::SetDefault("ns3::TcpL4Protocol::SocketType", TypeIdValue(type));
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
    }

    TcpTransport(const std::vector<Station>& stations, Fates fates)
        : m_stations(stations),
          m_fates(std::move(fates))
    {
        for (const Station& station : stations)
        {
            auto socket = Socket::CreateSocket(station.node, TcpSocketFactory::GetTypeId());
            socket->Bind(InetSocketAddress(Ipv4Address::GetAny(), kTcpPort));
            socket->Listen();
            socket->SetAcceptCallback(MakeNullCallback<bool, Ptr<Socket>, const Address&>(),
                                      MakeCallback(&TcpTransport::Accept, this));
            m_listeners.push_back(socket);
        }
    }

    // Called with the address and port of a connection's source, and the flow.
    std::function<void(Ipv4Address, uint16_t, const std::string&)> on_connect;

    void Send(const CoordinatorPacket& packet)
    {
        auto key = std::make_tuple(packet.source, packet.destination, packet.flow);
        auto& connection = m_connections[key];
        if (connection == nullptr)
        {
            connection = Open(packet, key);
        }
        connection->queued_bytes += packet.size_bytes;
        connection->messages.push_back({packet.id, connection->queued_bytes});
        Write(connection);
    }

  private:
    using Key = std::tuple<size_t, size_t, std::string>;

    struct Message
    {
        uint64_t id;
        uint64_t end; // position after its last byte in the stream
    };

    struct Connection
    {
        Ptr<Socket> sender;
        bool is_open = false;
        uint64_t queued_bytes = 0;
        uint64_t written_bytes = 0;
        uint64_t read_bytes = 0;
        std::deque<Message> messages; // messages that have not arrived
    };

    using ConnectionPointer = std::shared_ptr<Connection>;
    using OnSocket = Callback<void, Ptr<Socket>>;

    ConnectionPointer Open(const CoordinatorPacket& packet, const Key& key)
    {
        auto connection = std::make_shared<Connection>();
        const Station& source = m_stations[packet.source];
        auto socket = Socket::CreateSocket(source.node, TcpSocketFactory::GetTypeId());
        connection->sender = socket;
        socket->Bind();
        Address local;
        socket->GetSockName(local);
        uint16_t port = InetSocketAddress::ConvertFrom(local).GetPort();
        m_byEnd[{source.address, port}] = connection;
        if (on_connect)
        {
            on_connect(source.address, port, packet.flow);
        }
        std::weak_ptr<Connection> weak = connection;
        socket->SetConnectCallback(OnSocket([this, weak](Ptr<Socket>) {
                                       if (auto opened = weak.lock())
                                       {
                                           opened->is_open = true;
                                           Write(opened);
                                       }
                                   }),
                                   OnSocket([this, key, weak](Ptr<Socket>) { GiveUp(key, weak); }));
        socket->SetCloseCallbacks(OnSocket([this, key, weak](Ptr<Socket>) { GiveUp(key, weak); }),
                                  OnSocket([this, key, weak](Ptr<Socket>) { GiveUp(key, weak); }));
        socket->SetSendCallback(Callback<void, Ptr<Socket>, uint32_t>([this, weak](Ptr<Socket>, uint32_t) {
            if (auto writable = weak.lock())
            {
                Write(writable);
            }
        }));
        socket->Connect(InetSocketAddress(m_stations[packet.destination].address, kTcpPort));
        return connection;
    }

    static void Write(const ConnectionPointer& connection)
    {
        while (connection->is_open && connection->written_bytes < connection->queued_bytes)
        {
            uint64_t size = std::min<uint64_t>(connection->queued_bytes - connection->written_bytes,
                                               connection->sender->GetTxAvailable());
            if (size == 0)
            {
                return;
            }
            // The bytes are counted before Send, because Send may call this function again.
            connection->written_bytes += size;
            int sent = connection->sender->Send(Create<Packet>(static_cast<uint32_t>(size)));
            if (sent < 0 || static_cast<uint64_t>(sent) < size)
            {
                connection->written_bytes -= size - std::max(sent, 0);
                return;
            }
        }
    }

    void Accept(Ptr<Socket> socket, const Address& from)
    {
        auto end = InetSocketAddress::ConvertFrom(from);
        std::weak_ptr<Connection> weak = m_byEnd[{end.GetIpv4(), end.GetPort()}];
        socket->SetRecvCallback(OnSocket([this, weak](Ptr<Socket> readable) {
            uint64_t bytes = 0;
            while (auto data = readable->Recv())
            {
                if (data->GetSize() == 0)
                {
                    break;
                }
                bytes += data->GetSize();
            }
            if (auto connection = weak.lock())
            {
                Read(*connection, bytes);
            }
        }));
        m_receivers.push_back(socket);
    }

    void Read(Connection& connection, uint64_t bytes)
    {
        connection.read_bytes += bytes;
        while (!connection.messages.empty() && connection.messages.front().end <= connection.read_bytes)
        {
            m_fates.arrive(connection.messages.front().id);
            connection.messages.pop_front();
        }
    }

    void GiveUp(const Key& key, const std::weak_ptr<Connection>& weak)
    {
        auto connection = weak.lock();
        if (connection == nullptr || m_connections[key] != connection)
        {
            return;
        }
        m_connections[key] = nullptr;
        m_closed.push_back(connection); // it must not be destroyed, because its socket is calling this function
        connection->is_open = false;
        for (const Message& message : connection->messages)
        {
            m_fates.drop(message.id, "TCP connection given up");
        }
        connection->messages.clear();
    }

    const std::vector<Station>& m_stations;
    Fates m_fates;
    std::vector<Ptr<Socket>> m_listeners;
    std::vector<Ptr<Socket>> m_receivers;
    std::map<Key, ConnectionPointer> m_connections;
    std::map<std::pair<Ipv4Address, uint16_t>, ConnectionPointer> m_byEnd; // by address and port of the sender
    std::vector<ConnectionPointer> m_closed;
};

} // namespace fieldkit

#endif
