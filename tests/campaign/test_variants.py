"""What a campaign runs, and what its runs share."""

import dataclasses

import numpy as np
import pytest

from represent_jax.campaign.entries import entries
from represent_jax.campaign.variants import TABLES, VARIANTS, runs_of
from represent_jax.data.catalogue import load_demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import UsageError
from represent_jax.methods.config import make_problem
from represent_jax.methods.plan import Stage, execute, nodes, stage_key
from represent_jax.methods.registry import find_method
from represent_jax.methods.results import describe
from represent_jax.runs import open_run


def test_runs_of_tables_are_their_union():
    wanted = runs_of(["1", "2"], ["hopper"])
    assert set(wanted) == {"hopper"}
    assert set(wanted["hopper"]) == {*TABLES["1"].until, *TABLES["2"].until}
    assert wanted["hopper"]["represent"] == ("reward_evaluation", "policy_evaluation")
    assert wanted["hopper"]["bc"] == ("policy_evaluation",)
    # Table III speaks of Hopper alone.
    assert set(runs_of(["1", "3"], ["half_cheetah"])["half_cheetah"]) == set(TABLES["1"].until)
    assert list(runs_of(["1"], ["hopper"], ["msrd"])["hopper"]) == ["msrd"]


@pytest.mark.parametrize(
    ("tables", "domains", "variants", "message"),
    [
        (["11"], ["hopper"], [], "unknown table"),
        (["1"], ["hoper"], [], "hopper"),
        (["1"], ["hopper"], ["ssr"], "ssrr"),
        (["5"], ["half_cheetah"], ["bc"], "do not speak"),
        (["3"], ["half_cheetah"], [], "do not speak"),
    ],
)
def test_unknown_names_are_errors(tables, domains, variants, message):
    with pytest.raises(UsageError, match=message):
        runs_of(tables, domains, variants)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_has_the_stages_that_its_tables_need(variant):
    method = find_method(VARIANTS[variant].method)
    config = VARIANTS[variant].config("smoke", "half_cheetah", ["airl.env_steps=320", "seed=3"])
    assert config.seed == 3 and isinstance(config, method.config)


@pytest.fixture(scope="module")
def hashes():
    """Hash of every stage that some runs need, by run and stage."""
    found = {}
    for seed in (0, 1):
        for entry in entries(["1", "ablations"], ["half_cheetah"], [seed], "smoke"):
            stages = find_method(entry.config.method).plan(entry.config, entry.problem)
            made = nodes(entry.config, entry.problem, stages, "run")
            grouping = entry.config.grouping
            for stage, node in made.items():
                found[entry.variant, grouping, seed, stage] = node.hash
    return found


def test_methods_share_the_stages_that_are_the_same_for_both(hashes):
    own = {stage: value for (*run, stage), value in hashes.items() if run == _run("represent")}
    for variant in ("ssrr", "no_reg", "no_bcd", "shared", "no_sigmoid", "ensemble_1"):
        for stage in ("airl", "airl_evaluation", "noise"):
            assert hashes[*_run(variant), stage] == own[stage]
        for stage in ("regression", "policies", "policy_evaluation"):
            assert hashes[*_run(variant), stage] != own[stage]
        assert (hashes[*_run(variant), "curve"] == own["curve"]) == (variant != "no_sigmoid")
    assert hashes["ssrr", "merged", 0, "airl"] != own["airl"]


def test_every_stage_depends_on_the_seed(hashes):
    for (variant, grouping, seed, stage), value in hashes.items():
        if seed == 0:
            assert value != hashes[variant, grouping, 1, stage]


def test_one_phase_1_serves_all_seeds_under_a_name_of_its_own(hashes):
    overrides = ["phase_1_seed=0"]
    first = ("airl", "airl_evaluation", "noise", "curve")
    (entry,) = entries(["1"], ["half_cheetah"], [1], "smoke", overrides, ["represent"])
    for stage, value in _hashes(entry.config, entry.problem).items():
        seed = 0 if stage in first else 1
        shared = value == hashes[*_run("represent", seed), stage]
        assert shared == (stage in first)
    assert describe(entry.config, entry.problem)["preset"] == "smoke_one_phase_1"
    with pytest.raises(UsageError, match="phase_1_seed"):
        entries(["1"], ["half_cheetah"], [1], "smoke", ["phase_1_seed=-1"])


def test_a_stage_draws_from_the_seed_that_it_is_found_by(tmp_path):
    config = VARIANTS["represent"].config("smoke", "half_cheetah", ["seed=1", "phase_1_seed=5"])
    drawn = []

    def draw(key, directory, *_):
        drawn.append(key)
        return {}

    stages = (Stage("airl", draw, before_rewards=True), Stage("regression", draw, ("airl",)))
    problem = make_problem(
        config, make_env("half_cheetah", "mujoco"), load_demonstrations("half_cheetah")
    )
    with open_run(tmp_path, {}) as run:
        execute(config, problem, stages, run)
    assert np.array_equal(drawn, [stage_key(5, "airl"), stage_key(1, "regression")])


def _run(variant, seed=0):
    return [variant, "separate", seed]


def test_policies_of_some_targets_share_all_that_comes_before():
    (whole,) = entries(["2"], ["half_cheetah"], [0], "smoke", variants=["represent"])
    (part,) = entries(
        ["2"], ["half_cheetah"], [0], "smoke", ["policy_targets=task"], variants=["represent"]
    )
    assert whole.reports["reward_evaluation"].hash == part.reports["reward_evaluation"].hash
    assert whole.reports["policy_evaluation"].hash != part.reports["policy_evaluation"].hash
    with pytest.raises(UsageError, match="strategy_1"):
        VARIANTS["represent"].config("smoke", "hopper", ["policy_targets=strategy1"])


def test_a_variant_stays_what_it_is_and_no_setting_is_dropped_in_silence():
    overrides = ["regression.lambda_reg=0.3", "msrd.batch_size=9"]
    config = VARIANTS["no_reg"].config("smoke", "hopper", overrides)
    assert config.regression.lambda_reg == 0.0
    assert VARIANTS["represent"].config("smoke", "hopper", overrides).regression.lambda_reg == 0.3
    with pytest.raises(UsageError, match="unknown setting 'regresion': did you mean regression"):
        VARIANTS["represent"].config("smoke", "hopper", ["regresion.lambda_reg=9"])


def _hashes(config, problem):
    stages = find_method(config.method).plan(config, problem)
    return {stage: node.hash for stage, node in nodes(config, problem, stages, "run").items()}


def test_a_raised_revision_renews_a_stage_and_what_lies_behind_it():
    config = VARIANTS["represent"].config("smoke", "half_cheetah")
    problem = make_problem(
        config, make_env("half_cheetah", "mujoco"), load_demonstrations("half_cheetah")
    )
    stages = find_method("represent").plan(config, problem)
    raised = [
        dataclasses.replace(stage, revision=2) if stage.name == "regression" else stage
        for stage in stages
    ]
    before, after = (nodes(config, problem, each, "run") for each in (stages, raised))
    same = {name for name in before if before[name].hash == after[name].hash}
    assert same == {"airl", "airl_evaluation", "noise", "curve"}


def test_judges_and_recurrent_clones_depend_on_pauses_and_other_stages_do_not():
    env = make_env("half_cheetah", "mujoco")
    shown = load_demonstrations("half_cheetah")
    moving, paused = (
        dataclasses.replace(shown, trajectories=tuple(_beginning(t, n) for t in shown.trajectories))
        for n in (0, 1)
    )
    for variant, same in (
        ("represent", {"airl", "noise", "curve", "regression", "policies", "selection"}),
        ("bc_rnn", set()),
    ):
        config = VARIANTS[variant].config("smoke", "half_cheetah", ["least_change=1e-6"])
        config = dataclasses.replace(config, horizon=40)
        before, after = (
            _hashes(config, make_problem(config, env, one)) for one in (moving, paused)
        )
        assert {stage for stage in before if before[stage] == after[stage]} == same


def _beginning(t, num_pauses):
    """The first 30 steps, after steps in which nothing moves."""

    def paused(x, num):
        return np.concatenate([*[x[:1]] * num_pauses, x[:num]])

    return dataclasses.replace(
        t, obs=paused(t.obs, 31), actions=paused(t.actions, 30), rewards=paused(t.rewards, 30)
    )


def test_the_same_reward_under_another_name_is_judged_anew():
    env = make_env("half_cheetah", "mujoco")
    shown = load_demonstrations("half_cheetah")
    first, second = (
        VARIANTS[name].config("smoke", "half_cheetah", ["num_strategies=1"])
        for name in ("ssrr", "ssrr_separate")
    )
    first, second = (_hashes(one, make_problem(one, env, shown)) for one in (first, second))
    assert first["airl"] == second["airl"]
    assert first["reward_evaluation"] != second["reward_evaluation"]


def test_a_strategy_alone_keeps_its_name():
    config = VARIANTS["represent"].config("smoke", "half_cheetah", ["grouping=strategy_2"])
    assert config.target_names == config.policy_names == ("task", "strategy_2")
    assert config.group_names == ("strategy_2",)
