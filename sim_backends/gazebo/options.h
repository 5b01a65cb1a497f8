// Options of the federate `gazebo`: `physics.options` of a scenario, which `gazebo_options.py` validates and completes.

#ifndef FIELDKIT_GAZEBO_OPTIONS_H
#define FIELDKIT_GAZEBO_OPTIONS_H

#include "fieldkit/bytes.h"
#include "libraries.h"

#include <array>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

namespace fieldkit
{

using Json = nlohmann::json;
using protocol::Refusal;

struct Options
{
    std::string world, partition, ip, acknowledge, velocity;
    std::string create_service, remove_service;
    std::string control_service, pose_service, pose_topic, clock_topic, command_topic, fence_topic, fence_answer;
    std::map<std::string, std::string> models, model_files, command_topics;
    std::map<std::string, std::string> sdf; // SDF of the model of each agent
    std::map<std::string, std::array<double, 3>> origins_m;
    double timeout_s, settle_s, start_error_m, gravity_m_s2, yaw_gain_per_s, control_period_s;
    double limit_m_s2 = std::numeric_limits<double>::infinity();
    bool reset, place, deterministic;

    explicit Options(const Json& configuration)
    try
    {
        const Json& json = configuration.at("options");
        world = json.contains("world") ? json["world"] : configuration.at("world").at("name");
        partition = json.value("partition", ""), ip = json.value("ip", "");
        limit_m_s2 = json.value("limit_m_s2", limit_m_s2);
        auto read = [&](const char* key, auto& value) { json.at(key).get_to(value); };
        read("acknowledge", acknowledge), read("velocity", velocity);
        read("control_service", control_service), read("pose_service", pose_service);
        read("create_service", create_service), read("remove_service", remove_service);
        read("model_files", model_files);
        const Json descriptions = configuration.value("sdf", Json::object()); // a lab has none: its robots exist from the start
        for (const auto& [agent, versions] : descriptions.items())
        {
            sdf[agent] = versions.at(FIELDKIT_GAZEBO_PLUGINS);
        }
        read("pose_topic", pose_topic), read("clock_topic", clock_topic), read("command_topic", command_topic);
        read("fence_topic", fence_topic), read("fence_answer", fence_answer);
        read("models", models), read("command_topics", command_topics), read("origins_m", origins_m);
        read("timeout_s", timeout_s), read("settle_s", settle_s), read("start_error_m", start_error_m);
        read("gravity_m_s2", gravity_m_s2), read("yaw_gain_per_s", yaw_gain_per_s);
        read("control_period_s", control_period_s);
        read("reset", reset), read("place", place), read("deterministic", deterministic);
    }
    catch (const Json::exception& error)
    {
        throw Refusal(std::string("the options are incomplete (run the adapter by its name, gazebo): ") +
                      error.what());
    }

    // The name of a topic or service, from a pattern with `{world}` and `{model}`.
    std::string Name(std::string pattern, const std::string& model = "") const
    {
        for (const auto& [key, value] : {std::pair<std::string, std::string>{"{world}", world}, {"{model}", model}})
        {
            for (size_t at; (at = pattern.find(key)) != std::string::npos;)
            {
                pattern.replace(at, key.size(), value);
            }
        }
        return pattern;
    }

    std::string ControlService() const
    {
        return Name(control_service);
    }

    // The topic of the commands to an agent, which is a model in Gazebo.
    std::string CommandTopic(const std::string& agent, const std::string& model) const
    {
        auto agent_topic = command_topics.find(agent);
        return Name(agent_topic == command_topics.end() ? command_topic : agent_topic->second, model);
    }
};

} // namespace fieldkit

#endif
