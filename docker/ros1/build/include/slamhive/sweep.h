// The points of a LiDAR sweep with ring and time, whatever the driver calls them and in whatever unit.
// The runtime sets the parameters below /slamhive/sweep from dataset.yaml (slamhive.runtime.ros1.system).
#pragma once

#include <cmath>
#include <cstring>
#include <string>
#include <vector>

#include <ros/ros.h>
#include <sensor_msgs/PointCloud2.h>

namespace slamhive {

struct SweepPoint {
    float x = 0, y = 0, z = 0, intensity = 0;
    int ring = -1;        // -1 if the points have no ring
    double time_s = -1;   // since the start of the sweep; -1 if the points have no time
};

// How the points of this run state ring and time; the keys are those of dataset.yaml.
struct SweepLayout {
    std::string ring_field, time_field;
    double time_unit_s = 1, time_zero_s = 0, duration_s = 0.1, stamp_fraction = 0;
    bool absolute = false, clockwise = true;

    static const SweepLayout &get() {
        static const SweepLayout layout;
        return layout;
    }

    // When the sweep began, for a message with this timestamp.
    double start(const ros::Time &stamp) const { return stamp.toSec() - stamp_fraction * duration_s; }

    // Whether azimuths, atan2(y, x), grow with time: 1 counter-clockwise seen from above, -1 clockwise.
    float direction() const { return clockwise ? -1.0f : 1.0f; }

private:
    SweepLayout() {
        ros::NodeHandle node("/slamhive/sweep");
        node.param<std::string>("ring_field", ring_field, "");
        node.param<std::string>("time_field", time_field, "");
        node.param("time_unit_s", time_unit_s, 1.0);
        node.param("time_zero_s", time_zero_s, 0.0);
        node.param("absolute", absolute, false);
        node.param("duration_s", duration_s, 0.1);
        node.param("stamp_fraction", stamp_fraction, 0.0);
        node.param("clockwise", clockwise, true);
    }
};

namespace detail {

template <typename T> double valueAt(const uint8_t *bytes) {
    T value;
    std::memcpy(&value, bytes, sizeof value);
    return static_cast<double>(value);
}

inline double valueOf(const uint8_t *point, const sensor_msgs::PointField &field) {
    const uint8_t *bytes = point + field.offset;
    switch (field.datatype) {
    case sensor_msgs::PointField::INT8: return valueAt<int8_t>(bytes);
    case sensor_msgs::PointField::UINT8: return valueAt<uint8_t>(bytes);
    case sensor_msgs::PointField::INT16: return valueAt<int16_t>(bytes);
    case sensor_msgs::PointField::UINT16: return valueAt<uint16_t>(bytes);
    case sensor_msgs::PointField::INT32: return valueAt<int32_t>(bytes);
    case sensor_msgs::PointField::UINT32: return valueAt<uint32_t>(bytes);
    case sensor_msgs::PointField::FLOAT32: return valueAt<float>(bytes);
    default: return valueAt<double>(bytes);
    }
}

inline const sensor_msgs::PointField *find(const sensor_msgs::PointCloud2 &message, const std::string &name) {
    for (const auto &field : message.fields)
        if (!name.empty() && field.name == name) return &field;
    return nullptr;
}

}  // namespace detail

// The finite points of a message that are at least minimum_range (m) away, in the order of the message.
inline std::vector<SweepPoint> readSweep(const sensor_msgs::PointCloud2 &message, double minimum_range = 0) {
    const SweepLayout &layout = SweepLayout::get();
    const auto *x = detail::find(message, "x"), *y = detail::find(message, "y"), *z = detail::find(message, "z");
    const auto *intensity = detail::find(message, "intensity");
    const auto *ring = detail::find(message, layout.ring_field), *time = detail::find(message, layout.time_field);
    // Times of points count from the start of the sweep, or from what time_zero_s and absolute say.
    const double shift = layout.absolute ? -layout.start(message.header.stamp) : layout.time_zero_s;
    std::vector<SweepPoint> points;
    if (!x || !y || !z) return points;
    points.reserve(static_cast<size_t>(message.width) * message.height);
    for (uint32_t row = 0; row < message.height; ++row)
        for (uint32_t column = 0; column < message.width; ++column) {
            const uint8_t *bytes = message.data.data() + row * message.row_step + column * message.point_step;
            SweepPoint point;
            point.x = detail::valueOf(bytes, *x);
            point.y = detail::valueOf(bytes, *y);
            point.z = detail::valueOf(bytes, *z);
            const double range = std::sqrt(double(point.x) * point.x + double(point.y) * point.y + double(point.z) * point.z);
            if (!std::isfinite(range) || range < minimum_range) continue;
            if (intensity) point.intensity = detail::valueOf(bytes, *intensity);
            if (ring) point.ring = static_cast<int>(detail::valueOf(bytes, *ring));
            if (time) point.time_s = std::max(0.0, detail::valueOf(bytes, *time) * layout.time_unit_s + shift);
            points.push_back(point);
        }
    return points;
}

}  // namespace slamhive
