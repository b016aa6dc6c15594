"""Serves a page on which a robot is driven with keys and its episodes are recorded.

python -m experiments.teleoperate --env=inverted_double_pendulum --out=mine.npz
python -m experiments.teleoperate --run=runs/demo --target=task   # watch a policy
"""

from absl import flags

from experiments import launch
from represent_jax.api import load_config, load_policy
from represent_jax.envs import make_env
from represent_jax.errors import UsageError
from represent_jax.physics import offscreen
from represent_jax.teleoperation.painter import Painter
from represent_jax.teleoperation.session import Session

_ENV = flags.DEFINE_string("env", None, "Environment to drive.")
_OUT = flags.DEFINE_string(
    "out", None, "File of demonstrations to record to; demonstrations/<env>.npz if not given."
)
_HOST = flags.DEFINE_string("host", "localhost", "Address to listen on.")
_PORT = flags.DEFINE_integer(
    "port", 8080, "Port to listen on; 0 picks a free one.", lower_bound=0, upper_bound=65_535
)
_HORIZON = flags.DEFINE_integer("horizon", None, "Steps of an episode; the environment's if empty.")
_SEED = flags.DEFINE_integer(
    "seed", None, "Seed of initial states; new ones every time if empty.", lower_bound=0
)
_RUN = flags.DEFINE_string("run", None, "Run folder, one of whose policies to watch.")
_TARGET = flags.DEFINE_string("target", "task", "Whose policy of --run: task, strategy_1, ...")
_CAMERA = flags.DEFINE_string(
    "camera", None, "Name of the first view, or free; one that follows the robot if there is."
)
_WIDTH = flags.DEFINE_integer("width", 800, "Width of pictures in pixels.", lower_bound=64)
_HEIGHT = flags.DEFINE_integer("height", 600, "Height of pictures in pixels.", lower_bound=64)
_FPS = flags.DEFINE_float("fps", 20.0, "Pictures a second, at most.", lower_bound=0.1)


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    # Only here, where an error becomes one line: it needs a library that is an extra.
    from represent_jax.teleoperation import server

    if (_ENV.value is None) == (_RUN.value is None):
        raise UsageError("expected either --env, to drive, or --run, to watch a policy")
    if _RUN.value:
        launch.refuse_beside("with --run, which records nothing", ("out",))
    else:
        launch.refuse_beside("without --run", ("target",))
    name = _ENV.value or load_config(_RUN.value).env
    if name.startswith("playground:"):
        raise UsageError(f"only tasks on this package's engines can be shown, not {name}")
    policy = load_policy(_RUN.value, _TARGET.value) if _RUN.value else None
    env = make_env(name, backend="mujoco")
    path = _OUT.value or f"demonstrations/{name}.npz"
    session = Session(env, path, _HORIZON.value, _SEED.value, policy)
    drives = session.keyboard is not None
    if drives:
        launch.require_writable(path)
    else:
        launch.refuse_beside(f"since nothing is recorded: no keys drive {name}", ("out",))
    model = env.engine.model
    camera = _CAMERA.value or offscreen.default_camera(model)
    painter = Painter(model, (_WIDTH.value, _HEIGHT.value), camera)

    def announce(address: str) -> None:
        does = "Drive" if drives else "Watch"
        where = f"episodes go to {path}" if drives else "nothing is recorded"
        print(f"{does} at {address} (Ctrl-C ends); {where}", flush=True)
        if _HOST.value not in server.LOOPBACK:
            print("Whoever can reach this address can drive and record.", flush=True)

    server.serve(session, painter, _HOST.value, _PORT.value, _FPS.value, announce)


if __name__ == "__main__":
    launch.run(main)
