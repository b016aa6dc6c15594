"""Settings by preset: `smoke` for tests, `quick` for a laptop, `paper` for the full protocol."""

from collections.abc import Callable

from represent_jax.agents.ppo import PpoConfig
from represent_jax.agents.sac import SacConfig
from represent_jax.errors import unknown
from represent_jax.methods.config import RepresentConfig
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.discriminator import DiscriminatorConfig
from represent_jax.stages.noise import NoiseConfig
from represent_jax.stages.policies import PoliciesConfig
from represent_jax.stages.regression import RegressionConfig


def _smoke(env: str) -> RepresentConfig:
    tiny = SacConfig(
        num_envs=4,
        updates_per_step=1,
        batch_size=8,
        buffer_capacity=400,
        warmup_env_steps=8,
        hidden_sizes=(8, 8),
    )
    tiny_ppo = PpoConfig(num_envs=4, unroll_length=5, num_minibatches=2, hidden_sizes=(8, 8))
    return RepresentConfig(
        env=env,
        preset="smoke",
        horizon=20,
        airl=AirlConfig(
            env_steps=160,
            cloning_updates=5,
            discriminator=DiscriminatorConfig(
                hidden_sizes=(8, 8), batch_size=8, updates_per_step=1
            ),
            sac=tiny,
            ppo=tiny_ppo,
        ),
        noise=NoiseConfig(num_levels=5, level_step=0.2, trajectories_per_level=2),
        regression=RegressionConfig(
            num_updates=20,
            num_snippets=4,
            states_per_snippet=2,
            num_demonstration_states=8,
            min_snippet_steps=5,
            max_snippet_steps=10,
            hidden_sizes=(8, 8),
            ensemble_size=2,
        ),
        policies=PoliciesConfig(
            env_steps=160, eval_env_steps=40, eval_episodes=2, sac=tiny, ppo=tiny_ppo
        ),
    )


def _quick(env: str) -> RepresentConfig:
    return RepresentConfig(
        env=env,
        preset="quick",
        policies=PoliciesConfig(env_steps=320_000),
    )


def _paper(env: str) -> RepresentConfig:
    return RepresentConfig(
        env=env,
        preset="paper",
        regression=RegressionConfig(ensemble_size=5),
        policies=PoliciesConfig(env_steps=1_000_000),
    )


PRESETS: dict[str, Callable[[str], RepresentConfig]] = {
    "smoke": _smoke,
    "quick": _quick,
    "paper": _paper,
}


def make_config(preset: str, env: str) -> RepresentConfig:
    """Makes the settings of a preset for an environment.

    Raises:
      UsageError: no preset of that name.
    """
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return PRESETS[preset](env)
