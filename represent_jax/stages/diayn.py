"""Demonstrators: DIAYN (https://arxiv.org/abs/1802.06070) with the environment's reward mixed in.

One skill-conditioned SAC agent maximises

  r(s, a, z) = r_env + beta * clip(log q(z|s') - log p(z)),

REPRESENT's Eq. 6 in the mixture of its Eq. 1, with q a discriminator trained on replayed states
and p uniform. The diversity reward is computed from the current discriminator at update time.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import optax
from brax.training import networks as brax_networks
from flax import linen, struct

from represent_jax.agents import sac
from represent_jax.agents.sac import SacConfig
from represent_jax.config import later, require, require_entries, require_sizes
from represent_jax.envs.episode import Episode
from represent_jax.envs.skill import SkillConditioned
from represent_jax.types import Metrics, Params


@dataclasses.dataclass(frozen=True)
class DiaynConfig:
    """Settings of the demonstrators.

    Attributes:
      num_skills: number of skills; each becomes one demonstrator.
      diversity_weight: beta, the weight of the diversity reward beside the environment's.
      discriminator_obs: indices of the observation that q sees, all if empty. A prior on what
        makes a style (DIAYN, section 3.2): gaits then differ, rather than which side is up.
      diversity_floor, diversity_ceiling: bounds of log q - log p, which is unbounded below and at
        most log(num_skills). With three skills or more the ceiling ends what is paid before the
        discriminator is certain, so that the environment's reward is not outbid.
      discriminator_hidden_sizes: units of the discriminator's hidden layers.
      discriminator_learning_rate: its Adam step size.
      sac: the agent.
    """

    num_skills: int = 2
    diversity_weight: float = 1.0
    discriminator_obs: tuple[int, ...] = ()
    diversity_floor: float = -5.0
    diversity_ceiling: float = later(1.0)
    discriminator_hidden_sizes: tuple[int, ...] = (128, 128)
    discriminator_learning_rate: float = 3e-4
    sac: SacConfig = SacConfig()

    def __post_init__(self) -> None:
        require(self.num_skills >= 2, "num_skills", "at least 2", self.num_skills)
        require(
            self.sac.num_envs >= self.num_skills,
            "sac.num_envs",
            f"at least num_skills ({self.num_skills})",
            self.sac.num_envs,
        )
        weight = self.diversity_weight
        require(weight >= 0.0, "diversity_weight", "at least 0", weight)
        require(
            self.diversity_floor < self.diversity_ceiling,
            "diversity_floor",
            f"below diversity_ceiling ({self.diversity_ceiling})",
            self.diversity_floor,
        )
        require(
            self.discriminator_learning_rate > 0.0,
            "discriminator_learning_rate",
            "positive",
            self.discriminator_learning_rate,
        )
        require_sizes(self.discriminator_hidden_sizes, "discriminator_hidden_sizes")


@struct.dataclass
class DiaynState:
    """Training state.

    Attributes:
      sac: the agent's.
      discriminator: parameters of q(z|s).
      discriminator_opt: its optimiser's state.
    """

    sac: sac.SacState
    discriminator: Params
    discriminator_opt: optax.OptState


@functools.lru_cache
def _discriminator(config: DiaynConfig):
    module = brax_networks.MLP(
        layer_sizes=(*config.discriminator_hidden_sizes, config.num_skills),
        activation=linen.relu,
    )
    return module, optax.adam(config.discriminator_learning_rate)


def init(key: jax.Array, env: Episode, config: DiaynConfig) -> DiaynState:
    """Starts training; each of the agent's environments belongs to one skill.

    Raises:
      UsageError: the discriminator is to see entries that an observation does not have.
    """
    size = env.observation_size
    require_entries(config.discriminator_obs, size, "discriminator_obs")
    key_sac, key_reset, key_discriminator = jax.random.split(key, 3)
    conditioned = SkillConditioned(env, config.num_skills)
    skills = jnp.arange(config.sac.num_envs) % config.num_skills
    start = jax.vmap(conditioned.reset)(jax.random.split(key_reset, skills.size), skills)
    agent = sac.init(key_sac, conditioned, config.sac, start)
    module, optimizer = _discriminator(config)
    params = module.init(key_discriminator, _seen(jnp.zeros(size), config))
    return DiaynState(agent, params, optimizer.init(params))


def log_skill_posterior(params: Params, obs_t: jax.Array, config: DiaynConfig) -> jax.Array:
    """Log q(z|s), `[..., num_skills]`, of observations without the skill, `[..., obs_dim]`."""
    module, _ = _discriminator(config)
    return jax.nn.log_softmax(module.apply(params, _seen(obs_t, config)))


def _seen(obs_t: jax.Array, config: DiaynConfig) -> jax.Array:
    if not config.discriminator_obs:
        return obs_t
    return obs_t[..., jnp.asarray(config.discriminator_obs)]


def diversity_reward(
    log_posterior: jax.Array, skill: jax.Array, floor: float, ceiling: float
) -> jax.Array:
    """Eq. 6 with a uniform prior: log q(z|s) + log num_skills, clipped to `[floor, ceiling]`.

    Args:
      log_posterior: `[..., num_skills]`.
      skill: one-hot, `[..., num_skills]`.
      floor, ceiling: bounds.
    """
    log_ratio = jnp.sum(log_posterior * skill, axis=-1) + jnp.log(skill.shape[-1])
    return jnp.clip(log_ratio, floor, ceiling)


def step(state: DiaynState, env: Episode, config: DiaynConfig) -> tuple[DiaynState, Metrics]:
    """Takes one vectorised environment step; updates the discriminator, then the agent."""
    conditioned = SkillConditioned(env, config.num_skills)
    agent, transitions = sac.collect(state.sac, conditioned, config.sac)
    agent, batches = sac.draw(agent, conditioned, config.sac)
    next_obs = batches.next_obs_t[..., : -config.num_skills]
    skill = batches.next_obs_t[..., -config.num_skills :]

    def loss_fn(params):
        log_posterior = log_skill_posterior(params, next_obs, config)
        return -jnp.mean(jnp.sum(log_posterior * skill, axis=-1)), log_posterior

    (loss, log_posterior), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.discriminator)
    _, optimizer = _discriminator(config)
    updates, discriminator_opt = optimizer.update(grads, state.discriminator_opt)
    discriminator = optax.apply_updates(state.discriminator, updates)

    diversity = diversity_reward(
        log_posterior, skill, config.diversity_floor, config.diversity_ceiling
    )
    reward_t = batches.reward_t + config.diversity_weight * diversity
    agent, metrics = sac.learn(agent, batches._replace(reward_t=reward_t), config.sac)
    hit = jnp.argmax(log_posterior, axis=-1) == jnp.argmax(skill, axis=-1)
    metrics = {
        **metrics,
        "env_reward": jnp.mean(transitions.reward_t),
        "discriminator_loss": loss,
        "discriminator_accuracy": jnp.mean(hit),
    }
    return DiaynState(agent, discriminator, discriminator_opt), metrics


def train(
    state: DiaynState, env: Episode, config: DiaynConfig, num_steps: int
) -> tuple[DiaynState, Metrics]:
    """Scans `step`; metrics are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, env, config), state, None, length=num_steps
    )
    return state, jax.tree.map(jnp.mean, metrics)


def act(
    params: sac.PolicyParams,
    skill: jax.Array | int,
    obs_t: jax.Array,
    key: jax.Array,
    config: DiaynConfig,
    action_dim: int,
    deterministic: bool = False,
) -> jax.Array:
    """Acts with one skill on observations without it, `[batch, obs_dim]`."""
    one_hot = jax.nn.one_hot(skill, config.num_skills)
    one_hot = jnp.broadcast_to(one_hot, (*obs_t.shape[:-1], config.num_skills))
    conditioned = jnp.concatenate([obs_t, one_hot], axis=-1)
    return sac.act(params, conditioned, key, config.sac, action_dim, deterministic)
