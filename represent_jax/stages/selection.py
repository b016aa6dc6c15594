"""Selection: which policy each target is handed, of all that were trained on one task.

Rewards of one task have most of it in common, so each can judge every policy, and a reward knows
where its own agent was stuck: another's policy then earns more of it. The true reward is not
looked at.
"""

import dataclasses

import jax
import jax.numpy as jnp

from represent_jax.config import require


@dataclasses.dataclass(frozen=True)
class SelectionConfig:
    """Settings of the selection.

    Attributes:
      margin: share by which another's policy has to earn more of a strategy's reward than the
        policy trained on it, before it is handed on in its place: a strategy's own policy is in
        its style. The task has no style, and is handed whatever earns most.
    """

    margin: float = 0.05

    def __post_init__(self) -> None:
        require(self.margin >= 0.0, "margin", "at least 0", self.margin)


def choose(learned_returns: jax.Array, margins: jax.Array) -> jax.Array:
    """Chooses a policy for every target.

    Args:
      learned_returns: `[num_targets, num_targets]`, in row p and column t what the policy trained
        for target p earns of target t's reward.
      margins: share by which another's has to earn more, `[num_targets]`.

    Returns:
      For every target the one whose policy it is handed, `[num_targets]` int32.
    """
    own = jnp.diagonal(learned_returns)
    known = jnp.where(jnp.isfinite(learned_returns), learned_returns, -jnp.inf)
    better = jnp.max(known, axis=0) > own + margins * jnp.abs(own)
    return jnp.where(better, jnp.argmax(known, axis=0), jnp.arange(own.shape[0]))
