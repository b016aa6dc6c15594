"""The whole pipeline with tiny budgets: every stage, killed and resumed, and what it leaves."""

import dataclasses
import itertools
import json
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from launcher import ROOT, finish, launch, log_of, results_of

import represent_jax as rj
from represent_jax.config import apply_overrides
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods import represent
from represent_jax.methods.config import make_problem
from represent_jax.methods.pipeline import transitions
from represent_jax.methods.presets import make_config
from represent_jax.stages import policies

PENDULUM = ("--env=inverted_double_pendulum", "--backend=mujoco")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def finished(tmp_path_factory, cache):
    """A whole run, from demonstrations to policies."""
    out = tmp_path_factory.mktemp("run") / "whole"
    record = out.parent / "records.jsonl"
    output = finish(launch(out, *PENDULUM, f"--record={record}", cache=cache))
    return out, record, output


def test_run_directory_has_everything(finished):
    out, record, output = finished
    for name in ("config.json", "metrics.jsonl", "results.json", "report.html"):
        assert (out / name).stat().st_size > 0
    assert list((out / "tensorboard").rglob("events*"))
    results = results_of(out)
    assert set(results["policies"]) == {"task", "strategy_1", "strategy_2"}
    assert set(results["rewards"]) == {"task", "strategy_1", "strategy_2"}
    assert "report:" in output
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert {"pearson_test", "return_final", "demo_return"} <= {line["quantity"] for line in lines}
    assert all(line["commit"] and line["versions"] for line in lines)


def test_selection_hands_on_what_earns_most(finished):
    out, _, _ = finished
    selection = results_of(out)["selection"]
    assert set(selection) == {"task", "strategy_1", "strategy_2"}
    earned = selection["task"]["learned_returns"]
    assert earned[selection["task"]["trained_for"]] == max(earned.values())
    obs = np.linspace(-1.0, 1.0, 33, dtype=np.float32).reshape(3, 11)
    of, actions = {}, {}
    for name, found in selection.items():
        of[name], actions[name] = found["trained_for"], rj.load_policy(out, name)(obs)
    for a, b in itertools.combinations(selection, 2):
        assert np.array_equal(actions[a], actions[b]) == (of[a] == of[b])


def test_killed_at_three_points_and_resumed_ends_in_the_same_results(finished, cache, tmp_path):
    whole, _, _ = finished
    out = tmp_path / "killed"
    flags = (*PENDULUM, "--resume", "--checkpoint_seconds=0")
    for stage in ("airl", "regression", "policies"):
        process = launch(out, *flags, cache=cache)
        deadline = time.monotonic() + 300
        progress = out / "checkpoints" / stage / "progress"
        while process.poll() is None and time.monotonic() < deadline:
            if progress.exists() and list(progress.glob("[0-9]*")):
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL, f"{stage} ended before it was killed"
    finish(launch(out, *flags, cache=cache))
    assert results_of(out) == results_of(whole)
    steps = [line["step"] for line in log_of(out) if line["stage"] == "policies"]
    assert steps == sorted(set(steps))


def test_a_run_can_stop_behind_a_stage(tmp_path):
    out = tmp_path / "part"
    output = finish(launch(out, "--backend=mujoco", "--env=hopper", "--until=noise"))
    assert "done until noise" in output
    assert not (out / "results.json").exists()
    assert {line["stage"] for line in log_of(out)} == {"airl", "clock"}


def test_merged_demonstrations_are_those_of_one_strategy():
    config = make_config("smoke", "half_cheetah", "ssrr")
    env = rj.make_env("half_cheetah", "mujoco")
    shipped = rj.load_demonstrations("half_cheetah")
    test = rj.load_demonstrations("half_cheetah_test")
    merged = make_problem(config, env, shipped, test).demonstrations
    alone = dataclasses.replace(config, grouping="strategy_2")
    alone = make_problem(alone, env, shipped, test).demonstrations
    assert merged.num_strategies == alone.num_strategies == 1
    counts = [len(shipped.of_strategy(i)) for i in range(2)]
    assert len(merged.trajectories) == sum(counts) and len(alone.trajectories) == counts[1]
    assert config.target_names == ("task",)


def test_a_stage_that_there_is_not_leaves_no_folder(tmp_path):
    config = make_config("smoke", "half_cheetah")
    with pytest.raises(UsageError, match="did you mean regression"):
        rj.learn(
            tmp_path / "run", config, rj.load_demonstrations("half_cheetah"), until="regresion"
        )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("grouping", "groups"),
    [("separate", ({0}, {1})), ("merged", ({0, 1},)), ("strategy_2", ({1},))],
)
def test_floors_are_what_the_demonstrators_of_each_target_earn_of_the_task(grouping, groups):
    config = dataclasses.replace(make_config("smoke", "half_cheetah"), grouping=grouping)
    env = rj.make_env("half_cheetah", "mujoco")
    shipped = rj.load_demonstrations("half_cheetah")
    problem = make_problem(config, env, shipped, shipped)

    def first_entry(params, obs_t, action_t, next_obs_t):
        return next_obs_t[..., 0]

    floors = represent.task_floors(config, problem, first_entry, ())
    end = problem.env.horizon + 1
    expected = [
        np.mean([np.sum(t.obs[1:end, 0]) for t in shipped.trajectories if t.strategy in group])
        for group in groups
    ]
    assert floors[0] == -np.inf
    np.testing.assert_allclose(floors[1:], expected, rtol=1e-4)


def test_the_tasks_policy_starts_from_a_clone_of_all_demonstrations():
    wide = ("airl.cloning_updates=1_000", "policies.sac.hidden_sizes=64,64")
    wide = (*wide, "airl.sac.hidden_sizes=64,64")
    config = make_config("smoke", "half_cheetah")
    config = apply_overrides(config, ["task_policy.start=clone", *wide])
    shipped = rj.load_demonstrations("half_cheetah")
    env = rj.make_env("half_cheetah", "mujoco")

    def mean_action(sign):
        """Of a clone of those who press one way in strategy 1, and the way of `sign` in others."""
        driven = tuple(
            dataclasses.replace(t, actions=np.full_like(t.actions, 0.5 * sign**t.strategy))
            for t in shipped.trajectories
        )
        driven = dataclasses.replace(shipped, trajectories=driven)
        problem = make_problem(config, env, driven)
        clone = represent.clone_all(jax.random.PRNGKey(0), config, problem)
        obs = transitions(problem.lessons.trajectories).obs_t
        return float(np.mean(policies.act(clone, obs, env.action_size, config.policies)))

    assert mean_action(1) > 0.2 > abs(mean_action(-1))


def test_what_is_different_for_the_task_needs_what_it_is_made_of():
    config = make_config("smoke", "half_cheetah")
    cloned = apply_overrides(config, ["task_policy.start=clone"])
    assert cloned.needs_actions == "task_policy.start=clone"
    cold = apply_overrides(cloned, ["policies.start=cold", "airl.cloning_updates=0"])
    assert not cold.needs_actions
    message = "airl.cloning_updates: expected above 0 where task_policy.start=clone"
    with pytest.raises(UsageError, match=message):
        apply_overrides(cloned, ["airl.cloning_updates=0"])
    with pytest.raises(UsageError, match="which has no prior"):
        apply_overrides(config, ["policies.agent=ppo", "task_policy.prior_half_life=100"])
    with pytest.raises(UsageError, match=r"task_policy.* SSRR has no R\^0"):
        apply_overrides(make_config("smoke", "half_cheetah", "ssrr"), ["task_policy.span=2"])


def test_evaluate_judges_a_finished_run(finished):
    out, _, _ = finished
    command = [sys.executable, "-m", "experiments.evaluate", f"--run={out}", "--backend=mujoco"]
    shown = subprocess.run(
        [*command, "--episodes=2"], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert shown.returncode == 0, shown.stderr
    by_target = {line.split("  ")[0]: line.split() for line in shown.stdout.splitlines()}
    # The run's own test trajectories are cut to its tiny horizon, these are whole.
    test = rj.load_demonstrations("inverted_double_pendulum_test").trajectories
    reward = rj.load_reward(out)
    learned = [float(np.sum(reward(t.obs[:-1], t.actions, t.obs[1:]))) for t in test]
    expected = np.corrcoef([t.total_reward for t in test], learned)[0, 1]
    assert float(by_target["Task"][1]) == pytest.approx(expected, abs=2e-3)
    assert {"Task", "Strategy 1", "Strategy 2"} <= set(by_target)


def test_loaded_reward_and_policy(finished):
    out, _, _ = finished
    reward, policy = rj.load_reward(out), rj.load_policy(out, target="strategy_1")
    env = rj.make_env("inverted_double_pendulum", "mujoco")
    obs = np.zeros((5, env.observation_size), np.float32)
    action = np.zeros((5, env.action_size), np.float32)
    task = reward(obs, action, obs)
    strategy = reward(obs, action, obs, target="strategy_2")
    assert task.shape == (5,) and bool(np.any(task != strategy))
    jitted = jax.jit(jax.vmap(lambda o: reward(o, action[0], o)))(obs)
    np.testing.assert_allclose(jitted, task, rtol=1e-5)
    assert policy(obs).shape == action.shape and float(np.abs(policy(obs)).max()) <= 1.0
    for field, rows in {
        "obs_t": (obs[:-1], action, obs),
        "action_t": (obs, action[:, :0], obs),
        "next_obs_t": (obs, action, obs[:, :5]),
    }.items():
        with pytest.raises(UsageError, match=rf"^{field}: expected an array of shape \(5, \d+\)"):
            reward(*rows)
    with pytest.raises(
        UsageError, match=r"^obs: expected an array of shape \(5, 11\), found \(5, 5\)"
    ):
        policy(obs[:, :5])
    with pytest.raises(UsageError, match="strategy_2"):
        reward(obs, action, obs, target="strategy_3")
    with pytest.raises(UsageError, match="strategy_1"):
        rj.load_policy(out, target="strategy1")


def test_reward_of_an_unfinished_run_is_an_error(tmp_path):
    with pytest.raises(RepresentError):
        rj.load_reward(tmp_path)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--env=halfcheetah", "half_cheetah"),
        ("--preset=smok", "smoke"),
        ("--until=nois", "noise"),
        ("--method=srr", "ssrr"),
        ("--override=grouping=strategy_3", "strategy_2"),
        ("--backend=mjxx", "mjx"),
        ("--override=airl.env_step=10", "airl.env_steps"),
        ("--override=num_strategies=9", "num_strategies"),
        ("--demonstrations=nothing.npz", "nothing.npz"),
    ],
)
def test_bad_usage_is_one_line(tmp_path, flag, message):
    process = launch(tmp_path / "bad", flag)
    output, _ = process.communicate(timeout=120)
    assert process.returncode in (1, 2)
    assert message in output and "Traceback" not in output
