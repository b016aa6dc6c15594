"""Franka Kitchen: an arm moves a kettle from one burner to another."""

from represent_jax.envs.franka_kitchen.hand import FrankaKitchenHand
from represent_jax.envs.franka_kitchen.task import FrankaKitchen

__all__ = ["FrankaKitchen", "FrankaKitchenHand"]
