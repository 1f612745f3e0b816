"""``python -m slamhive`` is the ``slamhive`` command."""

from slamhive.cli import main

main(prog_name="slamhive")
