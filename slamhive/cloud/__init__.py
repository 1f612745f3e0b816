"""Machines rented from a cloud: what they cost, how they begin, and how nothing of them is left."""
