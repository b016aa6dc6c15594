"""The verdicts at their thresholds."""

import numpy as np
import pytest

from represent_jax.report import diagnostics
from represent_jax.report.diagnostics import FAIR, GOOD, POOR


def test_a_good_run_is_good_throughout(results, learning):
    verdicts = diagnostics.verdicts(results, learning, np.full(20, 0.2))
    assert [verdict.level for verdict in verdicts] == [GOOD] * 9
    assert all(verdict.sentence.startswith("Yes") for verdict in verdicts)


def test_stages_without_results_get_no_verdict(results):
    assert diagnostics.verdicts({}, {}) == []
    early = {key: results[key] for key in ("demonstrators", "airl", "curve")}
    assert len(diagnostics.verdicts(early, {})) == 2


@pytest.mark.parametrize(("reached", "level"), [(1100.0, GOOD), (900.0, FAIR), (800.0, POOR)])
def test_imitation_is_as_good_as_its_worst_strategy(results, reached, level):
    results["airl"][0]["return"] = reached
    verdict = diagnostics.imitation(results)
    assert verdict.level == level
    assert verdict.details[0] == f"Strategy 1: {reached / 12:.0f} % of the demonstrator's return"


def test_imitation_of_negative_returns(results):
    results["demonstrators"][0]["return_mean"] = -100.0
    results["airl"][0]["return"] = -105.0
    assert diagnostics.imitation(results).level == GOOD
    results["airl"][0]["return"] = -200.0
    assert diagnostics.imitation(results).level == POOR


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({"r2": 0.6}, FAIR),
        ({"status": "max_iterations"}, GOOD),
        ({"status": "not_falling", "r2": 0.1}, POOR),
        ({"status": "non_finite", "r2": None}, POOR),
        ({"status": "of a later version"}, POOR),
    ],
)
def test_noise_curve(results, changes, level):
    results["curve"][1] = results["curve"][1] | changes
    assert diagnostics.noise_curve(results).level == level


@pytest.mark.parametrize(("last", "level"), [(1.0, GOOD), (0.91, GOOD), (0.89, FAIR), (1.5, GOOD)])
def test_the_floor_of_a_loss_is_where_it_stops_to_fall(last, level):
    losses = np.concatenate([np.linspace(5.0, 1.0, 12), np.ones(4), np.full(4, last)])
    assert diagnostics.floor(losses).level == level
    assert diagnostics.floor(losses[:4]) is None


@pytest.mark.parametrize(
    ("learned", "level"),
    [((1, 2, 3), GOOD), ((1, 3, 2.8), GOOD), ((1, 3, 2), FAIR), ((3, 2, 1), POOR)],
)
def test_what_agents_are_for_is_their_own_reward(learned, level):
    curve = {"learned_return": np.asarray(learned), "true_return": np.zeros(3)}
    assert diagnostics.maximised({"task": curve}).level == level
    assert diagnostics.maximised({"task": {"learned_return": np.ones(2)}}) is None


@pytest.mark.parametrize(("share", "level"), [(0.85, GOOD), (0.7, FAIR), (0.5, POOR)])
def test_how_much_of_the_task_is_the_task_rewards(results, share, level):
    results["rewards"]["strategy_2"] = {"task_share": share}
    verdict = diagnostics.sharing(results)
    assert verdict.level == level
    assert verdict.details[-1].startswith(f"Strategy 2: {100 * share:.0f} %")


def test_rewards_without_a_shared_part_are_not_asked_for_it(results):
    results["rewards"] = {"task": {"pearson_test": 0.9}}
    assert diagnostics.sharing(results) is None


def test_correlations(results):
    results["rewards"]["strategy_2"] = {"pearson_test": 0.8, "pearson_above_demonstrators": None}
    assert diagnostics.unseen(results).level == FAIR
    assert "Strategy 2: r = 0.80" in diagnostics.unseen(results).details
    assert diagnostics.extrapolation(results).level == GOOD
    assert len(diagnostics.extrapolation(results).details) == 2


@pytest.mark.parametrize(("final", "level"), [(1601.0, GOOD), (1500.0, FAIR), (1300.0, POOR)])
def test_policies_against_their_demonstrators(results, final, level):
    results["policies"]["task"] = {"return_final": final}
    assert diagnostics.improvement(results).level == level


def test_a_policy_that_exploits_the_reward_is_found_out(results, learning):
    rising = np.linspace(0.0, 10.0, 11)
    fooled = {"env_steps": rising, "true_return": 2000 - 100 * rising, "learned_return": rising}
    verdict = diagnostics.path(results, learning | {"strategy_1": fooled})
    assert verdict.level == POOR
    assert "r = -1.00" in verdict.details[1] or "r = -1.000" in verdict.details[1]


def test_a_path_too_short_to_judge_is_not_judged(results, learning):
    short = {name: values[:2] for name, values in learning["task"].items()}
    assert diagnostics.path(results, {"task": short}) is None
