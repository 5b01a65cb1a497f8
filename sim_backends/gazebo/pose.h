// Poses of models: positions and rotations.

#ifndef FIELDKIT_GAZEBO_POSE_H
#define FIELDKIT_GAZEBO_POSE_H

#include <cmath>

namespace fieldkit
{

struct Vector
{
    double x = 0, y = 0, z = 0;

    Vector operator+(const Vector& other) const
    {
        return {x + other.x, y + other.y, z + other.z};
    }
    Vector operator-(const Vector& other) const
    {
        return {x - other.x, y - other.y, z - other.z};
    }
};

struct Pose
{
    Vector position;
    double w = 1, x = 0, y = 0, z = 0; // rotation as a unit quaternion

    static Pose WithYaw(double yaw)
    {
        return {{}, std::cos(yaw / 2), 0, 0, std::sin(yaw / 2)};
    }

    // Convert a vector from the axes of the model to the axes of the world: v + 2 w (q x v) + 2 q x (q x v).
    Vector Rotated(const Vector& v) const
    {
        double a = 2 * (y * v.z - z * v.y), b = 2 * (z * v.x - x * v.z), c = 2 * (x * v.y - y * v.x);
        return {v.x + w * a + y * c - z * b, v.y + w * b + z * a - x * c, v.z + w * c + x * b - y * a};
    }

    // Convert a vector from the axes of the world to the axes of the model.
    Vector InverseRotated(const Vector& v) const
    {
        return Pose{{}, w, -x, -y, -z}.Rotated(v);
    }

    double Yaw() const
    {
        return std::atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
    }
};

} // namespace fieldkit

#endif
