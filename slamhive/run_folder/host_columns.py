"""The columns of ``host.csv``. The process that measures in a pod imports this, so it needs no more than Python 3.7."""

COLUMNS = (
    "time",
    "cores",
    "busy",
    "steal",
    "run",
    "cpu_pressure",
    "io_pressure",
    "memory_pressure",
    "throttles",
    "frequency",
)
"""Seconds since the run's start; cores that the run may use; CPU seconds of those cores, of the hypervisor, of the run;
seconds in which some task waited for a core, the disk, memory; thermal events; Hz of the fastest core."""

NOT_MEASURED = "# not measured: "
"""Begins a line that says what is missing, and why."""
