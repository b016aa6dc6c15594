"""Measures engines, MJX's solver settings, populations of agents and growth on this machine.

    python -m experiments.benchmark --sections=engines --num_envs=64,256

All rates of a table are taken in turns within one process, so that ratios hold on a busy machine:
a ratio is the median over rounds of the ratio within a round. Compilation is timed apart.
"""

import copy
import dataclasses
import itertools
import resource
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from absl import flags
from mujoco import batch as mujoco_batch

from experiments import benchmark_scaling, launch
from represent_jax.agents import sac
from represent_jax.config import config_hash, to_dict
from represent_jax.envs import Environment, Episode, make_env
from represent_jax.errors import UsageError, unknown
from represent_jax.methods import transfer
from represent_jax.physics.mjx import MjxEngine, MjxSolver
from represent_jax.runs import append_record, provenance
from represent_jax.types import Transition

State = Any  # Brax's

_SECTIONS = ("engines", "solver", "population", "scaling")
_LOOP, _MUJOCO, _EPISODE, _MJX, _GYM = (
    "mujoco.batch, Python loop",
    "mujoco, jit(scan)",
    "mujoco, jit(scan), episodes",
    "mjx, jit(scan)",
    "gymnasium.make_vec, sync",
)
_ENVS = flags.DEFINE_list("envs", list(transfer.TASKS), "Environments.")
_NUM_ENVS = flags.DEFINE_list("num_envs", ["64"], "Numbers of environments stepped together.")
_SECTION = flags.DEFINE_list("sections", ["engines", "population"], "Among " + str(_SECTIONS))
_SECONDS = flags.DEFINE_float("seconds", 1.0, "Least time of one measurement.", lower_bound=0.0)
_REPEATS = flags.DEFINE_integer("repeats", 5, "Rounds of measurements.", lower_bound=1)
_MJX_ROW = flags.DEFINE_bool("mjx", True, "Whether to measure mjx (compiles for a minute).")
_POPULATION = flags.DEFINE_list("population", ["1", "2", "4", "8"], "Agents in one vmap.")
_SOLVER = flags.DEFINE_list(
    "solver",
    ["1/4", "2/4", "3/4", "4/2", "4/4", "4/8", "4/4/sparse", "8/8", "100/50"],
    "MJX settings to compare: iterations/line search[/sparse]; the last is the ratios' base.",
)
_SCALING = flags.DEFINE_multi_string(
    "scaling",
    [
        "seeds:1,2,3,4:40",
        "environments:32,64,128,256:4096",
        "strategies:1,2,3,4:16",
        "demonstrations:5,10,20,40:400",
        "horizon:50,100,200,400:1000",
    ],
    "What grows, as axis:measured sizes:extrapolated sizes.",
)
_RECORD = flags.DEFINE_string("record", None, "File to append the results to, one JSON a line.")


@dataclasses.dataclass
class Row:
    """Something whose speed is measured.

    Attributes:
      name: what the table calls it.
      run: does `work` units of work, and returns when they are done.
      work: units, such as environment steps.
      compile_seconds: what the first call took longer than the second.
      rates: units a second, one for each round.
    """

    name: str
    run: Callable[[], None]
    work: int
    compile_seconds: float = 0.0
    rates: list[float] = dataclasses.field(default_factory=list)

    @property
    def rate(self) -> float:
        return float(np.median(self.rates))

    def ratio_to(self, other: "Row") -> float:
        return float(np.median(np.divide(self.rates, other.rates)))


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    for section in _SECTION.value:
        if section not in _SECTIONS:
            raise unknown("section", section, _SECTIONS)
    print(f"Machine: {provenance()['device']}, JAX on {jax.default_backend()}.")
    print(f"Median of {_REPEATS.value} rounds of at least {_SECONDS.value:g} s each.\n")
    if "engines" in _SECTION.value:
        _engines()
    if "solver" in _SECTION.value:
        _solver_settings()
    if "population" in _SECTION.value:
        _population()
    if "scaling" in _SECTION.value:
        _scaling()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"Peak resident memory of this process: {peak:.2f} GiB.")


def _engines() -> None:
    heads = ("environment", "number", "engine", "env steps/s", "to Python loop", "compile, s")
    table = []
    for name, num_envs in itertools.product(_ENVS.value, _integers(_NUM_ENVS)):
        env = make_env(name, "mujoco")
        rows = [_python_loop(env, num_envs), _jitted(_MUJOCO, env, num_envs, 100)]
        rows.append(_jitted(_EPISODE, Episode(env), num_envs, 100))
        if _MJX_ROW.value:
            rows.append(_jitted(_MJX, make_env(name, "mjx"), num_envs, 10))
        if name in transfer.TASKS:
            try:
                rows.append(_gymnasium(name, num_envs))
            except ImportError as error:
                print(f"Gymnasium's MuJoCo environments are left out: {error}.")
        _measure(rows)
        for row in rows:
            ratio = row.ratio_to(rows[0])
            cells = (f"{row.rate:,.0f}", f"{ratio:.2f}", f"{row.compile_seconds:.1f}")
            table.append((name, str(num_envs), row.name, *cells))
            _record(name, row.name, "env_steps_per_second", row.rate, f"num_envs={num_envs}")
            _record(name, row.name, "ratio_to_python_loop", ratio, f"num_envs={num_envs}")
    _print_table(heads, table)
    print("Actions are random. Gymnasium and 'episodes' restart what has ended, others go on.\n")


def _python_loop(env: Environment, num_envs: int) -> Row:
    """The limit: the same thread pool, task and dtypes without JAX in between."""
    num_steps = 100
    model, frame_skip = env.engine.model, env.engine.frame_skip
    batch = mujoco_batch.Batch(model, num_envs, min(env.engine.num_threads, num_envs))
    qpos, qvel, ctrl = (batch.bind(field) for field in ("qpos", "qvel", "ctrl"))
    for field in env.engine.derived_fields:
        batch.bind(field)
    rng = np.random.default_rng(0)

    def run() -> None:
        for _ in range(num_steps):
            x_before = qpos[:, 0].copy()
            actions = rng.uniform(-1.0, 1.0, ctrl.shape).astype(np.float32)
            ctrl[:] = actions
            batch.step(nstep=frame_skip)
            np.concatenate([qpos[:, 1:], qvel], axis=1).astype(np.float32)
            (qpos[:, 0] - x_before) / env.engine.dt - 0.1 * np.square(actions).sum(axis=1)

    return Row(_LOOP, run, num_steps * num_envs)


def _jitted(name: str, env: Environment | Episode, num_envs: int, num_steps: int) -> Row:
    @jax.jit
    def rollout(state: State, key: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        def body(state: State, key: jax.Array) -> tuple[State, jax.Array]:
            shape = (num_envs, env.action_size)
            actions = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
            state = jax.vmap(env.step)(state, actions)
            return state, jnp.sum(state.obs) + jnp.sum(state.reward)

        key, key_scan = jax.random.split(key)
        state, sums = jax.lax.scan(body, state, jax.random.split(key_scan, num_steps))
        return state, key, jnp.sum(sums)

    keys = jax.random.split(jax.random.PRNGKey(0), num_envs)
    carry = [jax.jit(jax.vmap(env.reset))(keys), jax.random.PRNGKey(1)]

    def run() -> None:
        *carry[:], total = rollout(*carry)
        jax.block_until_ready(total)

    return Row(name, run, num_steps * num_envs)


def _gymnasium(name: str, num_envs: int) -> Row:
    num_steps = 20
    gym_name, options = transfer.TASKS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # -v4 is called outdated; it is the one with this reward
        mujoco.set_mju_user_warning(lambda message: None)  # one for each model compiled
        try:
            envs = gymnasium.make_vec(gym_name, num_envs, "sync", **options)
        finally:
            mujoco.set_mju_user_warning(None)
    envs.reset(seed=0)
    rng = np.random.default_rng(0)

    def run() -> None:
        for _ in range(num_steps):
            envs.step(rng.uniform(-1.0, 1.0, envs.action_space.shape).astype(np.float32))

    return Row(_GYM, run, num_steps * num_envs)


def _solver_settings() -> None:
    """Errors of one step of MJX against C MuJoCo, on states of random rollouts."""
    num_envs = _integers(_NUM_ENVS)[0]
    table = []
    for name in _ENVS.value:
        env = make_env(name, "mujoco")
        before, actions, obs, rewards = _random_steps(env, num_envs)
        rows, errors = [], []
        for setting in _SOLVER.value:
            step = _solver_step(env, setting)
            results = [step(b, a) for b, a in zip(before, actions, strict=True)]
            found = jax.device_get(jax.tree.map(lambda *x: jnp.stack(x), *results))
            pair = zip(found, (obs, rewards), strict=True)
            errors.append([_relative_error(ours, reference) for ours, reference in pair])

            def run(step: Callable = step, before=before, actions=actions) -> None:
                jax.block_until_ready([step(before[-1], actions[-1]) for _ in range(5)])

            rows.append(Row(setting, run, 5 * num_envs))
        _measure(rows)
        for row, (obs_error, reward_error) in zip(rows, errors, strict=True):
            chosen = env.task.mjx_solver
            mark = " (chosen)" if row.name == f"{chosen.iterations}/{chosen.ls_iterations}" else ""
            cells = (f"{obs_error}", f"{reward_error}", f"{row.ratio_to(rows[-1]):.1f}")
            table.append((name, row.name + mark, *cells))
    quantiles = "median, 99 %, max"
    base_name = f"speed to {_SOLVER.value[-1]}"
    heads = ("environment", "solver", f"obs ({quantiles})", f"reward ({quantiles})", base_name)
    _print_table(heads, table)


def _solver_step(env: Environment, setting: str) -> Callable:
    iterations, ls_iterations, *jacobian = setting.split("/")
    model = copy.copy(env.engine.model)
    if jacobian == ["sparse"]:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    elif jacobian or not (iterations.isdigit() and ls_iterations.isdigit()):
        raise UsageError(f"solver: expected iterations/line search[/sparse], found {setting!r}")
    solver = MjxSolver(int(iterations), int(ls_iterations))
    engine = MjxEngine(model, env.engine.frame_skip, env.engine.derived_fields, solver)
    mjx_env = Environment(env.task, engine)

    @jax.jit
    @jax.vmap
    def step(state: State, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = mjx_env.step(state, action)
        return after.obs, after.reward

    return step


def _random_steps(env: Environment, num_envs: int) -> tuple[list, list, np.ndarray, np.ndarray]:
    """Every fifth step of random rollouts: states before, actions, observations and rewards."""

    @jax.jit
    def rollout(state: State) -> tuple:
        def body(state: State, key: jax.Array) -> tuple:
            shape = (num_envs, env.action_size)
            actions = jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
            after = jax.vmap(env.step)(state, actions)
            return after, (state, actions, after.obs, after.reward)

        return jax.lax.scan(body, state, jax.random.split(jax.random.PRNGKey(1), 200))[1]

    reset = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), num_envs))
    rows = [jax.tree.map(lambda x, i=i: x[i], rollout(reset)) for i in range(0, 200, 5)]
    before, actions, obs, rewards = zip(*rows, strict=True)
    return list(before), list(actions), np.stack(obs), np.stack(rewards)


def _relative_error(ours: np.ndarray, reference: np.ndarray) -> str:
    """Returns quantiles of |ours - reference| / max(1, |reference|), largest entry of each step."""
    error = np.abs(ours - reference) / np.maximum(1.0, np.abs(reference))
    error = error.max(axis=-1) if error.ndim == 3 else error
    return ", ".join(f"{x:.0e}" for x in (np.median(error), np.quantile(error, 0.99), error.max()))


def _population() -> None:
    """SAC updates of agents side by side in one vmap."""
    num_updates, env = 16, make_env("half_cheetah", "mujoco")
    config = sac.SacConfig()
    obs_dim, action_dim = env.observation_size, env.action_size
    rows = []
    for size in _integers(_POPULATION):
        keys = jax.random.split(jax.random.PRNGKey(0), size)
        learners = jax.jit(
            jax.vmap(lambda key: sac.init_learner(key, obs_dim, action_dim, config))
        )(keys)
        rng = np.random.default_rng(0)
        shape = (size, num_updates, config.batch_size)
        batches = Transition(
            obs_t=jnp.asarray(rng.normal(size=(*shape, obs_dim)), jnp.float32),
            action_t=jnp.asarray(rng.uniform(-1.0, 1.0, (*shape, action_dim)), jnp.float32),
            next_obs_t=jnp.asarray(rng.normal(size=(*shape, obs_dim)), jnp.float32),
            reward_t=jnp.ones(shape),
            discount_t=jnp.ones(shape),
            noise_level_t=jnp.zeros(shape),
        )

        @jax.jit
        @jax.vmap
        def learn(learner: sac.LearnerState, batches: Transition, key: jax.Array) -> tuple:
            def body(learner: sac.LearnerState, inputs: tuple) -> tuple:
                return sac.update(learner, *inputs, config)

            keys = jax.random.split(key, num_updates)
            learner, metrics = jax.lax.scan(body, learner, (batches, keys))
            return learner, metrics["critic_loss"][-1]

        def run(learn=learn, learners=learners, batches=batches, keys=keys) -> None:
            jax.block_until_ready(learn(learners, batches, keys))

        rows.append(Row(str(size), run, size * num_updates))
    _measure(rows)
    table = []
    for row in rows:
        speedup = row.ratio_to(rows[0])
        each = row.rate / int(row.name)
        cells = (f"{row.rate:,.0f}", f"{each:,.0f}", f"{speedup:.2f}", f"{row.compile_seconds:.1f}")
        table.append((row.name, *cells))
        preset = f"population={row.name}"
        _record("half_cheetah", "sac", "updates_per_second", row.rate, preset)
    heads = ("agents", "updates/s in all", "of each", f"to {rows[0].name} agents", "compile, s")
    width = "x".join(str(units) for units in config.hidden_sizes)
    print(f"SAC updates, batch {config.batch_size}, networks {width}, HalfCheetah's sizes:\n")
    _print_table(heads, table)


def _scaling() -> None:
    """How time and memory grow along each axis."""
    heads = ("what grows", "work", "number", "seconds", "MiB", "from")
    table, lines = [], []
    for axis, sizes, far in [benchmark_scaling.parse(text) for text in _SCALING.value]:
        rows, seconds, mib = benchmark_scaling.measure(axis, sizes, far, _REPEATS.value)
        for row in rows:
            told = "measured" if row.measured else "extrapolated"
            cells = (f"{row.size:,}", f"{row.seconds:.3f}", f"{row.mib:,.1f}", told)
            table.append((row.axis, row.work, *cells))
            if row.measured:
                preset = f"{row.axis}={row.size}"
                _record("half_cheetah", "scaling", "seconds", row.seconds, preset)
                _record("half_cheetah", "scaling", "mib", row.mib, preset)
        cells = (
            f"{line.start:.3g} + {line.slope:.3g} n, R² {line.r_squared:.3f}"
            for line in (seconds, mib)
        )
        lines.append((axis, *cells))
    print(
        "Growth at HalfCheetah's sizes; a round is one run of each size. MiB are the arguments, "
        "outputs and\ntemporary arrays of the compiled program, without MuJoCo's own and the "
        "process around them.\n"
    )
    _print_table(heads, table)
    _print_table(("what grows", "seconds, line through what was measured", "MiB"), lines)


def _measure(rows: list[Row]) -> None:
    """Warms up, then takes the rows in turns."""
    for row in rows:
        first, second = _seconds(row), _seconds(row)
        row.compile_seconds = max(first - second, 0.0)
    for _ in range(_REPEATS.value):
        for row in rows:
            calls, seconds = 0, 0.0
            while seconds < _SECONDS.value or not calls:
                seconds += _seconds(row)
                calls += 1
            row.rates.append(calls * row.work / seconds)


def _seconds(row: Row) -> float:
    start = time.perf_counter()
    row.run()
    return time.perf_counter() - start


def _record(domain: str, target: str, quantity: str, value: float, preset: str) -> None:
    if _RECORD.value is None:
        return
    settings = {"repeats": _REPEATS.value, "seconds": _SECONDS.value}
    append_record(
        _RECORD.value,
        domain=domain,
        method="benchmark",
        target=target,
        quantity=quantity,
        seed=0,
        value=value,
        preset=preset,
        backend=jax.default_backend(),
        config_hash=config_hash(to_dict(sac.SacConfig()) | settings),
        seconds=_REPEATS.value * _SECONDS.value,
    )


def _integers(flag: flags.FlagHolder) -> list[int]:
    bad = [text for text in flag.value if not text.isdigit() or int(text) < 1]
    if bad:
        raise UsageError(f"--{flag.name}: expected positive integers, found {bad[0]!r}")
    return [int(text) for text in flag.value]


def _print_table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    rule = tuple("-" * width for width in widths)
    for cells in (heads, rule, *rows):
        print("| " + " | ".join(c.ljust(w) for c, w in zip(cells, widths, strict=True)) + " |")
    print(flush=True)


if __name__ == "__main__":
    launch.run(main)
