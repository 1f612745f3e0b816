"""Algorithm folders of others, laid out as those of the published SLAM Hive: read as text, never executed."""
