// Lock-step with a world of Gazebo: the start of a run, steps, and the motion of robots.

#ifndef FIELDKIT_GAZEBO_LOCK_STEP_H
#define FIELDKIT_GAZEBO_LOCK_STEP_H

#include "connection.h"
#include "world_models.h"

#include <deque>

namespace fieldkit
{

class LockStep
{
  public:
    LockStep(Options options, std::vector<Agent> agents, protocol::Heartbeat& heartbeat)
        : m_options(std::move(options)),
          m_agents(std::move(agents)),
          m_monitor(m_options, m_agents, heartbeat),
          m_connection(m_options, m_agents, m_monitor),
          m_models(m_options, m_connection)
    {
    }

    LockStep(const LockStep&) = delete;

    std::vector<Agent>& Agents()
    {
        return m_agents;
    }

    int64_t StepNs() const
    {
        return m_stepNs;
    }

    // Connect, stop the robots, reset the world, and place the robots. Then advance by `settle_s`, in which they come to
    // rest; the end of this interval is time 0.
    void Start()
    {
        m_connection.Open();
        Pause();
        m_models.RestoreAfterKilledRun();
        MeasureStep();
        m_connection.FindModels();
        m_models.WriteJournal(m_agents);
        int64_t settle_steps = StepsOf(m_options.settle_s);
        SendCommands();
        ComeToRest(settle_steps);
        if (m_options.reset)
        {
            Reset();
        }
        for (Agent& agent : m_agents)
        {
            // An agent that appears in the first step must exist at the start.
            bool is_present = agent.appears_ns < m_stepNs;
            if (is_present != agent.is_present)
            {
                is_present ? Create(agent) : Remove(agent);
            }
            if (agent.is_present && m_options.place)
            {
                m_models.Place(agent);
            }
        }
        SendCommands();
        Step(settle_steps);
        m_startNs = m_nowNs;
        m_monitor.reached_ns = 0;
        CheckStart();
        m_windowPoses = Poses();
        for (Agent& agent : m_agents)
        {
            if (agent.appears_ns >= m_stepNs)
            {
                // The model is created one step earlier, because the next step publishes its first pose.
                m_changes.push_back({agent.appears_ns / m_stepNs - 1, agent, true});
            }
            if (agent.disappears_ns >= 0)
            {
                m_changes.push_back({(agent.disappears_ns + m_stepNs - 1) / m_stepNs, agent, false});
            }
        }
        std::stable_sort(m_changes.begin(), m_changes.end(),
                         [](const Change& first, const Change& second) { return first.step < second.step; });
    }

    // Advance to a number of steps after the start.
    void Advance(int64_t to_step)
    {
        // A model that is created after step n has a pose at step n + 1, so it is created only if that step is made.
        while (!m_changes.empty() && m_changes.front().step + (m_changes.front().appears ? 1 : 0) <= to_step)
        {
            Change change = m_changes.front();
            m_changes.pop_front();
            AdvanceSteps(change.step);
            change.appears ? Create(change.agent) : Remove(change.agent);
        }
        AdvanceSteps(to_step);
    }

    // Publish the command of each agent, and wait until Gazebo has received all commands.
    void SendCommands()
    {
        for (size_t i = 0; i < m_agents.size(); i++)
        {
            if (m_agents[i].is_present && !m_connection.Publish(i, TwistOf(m_agents[i], m_options, m_stepNs)))
            {
                m_monitor.Fail("a command to " + m_agents[i].name + " cannot be published on " +
                               m_connection.CommandTopic(i));
            }
        }
        m_connection.Acknowledge();
    }

    // Stop all robots, without waiting, and restore the models; the world stays paused.
    void End()
    {
        for (size_t i = 0; i < m_agents.size(); i++)
        {
            m_agents[i].Stop();
            if (m_agents[i].is_present)
            {
                m_connection.Publish(i, TwistOf(m_agents[i], m_options, m_stepNs));
            }
        }
        m_models.Restore(m_agents);
    }

  private:
    // The step after which the model of an agent is created or removed.
    struct Change
    {
        int64_t step;
        std::reference_wrapper<Agent> agent;
        bool appears;
    };

    void AdvanceSteps(int64_t to_step)
    {
        int64_t step = m_monitor.reached_ns / m_stepNs;
        if (to_step <= step)
        {
            return;
        }
        int64_t period = StepsOf(m_options.control_period_s);
        std::vector<Pose> before = Poses();
        int64_t before_step = step;
        while (step < to_step)
        {
            int64_t next = to_step;
            bool is_turning =
                std::any_of(m_agents.begin(), m_agents.end(), [](const Agent& agent) { return agent.Turns(); });
            if (is_turning) // the command depends on the heading, so it is sent again after each control period
            {
                next = std::min(next, (step / period + 1) * period);
            }
            if (m_options.velocity == "step" && next == to_step && next - step > 1)
            {
                next--; // the last step is made separately, because the velocity is the motion in this step
            }
            before = Poses();
            before_step = step;
            Step(next - step);
            step = next;
            if (is_turning && step % period == 0)
            {
                SendCommands(); // also when an agent has reached its direction, to stop its rotation
            }
        }
        if (m_options.velocity == "window")
        {
            before = m_windowPoses;
            before_step = m_windowEndStep;
        }
        double elapsed_s = double((step - before_step) * m_stepNs) / 1e9;
        for (size_t i = 0; i < m_agents.size(); i++)
        {
            Agent& agent = m_agents[i];
            Vector motion = agent.AntennaAt(agent.pose) - agent.AntennaAt(before[i]);
            agent.velocity = {motion.x / elapsed_s, motion.y / elapsed_s, motion.z / elapsed_s};
        }
        m_windowPoses = Poses();
        m_windowEndStep = step;
    }

    void Create(Agent& agent)
    {
        m_models.Create(agent);
        agent.is_present = agent.is_new = true;
        size_t number = static_cast<size_t>(&agent - m_agents.data());
        agent.pose = agent.Start();
        if (!m_windowPoses.empty())
        {
            m_windowPoses[number] = agent.pose;
        }
        {
            WorldMonitor::Lock lock(m_monitor.mutex);
            m_connection.WaitForSubscribers(lock);
        }
        SendCommands();
    }

    void Remove(Agent& agent)
    {
        m_models.Remove(agent.model);
        agent.is_present = agent.is_new = false;
        agent.Stop();
    }

    int64_t StepsOf(double seconds) const
    {
        return std::max<int64_t>(std::llround(seconds * 1e9 / double(m_stepNs)), 1);
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
    void Step(int64_t count)
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

    // Advance in intervals until no robot moves by 0.1 mm or turns by 0.1 mrad in an interval, for at most 20 intervals.
    // Robots may still move because of an earlier run, and setting a position does not stop them.
    void ComeToRest(int64_t steps)
    {
        Step(steps);
        for (int round = 0; round < 20; round++)
        {
            std::vector<Pose> before = Poses();
            Step(std::max<int64_t>(steps / 4, 1));
            double largest = 0;
            for (size_t i = 0; i < m_agents.size(); i++)
            {
                Vector motion = m_agents[i].pose.position - before[i].position;
                double turn = std::remainder(m_agents[i].pose.Yaw() - before[i].Yaw(), 2 * M_PI);
                largest = std::max(
                    {largest, std::fabs(motion.x), std::fabs(motion.y), std::fabs(motion.z), std::fabs(turn)});
            }
            if (largest < 1e-4)
            {
                return;
            }
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

    void CheckStart() const
    {
        for (const Agent& agent : m_agents)
        {
            Vector error = agent.pose.position - agent.start;
            double distance_m = std::sqrt(error.x * error.x + error.y * error.y + error.z * error.z);
            if (agent.is_present && !(distance_m <= m_options.start_error_m))
            {
                m_monitor.Fail(
                    "the model " + agent.model + " is " + std::to_string(distance_m) + " m away from the start of " +
                    agent.name +
                    "; write the world with `fieldkit cosim sdf`, or set physics.options.place or origins_m");
            }
        }
    }

    std::vector<Pose> Poses() const
    {
        std::vector<Pose> poses;
        for (const Agent& agent : m_agents)
        {
            poses.push_back(agent.pose);
        }
        return poses;
    }

    Options m_options;
    std::vector<Agent> m_agents;
    WorldMonitor m_monitor;
    Connection m_connection;
    WorldModels m_models;
    int64_t m_stepNs = 0;
    int64_t m_nowNs = -1; // Gazebo's time
    int64_t m_startNs = 0;
    int64_t m_windowEndStep = 0; // step at which the last window has ended
    std::vector<Pose> m_windowPoses;
    std::deque<Change> m_changes;
};

} // namespace fieldkit

#endif
