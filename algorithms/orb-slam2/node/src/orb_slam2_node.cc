// ORB-SLAM2 as one ROS node for its three modes, without a viewer. It takes the place of upstream's ROS examples,
// which keep one image at most, publish nothing, and draw windows.
//
// Private parameters: mode (mono, stereo, rgbd), vocabulary, settings, output (a folder), queue_size (messages of each
// topic that wait while a frame is tracked).
// Topics: listens to left, and to right or depth; publishes the pose of each tracked frame on ~pose, and the header of
// every frame that it is through with, tracked or lost, on ~processed.
// At the end it writes to the output folder:
//   trajectory.txt, keyframes.txt   TUM format, after all optimisation; no trajectory.txt for one camera
//   points.f32                      the points of the map, x y z (m), 32-bit floats
// All poses describe the left camera as it is mounted, in stereo too, where ORB-SLAM2 tracks the rectified one.

#include <algorithm>
#include <cmath>
#include <fstream>
#include <functional>
#include <iomanip>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <Eigen/Geometry>
#include <boost/bind/bind.hpp>
#include <cv_bridge/cv_bridge.h>
#include <geometry_msgs/PoseStamped.h>
#include <message_filters/subscriber.h>
#include <message_filters/sync_policies/approximate_time.h>
#include <message_filters/synchronizer.h>
#include <opencv2/calib3d.hpp>
#include <opencv2/core/eigen.hpp>
#include <opencv2/imgproc.hpp>
#include <ros/ros.h>
#include <sensor_msgs/Image.h>
#include <std_msgs/Header.h>

#include "System.h"

namespace {

using Image = sensor_msgs::ImageConstPtr;
using Policy = message_filters::sync_policies::ApproximateTime<sensor_msgs::Image, sensor_msgs::Image>;

constexpr double SYNC_TOLERANCE_S = 0.003;
constexpr double ROUNDING = 1e-6;
constexpr double LEVEL_SHARE = 0.01;  // of the baseline: how far the right camera may be off the left one's x axis

cv::Mat grey(const Image& message) { return cv_bridge::toCvShare(message, "mono8")->image; }

// Pinhole images in one plane, from any pair of cameras. ORB-SLAM2 itself takes rectified images only.
class Rectifier {
 public:
  // Reads LEFT.K, LEFT.D, RIGHT.K, RIGHT.D, T_right_left and the size, and adds the Camera.* of the rectified pair.
  explicit Rectifier(const std::string& settings) {
    cv::FileStorage file(settings, cv::FileStorage::READ);
    cv::Mat K[2], D[2], T;
    file["LEFT.K"] >> K[0];
    file["LEFT.D"] >> D[0];
    file["RIGHT.K"] >> K[1];
    file["RIGHT.D"] >> D[1];
    file["T_right_left"] >> T;
    const cv::Size size{static_cast<int>(file["Camera.width"]), static_cast<int>(file["Camera.height"])};
    const cv::Mat R = T(cv::Rect(0, 0, 3, 3)), t = T(cv::Rect(3, 0, 1, 3));
    file.release();

    cv::Mat P[2] = {K[0], K[1]};
    double baseline_m = -t.at<double>(0);
    if (!rectified(K, D, R, t)) {
      cv::Mat turn[2], Q;
      cv::stereoRectify(K[0], D[0], K[1], D[1], size, R, t, turn[0], turn[1], P[0], P[1], Q);
      baseline_m = -P[1].at<double>(0, 3) / P[1].at<double>(0, 0);
      for (int i = 0; i < 2; ++i)
        cv::initUndistortRectifyMap(K[i], D[i], turn[i], P[i], size, CV_32FC1, maps_[i][0], maps_[i][1]);
      cv::cv2eigen(turn[0], R_rectified_left_);
    }
    std::ofstream(settings, std::ios::app)
        << std::setprecision(12) << "Camera.fx: " << P[0].at<double>(0, 0) << "\nCamera.fy: " << P[0].at<double>(1, 1)
        << "\nCamera.cx: " << P[0].at<double>(0, 2) << "\nCamera.cy: " << P[0].at<double>(1, 2)
        << "\nCamera.bf: " << P[0].at<double>(0, 0) * baseline_m << "\n";
  }

  Rectifier() = default;

  cv::Mat operator()(const cv::Mat& image, int camera) const {
    if (maps_[camera][0].empty()) return image;
    cv::Mat straight;
    cv::remap(image, straight, maps_[camera][0], maps_[camera][1], cv::INTER_LINEAR);
    return straight;
  }

  const Eigen::Matrix3d& R_rectified_left() const { return R_rectified_left_; }

 private:
  static bool rectified(const cv::Mat K[2], const cv::Mat D[2], const cv::Mat& R, const cv::Mat& t) {
    return cv::countNonZero(D[0]) == 0 && cv::countNonZero(D[1]) == 0 && cv::norm(K[0], K[1], cv::NORM_INF) < ROUNDING &&
           cv::norm(R, cv::Mat::eye(3, 3, CV_64F), cv::NORM_INF) < ROUNDING &&
           std::hypot(t.at<double>(1), t.at<double>(2)) < LEVEL_SHARE * -t.at<double>(0);
  }

  cv::Mat maps_[2][2];
  Eigen::Matrix3d R_rectified_left_ = Eigen::Matrix3d::Identity();
};

std::string required(ros::NodeHandle& handle, const std::string& name) {
  std::string value;
  if (!handle.getParam(name, value)) throw std::runtime_error("parameter ~" + name + " is missing");
  return value;
}

class Node {
 public:
  Node(ros::NodeHandle& handle, ros::NodeHandle& own)
      : mode_(required(own, "mode")), output_(required(own, "output") + "/"), queue_size_(own.param("queue_size", 1)) {
    const std::string settings = required(own, "settings");
    if (mode_ == "stereo") rectify_ = Rectifier(settings);
    const auto sensor = mode_ == "stereo" ? ORB_SLAM2::System::STEREO
                        : mode_ == "rgbd" ? ORB_SLAM2::System::RGBD
                                          : ORB_SLAM2::System::MONOCULAR;
    slam_ = std::make_unique<ORB_SLAM2::System>(required(own, "vocabulary"), settings, sensor, false);
    poses_ = own.advertise<geometry_msgs::PoseStamped>("pose", 100);
    processed_ = own.advertise<std_msgs::Header>("processed", 100);
    left_.registerCallback([this](const Image&) { ++received_; });
    if (mode_ == "mono") {
      left_.registerCallback([this](const Image& left) {
        track(left, [&](double t_s) { return slam_->TrackMonocular(grey(left), t_s); });
      });
    } else {
      pairs_ = std::make_unique<message_filters::Synchronizer<Policy>>(Policy(queue_size_ + 1), left_, second_);
      pairs_->setMaxIntervalDuration(ros::Duration(SYNC_TOLERANCE_S));
      pairs_->registerCallback(boost::bind(&Node::track_pair, this, boost::placeholders::_1, boost::placeholders::_2));
      second_.subscribe(handle, mode_ == "stereo" ? "right" : "depth", queue_size_);
    }
    left_.subscribe(handle, "left", queue_size_);
  }

  void finish() {
    left_.unsubscribe();
    second_.unsubscribe();
    slam_->Shutdown();
    ROS_INFO("%u images of the left camera received, %u frames, %u tracked", received_, frames_, tracked_);
    auto keyframes = slam_->GetMap()->GetAllKeyFrames();
    if (keyframes.empty()) return;  // upstream saves the first one without a look
    if (mode_ != "mono") save("trajectory.txt", &ORB_SLAM2::System::SaveTrajectoryTUM);
    save("keyframes.txt", &ORB_SLAM2::System::SaveKeyFrameTrajectoryTUM);
    std::sort(keyframes.begin(), keyframes.end(), ORB_SLAM2::KeyFrame::lId);
    save_points(mode_ == "mono" ? cv::Mat::eye(4, 4, CV_32F) : keyframes.front()->GetPose());
  }

 private:
  void track_pair(const Image& left, const Image& second) {
    track(left, [&](double t_s) {
      if (mode_ == "rgbd") return slam_->TrackRGBD(grey(left), cv_bridge::toCvShare(second)->image, t_s);
      return slam_->TrackStereo(rectify_(grey(left), 0), rectify_(grey(second), 1), t_s);
    });
  }

  void track(const Image& left, const std::function<cv::Mat(double)>& track_at) {
    ++frames_;
    const cv::Mat T_camera_world = track_at(left->header.stamp.toSec());
    // A lost frame may come with a guess of its pose.
    if (!T_camera_world.empty() && slam_->GetTrackingState() == ORB_SLAM2::Tracking::OK) {
      ++tracked_;
      publish(left->header.stamp, T_camera_world);
    }
    processed_.publish(left->header);
  }

  void publish(const ros::Time& stamp, const cv::Mat& T_camera_world) {
    Eigen::Matrix4d T;
    cv::cv2eigen(T_camera_world, T);
    const Eigen::Matrix3d R_world_camera = T.topLeftCorner<3, 3>().transpose();
    const Eigen::Vector3d p = -R_world_camera * T.topRightCorner<3, 1>();
    const Eigen::Quaterniond q(R_world_camera * rectify_.R_rectified_left());
    geometry_msgs::PoseStamped pose;
    pose.header.stamp = stamp;
    pose.header.frame_id = "map";
    pose.pose.position.x = p.x();
    pose.pose.position.y = p.y();
    pose.pose.position.z = p.z();
    pose.pose.orientation.x = q.x();
    pose.pose.orientation.y = q.y();
    pose.pose.orientation.z = q.z();
    pose.pose.orientation.w = q.w();
    poses_.publish(pose);
  }

  // Upstream's file, with the orientations turned from the rectified camera to the left one.
  void save(const std::string& name, void (ORB_SLAM2::System::*write)(const std::string&)) {
    const std::string path = output_ + name;
    ((*slam_).*write)(path);
    std::ifstream written(path);
    std::ostringstream turned;
    turned << std::fixed << std::setprecision(9);
    std::string stamp;
    double v[7];
    while (written >> stamp >> v[0] >> v[1] >> v[2] >> v[3] >> v[4] >> v[5] >> v[6]) {
      const Eigen::Quaterniond q(Eigen::Quaterniond(v[6], v[3], v[4], v[5]).toRotationMatrix() *
                                 rectify_.R_rectified_left());
      turned << stamp << ' ' << v[0] << ' ' << v[1] << ' ' << v[2] << ' ' << q.x() << ' ' << q.y() << ' ' << q.z() << ' '
             << q.w() << '\n';
    }
    written.close();
    std::ofstream(path) << turned.str();
  }

  // The points in the world of the trajectory: upstream moves that one so that it begins at the first keyframe.
  void save_points(const cv::Mat& T_trajectory_world) {
    const cv::Mat R = T_trajectory_world(cv::Rect(0, 0, 3, 3)), t = T_trajectory_world(cv::Rect(3, 0, 1, 3));
    std::ofstream file(output_ + "points.f32", std::ios::binary);
    for (ORB_SLAM2::MapPoint* point : slam_->GetMap()->GetAllMapPoints()) {
      if (point->isBad()) continue;
      const cv::Mat position = R * point->GetWorldPos() + t;
      file.write(position.ptr<char>(), 3 * sizeof(float));
    }
  }

  const std::string mode_, output_;
  const int queue_size_;
  Rectifier rectify_;
  std::unique_ptr<ORB_SLAM2::System> slam_;
  ros::Publisher poses_, processed_;
  message_filters::Subscriber<sensor_msgs::Image> left_, second_;
  std::unique_ptr<message_filters::Synchronizer<Policy>> pairs_;
  unsigned received_ = 0, frames_ = 0, tracked_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  ros::init(argc, argv, "orb_slam2");
  ros::NodeHandle handle, own("~");
  try {
    Node node(handle, own);
    ros::spin();
    node.finish();
  } catch (const std::exception& error) {
    ROS_FATAL("%s", error.what());
    return 1;
  }
  return 0;
}
