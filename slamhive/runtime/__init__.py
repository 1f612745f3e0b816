"""What algorithm images install: configuration, player, trajectory writer.

Depends on ``slamhive.errors`` and ``slamhive.strict_yaml`` only, so that an image needs three small things of the
product and none of its dependencies (numpy, PyYAML and rosbags).
"""
