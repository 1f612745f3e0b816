"""Runs a ROS 1 system in a container without a network: roscore, roslaunch, ``rosbag play`` and a recorder of poses.

Its ``mapping.py`` describes the system as :class:`~slamhive.runtime.ros1.system.Ros1System` and calls
:func:`slamhive.runtime.ros1.app.run`. Only ``recorder`` imports ROS.
"""
