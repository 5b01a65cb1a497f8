// Gazebo's libraries for messages and transport: Ignition Transport 11, or Gazebo Transport 12 and later.

#ifndef FIELDKIT_GAZEBO_LIBRARIES_H
#define FIELDKIT_GAZEBO_LIBRARIES_H

#if !defined(FIELDKIT_GZ) && !__has_include(<ignition/transport/Node.hh>)
#define FIELDKIT_GZ
#endif
#ifdef FIELDKIT_GZ
#include <gz/msgs/boolean.pb.h>
#include <gz/msgs/clock.pb.h>
#include <gz/msgs/empty.pb.h>
#include <gz/msgs/entity.pb.h>
#include <gz/msgs/entity_factory.pb.h>
#include <gz/msgs/pose.pb.h>
#include <gz/msgs/pose_v.pb.h>
#include <gz/msgs/twist.pb.h>
#include <gz/msgs/world_control.pb.h>
#include <gz/transport/Node.hh>
#include <gz/transport/config.hh>
#define FIELDKIT_GAZEBO_SOFTWARE "Gazebo Transport " GZ_TRANSPORT_VERSION_FULL
#define FIELDKIT_GAZEBO_PLUGINS "garden"

namespace fieldkit
{
namespace msgs = gz::msgs;
namespace transport = gz::transport;
} // namespace fieldkit
#else
#include <ignition/msgs/boolean.pb.h>
#include <ignition/msgs/clock.pb.h>
#include <ignition/msgs/empty.pb.h>
#include <ignition/msgs/entity.pb.h>
#include <ignition/msgs/entity_factory.pb.h>
#include <ignition/msgs/pose.pb.h>
#include <ignition/msgs/pose_v.pb.h>
#include <ignition/msgs/twist.pb.h>
#include <ignition/msgs/world_control.pb.h>
#include <ignition/transport/Node.hh>
#include <ignition/transport/config.hh>
#define FIELDKIT_GAZEBO_SOFTWARE "Ignition Transport " IGNITION_TRANSPORT_VERSION_FULL
#define FIELDKIT_GAZEBO_PLUGINS "fortress"

namespace fieldkit
{
namespace msgs = ignition::msgs;
namespace transport = ignition::transport;
} // namespace fieldkit
#endif

#endif
