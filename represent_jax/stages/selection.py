"""Selection: which policy each target is handed, of all that were trained on one task.

Rewards of one task have most of it in common, so each can judge every policy, and a reward knows
where its own agent was stuck: another's policy then earns far more of it. The true reward is not
looked at.
"""

import dataclasses

import jax
import jax.numpy as jnp

from represent_jax.config import later, require


@dataclasses.dataclass(frozen=True)
class SelectionConfig:
    """Settings of the selection.

    Attributes:
      task_margin: share by which another target's policy has to earn more of R^0 than the policy
        trained on it, before it is handed on in its place.
      strategy_margin: the same of R^i. A strategy's own policy is in its style, which R~^i, kept
        small, hardly pays for; so only what was stuck is replaced.
      task_floor: whether no strategy is handed a policy that earns less of R^0 than its
        demonstrations do. All demonstrate one task: a policy that leaves it undone has found what
        R~^i pays for by mistake.
    """

    task_margin: float = 0.0
    strategy_margin: float = 0.25
    task_floor: bool = later(False)

    def __post_init__(self) -> None:
        for field in ("task_margin", "strategy_margin"):
            require(getattr(self, field) >= 0.0, field, "at least 0", getattr(self, field))


def choose(
    learned_returns: jax.Array,
    margins: jax.Array,
    task_returns: jax.Array | None = None,
    floors: jax.Array | None = None,
) -> jax.Array:
    """Chooses a policy for every target; its own where no other will do.

    Args:
      learned_returns: `[num_targets, num_targets]`, in row p and column t what the policy trained
        for target p earns of target t's reward.
      margins: share by which another's has to earn more, `[num_targets]`.
      task_returns: what each policy earns of R^0, `[num_targets]`.
      floors: what a policy has to earn of R^0 to be handed to each target, `[num_targets]`; none
        has to earn anything if None.

    Returns:
      For every target the one whose policy it is handed, `[num_targets]` int32.
    """
    known = jnp.where(jnp.isfinite(learned_returns), learned_returns, -jnp.inf)
    if floors is not None:
        known = jnp.where(task_returns[:, None] >= floors, known, -jnp.inf)
    own = jnp.diagonal(known)
    to_beat = jnp.where(jnp.isfinite(own), own + margins * jnp.abs(own), -jnp.inf)
    better = jnp.max(known, axis=0) > to_beat
    return jnp.where(better, jnp.argmax(known, axis=0), jnp.arange(own.shape[0]))
