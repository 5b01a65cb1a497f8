// Lock-step with a world of Gazebo: the start of a run, its windows, and the motion of robots.

#ifndef FIELDKIT_GAZEBO_LOCK_STEP_H
#define FIELDKIT_GAZEBO_LOCK_STEP_H

#include "connection.h"
#include "world_models.h"
#include "world_steps.h"

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
          m_models(m_options, m_connection),
          m_steps(m_options, m_agents, m_monitor, m_connection)
    {
    }

    LockStep(const LockStep&) = delete;

    std::vector<Agent>& Agents()
    {
        return m_agents;
    }

    int64_t StepNs() const
    {
        return m_steps.StepNs();
    }

    // Connect, stop the robots, reset the world, and place the robots. Then advance by `settle_s`, in which they come to
    // rest; the end of this interval is time 0.
    void Start()
    {
        m_connection.Open();
        m_steps.Pause();
        m_models.RestoreAfterKilledRun();
        m_steps.MeasureStep();
        m_connection.FindModels();
        m_models.WriteJournal(m_agents);
        int64_t settle_steps = m_steps.StepsOf(m_options.settle_s);
        SendCommands();
        ComeToRest(settle_steps);
        if (m_options.reset)
        {
            m_steps.Reset();
        }
        for (Agent& agent : m_agents)
        {
            // An agent that appears in the first step must exist at the start.
            bool is_present = agent.appears_ns < StepNs();
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
        m_steps.Make(settle_steps);
        m_steps.StartRun();
        CheckStart();
        m_windowPoses = Poses();
        for (Agent& agent : m_agents)
        {
            if (agent.appears_ns >= StepNs())
            {
                // The model is created one step earlier, because the next step publishes its first pose.
                m_changes.push_back({agent.appears_ns / StepNs() - 1, agent, true});
            }
            if (agent.disappears_ns >= 0)
            {
                m_changes.push_back({(agent.disappears_ns + StepNs() - 1) / StepNs(), agent, false});
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
            if (m_agents[i].is_present && !m_connection.Publish(i, TwistOf(m_agents[i], m_options, StepNs())))
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
                m_connection.Publish(i, TwistOf(m_agents[i], m_options, StepNs()));
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
        int64_t step = m_monitor.reached_ns / StepNs();
        if (to_step <= step)
        {
            return;
        }
        int64_t period = m_steps.StepsOf(m_options.control_period_s);
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
            m_steps.Make(next - step);
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
        double elapsed_s = double((step - before_step) * StepNs()) / 1e9;
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

    // Advance in intervals until no robot moves by 0.1 mm or turns by 0.1 mrad in an interval, for at most 20 intervals.
    // Robots may still move because of an earlier run, and setting a position does not stop them.
    void ComeToRest(int64_t steps)
    {
        m_steps.Make(steps);
        for (int round = 0; round < 20; round++)
        {
            std::vector<Pose> before = Poses();
            m_steps.Make(std::max<int64_t>(steps / 4, 1));
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
    WorldSteps m_steps;
    int64_t m_windowEndStep = 0; // step at which the last window has ended
    std::vector<Pose> m_windowPoses;
    std::deque<Change> m_changes;
};

} // namespace fieldkit

#endif
