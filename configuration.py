"""Settings of this installation. Uncomment and edit; docs/settings.md explains each.

Environment variables (SLAMHIVE_<NAME>) and command-line options win over what is written here.
"""

# MODE = "workstation"            # workstation | view-only | cluster | cloud
# DATA = "data"                   # data root: datasets, runs, SQLite database
# DATABASE_URL = ""               # "" = SQLite in the data root; or mysql+pymysql://user@host/slamhive
# EXECUTOR = "auto"               # auto | docker | process | slurm | kubernetes
# WORKER_SLOTS = 1                # runs at a time; 1 keeps measurements undisturbed
