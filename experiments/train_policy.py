"""Trains a policy from scratch on a run's learned reward, or on the true one, with SAC or PPO.

python -m experiments.train_policy --run=runs/demo --target=strategy_1 --agent=ppo
python -m experiments.train_policy --env=half_cheetah --env_steps=400000
"""

import time

import jax
import jax.numpy as jnp
from absl import flags

from experiments import launch
from represent_jax import config as configs
from represent_jax.agents import ppo, rollout, sac
from represent_jax.api import load_config, load_reward_for
from represent_jax.envs import Episode, make_env
from represent_jax.errors import UsageError, unknown
from represent_jax.runs import open_run
from represent_jax.runs.loop import advance

_RUN = flags.DEFINE_string("run", None, "Run whose reward to train on; the true one if not given.")
_TARGET = flags.DEFINE_string("target", "task", "Which of its rewards: task, strategy_1, ...")
_ENV = flags.DEFINE_string("env", None, "Environment; that of the run if not given.")
_AGENT = flags.DEFINE_string("agent", "sac", "Agent: sac or ppo.")
_ENV_STEPS = flags.DEFINE_integer("env_steps", 400_000, "Budget.", lower_bound=1)
_EVAL_ENV_STEPS = flags.DEFINE_integer("eval_env_steps", 20_000, "Between two evaluations.")
_SEED = flags.DEFINE_integer("seed", 0, "Seed.")
_BACKEND = flags.DEFINE_string("backend", "auto", "Physics engine: auto, mujoco or mjx.")
_OVERRIDE = flags.DEFINE_multi_string("override", [], "Setting of the agent as key=value.")
_OUT = flags.DEFINE_string("out", "runs/policy", "Run folder.")
_RESUME = flags.DEFINE_bool("resume", False, "Go on with the run in the folder.")

_AGENTS = {
    "sac": (sac, sac.SacConfig(initial_temperature=0.1, learning_rate=1e-3)),
    "ppo": (ppo, ppo.PpoConfig(normalize_observations=True)),
}


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    if _AGENT.value not in _AGENTS:
        raise unknown("agent", _AGENT.value, _AGENTS)
    if not (_RUN.value or _ENV.value):
        raise UsageError("give --run, for its learned reward, or --env, for the true one")
    if not _RUN.value:
        launch.refuse_beside("without --run", ("target",))
    agent, config = _AGENTS[_AGENT.value]
    config = configs.apply_overrides(config, _OVERRIDE.value)
    made = load_config(_RUN.value) if _RUN.value else None
    env = make_env(_ENV.value or made.env, _BACKEND.value)
    env = Episode(env, made.horizon if made and made.horizon else env.horizon)
    whole = Episode(env.env, env.horizon, auto_reset=False)
    reward_fn = None
    if made is not None:
        sizes = (env.observation_size, env.action_size)
        learned = load_reward_for(_RUN.value, _TARGET.value, *sizes)
        # In the unit in which a noise-free demonstrator earns about 1 a step, where curves set one.
        scale = env.horizon / made.regression.return_scale if hasattr(made, "regression") else 1.0

        def reward_fn(_, obs_t, action_t, next_obs_t):
            return scale * learned(obs_t, action_t, next_obs_t)

    num_steps = max(1, _EVAL_ENV_STEPS.value // config.env_steps_per_step)

    def chunk(state):
        state, metrics = agent.train(state, env, config, num_steps, reward_fn)

        def act(params, obs_t, key):
            return agent.act(params, obs_t, key, config, env.action_size, deterministic=True)

        key_eval, key = jax.random.split(state.key)
        state = state.replace(key=key)
        batch = rollout.rollout(whole, act, agent.policy_of(state.learner), key_eval, jnp.zeros(5))
        result = {"true_return": jnp.mean(rollout.true_returns(batch)), **metrics}
        if reward_fn is not None:
            returns = rollout.learned_returns(batch, reward_fn, None) / scale
            result["learned_return"] = jnp.mean(returns)
        return state, result

    with open_run(_OUT.value, _settings(config), resume=_RESUME.value) as run:
        if run.is_done("policy"):
            print(f"{_OUT.value}: done already")
            return
        start = time.monotonic()
        init = jax.jit(lambda key: agent.init(key, env, config, reward_fn=reward_fn))
        env_steps = num_steps * config.env_steps_per_step
        state = advance(
            run,
            "policy",
            init(jax.random.PRNGKey(_SEED.value)),
            jax.jit(chunk, donate_argnums=0),
            -(-_ENV_STEPS.value // env_steps),
            units_per_chunk=env_steps,
            describe=lambda m: f"true return {float(m['true_return']):.1f}",
        )
        path = [(line["step"], line["true_return"]) for line in run.read_log("policy")]
        run.write_results({"env_steps": [s for s, _ in path], "true_return": [r for _, r in path]})
        # Last, since the run counts as done from here on.
        run.save_output("policy", agent.policy_of(state.learner))
        seconds = time.monotonic() - start
    print(f"true return {path[-1][1]:.1f} after {path[-1][0]:,} env steps, {seconds:.0f} s")


def _settings(config) -> dict:
    return {
        "run": _RUN.value,
        "target": _TARGET.value,
        "env": _ENV.value,
        "agent": _AGENT.value,
        "env_steps": _ENV_STEPS.value,
        "eval_env_steps": _EVAL_ENV_STEPS.value,
        "seed": _SEED.value,
        "backend": _BACKEND.value,
        "settings": configs.to_dict(config),
    }


if __name__ == "__main__":
    launch.run(main)
