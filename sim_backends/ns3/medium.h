// The medium of a run: Wi-Fi on fieldkit's channel, or fixed links.

#ifndef FIELDKIT_MEDIUM_H
#define FIELDKIT_MEDIUM_H

#include "configuration.h"
#include "fixed_links.h"
#include "jammers.h"
#include "stations.h"

#include "fieldkit/links.h"

namespace fieldkit
{

class Medium
{
  public:
    explicit Medium(std::vector<Station>& stations)
        : m_stations(stations)
    {
    }

    WifiSetup setup;
    FrameTracker tracker;

    // Give the stations links with the parameters in the configuration, which `ns3_options.py` has computed.
    void UseFixedLinks(uint64_t seed, const Json& link, std::function<PacketIdentity(uint64_t)> identity_of)
    {
        m_links = CreateObject<FixedLinks>();
        m_links->seed = seed;
        m_links->relay = setup.relay;
        m_links->parameters.rate_bit_s = link.at("rate_bit_s").is_null() ? 0 : link["rate_bit_s"].get<int64_t>();
        m_links->parameters.delay_ns = link.at("delay_ns");
        m_links->parameters.jitter_ns = link.at("jitter_ns");
        m_links->parameters.loss = link.at("loss");
        m_links->parameters.queue_packets = setup.queue_packets;
        m_links->tracker = &tracker;
        m_links->identity_of = std::move(identity_of);
        InstallFixedLinks(m_stations, m_links, tracker);
    }

    // Give the stations Wi-Fi; throws a refusal if the mode or the captures of the setup are impossible.
    void UseWifi(uint64_t seed, const Json& radio, const Json& world)
    {
        if (!setup.pcap.empty() && !m_stations.empty())
        {
            // Open the first file here to report an error: ns-3 aborts if it cannot open a file.
            std::ofstream first;
            OpenNew(first, setup.pcap + m_stations[0].name + ".pcap", "pcap");
        }
        setup.mode = radio.value("mode", "");
        if (setup.mode.substr(0, 1) == "n" && setup.standard != "802.11n")
        {
            throw Refusal("the mode " + setup.mode + " needs the standard 802.11n in all radios");
        }
        setup.noise_dbm = Number(radio.at("noise_floor_dbm"));
        if (setup.relay >= 0)
        {
            g_start_ns = kAssociationNs;
            if (setup.ampdu_bytes == 0)
            {
                tracker.relay = setup.relay;
            }
        }
        std::vector<std::string> names;
        for (const Station& station : m_stations)
        {
            names.push_back(station.name);
        }
        m_channel = std::make_unique<Channel>(seed, radio, world, names);
        Install(m_stations, setup, *m_channel, tracker);
        m_jammers = std::make_unique<Jammers>(m_stations, *m_channel, setup.noise_dbm);
    }

    // The jammers of Wi-Fi; with fixed links there are none.
    Jammers& jammers()
    {
        return *m_jammers;
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

    // Add `change` to the number of reasons why two stations cannot receive each other.
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
                radios.push_back({m_stations[number].agent, setup.noise_dbm, NowNs(), tracker.BusyNs(number)});
            }
            bool is_client = m_links == nullptr && setup.relay >= 0 && static_cast<size_t>(setup.relay) != number;
            for (size_t peer = 0; peer < m_stations.size(); peer++)
            {
                if (peer != number && (!is_client || static_cast<size_t>(setup.relay) == peer))
                {
                    links.push_back(SampleLink(number, peer));
                }
            }
        }
        return protocol::LinksBody(radios, links);
    }

  private:
    // Time before the start of the co-simulation in which stations scan, and associate with their access point.
    static constexpr int64_t kAssociationNs = 1'000'000'000;

    protocol::LinkSample SampleLink(size_t number, size_t peer)
    {
        const Station& station = m_stations[number];
        const Station& other = m_stations[peer];
        const LinkCounters& sent = tracker.Counters(number, peer);
        const LinkCounters& reverse = tracker.Counters(peer, number);
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

    std::vector<Station>& m_stations;
    std::unique_ptr<Channel> m_channel; // null with fixed links
    std::unique_ptr<Jammers> m_jammers; // null with fixed links
    Ptr<FixedLinks> m_links;            // null with Wi-Fi
};

} // namespace fieldkit

#endif
