"""Runs algorithms as Jobs of a Kubernetes cluster."""
