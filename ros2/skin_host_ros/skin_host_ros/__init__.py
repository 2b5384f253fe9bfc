"""ROS 2 messages from what skin-host publishes, and the node that sends them."""
