"""A headless Chromium, and the launcher's process it looks at."""

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

_REPOSITORY = Path(__file__).parents[2]
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
SECONDS = 90.0


@contextlib.contextmanager
def launched(
    env: str, folder: Path, *flags: str, announces: str = "Drive"
) -> Iterator[tuple[subprocess.Popen, str]]:
    """Yields the process of the launcher, and the address it serves; kills it in the end.

    It runs in `folder`, and records to `demonstrations/<env>.npz` there. `announces` is the word
    before the address: `Watch` for a robot that no keys drive.
    """
    command = [sys.executable, "-m", "experiments.teleoperate", f"--env={env}", "--port=0"]
    path = os.pathsep.join([str(_REPOSITORY), os.environ.get("PYTHONPATH", "")])
    with subprocess.Popen(
        [*command, *flags],
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": path},
    ) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith(f"{announces} at http://localhost:"), line
            yield process, line.split()[2]
        finally:
            process.kill()


@contextlib.contextmanager
def chromium(profile: Path, size: tuple[int, int] = (1280, 860)) -> Iterator:
    """Yields a selenium driver; skips the test, with the reason, where there is no browser."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs the extra 'dev'")
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("no chromium and chromedriver: run tests/teleoperation/install_browser.sh")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for flag in (*_FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"):
        options.add_argument(flag)
    service = webdriver.ChromeService(executable_path=driver)
    page = webdriver.Chrome(options=options, service=service)
    try:
        yield page
    finally:
        page.quit()


class TeleoperationPage:
    """The page, as a person sees it and touches it."""

    def __init__(self, driver):
        from selenium.webdriver.support.ui import WebDriverWait

        self.driver = driver
        self._wait = WebDriverWait(driver, SECONDS, poll_frequency=0.05)

    def text(self, element: str) -> str:
        """Returns what an element says, by its id."""
        return self.driver.find_element("id", element).text

    def click(self, element: str) -> None:
        """Clicks an element that may have to be shown and enabled first."""
        found = self.driver.find_element("id", element)
        self.until(lambda: found.is_displayed() and found.is_enabled())
        found.click()

    def choose(self, element: str, value: str) -> None:
        """Chooses an option by its value."""
        from selenium.webdriver.support.ui import Select

        Select(self.driver.find_element("id", element)).select_by_value(value)

    def until(self, found) -> None:
        """Waits until `found()`."""
        self._wait.until(lambda _: found())

    def until_phase(self, *phases: str) -> None:
        """Waits until the page says that it is in one of these phases."""
        self.until(lambda: self.text("phase") in phases)

    def press(self, key: str) -> None:
        """Holds a key, by its name in selenium's `Keys` or as a letter."""
        self._keys().key_down(key).perform()

    def release(self, key: str) -> None:
        """Lets go of a key."""
        self._keys().key_up(key).perform()

    def _keys(self):
        from selenium.webdriver.common.action_chains import ActionChains

        return ActionChains(self.driver)
