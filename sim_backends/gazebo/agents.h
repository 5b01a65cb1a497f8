// The agents of a run (models in Gazebo), and their commands.

#ifndef FIELDKIT_GAZEBO_AGENTS_H
#define FIELDKIT_GAZEBO_AGENTS_H

#include "fieldkit/commands.h"
#include "fieldkit/handshake.h"
#include "libraries.h"
#include "options.h"
#include "pose.h"

namespace fieldkit
{

struct Agent
{
    std::string name, model;
    bool flies = false;
    Vector antenna; // position in the frame of the model
    Vector start;   // start position of the model
    double start_yaw = 0;
    protocol::Command command; // the current command
    Pose pose;
    Vector velocity;
    int64_t appears_ns = 0, disappears_ns = -1; // -1 for never
    bool is_present = false; // it has a model, which may not have published a pose yet
    bool is_new = false;    // its model was created and has not published a pose yet
    bool had_model = false; // it had a model before the run

    bool HasLifetime() const
    {
        return appears_ns > 0 || disappears_ns >= 0;
    }

    Pose Start() const
    {
        Pose pose = Pose::WithYaw(start_yaw);
        pose.position = start;
        return pose;
    }

    Vector AntennaAt(const Pose& model_pose) const
    {
        return model_pose.position + model_pose.Rotated(antenna);
    }

    // Angle from its heading to its target heading, which is the fourth value of a command to an agent that flies.
    double YawError() const
    {
        return std::remainder(command.values[3] - pose.Yaw(), 2 * M_PI);
    }

    // True if it has a target heading (NaN for none) that it has not reached yet.
    bool Turns() const
    {
        return is_present && flies && !std::isnan(command.values[3]) && std::fabs(YawError()) > 1e-3;
    }

    void Stop()
    {
        command.values = {0, 0, 0, NAN};
    }
};

// The agents in the message `hello`, with their models and the start poses of the models. `plans` is the section
// `agents` of the scenario.
inline std::vector<Agent>
AgentsOf(const protocol::Hello& hello, const Json& plans, const Options& options)
{
    std::vector<Agent> agents;
    for (const protocol::Agent& hello_agent : hello.agents)
    {
        Agent agent;
        agent.name = hello_agent.name;
        agent.flies = hello_agent.flies;
        agent.antenna.z = hello_agent.antenna_m;
        double heading = hello_agent.start.heading_rad;
        agent.start_yaw = std::isnan(heading) ? 0 : heading;
        auto model = options.models.find(agent.name);
        agent.model = model == options.models.end() ? agent.name : model->second;
        auto origin = options.origins_m.find(agent.name);
        if (origin != options.origins_m.end())
        {
            const auto& [x, y, z] = origin->second;
            agent.antenna = agent.antenna + Vector{x, y, z};
        }
        const auto& position_m = hello_agent.start.position_m;
        Vector start{position_m[0], position_m[1], position_m[2]};
        agent.start = start - Pose::WithYaw(agent.start_yaw).Rotated(agent.antenna);
        agent.pose = agent.Start();
        auto plan = plans.value(agent.name, Json::object());
        auto read_ns = [&plan](const char* key, int64_t& time_ns) {
            if (plan.contains(key))
            {
                time_ns = std::llround(std::strtod(plan[key].get<std::string>().c_str(), nullptr) * 1e9);
            }
        };
        read_ns("appears", agent.appears_ns);
        read_ns("disappears", agent.disappears_ns);
        agents.push_back(agent);
    }
    return agents;
}

// The command of an agent as Gazebo's plugins expect it, in the axes of the model.
inline msgs::Twist
TwistOf(const Agent& agent, const Options& options, int64_t step_ns)
{
    msgs::Twist twist;
    const auto& values = agent.command.values;
    if (!agent.flies)
    {
        twist.mutable_linear()->set_x(values[0]);
        twist.mutable_angular()->set_z(values[1]);
        return twist;
    }
    // VelocityControl sets the velocity before each step, and gravity reduces it within the step by this speed.
    double fall_m_s = options.gravity_m_s2 * double(step_ns) / 1e9;
    Vector velocity = agent.pose.InverseRotated({values[0], values[1], values[2] + fall_m_s});
    twist.mutable_linear()->set_x(velocity.x);
    twist.mutable_linear()->set_y(velocity.y);
    twist.mutable_linear()->set_z(velocity.z);
    if (agent.Turns())
    {
        twist.mutable_angular()->set_z(options.yaw_gain_per_s * agent.YawError());
    }
    return twist;
}

} // namespace fieldkit

#endif
