"""Tests with a real ROS 2, in an environment of its own: `make test-ros2`; elsewhere they are skipped."""
