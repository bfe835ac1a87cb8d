"""From a recording to a finished result folder: in this process, by the ROS graph, or from a file of poses."""
