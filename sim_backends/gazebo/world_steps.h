// The steps of a paused world of Gazebo: their length, and their control. After each step, the agents have its poses.

#ifndef FIELDKIT_GAZEBO_WORLD_STEPS_H
#define FIELDKIT_GAZEBO_WORLD_STEPS_H

#include "connection.h"

namespace fieldkit
{

class WorldSteps
{
  public:
    WorldSteps(const Options& options, std::vector<Agent>& agents, WorldMonitor& monitor, Connection& connection)
        : m_options(options),
          m_agents(agents),
          m_monitor(monitor),
          m_connection(connection)
    {
    }

    // The length of a step; 0 before it was measured.
    int64_t StepNs() const
    {
        return m_stepNs;
    }

    // The number of steps in a time, at least 1.
    int64_t StepsOf(double seconds) const
    {
        return std::max<int64_t>(std::llround(seconds * 1e9 / double(m_stepNs)), 1);
    }

    // Let the run start now: this is its time 0.
    void StartRun()
    {
        m_startNs = m_nowNs;
        m_monitor.reached_ns = 0;
    }

    void Pause()
    {
        m_connection.Call(m_options.ControlService(), Connection::ControlRequest(0));
        WorldMonitor::Lock lock(m_monitor.mutex);
        m_monitor.repeated_clocks = 0;
        m_monitor.Wait(
            lock, [&] { return m_monitor.repeated_clocks >= 3; },
            [] { return std::string("it has not paused, another program may run it"); });
        m_nowNs = m_monitor.clock_ns;
    }

    // Make a step, and measure its length.
    void MeasureStep()
    {
        int64_t before_ns = m_nowNs;
        auto answer = m_connection.Send(m_options.ControlService(), Connection::ControlRequest(1));
        WorldMonitor::Lock lock(m_monitor.mutex);
        m_monitor.Wait(
            lock, [&] { return m_monitor.clock_ns > before_ns; }, [] { return std::string("it has not made a step"); });
        m_stepNs = m_monitor.clock_ns - before_ns;
        WaitForPoses(lock, before_ns + m_stepNs, before_ns, answer);
    }

    // Advance by a number of steps; afterwards the poses are those of the last step.
    void Make(int64_t count)
    {
        while (count > 0)
        {
            uint32_t steps = static_cast<uint32_t>(std::min<int64_t>(count, 1000000));
            {
                WorldMonitor::Lock lock(m_monitor.mutex);
                if (m_monitor.clock_ns != m_nowNs)
                {
                    m_monitor.Fail((m_monitor.clock_ns < m_nowNs ? "it was reset" : "another program has advanced it") +
                                   m_monitor.LastMessage());
                }
            }
            int64_t before_ns = m_nowNs;
            int64_t target_ns = before_ns + steps * m_stepNs;
            SetAwaited(target_ns);
            auto answer = m_connection.Send(m_options.ControlService(), Connection::ControlRequest(steps));
            WorldMonitor::Lock lock(m_monitor.mutex);
            WaitForPoses(lock, target_ns, before_ns, answer);
            m_monitor.awaited_ns = -1;
            count -= steps;
        }
        for (size_t i = 0; i < m_agents.size(); i++)
        {
            m_agents[i].pose = m_monitor.poses[i];
        }
    }

    void Reset()
    {
        m_connection.Call(m_options.ControlService(), Connection::ControlRequest(0, true));
        WorldMonitor::Lock lock(m_monitor.mutex);
        m_monitor.Wait(
            lock, [&] { return m_monitor.clock_ns == 0; },
            [] {
                return std::string("its clock has not returned to 0 after a reset (option reset: false avoids it)");
            });
        m_monitor.Wait(
            lock, [&] { return m_monitor.pose_ns == 0; },
            [] { return std::string("no poses have arrived after a reset"); });
        m_nowNs = 0;
        // Newer versions of Gazebo create the models and plugins again at a reset, so the plugins subscribe again.
        m_connection.SetPresence();
        m_connection.WaitForSubscribers(lock);
    }

  private:
    void SetAwaited(int64_t time_ns)
    {
        WorldMonitor::Lock lock(m_monitor.mutex);
        m_monitor.awaited_ns = time_ns;
    }

    // Gazebo publishes the time of a step before it makes the step, so this waits for poses with that time stamp. It also
    // waits for the time itself: messages of different topics can arrive in any order.
    void WaitForPoses(WorldMonitor::Lock& lock, int64_t target_ns, int64_t before_ns, const Connection::Answer& answer)
    {
        auto have_arrived = [&] {
            m_connection.Check(answer, m_options.ControlService());
            if (m_monitor.clock_ns > target_ns || m_monitor.pose_ns > target_ns)
            {
                m_monitor.Fail("it has advanced beyond Gazebo's time " + Seconds(target_ns) +
                               ", another program may control it" + m_monitor.LastMessage());
            }
            if (m_monitor.clock_ns < before_ns)
            {
                m_monitor.Fail("it was reset" + m_monitor.LastMessage());
            }
            return m_monitor.pose_ns == target_ns && m_monitor.clock_ns == target_ns && NewAgents().empty();
        };
        m_monitor.Wait(lock, have_arrived, [&]() -> std::string {
            if (m_monitor.pose_ns == target_ns && m_monitor.clock_ns == target_ns)
            {
                return "the models of " + NewAgents() + " have not been created by " +
                       m_options.Name(m_options.create_service);
            }
            if (m_monitor.clock_ns == target_ns)
            {
                return "no poses of Gazebo's time " + Seconds(target_ns) + " have arrived on " +
                       m_options.Name(m_options.pose_topic) + " (the last ones are of " + Seconds(m_monitor.pose_ns) +
                       "; is dynamic_pose_hertz too small?)";
            }
            return "it has not reached Gazebo's time " + Seconds(target_ns) + ", another program may have paused it";
        });
        m_nowNs = target_ns;
        if (m_monitor.reached_ns >= 0)
        {
            m_monitor.reached_ns = m_nowNs - m_startNs;
        }
        for (Agent& agent : m_agents)
        {
            agent.is_new = false;
            if (agent.is_present && !m_monitor.present.count(agent.model))
            {
                m_monitor.Fail("the model " + agent.model + " has been removed");
            }
        }
    }

    // The names, for messages, of the agents whose models have been requested but have not published a pose.
    std::string NewAgents() const
    {
        std::string names;
        for (const Agent& agent : m_agents)
        {
            if (agent.is_new && !m_monitor.present.count(agent.model))
            {
                names += (names.empty() ? "" : ", ") + agent.name;
            }
        }
        return names;
    }

    const Options& m_options;
    std::vector<Agent>& m_agents;
    WorldMonitor& m_monitor;
    Connection& m_connection;
    int64_t m_stepNs = 0;
    int64_t m_nowNs = -1; // Gazebo's time
    int64_t m_startNs = 0;
};

} // namespace fieldkit

#endif
