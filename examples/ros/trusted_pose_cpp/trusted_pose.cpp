// Acts on a pose of the bone only while it may: one subscription, to ~/detection.
//
// ros2 run trusted_pose_cpp trusted_pose --ros-args -p topic:=/register_node/detection -p min_confidence:=0.9
#include <cmath>
#include <memory>
#include <string>

#include <rclcpp/rclcpp.hpp>
#include <vision_msgs/msg/detection3_d_array.hpp>

using vision_msgs::msg::Detection3DArray;

class TrustedPose : public rclcpp::Node
{
public:
  TrustedPose()
  : Node("trusted_pose")
  {
    least_ = declare_parameter("min_confidence", 0.9);
    oldest_ = declare_parameter("max_age", 1.0);  // s; 0: any, as of a bag without /clock
    const auto topic = declare_parameter("topic", std::string("/register_node/detection"));
    subscription_ = create_subscription<Detection3DArray>(
      topic, rclcpp::QoS(10).transient_local(),
      [this](const Detection3DArray & message) {on_detection(message);});
  }

private:
  void on_detection(const Detection3DArray & message)
  {
    const double age = (now() - rclcpp::Time(message.header.stamp, get_clock()->get_clock_type())).seconds();
    if (message.detections.empty() || message.detections[0].results.empty()) {
      RCLCPP_WARN(get_logger(), "hold: no pose");
      return;
    }
    const auto & best = message.detections[0].results[0];
    if (!(best.hypothesis.score >= least_) || (oldest_ > 0.0 && age > oldest_)) {
      RCLCPP_WARN(get_logger(), "hold: confidence %.2f, %.1f s old", best.hypothesis.score, age);
      return;
    }
    const auto & p = best.pose.pose.position;  // act on best.pose.pose and best.pose.covariance
    RCLCPP_INFO(
      get_logger(), "%s in %s at (%.4f, %.4f, %.4f) m, sd of x %.4f m", best.hypothesis.class_id.c_str(),
      message.header.frame_id.c_str(), p.x, p.y, p.z, std::sqrt(best.pose.covariance[0]));
  }

  double least_, oldest_;
  rclcpp::Subscription<Detection3DArray>::SharedPtr subscription_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<TrustedPose>());
  rclcpp::shutdown();
}
