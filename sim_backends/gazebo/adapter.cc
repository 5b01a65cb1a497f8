// The physics federate `gazebo`, which couples a running Gazebo (docs/gazebo.md) to fieldkit's coordinator.
//
// Standard input and output carry the protocol of docs/federates.md. Gazebo is reached over Gazebo Transport.

#include "fieldkit/commands.h"
#include "fieldkit/handshake.h"
#include "fieldkit/serving.h"
#include "lock_step.h"

namespace fieldkit
{

class Federate
{
  public:
    explicit Federate(protocol::Heartbeat& heartbeat)
        : m_heartbeat(heartbeat)
    {
    }

    protocol::Answer AnswerTo(const protocol::Frame& request)
    {
        switch (request.kind)
        {
        case protocol::kHello:
            return {protocol::kWelcome, Hello(request.body)};
        case protocol::kAdvancePhysics:
            return {protocol::kStates, Advance(request.body)};
        default:
            throw Refusal("the request is not supported");
        }
    }

    // Stop the robots at the end of the run, and restore the models. Returns false if Gazebo has refused a request.
    bool Stop()
    try
    {
        if (m_world)
        {
            m_world->End();
        }
        return true;
    }
    catch (const Refusal& error)
    {
        std::fprintf(stderr, "%s\n", error.what());
        return false;
    }

  private:
    std::string Hello(const std::string& body)
    {
        if (m_world)
        {
            throw Refusal("hello was sent twice");
        }
        protocol::Hello hello = protocol::ReadHello(body, protocol::kPhysics);
        m_heartbeat.SetInterval(hello.heartbeat_ms);
        Json configuration = Json::parse(hello.configuration);
        Options options(configuration);
        for (const auto& [name, value] :
             {std::pair<std::string, std::string>{"IP", options.ip}, {"PARTITION", options.partition}})
        {
            if (!value.empty())
            {
                setenv(("IGN_" + name).c_str(), value.c_str(), 1);
                setenv(("GZ_" + name).c_str(), value.c_str(), 1);
            }
        }
        m_limit_m_s2 = options.limit_m_s2;
        protocol::Welcome welcome;
        welcome.role = protocol::kPhysics;
        welcome.capabilities = protocol::kAgentsDisappear | (options.deterministic ? protocol::kDeterministic : 0);
        m_heartbeat.Send(0); // now, because the first use of Gazebo Transport takes some time
        std::vector<Agent> agents = AgentsOf(hello, configuration.at("scenario").at("agents"), options);
        m_world = std::make_unique<LockStep>(std::move(options), std::move(agents), m_heartbeat);
        m_world->Start();
        welcome.step_ns = m_world->StepNs();
        welcome.configuration_hash = hello.configuration_hash;
        welcome.name = "gazebo";
        welcome.software = FIELDKIT_GAZEBO_SOFTWARE;
        welcome.commands = {protocol::kTwist, protocol::kVelocity};
        return protocol::WelcomeBody(welcome);
    }

    std::string Advance(const std::string& body)
    {
        if (!m_world)
        {
            throw Refusal("hello is missing");
        }
        std::vector<Agent>& agents = m_world->Agents();
        protocol::PhysicsRequest request = protocol::ReadPhysicsRequest(body, agents.size());
        for (const protocol::Command& command : request.commands)
        {
            if ((command.type == protocol::kVelocity) != agents[command.agent].flies)
            {
                throw Refusal("a command to " + agents[command.agent].name + " has the wrong type");
            }
        }
        int64_t to_ns = request.to_ns;
        if (to_ns < m_toNs || request.from_ns > to_ns)
        {
            throw Refusal("time runs backwards: " + Seconds(m_toNs) + " to " + Seconds(to_ns));
        }
        m_toNs = to_ns;
        int64_t step_ns = m_world->StepNs();
        if (!request.commands.empty())
        {
            ApplyPending(request.from_ns); // apply the earlier commands first; they are valid until this time
            m_pending.insert(m_pending.end(), request.commands.begin(), request.commands.end());
            m_pendingStep = (request.from_ns + step_ns - 1) / step_ns;
        }
        ApplyPending(to_ns);
        m_world->Advance(to_ns / step_ns);
        std::vector<protocol::State> states;
        for (uint32_t number = 0; number < agents.size(); number++)
        {
            const Agent& agent = agents[number];
            if (!agent.is_present)
            {
                continue;
            }
            Vector position = agent.AntennaAt(agent.pose);
            const Vector& velocity = agent.velocity;
            states.push_back({number,
                              {position.x, position.y, position.z},
                              {velocity.x, velocity.y, velocity.z},
                              agent.pose.Yaw(),
                              m_limit_m_s2});
        }
        return protocol::StatesBody(to_ns - to_ns % step_ns, states);
    }

    // Apply the pending commands if the step at which they apply starts at or before `to_ns`.
    void ApplyPending(int64_t to_ns)
    {
        if (m_pending.empty() || m_pendingStep > to_ns / m_world->StepNs())
        {
            return;
        }
        m_world->Advance(m_pendingStep);
        for (const protocol::Command& command : m_pending)
        {
            if (m_world->Agents()[command.agent].is_present)
            {
                m_world->Agents()[command.agent].command = command;
            }
        }
        m_pending.clear();
        m_world->SendCommands();
    }

    protocol::Heartbeat& m_heartbeat;
    std::unique_ptr<LockStep> m_world;
    std::vector<protocol::Command> m_pending; // commands that have not been applied yet
    int64_t m_pendingStep = 0;                // the step at which they apply
    int64_t m_toNs = 0;                       // end of the last request
    double m_limit_m_s2 = 0;
};

} // namespace fieldkit

int
main()
{
    std::FILE* output = fieldkit::protocol::RedirectStandardOutput();
    fieldkit::protocol::Heartbeat heartbeat;
    fieldkit::Federate federate(heartbeat);
    fieldkit::protocol::Serve(stdin, output, heartbeat, [&federate](const fieldkit::protocol::Frame& request) {
        return federate.AnswerTo(request);
    });
    return federate.Stop() ? 0 : 1;
}
