"""ROS 2 node around ``geodiff_plugin.live``."""
