"""The five ROS 2 nodes and what they share; nothing else in the package imports rclpy."""
