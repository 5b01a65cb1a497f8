// Options of the federate `gazebo`: `physics.options` of a scenario.

#ifndef FIELDKIT_GAZEBO_OPTIONS_H
#define FIELDKIT_GAZEBO_OPTIONS_H

#include "fieldkit/bytes.h"

#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

namespace fieldkit
{

using Json = nlohmann::json;
using protocol::Refusal;

struct Options
{
    std::string world, partition, ip, acknowledge = "auto", velocity = "step";
    std::string control_service = "/world/{world}/control", pose_service = "/world/{world}/set_pose";
    std::string pose_topic = "/world/{world}/dynamic_pose/info", clock_topic = "/world/{world}/clock";
    std::string command_topic = "/model/{model}/cmd_vel", fence_topic = "/world/{world}/fieldkit/fence";
    std::string fence_answer = "/world/{world}/fieldkit/passed";
    std::map<std::string, std::string> models, command_topics;
    std::map<std::string, std::vector<double>> origins_m;
    double timeout_s = 10, settle_s = 0.5, start_error_m = 0.3, gravity_m_s2 = 9.80665, yaw_gain_per_s = 4;
    double control_period_s = 0.02, limit_m_s2 = std::numeric_limits<double>::infinity();
    bool reset = true, place = true, deterministic = false;

    explicit Options(const Json& json)
    {
        std::set<std::string> known;
        auto read = [&](const char* key, auto& value) {
            known.insert(key);
            if (json.contains(key))
            {
                value = json.at(key).get<std::decay_t<decltype(value)>>();
            }
        };
        read("world", world), read("partition", partition), read("ip", ip);
        read("acknowledge", acknowledge), read("velocity", velocity);
        read("control_service", control_service), read("pose_service", pose_service);
        read("pose_topic", pose_topic), read("clock_topic", clock_topic), read("command_topic", command_topic);
        read("fence_topic", fence_topic), read("fence_answer", fence_answer);
        read("models", models), read("command_topics", command_topics), read("origins_m", origins_m);
        read("timeout_s", timeout_s), read("settle_s", settle_s), read("start_error_m", start_error_m);
        read("gravity_m_s2", gravity_m_s2), read("yaw_gain_per_s", yaw_gain_per_s);
        read("control_period_s", control_period_s), read("limit_m_s2", limit_m_s2);
        read("reset", reset), read("place", place), read("deterministic", deterministic);
        for (const auto& item : json.items())
        {
            if (!known.count(item.key()))
            {
                std::string names;
                for (const std::string& name : known)
                {
                    names += (names.empty() ? "" : ", ") + name;
                }
                throw Refusal("physics.options has no key '" + item.key() + "'; keys: " + names);
            }
        }
        if (acknowledge != "auto" && acknowledge != "required" && acknowledge != "off")
        {
            throw Refusal("physics.options.acknowledge is '" + acknowledge + "', not auto, required or off");
        }
        if (velocity != "step" && velocity != "window")
        {
            throw Refusal("physics.options.velocity is '" + velocity + "', not step or window");
        }
        if (!(timeout_s > 0 && settle_s >= 0 && control_period_s > 0))
        {
            throw Refusal("physics.options: timeout_s and control_period_s must be above 0, settle_s at least 0");
        }
    }

    // The name of a topic or service, of a pattern with `{world}` and `{model}`.
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
        auto special = command_topics.find(agent);
        return Name(special == command_topics.end() ? command_topic : special->second, model);
    }
};

} // namespace fieldkit

#endif
