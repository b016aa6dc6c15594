"""Runs REPRESENT or a baseline: from demonstrations to rewards, policies and a report.

python -m experiments.represent --env=half_cheetah --preset=quick --out=runs/demo
python -m experiments.represent --env=hopper --seed=1 --override policies.env_steps=200000
python -m experiments.represent --env=hopper --until=regression --out=runs/hopper
python -m experiments.represent --env=hopper --demonstrations=mine.npz --test=unseen.npz
"""

import dataclasses
import json

from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.data.catalogue import load_demonstrations, load_test
from represent_jax.envs import make_env
from represent_jax.methods.config import MethodConfig, make_problem
from represent_jax.methods.plan import execute, stage_names
from represent_jax.methods.presets import make_config
from represent_jax.methods.registry import METHODS, find_method
from represent_jax.report import html, showcase, tables
from represent_jax.runs import open_run, processes
from represent_jax.runs.records import append_results
from represent_jax.runs.tracking import WandbTracker

_ENV = flags.DEFINE_string("env", "half_cheetah", "Environment.")
_METHOD = flags.DEFINE_string(
    "method", "represent", f"One of {', '.join(METHODS)}, or module:NAME of your own."
)
_PRESET = flags.DEFINE_string("preset", "quick", "Settings to begin with: smoke, quick or paper.")
_SEED = flags.DEFINE_integer("seed", 0, "Seed of everything after the demonstrations.")
_NUM_SEEDS = flags.DEFINE_integer(
    "num_seeds", 1, "Number of seeds, from --seed on, in turn.", lower_bound=1
)
_BACKEND = flags.DEFINE_string("backend", "auto", "Physics engine: auto, mujoco or mjx.")
_DEMONSTRATIONS = flags.DEFINE_string(
    "demonstrations", "", "Name or npz file of demonstrations; the environment's own if empty."
)
_TEST = flags.DEFINE_string(
    "test",
    "",
    "Name or npz file of unseen trajectories with true rewards, to judge rewards on; the "
    "environment's own if empty, none where none ship.",
)
_OUT = flags.DEFINE_string(
    "out", None, "Run folder; runs/<env>-<method>-<preset>-<seed> if not given."
)
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting as dotted.key=value; repeatable.")
_RESUME = flags.DEFINE_bool("resume", False, "Go on with the run in the folder.")
_UNTIL = flags.DEFINE_string("until", "", "Last of the method's stages to run; all if empty.")
_CHECKPOINT_SECONDS = flags.DEFINE_float(
    "checkpoint_seconds", 60.0, "Least time between two checkpoints of a stage."
)
_RECORD = flags.DEFINE_string("record", None, "File to append the results to, one JSON a line.")
_VIDEOS = flags.DEFINE_bool("videos", False, "Put videos on the report (extra `video`).")
_OPEN = flags.DEFINE_bool("open", False, "Show the report in a browser.")
_WANDB = flags.DEFINE_string(
    "wandb", None, "Project of Weights & Biases to log to (extra `wandb`)."
)
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "Show settings and stages, and run nothing.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    launch.compile_quickly(_PRESET.value)
    if _RECORD.value:
        launch.require_writable(_RECORD.value)
    for seed in range(_SEED.value, _SEED.value + _NUM_SEEDS.value):
        config = dataclasses.replace(
            make_config(_PRESET.value, _ENV.value, _METHOD.value),
            seed=seed,
            backend=_BACKEND.value,
            demonstrations=_DEMONSTRATIONS.value,
            test=_TEST.value,
        )
        config = configs.apply_overrides(config, launch.overrides(_OVERRIDE.value))
        out = _OUT.value or f"runs/{config.env}-{config.method}-{config.preset}-{seed}"
        if _OUT.value and _NUM_SEEDS.value > 1:
            out = f"{_OUT.value}/seed_{seed}"
        _run(config, out)


def _run(config: MethodConfig, out: str) -> None:
    env = make_env(config.env, config.backend)
    problem = make_problem(
        config,
        env,
        load_demonstrations(config.demonstrations or config.env),
        load_test(config.env, config.test),
    )
    print(json.dumps(configs.to_dict(config), indent=2))
    if problem.demonstrations.num_strategies == 1 and config.method == "represent":
        print("one strategy alone: the rewards are learned, but nothing is decomposed")
    method = find_method(config.method)
    stages = method.plan(config, problem, _CHECKPOINT_SECONDS.value)
    names = stage_names(stages, _UNTIL.value)
    if len(names) < len(stages):
        launch.refuse_beside(f"with --until={_UNTIL.value}", ("record", "videos", "open"))
    if _DRY_RUN.value:
        print(f"{out}: {' -> '.join(names)}; settings {configs.config_hash(config)}")
        return
    tracker = None
    if _WANDB.value:
        tracker = WandbTracker(_WANDB.value, out, out, configs.to_dict(config))
    with open_run(out, config, _RESUME.value, tracker) as run:
        results = execute(config, problem, stages, run, _UNTIL.value)
        if results is None:
            print(f"{out}: done until {_UNTIL.value}; --resume goes on")
            return
        if not processes.is_first():
            return
        if _VIDEOS.value:
            showcase.make(
                run,
                env,
                problem.env.horizon,
                problem.demonstrations,
                config.group_names,
                lambda: method.load_policies(config, env, run),
            )
        page = html.write_report(run.path)
    print(tables.summary(results))
    print(f"report: {page}")
    if _OPEN.value:
        launch.open_page(page)
    if _RECORD.value:
        append_results(_RECORD.value, config.method, configs.config_hash(config), results)


if __name__ == "__main__":
    launch.run(main, distributed=True)
