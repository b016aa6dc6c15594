"""Makes the demonstrations and test trajectories that ship with the package, or a robot's own.

python -m experiments.make_demonstrations --env=half_cheetah --out=represent_jax/data/shipped
python -m experiments.make_demonstrations --env=half_cheetah_8 --out=represent_jax/data/shipped
python -m experiments.make_demonstrations --env=franka_kitchen --out=data \\
    --override push.fast_share=0.3
python -m experiments.make_demonstrations --env=my_robots:Swimmer --out=data \\
    --override diayn.num_skills=2 --override target_returns=20,30
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.data.npz import save_demonstrations
from represent_jax.data.trajectories import Demonstrations, Trajectory
from represent_jax.envs import Environment, make_env
from represent_jax.errors import UsageError
from represent_jax.methods import demonstrators, operators
from represent_jax.stages import style

_ENV = flags.DEFINE_string(
    "env",
    "half_cheetah",
    "Environment whose demonstrators to make, or half_cheetah_8: eight strategies, no test set.",
)
_OUT = flags.DEFINE_string("out", "represent_jax/data/shipped", "Folder to write to.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace files that are in the folder.")
_PART = flags.DEFINE_enum("part", "both", ["both", "demonstrations", "test"], "What to make.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting as dotted.key=value; repeatable.")
_BACKEND = flags.DEFINE_string("backend", "auto", "Physics engine: auto, mujoco or mjx.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    known = demonstrators.DEMONSTRATORS | operators.OPERATORS
    config = known.get(_ENV.value) or _robots_own(_ENV.value)
    config = configs.apply_overrides(config, _OVERRIDE.value)
    out = Path(_OUT.value)
    driven = isinstance(config, operators.OperatorsConfig)
    # Of shipped demonstrations, some are a domain's second set.
    name = _ENV.value if _ENV.value in known else config.env
    if _PART.value == "test" and name != config.env:
        raise UsageError(f"part: {name} has no test set of its own, but that of {config.env}")
    made = []
    if _PART.value in ("both", "demonstrations"):
        make = _drive_demonstrations if driven else _make_demonstrations
        made.append((make, out / f"{name}.npz"))
    if _PART.value in ("both", "test") and name == config.env:
        make = _drive_test_set if driven else _make_test_set
        made.append((make, out / f"{config.env}_test.npz"))
    for _, path in made:
        if not _OVERWRITE.value:
            launch.refuse_to_replace(path)
        launch.require_writable(path)
    for make, path in made:
        make(config, path)


def _robots_own(name: str) -> demonstrators.DemonstratorConfig:
    """Settings to begin with for an environment of which nothing ships."""
    make_env(name, _BACKEND.value)  # An unknown name is an error of its own.
    configs.require(
        any(override.partition("=")[0].strip() == "target_returns" for override in _OVERRIDE.value),
        "override",
        f"target_returns=..., the return wanted of each skill, which nobody chose for {name}",
        _OVERRIDE.value,
    )
    return demonstrators.DemonstratorConfig(env=name)


def _make_demonstrations(config: demonstrators.DemonstratorConfig, path: Path) -> None:
    snapshots = demonstrators.train(
        config,
        config.seed,
        config.env_steps,
        config.snapshot_env_steps,
        config.trajectories_per_skill,
        config.demonstration_horizon,
        _BACKEND.value,
    )
    trajectories, env_steps = demonstrators.choose_demonstrations(
        snapshots,
        config.target_returns,
        config.min_skill_accuracy,
        config.strategy_order,
        config.steadiness_weight,
    )
    metadata = {
        "source": "DIAYN with environment reward, early stopping per skill",
        "snapshot_env_steps": env_steps,
        "style_accuracy": style.pairwise_accuracy(trajectories),
        "config": configs.to_dict(config),
    }
    data = Demonstrations(config.env, tuple(trajectories), metadata)
    save_demonstrations(path, data)
    _print_demonstrations(data, config.target_returns, path)


def _drive_demonstrations(config: operators.OperatorsConfig, path: Path) -> None:
    env = make_env(config.env, "mujoco")
    trajectories = operators.demonstrate(operators.Driver(env), config)
    metadata = {
        "source": "scripted operators of the keys (no person): 1 pushes the body, 2 holds the "
        "handle; of their episodes those nearest to the paper's mean returns",
        "outcomes": _outcomes(env, trajectories),
        "style_accuracy": style.pairwise_accuracy(trajectories),
        "config": configs.to_dict(config),
    }
    data = Demonstrations(config.env, tuple(trajectories), metadata)
    save_demonstrations(path, data)
    _print_demonstrations(data, config.target_returns, path)


def _drive_test_set(config: operators.OperatorsConfig, path: Path) -> None:
    env = make_env(config.env, "mujoco")
    trajectories = operators.make_test_set(operators.Driver(env), config)
    metadata = {
        "source": "scripted operators of the keys (no person), from deft to hopeless",
        "outcomes": _outcomes(env, trajectories),
        "config": configs.to_dict(config),
    }
    data = Demonstrations(config.env, tuple(trajectories), metadata)
    save_demonstrations(path, data)
    _print_test_set(data, path)


def _outcomes(env: Environment, trajectories: Sequence[Trajectory]) -> dict[str, list[float]]:
    """What every episode came to."""
    found = env.task.outcomes(np.stack([t.obs for t in trajectories]))
    return {name: np.round(values, 4).tolist() for name, values in found.items()}


def _print_demonstrations(data: Demonstrations, targets: Sequence[float], path: Path) -> None:
    for i, target in enumerate(targets):
        print(f"strategy {i + 1}: return {data.mean_return(i):.1f}, wanted {target:.1f}")
    for name, values in data.metadata.get("outcomes", {}).items():
        print(f"{name}: {values}")
    print(f"styles told apart: {data.metadata['style_accuracy']}; written to {path}")


def _make_test_set(config: demonstrators.DemonstratorConfig, path: Path) -> None:
    snapshots = demonstrators.train(
        config,
        config.test_seed,
        config.test_env_steps,
        config.test_env_steps // (config.test_snapshots - 1),
        config.test_trajectories_per_skill,
        backend=_BACKEND.value,
    )
    trajectories = demonstrators.choose_test_set(
        snapshots, config.test_snapshots, config.test_trajectories_per_skill
    )
    metadata = {
        "source": "snapshots of a DIAYN agent of another seed, evenly spread over training",
        "config": configs.to_dict(config),
    }
    data = Demonstrations(config.env, tuple(trajectories), metadata)
    save_demonstrations(path, data)
    _print_test_set(data, path)


def _print_test_set(data: Demonstrations, path: Path) -> None:
    trajectories = data.trajectories
    returns = sorted(t.total_reward for t in trajectories)
    print(
        f"{len(returns)} test trajectories, returns {returns[0]:.0f} to {returns[-1]:.0f}: {path}"
    )


if __name__ == "__main__":
    launch.run(main)
