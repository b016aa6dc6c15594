"""Agents by name: modules of one shape, whose policies are of one family.

Each has `init`, `train`, `act`, `log_prob`, `policy_of`, `init_learner` and `population_axes`, and
a state with a `learner`.
"""

from types import ModuleType

from represent_jax.agents import ppo, sac
from represent_jax.errors import unknown

AGENTS: dict[str, ModuleType] = {"sac": sac, "ppo": ppo}


def find_agent(name: str) -> ModuleType:
    """Returns the agent's module.

    Raises:
      UsageError: no agent of that name.
    """
    if name not in AGENTS:
        raise unknown("agent", name, AGENTS)
    return AGENTS[name]
