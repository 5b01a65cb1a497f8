// Obstacles of a world file, and the losses of radio paths through them, computed as in sim_backends/world/.

#ifndef FIELDKIT_OBSTACLES_H
#define FIELDKIT_OBSTACLES_H

#include <algorithm>
#include <array>
#include <cmath>
#include <complex>
#include <cstdlib>
#include <map>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <vector>

namespace fieldkit
{

using Json = nlohmann::json;
using Point = std::array<double, 3>; // metres east, north, up

constexpr double kSpeedOfLight = 299792458.0;
constexpr double kFrequencyHz = 2.437e9; // channel 6

// A number, or a text with a number in m or s, such as "0.2m" or "0.5s". The unit itself is not evaluated.
inline double
Number(const Json& value)
{
    return value.is_string() ? std::strtod(value.get<std::string>().c_str(), nullptr) : value.get<double>();
}

// A homogeneous material: ITU-R P.2040-1, table 3. Permittivity is a f^b, conductivity c f^d, f in GHz.
struct Solid
{
    double a, b, c, d;

    std::complex<double> Permittivity() const
    {
        double ghz = kFrequencyHz / 1e9;
        return {a * std::pow(ghz, b), -17.98 * c * std::pow(ghz, d) / ghz};
    }

    double LossDbPerMetre() const
    {
        return -20 / std::log(10) * 2 * M_PI * kFrequencyHz / kSpeedOfLight * std::sqrt(Permittivity()).imag();
    }

    double FaceLossDb() const
    {
        auto root = std::sqrt(Permittivity());
        return -10 * std::log10(1 - std::norm((1.0 - root) / (1.0 + root)));
    }
};

inline const Solid kGround = {15.0, -0.1, 0.035, 1.63};
inline const std::map<std::string, Solid> kSolids = {
    {"concrete", {5.31, 0.0, 0.0326, 0.8095}}, {"brick", {3.75, 0.0, 0.038, 0.0}},
    {"plasterboard", {2.94, 0.0, 0.0116, 0.7076}}, {"wood", {1.99, 0.0, 0.0047, 1.0718}},
    {"glass", {6.27, 0.0, 0.0043, 1.1925}}, {"chipboard", {2.58, 0.0, 0.0217, 0.7800}},
    {"metal", {1.0, 0.0, 1e7, 0.0}}, {"ground", kGround},
};

// Weissberger's modified exponential decay, for trees in leaf.
inline double
FoliageLossDb(double depth_m)
{
    double scale = std::pow(kFrequencyHz / 1e9, 0.284);
    return scale * (depth_m < 14 ? 0.45 * depth_m : 1.33 * std::pow(depth_m, 0.588));
}

// The obstacles of a world.
class Obstacles
{
  public:
    explicit Obstacles(const Json& world)
    {
        for (const auto& obstacle : world.at("obstacles"))
        {
            Add(obstacle);
        }
    }

    // The loss of a straight path in dB.
    double LossDb(const Point& start, const Point& end) const
    {
        double length_m = std::hypot(end[0] - start[0], end[1] - start[1], end[2] - start[2]);
        double loss_db = 0;
        double foliage_m = 0;
        for (const auto& part : m_parts)
        {
            double depth_m = part.ShareInside(start, end) * length_m;
            if (depth_m > 0 && part.is_foliage)
            {
                foliage_m += depth_m;
            }
            else if (depth_m > 0)
            {
                loss_db += depth_m * part.db_per_m + part.faces_db;
            }
        }
        return loss_db + FoliageLossDb(foliage_m);
    }

  private:
    // An upright box or cylinder.
    struct Part
    {
        Point centre;
        Point half; // half sizes: of a box along its axes; of a cylinder: radius, radius, half its height
        double cos = 1;
        double sin = 0;
        bool is_cylinder = false;
        bool is_foliage = false;
        double db_per_m = 0;
        double faces_db = 0;

        // The share of a straight path that is inside.
        double ShareInside(const Point& start, const Point& end) const
        {
            Point from = Local(start);
            Point to = Local(end);
            double entry = 0;
            double exit = 1;
            LimitToSlab(from[2], to[2], half[2], entry, exit);
            if (is_cylinder)
            {
                LimitToDisc(from, to, entry, exit);
            }
            else
            {
                LimitToSlab(from[0], to[0], half[0], entry, exit);
                LimitToSlab(from[1], to[1], half[1], entry, exit);
            }
            return std::max(exit - entry, 0.0);
        }

        // A point in the coordinates of the part.
        Point Local(const Point& point) const
        {
            double east = point[0] - centre[0];
            double north = point[1] - centre[1];
            return {east * cos + north * sin, north * cos - east * sin, point[2] - centre[2]};
        }

        // Reduce the shares [entry, exit] of the path to those between the planes at -half and half on one axis.
        static void LimitToSlab(double start, double end, double half, double& entry, double& exit)
        {
            double step = end - start;
            if (step == 0)
            {
                exit = std::abs(start) < half ? exit : 0;
                return;
            }
            double first = (-half - start) / step;
            double second = (half - start) / step;
            entry = std::max(entry, std::clamp(std::min(first, second), 0.0, 1.0));
            exit = std::min(exit, std::clamp(std::max(first, second), 0.0, 1.0));
        }

        // Reduce the shares [entry, exit] of the path to those within the radius of the cylinder.
        void LimitToDisc(const Point& start, const Point& end, double& entry, double& exit) const
        {
            double x = end[0] - start[0];
            double y = end[1] - start[1];
            double a = x * x + y * y;
            double half_b = start[0] * x + start[1] * y;
            double c = start[0] * start[0] + start[1] * start[1] - half[0] * half[0];
            double root = half_b * half_b - a * c;
            if (a == 0 || root <= 0)
            {
                exit = a == 0 && c < 0 ? exit : 0;
                return;
            }
            entry = std::max(entry, std::clamp((-half_b - std::sqrt(root)) / a, 0.0, 1.0));
            exit = std::min(exit, std::clamp((-half_b + std::sqrt(root)) / a, 0.0, 1.0));
        }
    };

    void AddPart(const std::string& material, const Point& centre, const Point& size, double yaw, bool cylinder = false)
    {
        Part part;
        part.centre = centre;
        part.half = {size[0] / 2, size[1] / 2, size[2] / 2};
        part.cos = std::cos(yaw);
        part.sin = std::sin(yaw);
        part.is_cylinder = cylinder;
        part.is_foliage = material == "foliage";
        if (!part.is_foliage)
        {
            const Solid& solid = kSolids.at(material);
            part.db_per_m = solid.LossDbPerMetre();
            part.faces_db = 2 * solid.FaceLossDb();
        }
        m_parts.push_back(part);
    }

    void Add(const Json& obstacle)
    {
        std::string kind = obstacle.at("kind");
        if (kind == "wall")
        {
            double east = Number(obstacle.at("to_m")[0]) - Number(obstacle.at("from_m")[0]);
            double north = Number(obstacle.at("to_m")[1]) - Number(obstacle.at("from_m")[1]);
            double height = Number(obstacle.at("height"));
            Point centre = {Number(obstacle.at("from_m")[0]) + east / 2, Number(obstacle.at("from_m")[1]) + north / 2,
                            height / 2};
            AddPart(obstacle.at("material"), centre,
                    {std::hypot(east, north), Number(obstacle.at("thickness")), height}, std::atan2(north, east));
        }
        else if (kind == "tree")
        {
            double base = Number(obstacle.at("crown_base"));
            double crown = Number(obstacle.at("height")) - base;
            double crown_size = 2 * Number(obstacle.at("crown_radius"));
            double trunk_size = 2 * Number(obstacle.at("trunk_radius"));
            double east = Number(obstacle.at("at_m")[0]);
            double north = Number(obstacle.at("at_m")[1]);
            AddPart("foliage", {east, north, base + crown / 2}, {crown_size, crown_size, crown}, 0, true);
            AddPart("wood", {east, north, base / 2}, {trunk_size, trunk_size, base}, 0, true);
        }
        else
        {
            AddRectangular(kind, obstacle);
        }
    }

    void AddRectangular(const std::string& kind, const Json& obstacle)
    {
        Point size = {Number(obstacle.at("size_m")[0]), Number(obstacle.at("size_m")[1]),
                      Number(obstacle.at("size_m")[2])};
        double yaw = Number(obstacle.at("yaw_deg")) * M_PI / 180;
        auto box = [&](const std::string& material, Point edges, double along, double across, double base) {
            Point centre = {Number(obstacle.at("centre_m")[0]) + along * std::cos(yaw) - across * std::sin(yaw),
                            Number(obstacle.at("centre_m")[1]) + along * std::sin(yaw) + across * std::cos(yaw),
                            base + edges[2] / 2};
            AddPart(material, centre, edges, yaw);
        };
        if (kind == "box")
        {
            box(obstacle.at("material"), size, 0, 0, Number(obstacle.at("base")));
        }
        else if (kind == "raised")
        {
            box("ground", size, 0, 0, 0);
        }
        else if (kind == "ramp")
        {
            const int steps = 8; // a ramp is approximated by this number of boxes
            for (int step = 0; step < steps; step++)
            {
                double share = (step + 0.5) / steps;
                box("ground", {size[0] / steps, size[1], share * size[2]}, (share - 0.5) * size[0], 0, 0);
            }
        }
        else if (kind == "building")
        {
            // Four walls, and a roof of the same thickness on them.
            double thick = Number(obstacle.at("thickness"));
            double under = size[2] - thick;
            std::string material = obstacle.at("material");
            for (int side : {1, -1})
            {
                box(material, {size[0], thick, under}, 0, side * (size[1] - thick) / 2, 0);
                box(material, {thick, size[1] - 2 * thick, under}, side * (size[0] - thick) / 2, 0, 0);
            }
            box(material, {size[0], size[1], thick}, 0, 0, under);
        }
        else
        {
            throw std::runtime_error("the world has an unknown kind of obstacle: " + kind);
        }
    }

    std::vector<Part> m_parts;
};

} // namespace fieldkit

#endif
