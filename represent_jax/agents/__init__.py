"""Reinforcement learning as pure functions; a reward is a function handed in."""
