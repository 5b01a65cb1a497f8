// A federate of the examples in docs/reference/federate-vectors.md, for the test of the headers for C++.

#include "fieldkit/commands.h"
#include "fieldkit/handshake.h"
#include "fieldkit/links.h"
#include "fieldkit/packets.h"
#include "fieldkit/serving.h"

using namespace fieldkit::protocol;

static void
Require(bool is_as_expected, const char* what)
{
    if (!is_as_expected)
    {
        throw Refusal(std::string("differs from the example: ") + what);
    }
}

static Answer
AnswerTo(const Frame& request, Heartbeat& heartbeat)
{
    if (request.kind == kHello)
    {
        Hello hello = ReadHello(request.body, kPhysics);
        heartbeat.SetInterval(hello.heartbeat_ms);
        Require(hello.heartbeat_ms == 1000 && hello.seed == 7 && hello.end_ns == 2'000'000'000, "numbers");
        Require(hello.token == "s3cret" && hello.name == "demo" && hello.configuration == "{}", "texts");
        const Agent& agent = hello.agents.at(0);
        Require(agent.name == "ugv" && agent.profile == "husky" && !agent.flies && agent.antenna_m == 0.5, "agent");
        Require(agent.start.heading_rad == 0.25 && agent.start.limit_m_s2 == 3, "start");
        Welcome welcome;
        welcome.capabilities = kDeterministic | kAgentsAppear;
        welcome.step_ns = hello.step_ns;
        welcome.configuration_hash = hello.configuration_hash;
        welcome.name = "carts";
        welcome.software = "carts 1.0";
        welcome.commands = {kTwist, kVelocity};
        return {kWelcome, WelcomeBody(welcome)};
    }
    if (request.kind == kAdvancePhysics)
    {
        PhysicsRequest advance = ReadPhysicsRequest(request.body, 2);
        Require(advance.to_ns == 11'100'000 && advance.from_ns == 10'000'000, "times");
        Require(advance.commands.at(0).values[1] == -0.125, "twist");
        Require(advance.commands.at(1).values[2] == 0.25 && std::isnan(advance.commands.at(1).values[3]), "velocity");
        std::vector<State> states{{0, {1, 2, 0.5}, {0, 0, 0}, 0.25, 3},
                                  {1, {-1.5, 0, 10}, {0, 0.5, -0.25}, NAN, INFINITY}};
        return {kStates, StatesBody(11'000'000, states, {{1, "uav"}})};
    }
    if (request.kind == kAdvanceNetwork)
    {
        NetworkRequest advance = ReadNetworkRequest(request.body);
        Require(advance.since_ns == 10'000'000 && advance.reckoning_ns == 1'000'000, "dead reckoning");
        const Packet& packet = advance.packets.at(0);
        Require(advance.states.at(0).position_m[1] == 2 && packet.flow == "pose" && packet.size_bytes == 300, "packet");
        Outcomes outcomes;
        outcomes.Arrive(packet.id, 11'000'250, packet.destination, {100'000, 350'000, 33});
        outcomes.Drop(8, "out of range");
        return {kOutcomes, outcomes.TakeBody(advance.to_ns, 12'000'000)};
    }
    if (request.kind == kSampleLinks)
    {
        return {kLinks, LinksBody({{0, -95, 11'099'999, 2'000'000}}, {{0, 1, -61.5, 54e6, NAN, 12, 11, 3, 1}})};
    }
    heartbeat.Send(10'000'000);
    throw Refusal("ValueError: no wheels");
}

int
main()
{
    Heartbeat heartbeat;
    std::FILE* output = RedirectStandardOutput();
    bool is_complete =
        Serve(stdin, output, heartbeat, [&heartbeat](const Frame& request) { return AnswerTo(request, heartbeat); });
    return is_complete ? 0 : 1;
}
