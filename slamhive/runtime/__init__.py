"""The part that algorithm images install: configuration, player, trajectory writer.

It imports nothing of SLAM Hive except ``errors``, ``files``, ``input_bounds`` and ``strict_yaml``, so an image installs
only numpy, rosbags and ruamel.yaml.
"""
