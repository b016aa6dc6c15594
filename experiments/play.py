"""Renders one of a run's policies to a video, off-screen.

python -m experiments.play --run=runs/demo --target=task --out=task.mp4
"""

import jax
from absl import flags

from experiments import launch
from represent_jax.api import load_config, load_policy
from represent_jax.envs import Environment, make_env
from represent_jax.errors import UsageError
from represent_jax.physics import offscreen
from represent_jax.report import showcase, video

_RUN = flags.DEFINE_string("run", None, "Run folder.", required=True)
_TARGET = flags.DEFINE_string("target", "task", "Whose policy: task, strategy_1, ...")
_OUT = flags.DEFINE_string("out", "policy.mp4", "Video to write.")
_STEPS = flags.DEFINE_integer("steps", 300, "Environment steps to show.", lower_bound=1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of the initial state.")
_BACKEND = flags.DEFINE_string("backend", None, "Physics engine; that of the run if not given.")
_CAMERA = flags.DEFINE_string(
    "camera", None, "Name of the camera; one that follows the robot if there is."
)


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    policy = load_policy(_RUN.value, _TARGET.value)
    config = load_config(_RUN.value)
    env = make_env(config.env, _BACKEND.value or config.backend)
    if not isinstance(env, Environment):
        raise UsageError(f"{env.name}: only tasks on the engines of this package can be shown")

    video.check_available()
    qpos, rewards = showcase.motion(env, policy, jax.random.PRNGKey(_SEED.value), _STEPS.value)
    model = env.engine.model
    camera = _CAMERA.value or offscreen.default_camera(model)
    path = video.render(model, qpos, _OUT.value, 1.0 / env.engine.dt, camera)
    print(f"{path}: {len(rewards)} steps, true return {float(rewards.sum()):.1f}")


if __name__ == "__main__":
    launch.run(main)
