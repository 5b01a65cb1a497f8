// Values of the configuration: the options of the run, the files that they name, and times.

#ifndef FIELDKIT_CONFIGURATION_H
#define FIELDKIT_CONFIGURATION_H

#include "obstacles.h"
#include "simulator.h"

#include <cmath>
#include <fstream>
#include <string>

namespace fieldkit
{

// A path in which the first {seed} is replaced by the seed.
inline std::string
OutputPath(std::string path, uint64_t seed)
{
    const std::string placeholder = "{seed}";
    auto at = path.find(placeholder);
    if (at != std::string::npos)
    {
        path.replace(at, placeholder.size(), std::to_string(seed));
    }
    return path;
}

// Open an empty file; throws a refusal with the name of its option if it cannot be written.
inline void
OpenNew(std::ofstream& file, const std::string& path, const std::string& option)
{
    file.open(path, std::ios::trunc);
    if (!file)
    {
        throw Refusal("the file of " + option + " cannot be written: " + path);
    }
}

// ns-3's time at a time of the scenario, which is given in seconds.
inline Time
At(const Json& seconds)
{
    return NanoSeconds(g_start_ns + std::llround(Number(seconds) * 1e9));
}

struct RunOptions
{
    uint32_t ampdu_bytes = 0;
    std::string standard; // of all radios; empty if their standards select it
    bool carries_topics = false;
    std::string delay_parts; // path of the file with the parts of delays; empty for none
    std::string pcap;        // beginning of the names of capture files; empty for none
};

// Read `network.options` of the scenario, which `ns3_options.py` has validated and completed.
inline RunOptions
ReadOptions(uint64_t seed, const Json& options)
{
    RunOptions run;
    run.ampdu_bytes = options.at("ampdu_bytes");
    run.standard = options.value("standard", "");
    run.carries_topics = options.contains("topics");
    if (options.contains("delay_parts"))
    {
        run.delay_parts = OutputPath(options["delay_parts"], seed);
    }
    if (options.contains("pcap"))
    {
        run.pcap = OutputPath(options["pcap"], seed);
    }
    return run;
}

// Throw a refusal if a topic is reliable, which datagrams cannot carry.
inline void
RefuseReliableTopics(const Json& traffic)
{
    for (const Json& flow : traffic)
    {
        bool is_reliable = !flow.contains("qos") || flow["qos"].value("reliability", "reliable") == "reliable";
        if (flow.at("protocol") == "topic" && is_reliable)
        {
            throw Refusal("topics: udp carries best_effort topics only, but " + flow.at("from").get<std::string>() +
                          " publishes a reliable topic");
        }
    }
}

} // namespace fieldkit

#endif
