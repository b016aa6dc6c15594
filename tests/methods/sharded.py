"""Trains tiny populations and writes their members' states; `test_sharding` runs it.

python sharded.py OUT STAGE:NUM_MEMBERS[:PHYSICS] ... [-- ADDRESS NUM_PROCESSES PROCESS]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from represent_jax.data.catalogue import load_demonstrations
from represent_jax.envs import make_env
from represent_jax.methods.config import make_problem
from represent_jax.methods.pipeline import padded_demonstrations, transitions_of
from represent_jax.methods.population import Population
from represent_jax.methods.presets import make_config
from represent_jax.runs import processes
from represent_jax.stages import airl, regression

NAME = "inverted_double_pendulum"


def of_regression(config, problem, num_members):
    demonstrations = padded_demonstrations(problem)
    num_strategies, num = demonstrations.strategy.shape
    targets = jnp.linspace(0.0, 1.0, num_strategies * num).reshape(num_strategies, num)
    data = regression.RegressionData(demonstrations, targets, demonstrations)
    members = [
        jax.tree.map(lambda x, i=i: x[i % num_strategies, None], data) for i in range(num_members)
    ]
    sizes = (problem.env.observation_size, problem.env.action_size, 1)
    return (
        Population(members, "vmap"),
        lambda key, _: regression.init(key, *sizes, config.regression),
        lambda state, data: regression.train(state, data, config.regression, 3),
    )


def of_airl(config, problem, num_members):
    strategies = transitions_of(problem.demonstrations)
    members = [strategies[i % len(strategies)] for i in range(num_members)]
    return (
        Population(members, "vmap", airl.population_axes),
        lambda key, rows: airl.init(key, problem.env, rows, config.airl),
        lambda state, rows: airl.train(state, problem.env, rows, config.airl, 3),
    )


def train(stage: str, num_members: int, physics: str) -> dict[str, np.ndarray]:
    config, data = make_config("smoke", NAME), load_demonstrations(NAME)
    problem = make_problem(config, make_env(NAME, physics), data, data)
    make = {"regression": of_regression, "airl": of_airl}[stage]
    population, init, step = make(config, problem, num_members)
    states = population.init(init, jax.random.PRNGKey(0))
    stepper = population.stepper(step)
    for _ in range(2):
        states, metrics = stepper(states)
    shardings = [leaf.sharding for leaf in jax.tree.leaves(states)]
    told = {
        "devices": np.array([len(sharding.device_set) for sharding in shardings]),
        "copies": np.array([sharding.is_fully_replicated for sharding in shardings]),
    }
    members = population.members(states)
    for j in range(len(jax.tree.leaves(members[0]))):
        told[f"state/{j}"] = np.stack([jax.tree.leaves(member)[j] for member in members])
    return told | {f"metrics/{key}": np.asarray(value) for key, value in metrics.items()}


def main(out: str, populations: list[str]) -> None:
    for name in populations:
        stage, num_members, *physics = name.split(":")
        told = train(stage, int(num_members), *(physics or ["mujoco"]))
        np.savez(Path(out) / f"{name}.npz", **told)


if __name__ == "__main__":
    arguments = sys.argv[1:]
    if "--" in arguments:
        at = arguments.index("--")
        address, num_processes, process = arguments[at + 1 :]
        processes.join(address, int(num_processes), int(process))
        arguments = arguments[:at]
    main(arguments[0], arguments[1:])
