// Receives the clock and the poses of models that a world of Gazebo publishes, and waits for them.

#ifndef FIELDKIT_GAZEBO_WORLD_MONITOR_H
#define FIELDKIT_GAZEBO_WORLD_MONITOR_H

#include "agents.h"
#include "fieldkit/serving.h"

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <set>

namespace fieldkit
{

using Clock = std::chrono::steady_clock;

// A time in seconds, without zeros at its end.
inline std::string
Seconds(int64_t time_ns)
{
    char text[40];
    std::snprintf(text, sizeof text, "%.9f", static_cast<double>(time_ns) / 1e9);
    std::string digits(text);
    digits.erase(digits.find_last_not_of('0') + 1);
    if (digits.back() == '.')
    {
        digits.pop_back();
    }
    return digits + " s";
}

class WorldMonitor
{
  public:
    using Lock = std::unique_lock<std::mutex>;

    WorldMonitor(const Options& options, const std::vector<Agent>& agents, protocol::Heartbeat& heartbeat)
        : poses(agents.size()),
          m_options(options),
          m_heartbeat(heartbeat)
    {
        for (size_t i = 0; i < agents.size(); i++)
        {
            m_indices[agents[i].model] = i;
        }
    }

    // Returns true if the world still exists; called without the lock. Empty before the connection.
    std::function<bool()> is_available;

    int64_t reached_ns = -1; // time that the run has reached; -1 before its start

    // Members that callbacks of Gazebo Transport change; access them with the lock only.
    std::mutex mutex;
    std::condition_variable changed;
    int64_t clock_ns = -1, pose_ns = -1;
    // Time of the awaited poses: messages with an earlier time do not notify `changed`. -1: all messages notify it.
    int64_t awaited_ns = -1;
    int repeated_clocks = 0; // number of consecutive messages with the same time, as a paused world sends them
    std::vector<Pose> poses;
    std::set<std::string> present; // models that have a pose
    std::string names;             // names of models and links, for messages

    void Receive(const msgs::Clock& message)
    {
        std::lock_guard<std::mutex> guard(mutex);
        int64_t time_ns = message.sim().sec() * 1000000000LL + message.sim().nsec();
        repeated_clocks = time_ns == clock_ns ? repeated_clocks + 1 : 0;
        m_clockAt = Clock::now();
        if (time_ns == clock_ns && repeated_clocks > 3)
        {
            return; // a paused world repeats its clock
        }
        // The awaited time notifies only if its poses have arrived before it.
        bool is_expected = clock_ns <= time_ns && (pose_ns < awaited_ns ? time_ns <= awaited_ns : time_ns < awaited_ns);
        clock_ns = time_ns;
        if (!is_expected)
        {
            changed.notify_all();
        }
    }

    void Receive(const msgs::Pose_V& message)
    {
        std::lock_guard<std::mutex> guard(mutex);
        const auto& stamp = message.header().stamp();
        int64_t time_ns = stamp.sec() * 1000000000LL + stamp.nsec();
        if (time_ns == pose_ns && message.pose_size() == m_poseCount)
        {
            return; // a paused world repeats its poses
        }
        pose_ns = time_ns;
        m_poseCount = message.pose_size();
        present.clear();
        names.clear();
        for (const msgs::Pose& pose : message.pose())
        {
            if (names.size() < 200)
            {
                names += (names.empty() ? "" : ", ") + pose.name();
            }
            auto model = m_indices.find(pose.name());
            if (model == m_indices.end() || !present.insert(pose.name()).second)
            {
                continue; // a link may have the name of a model; models come first
            }
            const auto& p = pose.position();
            const auto& q = pose.orientation();
            poses[model->second] = Pose{{p.x(), p.y(), p.z()}, q.w(), q.x(), q.y(), q.z()};
        }
        if (pose_ns >= awaited_ns)
        {
            changed.notify_all();
        }
    }

    // Throw a refusal with the world's name and its last time; the coordinator adds the request.
    [[noreturn]] void Fail(const std::string& what) const
    {
        std::string last = reached_ns >= 0 ? ", whose last time is " + Seconds(reached_ns) : ", which has not started";
        throw Refusal("Gazebo world '" + m_options.world + "'" + last + ": " + what);
    }

    // Wait, with the lock, until a condition is true. Progress of the clock extends the deadline. `what` returns the
    // text of the error for a timeout.
    template <typename Condition> void Wait(Lock& lock, Condition is_true, const std::function<std::string()>& what)
    {
        auto timeout = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(m_options.timeout_s));
        auto limit = Clock::now() + timeout, check = Clock::now() + std::chrono::milliseconds(500);
        int64_t progress_ns = clock_ns;
        while (!is_true())
        {
            auto now = Clock::now();
            if (clock_ns != progress_ns)
            {
                progress_ns = clock_ns;
                limit = now + timeout;
            }
            if (now >= limit)
            {
                Fail(what() + " within " + Seconds(int64_t(m_options.timeout_s * 1e9)) + LastMessage());
            }
            if (now >= m_heartbeat.Due())
            {
                lock.unlock();
                Beat();
                lock.lock();
                continue;
            }
            if (now >= check)
            {
                check = now + std::chrono::milliseconds(500);
                if (is_available && !Unlocked(lock, is_available))
                {
                    Fail("it has disappeared, or is suspended" + LastMessage());
                }
                continue;
            }
            changed.wait_until(lock, std::min({limit, m_heartbeat.Due(), check, now + std::chrono::milliseconds(100)}));
        }
    }

    // Evaluate without the lock, because Gazebo Transport holds its own lock during callbacks.
    template <typename Function> static bool Unlocked(Lock& lock, Function function)
    {
        lock.unlock();
        bool result = function();
        lock.lock();
        return result;
    }

    // Report to the coordinator, if necessary, that the request is still running.
    void Beat()
    {
        m_heartbeat.SendIfDue(std::max<int64_t>(reached_ns, 0));
    }

    // The end of an error message, with the last message of Gazebo's clock.
    std::string LastMessage() const
    {
        if (clock_ns < 0)
        {
            return "; no message of its clock has arrived on " + m_options.Name(m_options.clock_topic);
        }
        double silent_s = std::chrono::duration<double>(Clock::now() - m_clockAt).count();
        char text[120];
        std::snprintf(text, sizeof text, "; Gazebo's clock is at %s, received %.1f s ago", Seconds(clock_ns).c_str(),
                      silent_s);
        return text;
    }

  private:
    const Options& m_options;
    protocol::Heartbeat& m_heartbeat;
    std::map<std::string, size_t> m_indices; // of agents, by model
    Clock::time_point m_clockAt;
    int m_poseCount = 0; // in the last message
};

} // namespace fieldkit

#endif
