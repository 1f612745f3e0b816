"""Running one algorithm in isolation: in a Docker container, or in a process of its own where no engine answers."""
