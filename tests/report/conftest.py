"""A finished run of two strategies, made up."""

import json

import numpy as np
import pytest

LEVELS = [0.05 * i for i in range(20)]
TARGETS = ("task", "strategy_1", "strategy_2")


@pytest.fixture
def results():
    eta = np.array(LEVELS)
    fitted = 1.0 / (1.0 + np.exp(8.0 * (eta - 0.45)))
    curve = {
        **{"x0": 0.45, "y0": 0.0, "c": 1.0, "k": -8.0, "r2": 0.97, "status": "converged"},
        **{"levels": LEVELS, "returns": fitted.tolist(), "fitted": fitted.tolist()},
    }
    reward = {
        **{"pearson_test": 0.97, "spearman_test": 0.95, "pearson_noisy": 0.93},
        **{"pearson_pooled": 0.962, "pearson_above_demonstrators": 0.81},
    }
    policy = {
        **{"return_final": 3100.0, "return_best": 3350.0, "learned_return_final": 12.3},
        **{"ratio_to_demonstrators": 2.22, "style_kept": 0.87},
    }
    return {
        **{"env": "half_cheetah", "preset": "quick", "seed": 0, "backend": "mujoco"},
        "strategies": 2,
        "targets": list(TARGETS),
        "seconds": {"airl": 183.2, "noise": 4.1},
        "peak_memory_gib": 2.31,
        "demonstrators": [
            {"name": "strategy_1", "return_mean": 1200.0, "return_std": 12.0, "num": 4},
            {"name": "strategy_2", "return_mean": 1600.0, "return_std": 25.5, "num": 4},
        ],
        "airl": [{"return": 1150.0, "ratio": 0.958}, {"return": 1590.0, "ratio": 0.994}],
        "curve": [curve, curve],
        "rewards": {target: reward | {"task_share": 0.95} for target in TARGETS[1:]}
        | {"task": reward},
        "policies": {target: policy for target in TARGETS}
        | {"task": policy | {"style_kept": None}},
    }


@pytest.fixture
def points():
    """By target and group, true and learned returns [n]."""
    random = np.random.default_rng(0)

    def group(low, high, num):
        true = random.uniform(low, high, num)
        return true, 0.003 * true + random.normal(scale=0.3, size=num)

    return {
        target: {
            "noisy_1": group(-300, 1200, 30),
            "noisy_2": group(-300, 1600, 30),
            "test": group(-400, 4000, 40),
            "demonstrations": group(1200, 1600, 8),
        }
        for target in TARGETS
    }


@pytest.fixture
def learning():
    steps = np.linspace(0, 500_000, 11)
    true = 1300.0 + 0.004 * steps
    curve = {"env_steps": steps, "true_return": true, "learned_return": 0.003 * true}
    return {target: curve for target in TARGETS}


@pytest.fixture
def run_path(tmp_path, results, points, learning):
    config = {"env": "half_cheetah", "preset": "quick", "seed": 0, "airl": {"learning_rate": 1e-3}}
    write_json(tmp_path / "config.json", {"format_version": 1, "config": config})
    write_json(tmp_path / "results.json", results)
    (tmp_path / "arrays").mkdir()
    pairs = [(t, g, pair) for t, groups in points.items() for g, pair in groups.items()]
    scatter = {f"{t}/{g}/true": pair[0] for t, g, pair in pairs}
    scatter |= {f"{t}/{g}/learned": pair[1] for t, g, pair in pairs}
    np.savez(tmp_path / "arrays" / "scatter.npz", **scatter)
    curves = {f"{t}/{name}": values for t, c in learning.items() for name, values in c.items()}
    np.savez(tmp_path / "arrays" / "learning_curves.npz", **curves)
    return tmp_path


def write_json(path, value):
    path.write_text(json.dumps(value))
