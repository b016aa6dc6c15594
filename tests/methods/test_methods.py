"""Every method from demonstrations to what it returns, with tiny budgets."""

import json
import re
import subprocess
import sys
import types

import jax
import numpy as np
import pytest
from launcher import ROOT, finish, launch, log_of, results_of

import represent_jax as rj
from represent_jax import runs
from represent_jax.config import apply_overrides
from represent_jax.errors import RepresentError, UsageError
from represent_jax.methods.presets import make_config
from represent_jax.methods.registry import METHODS, find_method, register_method


def test_a_method_is_found_by_its_place(monkeypatch):
    module = types.ModuleType("my_methods")
    module.MINE, module.number = METHODS["ssrr"], 3
    monkeypatch.setitem(sys.modules, "my_methods", module)
    assert find_method("my_methods:MINE") is METHODS["ssrr"]
    with pytest.raises(UsageError, match=r"expected a methods\.registry\.Method, found 3"):
        find_method("my_methods:number")
    with pytest.raises(UsageError, match="has no attribute 'other'"):
        find_method("my_methods:other")
    with pytest.raises(UsageError, match="'ssrr' is already registered"):
        register_method(METHODS["bc"], "ssrr")


def test_represent_in_pure_xla(tmp_path):
    """Phases 1 to 3 on MJX; policies have Phase 1's agent, which compiles as long once more."""
    flags = ("--env=inverted_double_pendulum", "--backend=mjx", "--until=reward_evaluation")
    finish(launch(tmp_path / "xla", *flags))
    rewards = runs.RunDirectory(tmp_path / "xla").load_findings("reward_evaluation")["rewards"]
    assert set(rewards) == {"task", "strategy_1", "strategy_2"}
    assert all(np.isfinite(one["pearson_noisy"]) for one in rewards.values())
    stages = {line["stage"] for line in log_of(tmp_path / "xla")}
    assert stages == {"airl", "regression", "clock"}


def test_ssrr_on_one_strategy_with_ppo_throughout(tmp_path):
    out, record = tmp_path / "alone", tmp_path / "records.jsonl"
    overrides = ("grouping=strategy_2", "airl.agent=ppo", "policies.agent=ppo")
    flags = [f"--override={one}" for one in overrides]
    finish(launch(out, "--method=ssrr", "--backend=mujoco", f"--record={record}", *flags))
    assert set(results_of(out)["policies"]) == {"strategy_2"}
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert {line["method"] for line in lines} == {"ssrr"}
    assert {line["target"] for line in lines} == {"strategy_2"}
    obs, action = np.zeros((3, 17), np.float32), np.zeros((3, 6), np.float32)
    assert rj.load_reward(out)(obs, action, obs, "strategy_2").shape == (3,)
    assert rj.load_policy(out, "strategy_2")(obs).shape == (3, 6)
    keyed = rj.load_policy(out, "strategy_2")(obs, jax.random.PRNGKey(0))
    assert keyed.shape == (3, 6)


def test_a_policy_for_some_of_the_targets(tmp_path):
    out = tmp_path / "task_only"
    overrides = ("policy_targets=task", "num_strategies=1")
    flags = [f"--override={one}" for one in overrides]
    finish(launch(out, "--backend=mujoco", "--env=inverted_double_pendulum", *flags))
    results = results_of(out)
    assert set(results["rewards"]) == {"task", "strategy_1"}
    assert set(results["policies"]) == {"task"}
    obs = np.zeros((3, 11), np.float32)
    assert rj.load_policy(out)(obs).shape == (3, 1)
    with pytest.raises(UsageError, match="task"):
        rj.load_policy(out, "strategy_1")


@pytest.mark.parametrize(
    ("method", "override", "message"),
    [
        (
            "drex",
            "preference.min_level_gap=0.99",
            "highest noise level (0.95), found 0.99",
        ),
        ("drex", "grouping=separate", "expected 'merged' or one strategy, found 'separate'"),
        ("msrd", "grouping=merged", "expected 'separate', found 'merged'"),
        ("bc", "population=both", "expected one of auto, threads, vmap, found 'both'"),
        ("represent", "grouping=all", "strategy_1, strategy_2, found 'all'"),
    ],
)
def test_settings_that_no_stage_could_use_are_refused_at_once(method, override, message):
    with pytest.raises(UsageError, match=f"^{override.split('=')[0]}: .*{re.escape(message)}$"):
        apply_overrides(make_config("quick", "half_cheetah", method), [override])


@pytest.mark.parametrize("method", ["drex", "msrd", "airl", "noisy_airl", "bc", "bc_rnn"])
def test_baselines_run_to_their_end(tmp_path, method):
    record = tmp_path / "records.jsonl"
    out = tmp_path / method
    finish(launch(out, f"--method={method}", "--backend=mujoco", f"--record={record}"))
    results = results_of(out)
    finals = [policy["return_final"] for policy in results["policies"].values()]
    assert finals and np.isfinite(finals).all()
    lines = [json.loads(line) for line in record.read_text().splitlines()]
    assert {line["method"] for line in lines} == {method}
    obs, action = np.zeros((3, 17), np.float32), np.zeros((3, 6), np.float32)
    if method.startswith("bc"):
        with pytest.raises(RepresentError, match="no reward"):
            rj.load_reward(out)
    else:
        for target in results["rewards"]:
            assert rj.load_reward(out)(obs, action, obs, target=target).shape == (3,)
    if method == "bc_rnn":
        with pytest.raises(RepresentError, match="hidden state"):
            rj.load_policy(out)
        return
    for target in results["policies"]:
        assert rj.load_policy(out, target)(obs).shape == (3, 6)

    if method in ("msrd", "bc"):
        command = [sys.executable, "-m", "experiments.evaluate", f"--run={out}", "--episodes=2"]
        said = subprocess.check_output([*command, "--backend=mujoco"], cwd=ROOT, text=True)
        rows = {line.split()[0]: line.split()[-6:] for line in said.splitlines() if line.split()}
        # Whether correlations, true and learned returns are known: MSRD has no policy of the
        # task's, a clone no reward.
        known = {
            "msrd": {"Task": [True, False, False], "Strategy": [True, True, True]},
            "bc": {"Task": [False, True, False]},
        }
        for name, expected in known[method].items():
            assert ["-" not in rows[name][i : i + 2] for i in (0, 2, 4)] == expected, said
