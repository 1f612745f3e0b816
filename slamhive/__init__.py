"""SLAM Hive: run any SLAM algorithm on any dataset under any configuration, evaluate, compare, conclude."""

__version__ = "0.1.0"
