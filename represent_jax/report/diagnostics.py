"""Verdicts on a run: each stage's question, answered in a sentence from the run's own numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from represent_jax.report.tables import demonstrator_levels, groups, targets
from represent_jax.report.values import display_name, format_correlation, format_number, pearson
from represent_jax.stages.curve import CurveStatus, describe

GOOD, FAIR, POOR = "good", "fair", "poor"

_RANK = (GOOD, FAIR, POOR)


class Verdict(NamedTuple):
    """The answer to one question about a run.

    Attributes:
        question: what is asked.
        level: GOOD, FAIR or POOR.
        sentence: the answer in plain words.
        details: a line for each target.
    """

    question: str
    level: str
    sentence: str
    details: tuple[str, ...]


def verdicts(
    results: Mapping[str, Any],
    learning_curves: Mapping[str, Mapping[str, np.ndarray]],
    losses: Sequence[float] | np.ndarray = (),
) -> list[Verdict]:
    """Returns the verdicts that the stages done so far allow, in the order of the stages.

    Args:
        results: what results.json holds.
        learning_curves: by target, "env_steps", "true_return" and "learned_return" [num_evals].
        losses: the regression's loss while it was trained, at equal distances [num_logs].
    """
    found = [
        imitation(results),
        noise_curve(results),
        floor(losses),
        sharing(results),
        unseen(results),
        extrapolation(results),
        improvement(results),
        maximised(learning_curves),
        path(results, learning_curves),
    ]
    return [verdict for verdict in found if verdict is not None]


def imitation(results: Mapping[str, Any]) -> Verdict | None:
    """Is the imitation at the demonstrator's level? Good from 90 % on, as the levels are shares."""
    levels = demonstrator_levels(results)
    shares = {}
    for target, one in zip(groups(results), results.get("airl") or (), strict=False):
        if target in levels and one.get("return") is not None:
            shares[target] = _share(one["return"], levels[target][0])
    shares = {target: share for target, share in shares.items() if math.isfinite(share)}
    sentences = {
        GOOD: "Yes: Phase 1 imitates every demonstrator.",
        FAIR: "Nearly: at least one imitation falls a little short, so its noise curve starts "
        "below the demonstrations.",
        POOR: "No: at least one imitation stays far below its demonstrator. Its reward, and the "
        "noise curve built on it, are not to be trusted; give Phase 1 more steps.",
    }
    details = {
        t: f"{100 * share:.0f} % of the demonstrator's return" for t, share in shares.items()
    }
    for target, one in zip(groups(results), results.get("airl") or (), strict=False):
        if target in details and one.get("pearson_test") is not None:
            known = format_correlation(one["pearson_test"])
            details[target] += f"; its reward's r on unseen trajectories {known}"
    levels_found = {t: _grade(share, 0.9, 0.7) for t, share in shares.items()}
    return _verdict(
        "Is the imitation at the demonstrator's level?", levels_found, sentences, details
    )


def noise_curve(results: Mapping[str, Any]) -> Verdict | None:
    """Does the return fall with noise, along a sigmoid?"""
    graded, details = {}, {}
    for target, curve in zip(groups(results), results.get("curve") or (), strict=False):
        status = str(curve.get("status", "non_finite")).upper()
        status = CurveStatus[status] if status in CurveStatus.__members__ else None
        r2 = curve.get("r2")
        details[target] = "status not known" if status is None else describe(status)
        if r2 is not None:
            details[target] += f" (R\N{SUPERSCRIPT TWO} = {r2:.2f})"
        if status in (CurveStatus.CONVERGED, CurveStatus.MAX_ITERATIONS):
            graded[target] = GOOD if (r2 or 0.0) >= 0.8 else FAIR
        else:
            graded[target] = POOR
    sentences = {
        GOOD: "Yes: more noise means less return, and the sigmoid follows it closely.",
        FAIR: "It falls, but with much scatter around the sigmoid: the targets of the regression "
        "are uncertain. More rollouts a level would help.",
        POOR: "No: for at least one strategy noise does not lower the imitation reward's return "
        "along a sigmoid, so the ranking that Phase 3 learns from is weak.",
    }
    return _verdict("Does the noise curve fall, and fit?", graded, sentences, details)


def floor(losses: Sequence[float] | np.ndarray) -> Verdict | None:
    """Is the regression's loss at its floor? The last fifth of the updates against that before."""
    fifth = len(losses) // 5
    if not fifth:
        return None
    last, before = np.mean(losses[-fifth:]), np.mean(losses[-2 * fifth : -fifth])
    falls = float(1.0 - last / before) if before > 0.0 else 0.0
    if not math.isfinite(falls):
        return None
    graded = {"loss": GOOD if falls < 0.1 else FAIR}
    sentences = {
        GOOD: "Yes: the last fifth of the updates hardly changed it.",
        FAIR: "Not quite: it still fell in the last fifth of the updates. A lower loss need not "
        "rank unseen trajectories better; compare with more regression.num_updates.",
    }
    details = {"loss": f"{last:.3g} in the last fifth of the updates, {before:.3g} in that before"}
    return _verdict("Is the regression's loss at its floor?", graded, sentences, details)


def sharing(results: Mapping[str, Any]) -> Verdict | None:
    """Does the task reward hold what the strategies share? Needs no true return."""
    shares = _of_rewards(results, "task_share")
    sentences = {
        GOOD: "Yes: R\N{SUPERSCRIPT ZERO} explains the noisy rollouts, the strategies' own rewards "
        "add what is theirs.",
        FAIR: "Mostly: a strategy's own reward also holds some of the task, so it may judge other "
        "styles too low. A larger regression.lambda_reg leaves more to R\N{SUPERSCRIPT ZERO}.",
        POOR: "No: a strategy's own reward holds as much of the task as R\N{SUPERSCRIPT ZERO}, and "
        "judges other styles too low. Raise regression.lambda_reg.",
    }
    graded = {t: _grade(share, 0.8, 0.6) for t, share in shares.items()}
    details = {
        t: f"{100 * share:.0f} % of what its reward knows of its noisy rollouts"
        for t, share in shares.items()
    }
    return _verdict("Does the task reward hold what is shared?", graded, sentences, details)


def unseen(results: Mapping[str, Any]) -> Verdict | None:
    """Does the learned reward rank unseen trajectories?"""
    return _correlations(
        results,
        "pearson_test",
        "Does each reward rank unseen trajectories?",
        (0.9, 0.7),
        {
            GOOD: "Yes: learned and true return agree on trajectories the rewards never saw.",
            FAIR: "Mostly: the learned return follows the true one, with clear exceptions.",
            POOR: "No: at least one reward says little about the true return of unseen "
            "trajectories.",
        },
    )


def extrapolation(results: Mapping[str, Any]) -> Verdict | None:
    """Does the learned reward still rank trajectories better than all demonstrators?"""
    return _correlations(
        results,
        "pearson_above_demonstrators",
        "Does it still hold above the demonstrators?",
        (0.7, 0.3),
        {
            GOOD: "Yes: among trajectories better than every demonstrator, the better one still "
            "gets the higher learned return. This is what lets a policy surpass them.",
            FAIR: "Partly: above the demonstrators at least one reward orders trajectories only "
            "roughly.",
            POOR: "No: above the demonstrators at least one reward no longer tells better from "
            "worse, so its policy may stop improving there.",
        },
    )


def improvement(results: Mapping[str, Any]) -> Verdict | None:
    """Do the policies surpass the demonstrators?"""
    levels = demonstrator_levels(results)
    graded, details = {}, {}
    for target, policy in (results.get("policies") or {}).items():
        final = (policy or {}).get("return_final")
        if final is None or target not in levels:
            continue
        mean, best = levels[target]
        graded[target] = GOOD if final > best else FAIR if final > mean else POOR
        details[target] = (
            f"{format_number(final)}, demonstrators' mean {format_number(mean)}, "
            f"best demonstrator {format_number(best)}"
        )
    sentences = {
        GOOD: "Yes: every policy is better than the best demonstrator.",
        FAIR: "Yes, but not all of them are better than the best demonstrator too.",
        POOR: "No: at least one policy is below its demonstrators.",
    }
    return _verdict("Do the policies surpass the demonstrators?", graded, sentences, details)


def maximised(learning_curves: Mapping[str, Mapping[str, np.ndarray]]) -> Verdict | None:
    """Do the agents maximise the rewards they are given, whatever these are worth?"""
    graded, details = {}, {}
    for target, curve in learning_curves.items():
        learned = np.asarray(curve["learned_return"], np.float64)
        if len(learned) < 3 or not np.isfinite(learned).all():
            continue
        first, last, best = learned[0], learned[-1], float(np.max(learned))
        graded[target] = POOR if best <= first else GOOD if _share(last, best) >= 0.9 else FAIR
        details[target] = (
            f"learned return {format_number(first)} at the first evaluation, "
            f"{format_number(best)} at best, {format_number(last)} at the last"
        )
    sentences = {
        GOOD: "Yes: the learned return rises, and stays up.",
        FAIR: "Partly: it rises and falls again, so the policy kept is from before the end. A "
        "smaller step size, or a larger policies.sac.prior_weight, steadies it.",
        POOR: "No: for at least one reward no policy is better than the first one evaluated. Look "
        "at the critics' loss in the log.",
    }
    return _verdict("Do the agents maximise their rewards?", graded, sentences, details)


def path(
    results: Mapping[str, Any], learning_curves: Mapping[str, Mapping[str, np.ndarray]]
) -> Verdict | None:
    """Do learned and true return move together while the policies improve?"""
    graded, details = {}, {}
    for target in targets(results):
        curve = learning_curves.get(target)
        if curve is None or len(curve["true_return"]) < 3:
            continue
        true = np.asarray(curve["true_return"], np.float64)
        together = pearson(true, curve["learned_return"])
        kept = _share(true[-1], float(np.max(true)))
        if not (math.isfinite(together) and math.isfinite(kept)):
            continue
        graded[target] = _worst([_grade(together, 0.8, 0.5), _grade(kept, 0.9, 0.7)])
        details[target] = (
            f"r = {format_correlation(together)} along the path; "
            f"the last policy has {100 * kept:.0f} % of the best one's true return"
        )
    sentences = {
        GOOD: "Yes: as the policies raise the learned return, the true return rises with it.",
        FAIR: "Mostly: at times the learned return rises without the true one.",
        POOR: "No: a policy raised the learned return while the true one stayed or fell: it "
        "exploits an error of the reward.",
    }
    return _verdict("Do both returns rise together during training?", graded, sentences, details)


def _correlations(
    results: Mapping[str, Any],
    key: str,
    question: str,
    bounds: tuple[float, float],
    sentences: Mapping[str, str],
) -> Verdict | None:
    values = _of_rewards(results, key)
    graded = {t: _grade(v, *bounds) for t, v in values.items()}
    details = {t: f"r = {format_correlation(v)}" for t, v in values.items()}
    return _verdict(question, graded, sentences, details)


def _of_rewards(results: Mapping[str, Any], key: str) -> dict[str, float]:
    """Returns what is known of each reward, by target."""
    rewards = results.get("rewards") or {}
    values = {t: rewards[t].get(key) for t in targets(results) if rewards.get(t)}
    return {t: v for t, v in values.items() if v is not None and math.isfinite(v)}


def _verdict(
    question: str,
    graded: Mapping[str, str],
    sentences: Mapping[str, str],
    details: Mapping[str, str],
) -> Verdict | None:
    if not graded:
        return None
    level = _worst(graded.values())
    lines = tuple(f"{display_name(target)}: {text}" for target, text in details.items())
    return Verdict(question, level, sentences[level], lines)


def _share(value: float, reference: float) -> float:
    """Returns value / reference, and what corresponds to it where the reference is negative."""
    return 1.0 + (value - reference) / abs(reference) if reference else float("nan")


def _grade(value: float, good: float, fair: float) -> str:
    return GOOD if value >= good else FAIR if value >= fair else POOR


def _worst(levels: Iterable[str]) -> str:
    return max(levels, key=_RANK.index)
