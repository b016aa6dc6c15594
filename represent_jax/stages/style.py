"""Tells strategies apart by their states: do demonstrators differ, does a policy keep a style."""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.training import networks as brax_networks
from flax import linen, struct

from represent_jax.data.trajectories import Trajectory
from represent_jax.errors import RepresentError
from represent_jax.types import Params

_MODULE_SIZES = (64, 64)
_LEARNING_RATE = 1e-3
_NUM_UPDATES = 1000
_BATCH_SIZE = 256


@struct.dataclass
class StyleClassifier:
    """A classifier of states by strategy.

    Attributes:
      params: network parameters.
      mean, std: of the states it was fitted to, `[obs_dim]`.
      num_strategies: number of classes.
    """

    params: Params
    mean: jax.Array
    std: jax.Array
    num_strategies: int = struct.field(pytree_node=False)


def _module(num_strategies: int) -> brax_networks.MLP:
    return brax_networks.MLP(layer_sizes=(*_MODULE_SIZES, num_strategies), activation=linen.relu)


def fit(
    key: jax.Array, obs: jax.Array, strategy: jax.Array, num_strategies: int
) -> StyleClassifier:
    """Fits by cross-entropy.

    Args:
      key: PRNG key.
      obs: `[num_states, obs_dim]`.
      strategy: `[num_states]` int.
      num_strategies: number of classes.
    """
    module = _module(num_strategies)
    optimizer = optax.adamw(_LEARNING_RATE, weight_decay=1e-2)
    mean, std = jnp.mean(obs, axis=0), jnp.std(obs, axis=0) + 1e-3
    key_init, key_batches = jax.random.split(key)
    params = module.init(key_init, mean)

    def loss_fn(params, index):
        logits = module.apply(params, (obs[index] - mean) / std)
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, strategy[index]))

    def update(carry, key):
        params, opt = carry
        index = jax.random.randint(key, (_BATCH_SIZE,), 0, obs.shape[0])
        updates, opt = optimizer.update(jax.grad(loss_fn)(params, index), opt, params)
        return (optax.apply_updates(params, updates), opt), None

    keys = jax.random.split(key_batches, _NUM_UPDATES)
    (params, _), _ = jax.lax.scan(update, (params, optimizer.init(params)), keys)
    return StyleClassifier(params, mean, std, num_strategies)


def log_posterior(classifier: StyleClassifier, obs: jax.Array) -> jax.Array:
    """Log probability of each strategy, `[..., num_strategies]`."""
    module = _module(classifier.num_strategies)
    return jax.nn.log_softmax(
        module.apply(classifier.params, (obs - classifier.mean) / classifier.std)
    )


def pairwise_accuracy(trajectories: Sequence[Trajectory]) -> dict[str, dict[str, float]]:
    """Held-out accuracy with which every pair of strategies is told apart.

    Half of each strategy's trajectories is fitted to, the other half judged; both ways round.

    Returns:
      For every pair, such as "1-2": accuracy on single "states" and on whole "trajectories",
      which are judged by their states' mean log posterior.

    Raises:
      RepresentError: a strategy has fewer than two trajectories.
    """
    num_strategies = 1 + max(t.strategy for t in trajectories)
    for strategy in range(num_strategies):
        found = len(_own(trajectories, strategy))
        if found < 2:
            raise RepresentError(
                f"strategy {strategy + 1}: expected at least 2 trajectories, one to fit and one to "
                f"judge, found {found}"
            )
    fit_pair = jax.jit(fit, static_argnums=3)
    result = {}
    for pair in itertools.combinations(range(num_strategies), 2):
        states, wholes = [], []
        for parity in (0, 1):
            fitted = [
                np.concatenate([t.obs[1:] for t in _own(trajectories, strategy)[parity::2]])
                for strategy in pair
            ]
            labels = np.repeat(np.arange(2), [len(obs) for obs in fitted])
            classifier = fit_pair(jax.random.PRNGKey(parity), np.concatenate(fitted), labels, 2)
            for label, strategy in enumerate(pair):
                for t in _own(trajectories, strategy)[1 - parity :: 2]:
                    posterior = np.asarray(log_posterior(classifier, t.obs[1:]))
                    states.append(np.mean(np.argmax(posterior, axis=-1) == label))
                    wholes.append(np.argmax(np.mean(posterior, axis=0)) == label)
        result[f"{pair[0] + 1}-{pair[1] + 1}"] = {
            "states": round(float(np.mean(states)), 4),
            "trajectories": round(float(np.mean(wholes)), 4),
        }
    return result


def _own(trajectories: Sequence[Trajectory], strategy: int) -> list[Trajectory]:
    return [t for t in trajectories if t.strategy == strategy]
