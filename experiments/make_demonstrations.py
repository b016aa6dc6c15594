"""Makes the demonstrations and test trajectories that ship with the package.

python -m experiments.make_demonstrations --env=half_cheetah --out=represent_jax/data/shipped
"""

import os
from pathlib import Path

from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.data.npz import save_demonstrations
from represent_jax.data.trajectories import Demonstrations
from represent_jax.errors import unknown
from represent_jax.methods import demonstrators
from represent_jax.stages import style

_ENV = flags.DEFINE_string("env", "half_cheetah", "Environment whose demonstrators to make.")
_OUT = flags.DEFINE_string("out", "represent_jax/data/shipped", "Folder to write to.")
_PART = flags.DEFINE_enum("part", "both", ["both", "demonstrations", "test"], "What to make.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting as dotted.key=value; repeatable.")
_BACKEND = flags.DEFINE_string("backend", "auto", "Physics engine: auto, mujoco or mjx.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    if _ENV.value not in demonstrators.DEMONSTRATORS:
        raise unknown("environment", _ENV.value, demonstrators.DEMONSTRATORS)
    config = demonstrators.DEMONSTRATORS[_ENV.value]
    config = configs.apply_overrides(config, _OVERRIDE.value)
    out = Path(_OUT.value)
    os.makedirs(out, exist_ok=True)
    if _PART.value in ("both", "demonstrations"):
        _make_demonstrations(config, out / f"{config.env}.npz")
    if _PART.value in ("both", "test"):
        _make_test_set(config, out / f"{config.env}_test.npz")


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
    accuracy = style.pairwise_accuracy(trajectories)
    metadata = {
        "source": "DIAYN with environment reward, early stopping per skill",
        "snapshot_env_steps": env_steps,
        "style_accuracy": accuracy,
        "config": configs.to_dict(config),
    }
    data = Demonstrations(config.env, tuple(trajectories), metadata)
    save_demonstrations(path, data)
    for i, target in enumerate(config.target_returns):
        print(f"strategy {i + 1}: return {data.mean_return(i):.1f}, wanted {target:.1f}")
    print(f"styles told apart: {accuracy}; written to {path}")


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
    returns = sorted(t.total_reward for t in trajectories)
    print(
        f"{len(returns)} test trajectories, returns {returns[0]:.0f} to {returns[-1]:.0f}: {path}"
    )


if __name__ == "__main__":
    launch.run(main)
