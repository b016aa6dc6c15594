"""Which view a scene is drawn from, and what is said where nothing can be drawn."""

import mujoco
import pytest

from represent_jax.errors import RepresentError, UsageError
from represent_jax.physics import offscreen


def make_model(*cameras):
    body = "".join(f'<camera mode="{mode}" name="{mode}"/>' for mode in cameras)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body><geom size=".3"/>{body}</body></worldbody></mujoco>'
    )


@pytest.mark.parametrize(("mode", "expected"), [("fixed", -1), ("track", 0), ("trackcom", 0)])
def test_a_camera_that_follows_the_robot_is_the_default(mode, expected):
    assert offscreen.default_camera(make_model(mode)) == expected


def test_cameras_go_by_name_or_index_and_the_free_one_by_both():
    model = make_model("fixed", "track")
    assert [offscreen.find_camera(model, name).fixedcamid for name in ("track", 0)] == [1, 0]
    for free in ("free", -1):
        assert offscreen.find_camera(model, free).type == mujoco.mjtCamera.mjCAMERA_FREE
    with pytest.raises(UsageError, match="unknown camera 'tracks': did you mean track"):
        offscreen.find_camera(model, "tracks")
    with pytest.raises(UsageError, match="known are free"):
        offscreen.find_camera(make_model(), "side")


def test_a_library_that_opens_but_cannot_draw_is_passed_over(monkeypatch):
    class Context:
        freed = 0

        def __init__(self, width, height):
            del width, height

        def make_current(self):
            raise mujoco.FatalError("no framebuffer")

        def free(self):
            Context.freed += 1

    class Library:
        GLContext = Context

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(offscreen.importlib, "import_module", lambda name: Library)
    with pytest.raises(RepresentError, match=r"egl: '?no framebuffer'?; osmesa: '?no framebuffer"):
        offscreen.check_available()
    assert Context.freed == 2
