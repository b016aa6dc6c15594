"""Phase 1, Noisy-AIRL: a first reward and a first policy for each strategy.

A generator and a discriminator (`stages.discriminator`) learn in turn, in environments of known
action noise. The generator is SAC, which learns from everything it ever did, its rewards taken
anew from the current discriminator at every update; or PPO, which learns from its last unroll.
"""

import dataclasses
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from represent_jax.agents import cloning, ppo, replay, sac
from represent_jax.agents.ppo import PpoConfig
from represent_jax.agents.registry import find_agent
from represent_jax.agents.sac import PolicyParams, SacConfig
from represent_jax.config import later, require
from represent_jax.envs.episode import Episode
from represent_jax.stages import discriminator
from represent_jax.stages.discriminator import DiscriminatorConfig, DiscriminatorState, RewardParams
from represent_jax.types import Metrics, Params, Transition

# One environment in two is clean; the others climb to a quarter of random actions (SSRR's levels).
TRAINING_NOISE_LEVELS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.10, 0.15, 0.20, 0.25)
# What `policy_average_rate` is told for.
_AVERAGED_ENV_STEPS = 64


@dataclasses.dataclass(frozen=True)
class AirlConfig:
    """Settings of Phase 1.

    Attributes:
      env_steps: budget of each strategy.
      agent: the generator, "sac" or "ppo".
      cloning_updates: updates of behavioural cloning that the generator starts from; 0 starts it
        from random networks, and so do demonstrations of states alone.
      cloning_noise: standard deviation of noise on the observations that are cloned from.
      learn_policy: whether the generator learns; otherwise it stays the clone it began as, and only
        the discriminator learns, to tell that clone from the demonstrations.
      noisy: whether training environments have the noise levels of SSRR (Noisy-AIRL).
      reward_scale: factor on f where it rewards the generator.
      reward_clip: bound on f where it rewards the generator.
      policy_average_rate: share of the generator that enters the average handed on, every 64
        environment steps; 1 hands on the last generator itself.
      discriminator: the discriminator.
      sac, ppo: the generators.
    """

    env_steps: int = 240_000
    agent: str = "sac"
    cloning_updates: int = 2_000
    cloning_noise: float = later(0.0)
    learn_policy: bool = later(True)
    noisy: bool = True
    reward_scale: float = 0.5
    reward_clip: float = 10.0
    policy_average_rate: float = 0.005
    discriminator: DiscriminatorConfig = DiscriminatorConfig()
    sac: SacConfig = SacConfig(buffer_capacity=256_000, initial_temperature=0.1, learning_rate=1e-3)
    ppo: PpoConfig = PpoConfig()

    def __post_init__(self) -> None:
        find_agent(self.agent)
        for field in ("cloning_updates", "cloning_noise"):
            require(getattr(self, field) >= 0, field, ">= 0", getattr(self, field))
        for field in ("env_steps", "reward_scale", "reward_clip"):
            require(getattr(self, field) > 0, field, "positive", getattr(self, field))
        rate = self.policy_average_rate
        require(0.0 < rate <= 1.0, "policy_average_rate", "in (0, 1]", rate)
        require(
            self.learn_policy or self.cloning_updates > 0,
            "cloning_updates",
            "above 0 where learn_policy=false",
            self.cloning_updates,
        )
        # A clone is fitted before there are statistics, which would then move under its feet.
        require(
            not (self.cloning_updates and generator(self)[1].normalize_observations),
            f"{self.agent}.normalize_observations",
            "false where cloning_updates > 0",
            True,
        )

    @property
    def needs_actions(self) -> str:
        """What needs demonstrated actions: a g that sees them, or a policy that stays a clone."""
        if not self.discriminator.state_only:
            return "airl.discriminator.state_only=false"
        return "" if self.learn_policy else "airl.learn_policy=false"


@struct.dataclass
class AirlState:
    """Training state of one strategy.

    Attributes:
      agent: the generator's.
      average: exponential average of the generator's networks.
      discriminator: the discriminator's.
    """

    agent: sac.SacState | ppo.PpoState
    average: Params
    discriminator: DiscriminatorState


class AirlOutput(NamedTuple):
    """What Phase 1 hands on for one strategy."""

    policy: PolicyParams
    reward: RewardParams


def generator(config: AirlConfig) -> tuple[ModuleType, SacConfig | PpoConfig]:
    """The generator's module and settings; policies of both are of one family."""
    return find_agent(config.agent), getattr(config, config.agent)


def training_noise_levels(num_envs: int) -> jax.Array:
    """SSRR's noise levels, for as many environments as there are, `[num_envs]`.

    Repeated where there are more environments than levels; spread where there are fewer.
    """
    levels = jnp.asarray(TRAINING_NOISE_LEVELS)
    if num_envs >= levels.size:
        return jnp.resize(levels, (num_envs,))
    return levels[jnp.linspace(0, levels.size - 1, num_envs).round().astype(int)]


def init(key: jax.Array, env: Episode, demonstrations: Transition, config: AirlConfig) -> AirlState:
    """Starts training on one strategy's transitions, `[num_transitions]`."""
    key_agent, key_reset, key_discriminator, key_policy, key_clone = jax.random.split(key, 5)
    module, settings = generator(config)
    levels = training_noise_levels(settings.num_envs) * config.noisy
    start = jax.vmap(env.reset)(jax.random.split(key_reset, settings.num_envs), levels)
    policy = cloning.start(
        key_policy,
        key_clone,
        module,
        settings,
        env,
        demonstrations,
        config.cloning_updates,
        config.cloning_noise,
    )
    agent = module.init(key_agent, env, settings, start, policy)
    return AirlState(
        agent=agent,
        # A copy: the state is donated, and two leaves must not share one buffer.
        average=jax.tree.map(jnp.copy, agent.learner.policy_params),
        discriminator=discriminator.init(key_discriminator, demonstrations, config.discriminator),
    )


def step(
    state: AirlState, env: Episode, demonstrations: Transition, config: AirlConfig
) -> tuple[AirlState, Metrics]:
    """Acts, updates the discriminator, then the generator.

    The discriminator comes first: it must see log pi of the policy that faces it.
    """
    one_step = _step_off_policy if config.agent == "sac" else _step_on_policy
    agent, learned, metrics = one_step(state, env, demonstrations, config)
    average = optax.incremental_update(
        agent.learner.policy_params, state.average, _average_rate(config)
    )
    return AirlState(agent, average, learned), metrics


def _average_rate(config: AirlConfig) -> float:
    """The share of a training step, which is 64 environment steps of SAC and 2,048 of PPO."""
    env_steps = generator(config)[1].env_steps_per_step
    return 1.0 - (1.0 - config.policy_average_rate) ** (env_steps / _AVERAGED_ENV_STEPS)


def _step_off_policy(state, env, demonstrations, config):
    agent, transitions = sac.collect(state.agent, env, config.sac)
    key_replay, key_rows, key = jax.random.split(agent.key, 3)
    agent = agent.replace(key=key)
    replayed = replay.sample(
        agent.buffer, key_replay, _rows_shape(config), env.observation_size, env.action_size
    )
    learned, metrics = _discriminate(
        key_rows, state.discriminator, agent, demonstrations, replayed, config
    )
    env_reward = jnp.mean(transitions.reward_t)
    if not config.learn_policy:
        return agent, learned, {**metrics, "env_reward": env_reward}
    agent, batches = sac.draw(agent, env, config.sac)
    f_t = _bounded_advantage(learned.params, batches, config)
    # AIRL's reward is f - log pi. Its second half is the entropy that SAC adds by itself; written
    # into the rewards of replayed actions it would favour those the policy has left behind.
    agent, agent_metrics = sac.learn(agent, batches._replace(reward_t=f_t), config.sac)
    return agent, learned, {**agent_metrics, **metrics, "env_reward": env_reward}


def _step_on_policy(state, env, demonstrations, config):
    agent, rollout = ppo.collect(state.agent, env, config.ppo)
    transitions = rollout.transitions
    key_sample, key_rows, key = jax.random.split(agent.key, 3)
    agent = agent.replace(key=key)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), transitions)
    index = jax.random.randint(key_sample, _rows_shape(config), 0, flat.reward_t.shape[0])
    rows = jax.tree.map(lambda x: x[index], flat)
    learned, metrics = _discriminate(
        key_rows, state.discriminator, agent, demonstrations, rows, config
    )
    env_reward = jnp.mean(transitions.reward_t)
    if not config.learn_policy:
        return agent, learned, {**metrics, "env_reward": env_reward}
    # log pi is that of the drawn action, also where noise replaced it and f is of another.
    f_t = _bounded_advantage(learned.params, transitions, config)
    log_prob_t = discriminator.bounded_log_prob(rollout.log_prob_t, config.discriminator)
    reward_t = f_t - config.reward_scale * log_prob_t
    rollout = rollout._replace(transitions=transitions._replace(reward_t=reward_t))
    agent, agent_metrics = ppo.learn(agent, rollout, config.ppo)
    return agent, learned, {**agent_metrics, **metrics, "env_reward": env_reward}


def _rows_shape(config: AirlConfig) -> tuple[int, int]:
    return (config.discriminator.updates_per_step, config.discriminator.batch_size)


def _discriminate(key, state, agent, demonstrations, policy_rows, config):
    """Updates the discriminator with rows of the policy and as many of the demonstrations."""
    key_expert, key_update = jax.random.split(key)
    index = jax.random.randint(key_expert, _rows_shape(config), 0, demonstrations.reward_t.shape[0])
    expert = jax.tree.map(lambda x: x[index], demonstrations)
    module, settings = generator(config)
    policy = module.policy_of(agent.learner)

    def log_prob(rows):
        if rows.action_t is None:
            return None
        log_prob_t = module.log_prob(policy, rows.obs_t, rows.action_t, settings)
        return discriminator.bounded_log_prob(log_prob_t, config.discriminator)

    rows = discriminator.Rows(expert, policy_rows, log_prob(expert), log_prob(policy_rows))
    return discriminator.update(state, rows, key_update, config.discriminator)


def _bounded_advantage(
    params: RewardParams, transition: Transition, config: AirlConfig
) -> jax.Array:
    f_t = discriminator.advantage(params, transition, config.discriminator)
    return config.reward_scale * jnp.clip(f_t, -config.reward_clip, config.reward_clip)


def train(
    state: AirlState, env: Episode, demonstrations: Transition, config: AirlConfig, num_steps: int
) -> tuple[AirlState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, env, demonstrations, config), state, None, length=num_steps
    )
    return state, jax.tree.map(jnp.mean, metrics)


def act(
    params: PolicyParams,
    obs_t: jax.Array,
    key: jax.Array,
    config: AirlConfig,
    action_dim: int,
    deterministic: bool = False,
) -> jax.Array:
    """Samples the generator's actions, or takes their mode, `[..., action_dim]`."""
    module, settings = generator(config)
    return module.act(params, obs_t, key, settings, action_dim, deterministic)


def reward(
    params: RewardParams,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: AirlConfig,
) -> jax.Array:
    """Phase 1's reward, g, `[...]`."""
    return discriminator.reward(params, obs_t, action_t, next_obs_t, config.discriminator)


def finish(state: AirlState) -> AirlOutput:
    """Reads what the later phases need."""
    policy = PolicyParams(state.agent.learner.obs_stats, state.average)
    return AirlOutput(policy, state.discriminator.params)


def population_axes(state: AirlState) -> AirlState:
    """Returns vmap axes for a stacked state: 0 everywhere but for the generator's counters."""
    module = sac if isinstance(state.agent, sac.SacState) else ppo
    return AirlState(module.population_axes(state.agent), average=0, discriminator=0)
