"""Demonstrations and test trajectories that come with the package."""
