"""What a method does without true rewards, without actions, and without test trajectories."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import represent_jax as rj
from represent_jax.config import apply_overrides
from represent_jax.data import formats, save_demonstrations
from represent_jax.data.catalogue import load_test
from represent_jax.data.trajectories import pad
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods import results
from represent_jax.methods.config import make_problem
from represent_jax.methods.plan import execute
from represent_jax.methods.presets import make_config
from represent_jax.methods.registry import find_method
from represent_jax.report import tables
from represent_jax.runs import RunDirectory

ROOT = Path(__file__).parents[2]
ENV = "inverted_double_pendulum"


def without(data, *parts):
    trajectories = (dataclasses.replace(t, **dict.fromkeys(parts)) for t in data.trajectories)
    return dataclasses.replace(data, trajectories=tuple(trajectories))


@pytest.fixture(scope="module")
def env():
    return rj.make_env(ENV, "mujoco")


@pytest.fixture(scope="module")
def shown():
    return rj.load_demonstrations(ENV)


@pytest.mark.parametrize(
    "method, override, needs",
    [
        ("bc", (), "method=bc "),
        ("bc_rnn", (), "method=bc_rnn "),
        ("drex", (), r"base=bc \(base=airl does without\)"),
        ("drex", ("base=airl",), ""),
        ("drex", ("base=airl", "airl.learn_policy=false"), "airl.learn_policy=false"),
        ("msrd", (), ""),
        ("ssrr", (), ""),
        ("represent", (), ""),
        ("represent", ("regression.include_action=true",), "regression.include_action=true"),
        ("ssrr", ("airl.discriminator.state_only=false",), "airl.discriminator.state_only=false"),
        ("represent", ("airl.learn_policy=false",), "airl.learn_policy=false"),
    ],
)
def test_methods_that_need_actions_refuse_states_alone(env, shown, method, override, needs):
    config = apply_overrides(make_config("smoke", ENV, method), override)
    make_problem(config, env, shown)
    states = without(shown, "actions")
    if not needs:
        assert make_problem(config, env, states).demonstrations.action_dim is None
        return
    with pytest.raises(UsageError, match=f"demonstrations hold no actions, which {needs}"):
        make_problem(config, env, states)


def test_settings_that_observations_do_not_fit_are_refused_before_any_stage(env, shown):
    config = apply_overrides(make_config("smoke", ENV), ["regression.task_entries=0,99"])
    size = env.observation_size
    with pytest.raises(UsageError, match=rf"task_entries: .*size {size}, found \(0, 99\)"):
        make_problem(config, env, shown)


def test_demonstrations_of_another_robot_are_refused_though_their_sizes_fit(shown):
    config = make_config("smoke", "hopper")
    hopper = rj.make_env("hopper", "mujoco")
    states = without(shown, "actions")
    assert states.obs_dim == hopper.observation_size
    with pytest.raises(RepresentError, match="are of inverted_double_pendulum, expected hopper"):
        make_problem(config, hopper, states)
    make_problem(config, hopper, dataclasses.replace(states, env_name="mine"))


def test_test_trajectories(env, shown):
    config = make_config("smoke", ENV)
    assert make_problem(config, env, shown).test == ()
    with pytest.raises(UsageError, match="test trajectories hold no true rewards"):
        make_problem(config, env, shown, without(shown, "rewards"))
    assert load_test("robot_of_mine") is None
    assert len(load_test(ENV).trajectories) > len(shown.trajectories)
    with pytest.raises(UsageError, match=r"nothing\.npz"):
        load_test(ENV, "nothing.npz")


def first_of_obs(batch):
    """A made-up reward: the mean of an observation's first number."""
    return batch.obs[:, 1:, 0].mean(axis=1)


@pytest.mark.parametrize("has_rewards", [True, False])
@pytest.mark.parametrize("has_test", [True, False])
def test_rewards_are_judged_by_what_is_known(tmp_path, env, shown, has_rewards, has_test):
    config = make_config("smoke", ENV)
    own = shown if has_rewards else without(shown, "rewards", "actions")
    problem = make_problem(config, env, own, load_test(ENV) if has_test else None)
    learned = {"task": first_of_obs}
    found = results.judge_rewards(problem, {}, learned, RunDirectory(tmp_path))["task"]
    assert ("pearson_test" in found) is has_test
    assert ("pearson_pooled" in found) is (has_test or has_rewards)
    assert ("pearson_above_demonstrators" in found) is (has_test and has_rewards)
    said = results.describe(config, problem)
    assert said["missing"] == [
        *(() if has_rewards else ("actions", "rewards")),
        *(() if has_test else ("test",)),
    ]
    assert all((one["return_mean"] is None) is not has_rewards for one in said["demonstrators"])
    text = tables.summary(said | {"rewards": {"task": found}})
    assert ("no true rewards" in text) is not has_rewards
    assert ("no unseen trajectories" in text) is not has_test


def test_the_share_of_the_task_needs_no_true_return(tmp_path, env, shown):
    problem = make_problem(make_config("smoke", ENV), env, without(shown, "rewards"), None)
    noisy = pad(shown.trajectories, 1_000)
    learned = {
        "task": lambda batch: 1.0 + 0.6 * first_of_obs(batch),
        "strategy_1": first_of_obs,
        "strategy_2": first_of_obs,
    }
    found = results.judge_rewards(problem, {"noisy_1": noisy}, learned, RunDirectory(tmp_path))
    assert found["strategy_1"]["task_share"] == pytest.approx(0.6, abs=1e-4)
    assert "task_share" not in found["task"] | found["strategy_2"]


LAUNCH = """
from represent_jax.envs import register
from represent_jax.envs.hopper import Hopper
register(Hopper, "robot_of_mine")
from experiments import launch, {launcher}
launch.run({launcher}.main)
"""


def launched(launcher, *flags):
    """Runs a launcher with a robot of one's own registered."""
    command = [sys.executable, "-c", LAUNCH.format(launcher=launcher), *flags]
    cpu = {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | cpu, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_states_alone_of_a_robot_of_ones_own(tmp_path):
    data = without(rj.load_demonstrations("hopper"), "actions", "rewards")
    own = dataclasses.replace(data, env_name="robot_of_mine")
    save_demonstrations(tmp_path / "mine.npz", own)
    out, record = tmp_path / "run", tmp_path / "records.jsonl"
    flags = ("--env=robot_of_mine", f"--demonstrations={tmp_path / 'mine.npz'}", f"--out={out}")
    more = ("--preset=smoke", "--backend=mujoco", f"--record={record}", "--override")
    more += ("policy_targets=task",)
    said = launched("represent", *flags, *more)
    assert "no actions" in said and "no true rewards" in said and "no unseen" in said
    found = json.loads((out / "results.json").read_text())
    assert found["missing"] == ["actions", "rewards", "test"]
    assert [set(one) for one in found["airl"]] == [{"return"}, {"return"}]
    for name in ("task", "strategy_1", "strategy_2"):
        assert np.isfinite(found["rewards"][name]["pearson_noisy"])
        assert "pearson_test" not in found["rewards"][name]
    assert np.isfinite(found["policies"]["task"]["return_final"])
    assert "ratio_to_demonstrators" not in found["policies"]["task"]
    page = (out / "report.html").read_text()
    assert "no true rewards" in page and "not finished" not in page
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert not {"demo_return", "pearson_test"} & {line["quantity"] for line in lines}
    judged = launched("evaluate", f"--run={out}", "--episodes=2")
    assert "No trajectories" in judged and "Strategy 2" in judged and "Pearson" not in judged


@pytest.fixture
def quick_compilation():
    """Programs that run once: their time is the compiler's."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.mark.usefixtures("quick_compilation")
def test_a_minari_round_trip_gives_the_same_learned_reward(tmp_path, env, shown, monkeypatch):
    pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    formats.write("minari", "pendulum/mine-v0", shown)
    again = formats.read("minari", ["pendulum/mine-v0"])
    obs = np.random.default_rng(0).normal(size=(20, env.observation_size)).astype(np.float32)
    config = make_config("smoke", ENV)
    method = find_method("represent")
    learned = []
    for i, data in enumerate((shown, again)):
        problem = make_problem(config, env, data)
        stages = [one for one in method.plan(config, problem) if not one.reports]
        with RunDirectory(tmp_path / f"run_{i}") as directory:
            execute(config, problem, stages, directory, until="regression")
            rewards = method.load_rewards(config, env, directory)
        learned.append({name: np.asarray(of(obs, None, obs)) for name, of in rewards.items()})
    assert set(learned[0]) == {"task", "strategy_1", "strategy_2"}
    for name, values in learned[0].items():
        assert values.std() > 0
        np.testing.assert_array_equal(values, learned[1][name])
