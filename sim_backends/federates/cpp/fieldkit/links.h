// Samples of the links of radios, as their drivers report them.

#ifndef FIELDKIT_FEDERATES_LINKS_H
#define FIELDKIT_FEDERATES_LINKS_H

#include "bytes.h"

#include <cmath>
#include <vector>

namespace fieldkit::protocol
{

struct RadioSample
{
    uint32_t agent = 0;
    double noise_dbm = NAN;
    int64_t active_ns = 0; // time during which the radio was on the channel
    int64_t busy_ns = 0; // part of that time in which the channel was busy
};

// The link of an agent to a peer; a number that is not known is NaN.
struct LinkSample
{
    uint32_t agent = 0;
    uint32_t peer = 0;
    double signal_dbm = NAN; // from the peer
    double tx_rate_bit_s = NAN; // of the last frame to the peer
    double rx_rate_bit_s = NAN; // of the last frame from the peer
    uint64_t tx_packets = 0;
    uint64_t rx_packets = 0;
    uint64_t tx_retries = 0;
    uint64_t tx_failures = 0; // packets dropped after the last retry
};

inline std::string
LinksBody(const std::vector<RadioSample>& radios, const std::vector<LinkSample>& links)
{
    Writer body;
    body.Put(static_cast<uint32_t>(radios.size()));
    for (const RadioSample& radio : radios)
    {
        body.Put(radio.agent).Put(uint32_t{0}).Put(radio.noise_dbm).Put(radio.active_ns).Put(radio.busy_ns);
    }
    body.Put(static_cast<uint32_t>(links.size()));
    for (const LinkSample& link : links)
    {
        body.Put(link.agent).Put(link.peer).Put(link.signal_dbm).Put(link.tx_rate_bit_s).Put(link.rx_rate_bit_s);
        body.Put(link.tx_packets).Put(link.rx_packets).Put(link.tx_retries).Put(link.tx_failures);
    }
    return body.data;
}

} // namespace fieldkit::protocol

#endif
