// A lock for a world of Gazebo, so that runs on this machine use the world in sequence.

#ifndef FIELDKIT_GAZEBO_WORLD_LOCK_H
#define FIELDKIT_GAZEBO_WORLD_LOCK_H

#include "fieldkit/bytes.h"

#include <cerrno>
#include <cstdlib>
#include <functional>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

namespace fieldkit
{

// The lock is the name of an abstract socket: only one process can bind it, and it is free when that process exits.
class WorldLock
{
  public:
    explicit WorldLock(const std::string& world)
        : m_world(world)
    {
        const char* partition = std::getenv("IGN_PARTITION");
        size_t key = std::hash<std::string>()(world + "\n" + (partition ? partition : ""));
        std::string name = "fieldkit-gazebo-" + std::to_string(getuid()) + "-" + std::to_string(key);
        m_address.sun_family = AF_UNIX;
        name.copy(m_address.sun_path + 1, sizeof m_address.sun_path - 1); // abstract: the first byte is 0
    }

    // Acquire the lock until the process exits; returns false if another process has it.
    bool TryLock()
    {
        if (m_socket < 0)
        {
            m_socket = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
        }
        if (m_socket >= 0 && bind(m_socket, reinterpret_cast<sockaddr*>(&m_address), sizeof m_address) == 0)
        {
            return true;
        }
        if (m_socket < 0 || errno != EADDRINUSE)
        {
            throw protocol::Refusal("the lock of Gazebo world '" + m_world +
                                    "' cannot be acquired: " + std::strerror(errno));
        }
        return false;
    }

  private:
    std::string m_world;
    sockaddr_un m_address = {};
    int m_socket = -1;
};

} // namespace fieldkit

#endif
