// Prints results of ns-3 for 802.11 links and cables, for the benchmarks *_vs_ns3.py:
//
// - `errors`: frame error of a mode by SNR;
// - `durations`: airtime in ns by frame size in bytes;
// - `link`: goodput in Mbit/s, by traffic class, of saturated stations that send UDP to one receiver, all with the same
//   distance from each other;
// - `pairs`: goodput in Mbit/s of two pairs of stations, each with a saturated sender and a receiver;
// - `udp`: goodput and loss of a stream at a fixed rate;
// - `tcp`: goodput of a stream at full rate, and the events of its sender (over 802.11 only its congestion window).

#include "ns3_link_goodputs.h"
#include "ns3_link_streams.h"
#include "ns3_link_wifi.h"

namespace fieldkit {

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

} // namespace fieldkit

int main(int argc, char** argv)
{
    using namespace fieldkit;
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
