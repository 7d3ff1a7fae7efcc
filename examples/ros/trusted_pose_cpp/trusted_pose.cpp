// Acts on a pose of the bone only while it may: one subscription, to ~/detection.
// ros2 run trusted_pose_cpp trusted_pose --ros-args -p topic:=/register_node/detection -p min_confidence:=0.9
#include <cmath>
#include <memory>
#include <string>

#include <rclcpp/rclcpp.hpp>
#include <vision_msgs/msg/detection3_d_array.hpp>

using vision_msgs::msg::Detection3DArray;

struct TrustedPose : rclcpp::Node
{
  TrustedPose() : Node("trusted_pose") {}
  void on_detection(const Detection3DArray & message)
  {
    const double age = (now() - rclcpp::Time(message.header.stamp, get_clock()->get_clock_type())).seconds();
    const bool is_empty = message.detections.empty() || message.detections[0].results.empty();
    const auto * best = is_empty ? nullptr : &message.detections[0].results[0];
    if (!best || !(best->hypothesis.score >= least) || (0.0 < oldest && oldest < age)) {
      const char * bone = best ? best->hypothesis.class_id.c_str() : "no pose";
      RCLCPP_WARN(get_logger(), "hold: %s, %.2f, %.1f s old", bone, best ? best->hypothesis.score : 0.0, age);
      return;
    }
    const auto & p = best->pose.pose.position;  // act on best->pose.pose and best->pose.covariance
    RCLCPP_INFO(get_logger(), "%s in %s at (%.4f, %.4f, %.4f) m, sd of x %.4f m", best->hypothesis.class_id.c_str(),
      message.header.frame_id.c_str(), p.x, p.y, p.z, std::sqrt(best->pose.covariance[0]));
  }

  double least = declare_parameter("min_confidence", 0.9);
  double oldest = declare_parameter("max_age", 1.0);  // s; 0: any, as of a bag without /clock
  rclcpp::SubscriptionBase::SharedPtr subscription = create_subscription<Detection3DArray>(
    declare_parameter("topic", std::string("/register_node/detection")), rclcpp::QoS(10).transient_local(),
    [this](const Detection3DArray & message) {on_detection(message);});
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<TrustedPose>());
}
