"""Behavioural cloning: maximum likelihood of demonstrated actions."""

from collections.abc import Callable
from types import ModuleType

import jax
import jax.numpy as jnp
import optax

from represent_jax.agents.ppo import PpoConfig
from represent_jax.agents.sac import PolicyParams, SacConfig
from represent_jax.envs.episode import Episode
from represent_jax.types import Transition

# Saturated actions are infinitely far away before the tanh.
_LARGEST_ACTION = 0.999


def start(
    key_policy: jax.Array,
    key_clone: jax.Array,
    module: ModuleType,
    settings: SacConfig | PpoConfig,
    env: Episode,
    demonstrations: Transition,
    num_updates: int,
    observation_noise: float = 0.0,
) -> PolicyParams | None:
    """The policy that an agent begins from: a clone of the demonstrations.

    Args:
      key_policy: PRNG key of the networks that the clone begins from.
      key_clone: PRNG key of cloning.
      module: the agent's module, `agents.sac` or `agents.ppo`.
      settings: the agent's.
      env: tells sizes.
      demonstrations: `[num_transitions]`.
      num_updates, observation_noise: see `clone`.

    Returns:
      None where there is nothing to clone, or no update to do it with.
    """
    if not num_updates or demonstrations.action_t is None:
        return None
    learner = module.init_learner(key_policy, env.observation_size, env.action_size, settings)

    def log_prob(params, obs_t, action_t):
        return module.log_prob(params, obs_t, action_t, settings)

    policy = module.policy_of(learner)
    return clone(key_clone, policy, log_prob, demonstrations, num_updates, observation_noise)


def clone(
    key: jax.Array,
    policy: PolicyParams,
    log_prob: Callable[[PolicyParams, jax.Array, jax.Array], jax.Array],
    demonstrations: Transition,
    num_updates: int,
    observation_noise: float = 0.0,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
) -> PolicyParams:
    """Fits a policy's networks to demonstrations; its observation statistics stay as they are.

    Args:
      key: PRNG key.
      policy: to begin from.
      log_prob: `log_prob(policy, obs_t, action_t)`, log density of actions, `[batch]`.
      demonstrations: `[num_transitions]`.
      num_updates: Adam steps, with the step size falling to zero along a cosine.
      observation_noise: standard deviation of Gaussian noise on what the policy sees while it
        learns, in units of observations: a clone of few demonstrations then knows what to do
        beside them too.
      batch_size: transitions in each.
      learning_rate: Adam's first step size.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, num_updates))

    def loss_fn(networks, rows):
        actions = jnp.clip(rows.action_t, -_LARGEST_ACTION, _LARGEST_ACTION)
        return -jnp.mean(log_prob(policy._replace(policy=networks), rows.obs_t, actions))

    def update(carry, key):
        networks, opt = carry
        index = jax.random.randint(key, (batch_size,), 0, demonstrations.reward_t.shape[0])
        rows = jax.tree.map(lambda x: x[index], demonstrations)
        if observation_noise:
            noise = jax.random.normal(jax.random.fold_in(key, 1), rows.obs_t.shape)
            rows = rows._replace(obs_t=rows.obs_t + observation_noise * noise)
        updates, opt = optimizer.update(jax.grad(loss_fn)(networks, rows), opt)
        return (optax.apply_updates(networks, updates), opt), None

    carry = (policy.policy, optimizer.init(policy.policy))
    (networks, _), _ = jax.lax.scan(update, carry, jax.random.split(key, num_updates))
    return policy._replace(policy=networks)
