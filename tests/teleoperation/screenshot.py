"""Takes the picture of the page that README shows, while keys are held in a headless Chromium.

python tests/teleoperation/screenshot.py --env=franka_kitchen --out=docs/images/teleoperation.png
"""

import io
import tempfile
import time
from pathlib import Path

from absl import app, flags
from browser import TeleoperationPage, chromium, launched
from PIL import Image

_ENV = flags.DEFINE_string("env", "franka_kitchen", "Environment to drive.")
_OUT = flags.DEFINE_string("out", "docs/images/teleoperation.png", "Picture to write.")
_KEYS = flags.DEFINE_list("keys", ["wa", "w", "d", "waq"], "Keys of each episode, held together.")
_SECONDS = flags.DEFINE_float("seconds", 2.0, "How long the keys of an episode are held.")


def main(argv: list[str]) -> None:
    del argv
    with tempfile.TemporaryDirectory() as folder:
        with (
            chromium(Path(folder) / "profile", size=(1320, 900)) as driver,
            launched(_ENV.value, Path(folder), "--seed=1") as (_, address),
        ):
            driver.get(address)
            page = TeleoperationPage(driver)
            page.until_phase("ready")
            *saved, shown = _KEYS.value
            for number, keys in enumerate(saved):
                drive(page, keys)
                page.choose("strategy", str(min(2, 1 + number)))
                page.click("save")
                page.until_phase("ready")
            drive(page, shown, release=False)
            Path(_OUT.value).parent.mkdir(parents=True, exist_ok=True)
            picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
            picture.quantize(256).save(_OUT.value, optimize=True)
    print(f"{_OUT.value}: {Path(_OUT.value).stat().st_size / 1e3:.0f} kB")


def drive(page: TeleoperationPage, keys: str, release: bool = True) -> None:
    page.click("primary")
    page.until_phase("recording")
    for key in keys:
        page.press(key)
    time.sleep(_SECONDS.value)
    if release:
        for key in keys:
            page.release(key)


if __name__ == "__main__":
    app.run(main)
