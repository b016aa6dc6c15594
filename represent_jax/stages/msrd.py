"""MSRD: multi-strategy reward distillation, the baseline that Eq. 1 of REPRESENT comes from.

MSRD (Chen, Paleja, Ghuy, Gombolay, HRI 2020, https://arxiv.org/abs/2001.00503) plays one AIRL game
for each of M strategies, whose discriminators share a part of their reward:

  logits_i = f_i(s, s') - log pi_i(a|s),
  f_i = (R^0 + alpha R~_i)(s') + gamma h_i(s') - h_i(s).

Its code's loss of a strategy adds 0.01 sum R~_i^2 + 0.0001 sum R^0^2 to the cross-entropy, sums of
squared outputs over a batch of 64 rows. Here they are means, of any number of rows, so that the
same weights read 64 * 0.01 = 0.64 and 64 * 0.0001 = 0.0064. R~_i and h_i change at every update;
the gradients of R^0 are gathered over the updates of all strategies, and then R^0 makes one step.

The paper's generator is TRPO. Here it is Phase 1's SAC, with all that `stages.airl` and
`stages.discriminator` do to have the game work: the rewards of replayed transitions are taken anew
from f_i, generators start as clones, inputs and log pi are bounded, f_i has a gradient penalty,
and an averaged policy is handed on. Nothing acts under noise, which MSRD has none of.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.training import networks as brax_networks
from flax import linen, struct

from represent_jax.agents import cloning, replay, sac
from represent_jax.agents.sac import PolicyParams, SacConfig
from represent_jax.config import later, require, require_indices, require_sizes
from represent_jax.envs.episode import Episode
from represent_jax.stages.airl import AirlConfig
from represent_jax.stages.discriminator import INPUT_CLIP, Rows, gradient_penalty, logits
from represent_jax.types import Metrics, Params, Transition


@dataclasses.dataclass(frozen=True)
class MsrdConfig:
    """Settings of MSRD.

    Attributes:
      env_steps: budget of each strategy.
      cloning_updates: updates of behavioural cloning that each generator starts from; 0 starts it
        from random networks, and so do demonstrations of states alone.
      cloning_noise: standard deviation of noise on the observations that are cloned from.
      hidden_sizes: units of the hidden layers of R^0, R~_i and h_i.
      learning_rate: AdamW step size of R~_i and h_i.
      task_learning_rate: that of R^0, which makes one step in a training step.
      weight_decay: AdamW weight decay of all three.
      batch_size: rows from each of demonstrations and policy in an update of one strategy.
      updates_per_step: updates of R~_i and h_i in a training step.
      gradient_penalty: weight of the squared gradient norm of f_i between demonstration and policy.
      shaping_discount: gamma in f_i.
      log_prob_clip: bound on log pi_i in the logits.
      strategy_l2, task_l2: weights of the mean squared outputs of R~_i and of R^0.
      strategy_weight: alpha, for all strategies.
      task_entries: entries of the next observation that R^0 sees, such as the objects that a task
        is about; all if empty.
      reward_scale: factor on f_i where it rewards the generator.
      reward_clip: bound on f_i where it rewards the generator.
      policy_average_rate: share of the generator that enters the average handed on, after every
        training step; 1 hands on the last generator itself.
      sac: the generators.
    """

    env_steps: int = 240_000
    cloning_updates: int = 2_000
    cloning_noise: float = later(0.0)
    hidden_sizes: tuple[int, ...] = (64, 64)
    learning_rate: float = 3e-4
    task_learning_rate: float = 3e-4
    weight_decay: float = 1e-3
    batch_size: int = 256
    updates_per_step: int = 4
    gradient_penalty: float = 1.0
    shaping_discount: float = 0.99
    log_prob_clip: float = 1.0
    strategy_l2: float = 0.64
    task_l2: float = 0.0064
    strategy_weight: float = 1.0
    task_entries: tuple[int, ...] = later(())
    reward_scale: float = 0.5
    reward_clip: float = 10.0
    policy_average_rate: float = 0.005
    sac: SacConfig = AirlConfig().sac

    def __post_init__(self) -> None:
        for field in ("env_steps", "batch_size", "updates_per_step"):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        for field in (
            *("learning_rate", "task_learning_rate"),
            *("log_prob_clip", "reward_scale", "reward_clip"),
        ):
            require(getattr(self, field) > 0.0, field, "positive", getattr(self, field))
        for field in (
            *("cloning_updates", "cloning_noise", "weight_decay"),
            *("gradient_penalty", "strategy_l2", "task_l2", "strategy_weight"),
        ):
            require(getattr(self, field) >= 0, field, ">= 0", getattr(self, field))
        require_sizes(self.hidden_sizes)
        discount = self.shaping_discount
        require(0.0 <= discount <= 1.0, "shaping_discount", "in [0, 1]", discount)
        require_indices(self.task_entries, "task_entries")
        rate = self.policy_average_rate
        require(0.0 < rate <= 1.0, "policy_average_rate", "in (0, 1]", rate)
        # A clone is fitted before there are statistics, which would then move under its feet.
        require(
            not (self.cloning_updates and self.sac.normalize_observations),
            "sac.normalize_observations",
            "false where cloning_updates > 0",
            True,
        )


class MsrdRewards(NamedTuple):
    """Parameters of all rewards; those of one strategy are the same without the strategy axis.

    Attributes:
      task: R^0.
      strategies: R~_1 to R~_M, leaves `[num_strategies, ...]`.
      shaping: h_1 to h_M, leaves `[num_strategies, ...]`.
      mean, std: of the observations demonstrated by all strategies together, `[obs_dim]`.
    """

    task: Params
    strategies: Params
    shaping: Params
    mean: jax.Array
    std: jax.Array


_STRATEGY_AXES = MsrdRewards(task=None, strategies=0, shaping=0, mean=None, std=None)


@struct.dataclass
class RewardsState:
    """All rewards and the states of their optimisers.

    Attributes:
      rewards: parameters.
      task_opt: the optimiser's of R^0.
      strategy_opt: the optimiser's of all R~_i and h_i.
    """

    rewards: MsrdRewards
    task_opt: optax.OptState
    strategy_opt: optax.OptState


@struct.dataclass
class MsrdState:
    """Training state of all strategies.

    Attributes:
      agents: the generators', leaves `[num_strategies, ...]` but for the counters they share.
      averages: exponential averages of the generators' networks, leaves `[num_strategies, ...]`.
      learned: the rewards'.
      key: PRNG key.
    """

    agents: sac.SacState
    averages: Params
    learned: RewardsState
    key: jax.Array


class MsrdOutput(NamedTuple):
    """What MSRD ends with: policies, leaves `[num_strategies, ...]`, and rewards."""

    policies: PolicyParams
    rewards: MsrdRewards


@functools.lru_cache
def _networks(config: MsrdConfig):
    module = brax_networks.MLP(layer_sizes=(*config.hidden_sizes, 1), activation=linen.relu)
    task_optimizer, optimizer = (
        optax.adamw(rate, weight_decay=config.weight_decay)
        for rate in (config.task_learning_rate, config.learning_rate)
    )
    return module, task_optimizer, optimizer


def init(key: jax.Array, env: Episode, demonstrations: Transition, config: MsrdConfig) -> MsrdState:
    """Starts training on the transitions of all, `[num_strategies, num_transitions]`."""
    key_agents, key_rewards, key = jax.random.split(key, 3)
    keys = jax.random.split(key_agents, demonstrations.reward_t.shape[0])

    def init_agent(key, demonstrations):
        return _init_agent(key, env, demonstrations, config)

    one = jax.eval_shape(init_agent, keys[0], jax.tree.map(lambda x: x[0], demonstrations))
    axes = sac.population_axes(one)
    agents = jax.vmap(init_agent, out_axes=axes)(keys, demonstrations)
    return MsrdState(
        agents=agents,
        # A copy: the state is donated, and two leaves must not share one buffer.
        averages=jax.tree.map(jnp.copy, agents.learner.policy_params),
        learned=init_rewards(key_rewards, demonstrations, config),
        key=key,
    )


def _init_agent(key, env, demonstrations, config):
    key_agent, key_policy, key_clone = jax.random.split(key, 3)
    policy = cloning.start(
        key_policy,
        key_clone,
        sac,
        config.sac,
        env,
        demonstrations,
        config.cloning_updates,
        config.cloning_noise,
    )
    return sac.init(key_agent, env, config.sac, policy_params=policy)


def init_rewards(key: jax.Array, demonstrations: Transition, config: MsrdConfig) -> RewardsState:
    """Draws R^0, R~_i and h_i, and takes the inputs' statistics from the demonstrations.

    Args:
      key: PRNG key.
      demonstrations: `[num_strategies, num_transitions]`.
      config: settings.
    """
    obs = demonstrations.obs_t
    obs_dim = obs.shape[-1]
    module, task_optimizer, optimizer = _networks(config)

    def draw(key, input_dim=obs_dim):
        return module.init(key, jnp.zeros(input_dim))

    key_task, key_own = jax.random.split(key)
    own = jax.vmap(jax.vmap(draw))(jax.random.split(key_own, (2, obs.shape[0])))
    rewards = MsrdRewards(
        task=draw(key_task, len(config.task_entries) or obs_dim),
        strategies=jax.tree.map(lambda x: x[0], own),
        shaping=jax.tree.map(lambda x: x[1], own),
        mean=jnp.mean(obs, axis=(0, 1)),
        # A floor, for observations that hardly move in the demonstrations.
        std=jnp.std(obs, axis=(0, 1)) + 1e-2,
    )
    strategy_opt = optimizer.init((rewards.strategies, rewards.shaping))
    return RewardsState(rewards, task_optimizer.init(rewards.task), strategy_opt)


def _apply(
    network: Params,
    rewards: MsrdRewards,
    obs: jax.Array,
    config: MsrdConfig,
    entries: tuple[int, ...] = (),
) -> jax.Array:
    module, _, _ = _networks(config)
    inputs = jnp.clip((obs - rewards.mean) / rewards.std, -INPUT_CLIP, INPUT_CLIP)
    return module.apply(network, inputs[..., entries] if entries else inputs)[..., 0]


def _task(rewards: MsrdRewards, obs: jax.Array, config: MsrdConfig) -> jax.Array:
    """R^0, `[...]`."""
    return _apply(rewards.task, rewards, obs, config, config.task_entries)


def _parts(own: MsrdRewards, transition: Transition, config: MsrdConfig):
    """R^0 and R~ of one strategy's rewards, `[...]` each."""
    obs = transition.next_obs_t
    return _task(own, obs, config), _apply(own.strategies, own, obs, config)


def advantage(own: MsrdRewards, transition: Transition, config: MsrdConfig) -> jax.Array:
    """f of one strategy's rewards, `[...]`; h is zero past a terminal state."""
    task_t, strategy_t = _parts(own, transition, config)
    h_t = _apply(own.shaping, own, transition.obs_t, config)
    next_h_t = _apply(own.shaping, own, transition.next_obs_t, config)
    g_t = task_t + config.strategy_weight * strategy_t
    return g_t + config.shaping_discount * transition.discount_t * next_h_t - h_t


def loss(
    own: MsrdRewards, rows: Rows, key: jax.Array, config: MsrdConfig
) -> tuple[jax.Array, Metrics]:
    """Loss of one strategy: cross-entropy, squared outputs of R~ and R^0, gradient penalty.

    Args:
      own: rewards of one strategy.
      rows: its batches of one update, `[batch_size]`; demonstrations are labelled 1.
      key: PRNG key of the penalty's interpolation.
      config: settings.
    """
    f_expert, f_policy = (advantage(own, of, config) for of in (rows.expert, rows.policy))
    logits_expert, logits_policy = logits(f_expert, f_policy, rows)
    outputs = zip(*(_parts(own, of, config) for of in (rows.expert, rows.policy)), strict=True)
    task_square, strategy_square = (jnp.mean(jnp.square(jnp.stack(part))) for part in outputs)
    cross_entropy = 0.5 * jnp.mean(jax.nn.softplus(-logits_expert))
    cross_entropy += 0.5 * jnp.mean(jax.nn.softplus(logits_policy))
    penalty = jnp.zeros(())
    if config.gradient_penalty > 0.0:
        penalty = gradient_penalty(
            lambda transition: advantage(own, transition, config), own.std, rows, key
        )
    metrics = {
        "discriminator_loss": cross_entropy,
        "gradient_penalty": penalty,
        "task_square": task_square,
        "strategy_square": strategy_square,
        "accuracy_expert": jnp.mean(logits_expert > 0.0),
        "accuracy_policy": jnp.mean(logits_policy < 0.0),
    }
    squares = config.task_l2 * task_square + config.strategy_l2 * strategy_square
    return cross_entropy + squares + config.gradient_penalty * penalty, metrics


def update_rewards(
    state: RewardsState, rows: Rows, key: jax.Array, config: MsrdConfig
) -> tuple[RewardsState, Metrics]:
    """Updates R~_i and h_i of all strategies once for each batch, and then R^0 once.

    The gradient of R^0 is the mean over updates of the sum over strategies, each taken where its
    R~_i and h_i are at that update.

    Args:
      state: rewards and optimisers.
      rows: `[num_strategies, updates_per_step, batch_size]`.
      key: PRNG key.
      config: settings.

    Returns:
      The next state, and metrics averaged over updates, `[num_strategies]`.
    """
    _, task_optimizer, optimizer = _networks(config)
    rewards = state.rewards
    num_strategies, num_updates = rows.log_prob_policy.shape[:2]

    def loss_fn(task, own, rows, key):
        one = rewards._replace(task=task, strategies=own[0], shaping=own[1])
        return loss(one, rows, key, config)

    grad_fn = jax.vmap(jax.grad(loss_fn, argnums=(0, 1), has_aux=True), in_axes=(None, 0, 0, 0))

    def body(carry, inputs):
        own, opt, task_grads = carry
        (task_each, own_grads), metrics = grad_fn(rewards.task, own, *inputs)
        task_grads = jax.tree.map(
            lambda total, each: total + jnp.sum(each, axis=0) / num_updates, task_grads, task_each
        )
        updates, opt = optimizer.update(own_grads, opt, own)
        return (optax.apply_updates(own, updates), opt, task_grads), metrics

    start = (
        (rewards.strategies, rewards.shaping),
        state.strategy_opt,
        jax.tree.map(jnp.zeros_like, rewards.task),
    )
    batches = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), rows)
    keys = jax.random.split(key, (num_updates, num_strategies))
    (own, strategy_opt, task_grads), metrics = jax.lax.scan(body, start, (batches, keys))
    updates, task_opt = task_optimizer.update(task_grads, state.task_opt, rewards.task)
    task = optax.apply_updates(rewards.task, updates)
    rewards = rewards._replace(task=task, strategies=own[0], shaping=own[1])
    metrics = jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)
    return RewardsState(rewards, task_opt, strategy_opt), metrics


def step(
    state: MsrdState, env: Episode, demonstrations: Transition, config: MsrdConfig
) -> tuple[MsrdState, Metrics]:
    """Acts, updates the rewards, then the generators; metrics are `[num_strategies]`.

    The rewards come first: they must see log pi of the policies that face them.
    """
    axes = sac.population_axes(state.agents)
    key_rows, key_rewards, key = jax.random.split(state.key, 3)
    agents, transitions = jax.vmap(
        lambda agent: sac.collect(agent, env, config.sac), in_axes=(axes,), out_axes=(axes, 0)
    )(state.agents)
    rows = jax.vmap(
        lambda agent, shown, key: _sample_rows(agent, env, shown, key, config),
        in_axes=(axes, 0, 0),
    )(agents, demonstrations, jax.random.split(key_rows, demonstrations.reward_t.shape[0]))
    learned, metrics = update_rewards(state.learned, rows, key_rewards, config)

    def learn(agent, own):
        agent, batches = sac.draw(agent, env, config.sac)
        # Without log pi: SAC adds the entropy by itself, see `stages.airl`.
        f_t = advantage(own, batches, config)
        f_t = config.reward_scale * jnp.clip(f_t, -config.reward_clip, config.reward_clip)
        return sac.learn(agent, batches._replace(reward_t=f_t), config.sac)

    agents, agent_metrics = jax.vmap(learn, in_axes=(axes, _STRATEGY_AXES), out_axes=(axes, 0))(
        agents, learned.rewards
    )
    averages = optax.incremental_update(
        agents.learner.policy_params, state.averages, config.policy_average_rate
    )
    env_reward = jnp.mean(transitions.reward_t, axis=-1)
    metrics = {**agent_metrics, **metrics, "env_reward": env_reward}
    return MsrdState(agents, averages, learned, key), metrics


def _sample_rows(agent, env, demonstrations, key, config):
    """Draws as many rows of one strategy's demonstrations as of what its generator did."""
    key_expert, key_policy = jax.random.split(key)
    shape = (config.updates_per_step, config.batch_size)
    sizes = (env.observation_size, env.action_size)
    replayed = replay.sample(agent.buffer, key_policy, shape, *sizes)
    index = jax.random.randint(key_expert, shape, 0, demonstrations.reward_t.shape[0])
    expert = jax.tree.map(lambda x: x[index], demonstrations)
    policy = sac.policy_of(agent.learner)

    def log_prob(rows):
        if rows.action_t is None:
            return None
        log_prob_t = sac.log_prob(policy, rows.obs_t, rows.action_t, config.sac)
        return jnp.clip(log_prob_t, -config.log_prob_clip, config.log_prob_clip)

    return Rows(expert, replayed, log_prob(expert), log_prob(replayed))


def train(
    state: MsrdState, env: Episode, demonstrations: Transition, config: MsrdConfig, num_steps: int
) -> tuple[MsrdState, Metrics]:
    """Scans `step`; metrics `[num_strategies]` are averaged over the steps."""
    state, metrics = jax.lax.scan(
        lambda state, _: step(state, env, demonstrations, config), state, None, length=num_steps
    )
    return state, jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics)


def act(
    params: PolicyParams,
    obs_t: jax.Array,
    key: jax.Array,
    config: MsrdConfig,
    action_dim: int,
    deterministic: bool = False,
) -> jax.Array:
    """Samples one strategy's actions, or takes their mode, `[..., action_dim]`."""
    return sac.act(params, obs_t, key, config.sac, action_dim, deterministic)


def reward(
    rewards: MsrdRewards,
    obs_t: jax.Array,
    action_t: jax.Array,
    next_obs_t: jax.Array,
    config: MsrdConfig,
    strategy: int | None = None,
) -> jax.Array:
    """R^0, or R^0 + alpha R~_i of one strategy counted from 0, of the next state, `[...]`."""
    del obs_t, action_t
    task_t = _task(rewards, next_obs_t, config)
    if strategy is None:
        return task_t
    own = jax.tree.map(lambda leaf: leaf[strategy], rewards.strategies)
    return task_t + config.strategy_weight * _apply(own, rewards, next_obs_t, config)


def finish(state: MsrdState) -> MsrdOutput:
    """Reads what is handed on."""
    policies = PolicyParams(state.agents.learner.obs_stats, state.averages)
    return MsrdOutput(policies, state.learned.rewards)
