"""Methods by name, and by the place of one that nobody registered."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from represent_jax import places
from represent_jax.errors import UsageError, unknown
from represent_jax.methods import (
    cloning,
    drex,
    imitation,
    msrd,
    policy_learning,
    represent,
    ssrr,
)
from represent_jax.methods.config import MethodConfig, RepresentConfig
from represent_jax.methods.plan import Stage

Loader = Callable[..., dict[str, Callable[..., jax.Array]]]


def _unchanged(settings: dict[str, Any]) -> dict[str, Any]:
    return settings


class Method(NamedTuple):
    """A method.

    Attributes:
      config: class of its settings.
      plan: its stages, `plan(config, problem, checkpoint_seconds)`, for `methods.plan`.
      load_rewards, load_policies: from settings, environment and run directory to functions
        `reward(obs_t, action_t, next_obs_t)` and `policy(obs, key=None)`, by target; what has no
        use for the key takes none into account.
      policies_in: the stage whose output holds the policies.
      configure: turns the settings of a preset and a domain, by name, into the method's.
    """

    config: type[MethodConfig]
    plan: Callable[..., tuple[Stage, ...]]
    load_rewards: Loader
    load_policies: Loader
    policies_in: str = "policies"
    configure: Callable[[dict[str, Any]], dict[str, Any]] = _unchanged


METHODS: dict[str, Method] = {
    "represent": Method(
        config=RepresentConfig,
        plan=represent.plan,
        load_rewards=represent.load_rewards,
        load_policies=policy_learning.load,
    ),
    "ssrr": Method(
        config=ssrr.SsrrConfig,
        plan=ssrr.plan,
        load_rewards=ssrr.load_rewards,
        load_policies=policy_learning.load,
        configure=ssrr.configure,
    ),
    "drex": Method(
        config=drex.DrexConfig,
        plan=drex.plan,
        load_rewards=drex.load_rewards,
        load_policies=policy_learning.load,
        configure=drex.configure,
    ),
    "msrd": Method(
        config=msrd.MsrdMethodConfig,
        plan=msrd.plan,
        load_rewards=msrd.load_rewards,
        load_policies=msrd.load_policies,
        policies_in="msrd",
    ),
    "noisy_airl": Method(
        config=imitation.NoisyAirlMethodConfig,
        plan=imitation.plan,
        load_rewards=imitation.load_rewards,
        load_policies=imitation.load_policies,
        policies_in="airl",
    ),
    "airl": Method(
        config=imitation.AirlMethodConfig,
        plan=imitation.plan,
        load_rewards=imitation.load_rewards,
        load_policies=imitation.load_policies,
        policies_in="airl",
        configure=imitation.configure_airl,
    ),
    "bc": Method(
        config=cloning.BcMethodConfig,
        plan=cloning.plan_bc,
        load_rewards=cloning.load_no_rewards,
        load_policies=cloning.load_bc_policies,
        policies_in="bc",
    ),
    "bc_rnn": Method(
        config=cloning.BcRnnMethodConfig,
        plan=cloning.plan_bc_rnn,
        load_rewards=cloning.load_no_rewards,
        load_policies=cloning.load_no_recurrent_policies,
        policies_in="bc_rnn",
    ),
}


def register_method(method: Method, name: str) -> None:
    """Makes a method known by name.

    Raises:
      UsageError: the name is taken.
    """
    if name in METHODS:
        raise UsageError(f"method {name!r} is already registered")
    METHODS[name] = method


def find_method(name: str) -> Method:
    """Finds a method.

    Args:
      name: of `METHODS`, or "module:NAME" of a `Method` that Python can import.

    Raises:
      UsageError: no method of that name.
    """
    if name in METHODS:
        return METHODS[name]
    if ":" not in name:
        raise unknown("method", name, METHODS)
    found = places.find("method", name)
    if not isinstance(found, Method):
        raise UsageError(f"method {name!r}: expected a methods.registry.Method, found {found!r}")
    return found


def setting_names() -> frozenset[str]:
    """Names of the settings, and groups of settings, that any method has."""
    return frozenset(
        field.name for method in METHODS.values() for field in dataclasses.fields(method.config)
    )
