"""Stable-Baselines3 on a learned reward: the documentation's page, run as it is printed."""

import numpy as np
import pages
import pytest

import represent_jax as rj

pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.extras


def test_sac_of_stable_baselines3_learns_on_a_learned_reward(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = pages.run_page("train_elsewhere.md")
    buffer, size = page["model"].replay_buffer, page["model"].replay_buffer.pos
    assert size == 150 and page["model"]._n_updates > 0
    obs, next_obs = buffer.observations[:size, 0], buffer.next_observations[:size, 0]
    learned = rj.load_reward("runs/smoke")(obs, buffer.actions[:size, 0], next_obs)
    np.testing.assert_allclose(buffer.rewards[:size, 0], 100.0 * learned, rtol=1e-4, atol=1e-4)
    assert np.isfinite(page["true_return"](page["model"]))
