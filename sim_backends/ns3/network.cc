// The network federate of ns-3: docs/ns3.md. Standard input and output carry the protocol of docs/federates.md.
//
//     network VERSION                 serve one run
//     network VERSION alone FILE      simulate the requests of a recorded run, and print the processor time
//     network VERSION losses          print the losses of links, for tests

#include "network.h"

#include <ctime>
#include <iostream>

namespace fieldkit
{

// Answer a request of the coordinator.
protocol::Answer
AnswerTo(Network& network, const protocol::Frame& request)
{
    switch (request.kind)
    {
    case protocol::kHello:
        return {protocol::kWelcome, network.Hello(request.body)};
    case protocol::kAdvanceNetwork:
        if (!network.IsReady() || request.copy != 0)
        {
            throw Refusal("hello is missing, or there is no such copy");
        }
        return {protocol::kOutcomes, network.Advance(request.body)};
    case protocol::kSampleLinks:
        if (!network.IsReady() || request.copy != 0 || !request.body.empty())
        {
            throw Refusal("hello is missing, there is no such copy, or bytes follow the message");
        }
        return {protocol::kLinks, network.SampleLinks()};
    default:
        throw Refusal("the request is not supported");
    }
}

// Simulate the requests of a file without a coordinator.
int
RunAlone(Network& network, const char* path)
{
    std::FILE* stream = std::fopen(path, "rb");
    protocol::Frame frame;
    int64_t to_ns = -1;
    std::clock_t started = 0;
    while (stream != nullptr && protocol::ReadFrame(stream, frame))
    {
        if (frame.kind == protocol::kHello)
        {
            network.Hello(frame.body);
            started = std::clock();
        }
        else if (frame.kind == protocol::kAdvanceNetwork)
        {
            to_ns = network.Schedule(frame.body, true);
        }
    }
    RunUntil(to_ns);
    double spent_s = static_cast<double>(std::clock() - started) / CLOCKS_PER_SEC;
    std::cout << Json{{"arrivals", network.packets().outcomes().Arrivals()},
                      {"drops", network.packets().outcomes().Drops()},
                      {"checksum", network.packets().checksum()},
                      {"spent_s", spent_s}}
              << "\n";
    return stream == nullptr;
}

// Print losses in dB for a JSON text with seed, radio, world and names: first for each row of `links` (a time, two
// indices and two positions), then for each row of `places` (two positions).
int
PrintLosses()
{
    auto request = Json::parse(std::cin);
    Channel channel(request.at("seed"), request.at("radio"), request.at("world"), request.at("names"));
    Json losses_db;
    for (const Json& row : request.at("links"))
    {
        losses_db.push_back(channel.LossDb(row[0], row[1], row[2], row[3], row[4]));
    }
    for (const Json& row : request.at("places"))
    {
        losses_db.push_back(channel.MeanLossDb(row[0].get<Point>(), row[1].get<Point>()));
    }
    std::cout << losses_db << "\n";
    return 0;
}

} // namespace fieldkit

int
main(int count, char** words)
{
    std::string task = count > 2 ? words[2] : "serve";
    if (task == "losses")
    {
        return fieldkit::PrintLosses();
    }
    fieldkit::Network network(count > 1 ? words[1] : "");
    if (task == "alone" && count > 3)
    {
        return fieldkit::RunAlone(network, words[3]);
    }
    std::FILE* output = fieldkit::protocol::RedirectStandardOutput();
    bool is_complete = fieldkit::protocol::Serve(
        stdin, output, fieldkit::g_heartbeat,
        [&network](const fieldkit::protocol::Frame& request) { return fieldkit::AnswerTo(network, request); });
    return is_complete ? 0 : 1;
}
