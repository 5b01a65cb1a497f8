// The transport to a running Gazebo: subscriptions, services and commands.

#ifndef FIELDKIT_GAZEBO_CONNECTION_H
#define FIELDKIT_GAZEBO_CONNECTION_H

#include "world_lock.h"
#include "world_monitor.h"

#include <memory>
#include <thread>

namespace fieldkit
{

class Connection
{
  public:
    Connection(const Options& options, std::vector<Agent>& agents, WorldMonitor& monitor)
        : m_options(options),
          m_agents(agents),
          m_monitor(monitor)
    {
        for (const Agent& agent : agents)
        {
            m_receivers.push_back({agent.name, options.CommandTopic(agent.name, agent.model), {}});
        }
    }

    // Wait until the world is free, and connect to it; `FindModels` must follow.
    void Open()
    {
        WaitForOtherRuns();
        Subscribe();
        Advertise();
        std::string control = m_options.ControlService();
        std::string poses = m_options.Name(m_options.pose_topic);
        WorldMonitor::Lock lock(m_monitor.mutex);
        m_monitor.Wait(
            lock, [&] { return WorldMonitor::Unlocked(lock, [&] { return HasService(control); }); },
            [&] { return "the service " + control + " has not been found (" + ListWorlds() + ")"; });
        m_monitor.is_available = [this, control] { return HasService(control); };
        m_monitor.Wait(
            lock, [&] { return m_monitor.clock_ns >= 0; },
            [] { return std::string("its clock has not been received"); });
        m_monitor.Wait(
            lock, [&] { return m_monitor.pose_ns >= 0; },
            [&] {
                return "no poses have been received on " + poses + "; the world needs the SceneBroadcaster plugin";
            });
    }

    // Find the models of the agents, and wait for the receivers of their commands.
    void FindModels()
    {
        WorldMonitor::Lock lock(m_monitor.mutex);
        SetPresence();
        for (Agent& agent : m_agents)
        {
            agent.had_model = agent.is_present;
        }
        CheckModels();
        WaitForSubscribers(lock);
    }

    // The unique id of the process that offers the world.
    std::string ProcessId() const
    {
        std::vector<transport::ServicePublisher> publishers;
        m_node.ServiceInfo(m_options.ControlService(), publishers);
        return publishers.empty() ? "" : publishers.front().PUuid();
    }

    // Set `is_present` of each agent: always true without a lifetime, otherwise true if the agent has a model now.
    void SetPresence()
    {
        for (Agent& agent : m_agents)
        {
            agent.is_present = !agent.HasLifetime() || m_monitor.present.count(agent.model) > 0;
        }
    }

    // Wait until the plugins of all present models subscribe to commands, and find out whether the world has the fence
    // (see `Acknowledge`). If the option `acknowledge` is `required`, wait for the fence too.
    void WaitForSubscribers(WorldMonitor::Lock& lock)
    {
        const CommandReceiver* missing = nullptr;
        auto all_connected = [&] {
            for (size_t i = 0; i < m_receivers.size(); i++)
            {
                CommandReceiver& receiver = m_receivers[i];
                if (m_agents[i].is_present && !receiver.publisher.HasConnections())
                {
                    missing = &receiver;
                    return false;
                }
            }
            return true;
        };
        m_monitor.Wait(
            lock, [&] { return WorldMonitor::Unlocked(lock, all_connected); },
            [&] {
                return "nothing subscribes to the commands of " + missing->agent + " on " + missing->topic +
                       " (its model needs the plugin DiffDrive or VelocityControl)";
            });
        std::vector<transport::MessagePublisher> publishers;
        auto has_fence = [&] {
            m_node.TopicInfo(m_options.Name(m_options.fence_answer), publishers);
            return !publishers.empty() && m_fence.HasConnections();
        };
        m_usesFence = m_options.acknowledge != "off" && WorldMonitor::Unlocked(lock, has_fence);
        if (m_options.acknowledge == "required")
        {
            m_monitor.Wait(
                lock, [&] { return m_usesFence || (m_usesFence = WorldMonitor::Unlocked(lock, has_fence)); },
                [&] {
                    return "there is no TriggeredPublisher from " + m_options.Name(m_options.fence_topic) + " to " +
                           m_options.Name(m_options.fence_answer);
                });
        }
    }

    // The answer of a service: -1 before it arrives, 0 for a refusal, 1 for success.
    using Answer = std::shared_ptr<int>;

    template <typename Request> Answer Send(const std::string& service, const Request& request)
    {
        auto answer = std::make_shared<int>(-1);
        std::function<void(const msgs::Boolean&, const bool)> on_answer = [this, answer](const msgs::Boolean& value,
                                                                                         const bool is_valid) {
            std::lock_guard<std::mutex> guard(m_monitor.mutex);
            *answer = is_valid && value.data();
            m_monitor.changed.notify_all();
        };
        if (!m_node.Request(service, request, on_answer))
        {
            m_monitor.Fail("the service " + service + " cannot be called");
        }
        return answer;
    }

    void Check(const Answer& answer, const std::string& service) const
    {
        if (*answer == 0)
        {
            m_monitor.Fail("the service " + service + " has refused the request");
        }
    }

    // Send a request that may arrive twice, and wait for its answer. The request is repeated, because the first answer
    // to a new process may be lost: Gazebo Transport does not wait until its connection is complete.
    template <typename Request> void Call(const std::string& service, const Request& request)
    {
        Answer answer = Send(service, request);
        auto repeat_at = Clock::now() + std::chrono::seconds(1);
        WorldMonitor::Lock lock(m_monitor.mutex);
        auto has_answered = [&] {
            if (*answer < 0 && Clock::now() > repeat_at)
            {
                repeat_at = Clock::now() + std::chrono::seconds(1);
                lock.unlock();
                answer = Send(service, request);
                lock.lock();
            }
            return *answer >= 0;
        };
        m_monitor.Wait(lock, has_answered, [&] { return "the service " + service + " has not answered"; });
        Check(answer, service);
    }

    // A request that makes a paused world advance by a number of steps.
    static msgs::WorldControl ControlRequest(uint32_t steps, bool resets = false)
    {
        msgs::WorldControl request;
        request.set_pause(true); // otherwise the world would run freely
        request.set_multi_step(steps);
        if (resets)
        {
            request.mutable_reset()->set_all(true);
        }
        return request;
    }

    // Publish a command to the agent with an index; returns false if that failed.
    bool Publish(size_t agent, const msgs::Twist& twist)
    {
        m_unacknowledged.push_back({agent, twist});
        return m_receivers[agent].publisher.Publish(twist);
    }

    const std::string& CommandTopic(size_t agent) const
    {
        return m_receivers[agent].topic;
    }

    // Wait until Gazebo has received all commands.
    //
    // Requests to a service may overtake messages to a topic. Therefore, a message that follows the commands on the
    // same connection (the fence) is answered by the plugin TriggeredPublisher. Without the plugin, this sends one
    // request more than there are agents. Gazebo's single receiving thread alternates between messages and requests,
    // so it has probably read all commands when it has answered these requests.
    void Acknowledge()
    {
        if (m_usesFence)
        {
            PassFence();
        }
        else if (m_options.acknowledge != "off")
        {
            for (size_t i = 0; i <= m_receivers.size(); i++)
            {
                Call(m_options.ControlService(), ControlRequest(0));
            }
        }
        m_unacknowledged.clear();
    }

  private:
    // Publish the fence, and wait for its answer. Commands and fence are published again after each second, because
    // Gazebo Transport drops the messages of a topic while a new plugin subscribes to it, as after a reset.
    void PassFence()
    {
        WorldMonitor::Lock lock(m_monitor.mutex);
        uint64_t before = m_passed, fences = 0;
        Clock::time_point repeat_at;
        auto has_passed = [&] {
            if (m_passed == before && Clock::now() >= repeat_at)
            {
                repeat_at = Clock::now() + std::chrono::seconds(1);
                lock.unlock();
                for (size_t i = 0; fences > 0 && i < m_unacknowledged.size(); i++)
                {
                    m_receivers[m_unacknowledged[i].agent].publisher.Publish(m_unacknowledged[i].twist);
                }
                m_fence.Publish(msgs::Empty());
                fences++;
                lock.lock();
            }
            return m_passed > before;
        };
        m_monitor.Wait(lock, has_passed, [&] {
            return "commands have not been acknowledged on " + m_options.Name(m_options.fence_answer);
        });
        if (fences > 1) // a late answer to an earlier fence must not acknowledge the next commands
        {
            m_monitor.changed.wait_for(lock, std::chrono::milliseconds(500),
                                       [&] { return m_passed >= before + fences; });
        }
    }

    // A published command.
    struct SentCommand
    {
        size_t agent;
        msgs::Twist twist;
    };

    // The receiver of the commands to an agent.
    struct CommandReceiver
    {
        std::string agent, topic;
        transport::Node::Publisher publisher;
    };

    // Several runs may start at the same time, for example those of `fieldkit cosim shootout`.
    void WaitForOtherRuns()
    {
        WorldLock world_lock(m_options.world);
        // The limit is longer than the timeout for a lack of progress, because other runs may take long.
        auto limit = Clock::now() + std::chrono::duration<double>(50 * m_options.timeout_s);
        while (!world_lock.TryLock())
        {
            if (Clock::now() >= limit)
            {
                m_monitor.Fail("another run on this machine uses it");
            }
            m_monitor.Beat();
            std::this_thread::sleep_for(std::chrono::milliseconds(20));
        }
    }

    void Subscribe()
    {
        std::string clock = m_options.Name(m_options.clock_topic), poses = m_options.Name(m_options.pose_topic);
        std::function<void(const msgs::Clock&)> on_clock = [this](const msgs::Clock& message) {
            m_monitor.Receive(message);
        };
        std::function<void(const msgs::Pose_V&)> on_poses = [this](const msgs::Pose_V& message) {
            m_monitor.Receive(message);
        };
        std::function<void(const msgs::Empty&)> on_passed = [this](const msgs::Empty&) {
            std::lock_guard<std::mutex> guard(m_monitor.mutex);
            m_passed++;
            m_monitor.changed.notify_all();
        };
        if (!m_node.Subscribe(clock, on_clock) || !m_node.Subscribe(poses, on_poses) ||
            !m_node.Subscribe(m_options.Name(m_options.fence_answer), on_passed))
        {
            m_monitor.Fail("a topic has an invalid name: " + clock + ", " + poses);
        }
    }

    void Advertise()
    {
        m_fence = m_node.Advertise<msgs::Empty>(m_options.Name(m_options.fence_topic));
        for (CommandReceiver& receiver : m_receivers)
        {
            receiver.publisher = m_node.Advertise<msgs::Twist>(receiver.topic);
            if (!receiver.publisher)
            {
                m_monitor.Fail("the topic " + receiver.topic + " has an invalid name");
            }
        }
    }

    bool HasService(const std::string& service) const
    {
        std::vector<transport::ServicePublisher> publishers;
        return m_node.ServiceInfo(service, publishers) && !publishers.empty();
    }

    std::string ListWorlds() const
    {
        std::vector<std::string> services;
        m_node.ServiceList(services);
        std::string worlds;
        for (const std::string& service : services)
        {
            // The service of a world is called /world/NAME/control: 7 characters are before the name, and 8 after it.
            if (service.rfind("/world/", 0) == 0 && service.size() > 15 &&
                service.compare(service.size() - 8, 8, "/control") == 0)
            {
                worlds += (worlds.empty() ? "" : ", ") + service.substr(7, service.size() - 15);
            }
        }
        return worlds.empty() ? "no world is visible; check IGN_PARTITION and IGN_IP (GZ_ in newer versions), or the "
                                "options partition and ip"
                              : "visible worlds: " + worlds;
    }

    void CheckModels() const
    {
        std::string missing;
        for (const Agent& agent : m_agents)
        {
            if (!agent.HasLifetime() && !m_monitor.present.count(agent.model))
            {
                missing += (missing.empty() ? "" : ", ") + agent.model;
            }
        }
        if (!missing.empty())
        {
            m_monitor.Fail("it has no moving model " + missing + " (models and links: " + m_monitor.names +
                           "); write the world with `fieldkit cosim sdf`, or set physics.options.models");
        }
    }

    const Options& m_options;
    std::vector<Agent>& m_agents;
    WorldMonitor& m_monitor;
    std::vector<CommandReceiver> m_receivers; // by index of the agent
    std::vector<SentCommand> m_unacknowledged;
    bool m_usesFence = false; // see `Acknowledge`
    uint64_t m_passed = 0;    // number of answers to the fence
    transport::Node::Publisher m_fence;
    transport::Node m_node; // declared last, because its callbacks use the other members
};

} // namespace fieldkit

#endif
