"""Runs as supervised processes of this machine, where no container engine answers."""
