"""Behavioural cloning of a SAC actor: maximum likelihood of demonstrated actions."""

import jax
import jax.numpy as jnp
import optax

from represent_jax.agents import sac
from represent_jax.agents.sac import LearnerState, SacConfig
from represent_jax.types import Transition

# Saturated actions are infinitely far away before the tanh.
_LARGEST_ACTION = 0.999


def clone(
    key: jax.Array,
    learner: LearnerState,
    demonstrations: Transition,
    config: SacConfig,
    num_updates: int,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
) -> LearnerState:
    """Fits the actor to demonstrations; everything else of the learner stays as it is.

    Args:
      key: PRNG key.
      learner: with the actor to begin from.
      demonstrations: `[num_transitions]`.
      config: settings of the agent.
      num_updates: Adam steps, with the step size falling to zero along a cosine.
      batch_size: transitions in each.
      learning_rate: Adam's first step size.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, num_updates))

    def loss_fn(policy_params, rows):
        policy = sac.PolicyParams(learner.obs_stats, policy_params)
        actions = jnp.clip(rows.action_t, -_LARGEST_ACTION, _LARGEST_ACTION)
        return -jnp.mean(sac.log_prob(policy, rows.obs_t, actions, config))

    def update(carry, key):
        params, opt = carry
        index = jax.random.randint(key, (batch_size,), 0, demonstrations.reward_t.shape[0])
        rows = jax.tree.map(lambda x: x[index], demonstrations)
        updates, opt = optimizer.update(jax.grad(loss_fn)(params, rows), opt)
        return (optax.apply_updates(params, updates), opt), None

    start = (learner.policy_params, optimizer.init(learner.policy_params))
    (params, _), _ = jax.lax.scan(update, start, jax.random.split(key, num_updates))
    return learner.replace(policy_params=params)
