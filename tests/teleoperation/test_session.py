"""Driving, recording, and playing what was recorded."""

import numpy as np
import pytest

from represent_jax.data import Demonstrations, Trajectory, load_demonstrations, save_demonstrations
from represent_jax.envs import make_env
from represent_jax.errors import RepresentError, UsageError
from represent_jax.teleoperation import recordings
from represent_jax.teleoperation.session import Phase, Session

RIGHT, LEFT = frozenset({"arrowright"}), frozenset({"arrowleft"})


@pytest.fixture
def session(env, tmp_path):
    return Session(env, tmp_path / "new" / "mine.npz", seed=3)


def drive(session, held, steps=3):
    session.start()
    for _ in range(steps):
        session.step(held)


def test_an_episode_is_recorded_as_it_was_driven(session):
    drive(session, RIGHT)
    figures = session.figures()
    assert (figures["step"], figures["phase"]) == (3, "driving")
    assert figures["seconds"] == pytest.approx(0.15)
    assert figures["readings"].keys() == {"height of the tip, m"}
    session.save(1)
    demonstrations = load_demonstrations(session.path)
    (trajectory,) = demonstrations.trajectories
    assert demonstrations.env_name == session.env.name
    assert trajectory.obs.shape == (4, session.env.observation_size)
    np.testing.assert_allclose(trajectory.actions, 0.5)
    assert trajectory.total_reward == pytest.approx(figures["return"], rel=1e-6)
    assert not trajectory.terminated


@pytest.mark.parametrize(("held", "sign"), [(RIGHT, 1), (LEFT, -1)])
def test_the_cart_goes_where_the_key_points(session, held, sign):
    before = session.qpos[0]
    drive(session, held)
    assert sign * (session.qpos[0] - before) > 0.1


def test_an_episode_ends_where_the_task_says_so(session):
    drive(session, RIGHT, steps=100)
    assert session.phase is Phase.OVER
    assert session.num_steps < 50
    session.save(1)
    assert load_demonstrations(session.path).trajectories[0].terminated


def test_an_episode_ends_at_the_time_limit(env, tmp_path):
    session = Session(env, tmp_path / "mine.npz", horizon=2)
    drive(session, frozenset(), steps=5)
    assert (session.phase, session.num_steps) == (Phase.OVER, 2)
    session.save(1)
    assert not load_demonstrations(session.path).trajectories[0].terminated


def test_no_time_passes_in_a_pause(session):
    drive(session, RIGHT)
    session.pause()
    session.step(RIGHT)
    assert session.num_steps == 3
    session.resume()
    session.step(RIGHT)
    assert session.num_steps == 4


def test_a_discarded_episode_leaves_nothing(session):
    drive(session, RIGHT)
    session.discard()
    assert (session.phase, session.num_steps) == (Phase.READY, 0)
    assert not session.path.exists()


def test_every_episode_starts_elsewhere_and_the_seed_repeats_them(env, tmp_path, session):
    other = Session(env, tmp_path / "other.npz", seed=3)
    first = session.qpos
    np.testing.assert_array_equal(other.qpos, first)
    drive(session, RIGHT)
    session.discard()
    assert np.abs(session.qpos - first).max() > 1e-3


def test_a_file_that_exists_is_added_to(env, session):
    for strategy in (1, 2):
        drive(session, RIGHT)
        session.save(strategy)
    again = Session(env, session.path)
    drive(again, LEFT)
    again.save(1)
    assert [t.strategy for t in load_demonstrations(session.path).trajectories] == [0, 1, 0]
    assert [line["strategy"] for line in again.recorded()] == [1, 2, 1]


def test_two_sessions_may_share_a_file(env, session):
    other = Session(env, session.path)
    for each in (session, other, session):
        drive(each, RIGHT)
        each.save(1)
    assert len(session.recorded()) == 3


def test_a_strategy_that_would_leave_one_out_is_refused_and_the_episode_kept(session):
    drive(session, RIGHT)
    with pytest.raises(UsageError, match="strategy: expected 1 to 1, found 2"):
        session.save(2)
    assert not session.path.exists()
    session.save(1)
    assert session.num_strategies == 1


def test_an_episode_outlives_a_disk_that_cannot_be_written(env, tmp_path):
    (tmp_path / "taken").write_text("a file where a folder is wanted")
    session = Session(env, tmp_path / "taken" / "mine.npz")
    drive(session, RIGHT)
    with pytest.raises(RepresentError, match="cannot be written"):
        session.save(1)
    assert (session.phase, session.num_steps) == (Phase.PAUSED, 3)


def test_a_recorded_episode_is_played_as_it_was(env, session):
    positions = [session.qpos]
    session.start()
    for _ in range(4):
        session.step(RIGHT)
        positions.append(session.qpos)
    session.save(1)
    again = Session(env, session.path)
    again.play(1)
    assert again.figures()["playing"] == 1
    for expected in positions[:-1]:
        np.testing.assert_allclose(again.qpos, expected, atol=1e-6)
        again.step(frozenset())
    assert again.phase is Phase.READY
    assert again.notice == "Played to its end."
    assert len(again.recorded()) == 1


def test_a_replay_that_differs_says_so(env, session):
    drive(session, RIGHT, steps=4)
    session.save(1)
    whole = load_demonstrations(session.path)
    (trajectory,) = whole.trajectories
    changed = Trajectory(trajectory.obs + 0.1, *trajectory_rest(trajectory))
    save_demonstrations(session.path, Demonstrations(env.name, (changed,), whole.metadata))
    again = Session(env, session.path)
    again.play(1)
    for _ in range(4):
        again.step(frozenset())
    assert "not as recorded" in again.notice


def trajectory_rest(trajectory):
    return trajectory.actions, trajectory.rewards, trajectory.terminated, trajectory.strategy


def test_demonstrations_from_elsewhere_are_kept_but_cannot_be_played(env, session):
    drive(session, RIGHT)
    session.save(1)
    elsewhere = load_demonstrations(session.path)
    save_demonstrations(
        session.path, Demonstrations(env.name, elsewhere.trajectories, {"source": "elsewhere"})
    )
    again = Session(env, session.path)
    with pytest.raises(UsageError, match="episode 1 was not recorded here"):
        again.play(1)
    for _ in range(2):
        drive(again, LEFT)
        again.save(1)
    demonstrations = load_demonstrations(session.path)
    assert demonstrations.metadata["source"] == "elsewhere + teleoperation"
    seeds = recordings.reset_seeds(demonstrations)
    assert seeds[0] is None
    assert isinstance(seeds[1], int)


def test_a_file_of_another_environment_is_refused(env, session):
    drive(session, RIGHT)
    session.save(1)
    hopper = make_env("hopper", backend="mujoco")
    with pytest.raises(UsageError, match="inverted_double_pendulum, expected hopper"):
        Session(hopper, session.path)


def test_a_file_without_actions_is_refused_before_anybody_drives(env, tmp_path):
    states = Trajectory(np.zeros((3, env.observation_size)), None, None, False, 0)
    save_demonstrations(tmp_path / "states.npz", Demonstrations(env.name, (states,)))
    with pytest.raises(UsageError, match="lacks actions or rewards"):
        Session(env, tmp_path / "states.npz")


@pytest.mark.parametrize("command", ["resume", "discard"])
def test_commands_that_do_not_fit_are_refused(session, command):
    with pytest.raises(UsageError, match="found ready"):
        getattr(session, command)()


def test_an_episode_without_a_step_is_not_saved(session):
    session.start()
    with pytest.raises(UsageError, match="at least 1 step"):
        session.save(1)


def test_an_unfinished_episode_is_not_thrown_away_by_another_command(session):
    drive(session, RIGHT)
    for command in (session.start, lambda: session.play(1)):
        with pytest.raises(UsageError, match="found driving"):
            command()
    assert session.num_steps == 3


def test_without_keys_a_robot_is_watched(tmp_path):
    session = Session(make_env("hopper", backend="mujoco"), tmp_path / "none.npz")
    drive(session, RIGHT)
    assert session.num_steps == 3
    with pytest.raises(UsageError, match="nobody drives"):
        session.save(1)


def test_a_policy_drives_in_place_of_keys(env, tmp_path):
    session = Session(env, tmp_path / "none.npz", policy=lambda obs: -np.ones(1))
    assert session.watched and session.keyboard is None
    before = session.qpos[0]
    drive(session, RIGHT)
    assert session.qpos[0] < before - 0.1
    with pytest.raises(UsageError, match="nobody drives"):
        session.save(1)
