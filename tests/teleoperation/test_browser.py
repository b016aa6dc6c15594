"""From a key that is pressed in a real browser to a file of demonstrations."""

import numpy as np
import pytest
from browser import TeleoperationPage, chromium, launched

from represent_jax.data import load_demonstrations

pytest.importorskip("aiohttp", reason="needs the extra 'teleop'")


def drive_until_over(page, key):
    page.until_phase("ready")
    page.press(key)
    page.click("primary")
    page.until_phase("episode over")
    page.release(key)


def test_keys_in_a_browser_move_the_robot_and_episodes_are_saved(tmp_path):
    path = tmp_path / "demonstrations" / "inverted_double_pendulum.npz"
    with (
        chromium(tmp_path / "profile") as driver,
        launched("inverted_double_pendulum", tmp_path, "--seed=1", "--horizon=60") as (_, address),
    ):
        from selenium.webdriver.common.keys import Keys

        driver.get(address)
        page = TeleoperationPage(driver)
        page.until_phase("ready")
        assert page.text("role") == "you drive"
        assert "push the cart to the left" in page.text("keys")
        for strategy, key in (("1", Keys.ARROW_RIGHT), ("2", Keys.ARROW_LEFT)):
            drive_until_over(page, key)
            page.choose("strategy", strategy)
            page.click("save")
            page.until(lambda strategy=strategy: f"strategy {strategy}." in page.text("notice"))
        drive_until_over(page, Keys.ARROW_LEFT)
        page.click("discard")
        page.until_phase("ready")

        right, left = load_demonstrations(path).trajectories
        assert (right.strategy, left.strategy) == (0, 1)
        for trajectory, sign in ((right, 1), (left, -1)):
            np.testing.assert_allclose(trajectory.actions, sign * 0.5)
            assert sign * (trajectory.obs[-1, 0] - trajectory.obs[0, 0]) > 0.1

        page.until(lambda: "1 of strategy 1, 1 of strategy 2" in page.text("count"))
        driver.find_element("css selector", "#recorded button").click()
        page.until(lambda: page.text("notice") == "Played to its end.")

        first = driver.current_window_handle
        driver.switch_to.new_window("tab")
        driver.get(address)
        page.until(lambda: page.text("role") == "watching; another page drives")
        assert not driver.find_element("id", "primary").is_enabled()
        driver.switch_to.window(first)
        driver.close()
        driver.switch_to.window(driver.window_handles[0])
        page.click("drive")
        page.until(lambda: page.text("role") == "you drive")
        console = [line for line in driver.get_log("browser") if line["level"] == "SEVERE"]
        assert not console


def test_a_key_in_a_browser_moves_the_arm_of_the_kitchen(tmp_path):
    pytest.importorskip("gymnasium_robotics", reason="needs the extra 'kitchen'")
    # Without a graphics card pictures of the kitchen are slow: few and small ones.
    pictures = ("--width=64", "--height=64", "--fps=2")
    with (
        chromium(tmp_path / "profile") as driver,
        launched("franka_kitchen", tmp_path, "--horizon=25", *pictures) as (_, address),
    ):
        driver.get(address)
        page = TeleoperationPage(driver)
        page.until_phase("ready")
        assert "move forward" in page.text("keys")
        drive_until_over(page, "w")
        page.click("save")
        page.until(lambda: page.text("notice") == "Saved as episode 1, strategy 1.")
    demonstrations = load_demonstrations(tmp_path / "demonstrations" / "franka_kitchen.npz")
    assert demonstrations.env_name == "franka_kitchen"
    (trajectory,) = demonstrations.trajectories
    assert trajectory.obs.shape == (26, 59)
    assert trajectory.actions.shape == (25, 9) and trajectory.rewards.shape == (25,)
    # Without the key all joints stay within 0.03 rad of where they are.
    moved = np.abs(trajectory.obs[-1, :7] - trajectory.obs[0, :7])
    assert moved.max() > 0.3 and np.sum(moved > 0.1) >= 2, moved


def test_the_page_says_when_the_server_is_gone(tmp_path):
    with (
        chromium(tmp_path / "profile") as driver,
        launched("hopper", tmp_path, announces="Watch") as (process, address),
    ):
        driver.get(address)
        page = TeleoperationPage(driver)
        page.until_phase("ready")
        assert "can only be watched" in page.text("keys-note")
        page.click("primary")
        page.until_phase("watching")
        page.until(lambda: page.text("primary") == "Again")
        page.click("primary")
        page.until_phase("ready")
        process.kill()
        page.until(lambda: page.text("role") == "connection lost")
        assert "What was saved is in the file" in page.text("problem")
