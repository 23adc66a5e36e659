"""ROS 2 without ROS: its messages, its topics over plain DDS or a sourced ROS's rclpy, and its transforms."""
