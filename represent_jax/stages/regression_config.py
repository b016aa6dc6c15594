"""Settings of Phase 3."""

import dataclasses
import enum

from represent_jax.config import later, require, require_indices, require_sizes


class Discrimination(enum.StrEnum):
    """How Eq. 5 is read; u_i(m) is the mean of rho^i over a demonstration of strategy m.

    LOG_RATIO: (u_i(m) - sg u_i(i) - log w)^2, Eq. 5 in the exponent: a bounded target.
    FLAIR: (exp u_i(m) - w exp sg u_i(i))^2, the loss of FLAIR's code with target ratio w.
    LITERAL: (exp u_i(i) - exp u_i(m))^2, Eq. 5 as printed; it makes strategies equal.
    """

    LOG_RATIO = "log_ratio"
    FLAIR = "flair"
    LITERAL = "literal"


@dataclasses.dataclass(frozen=True)
class RegressionConfig:
    """Settings of Phase 3.

    Attributes:
      num_updates: Adam steps.
      num_snippets: snippets of each strategy in a step.
      states_per_snippet: states drawn from a snippet to estimate its sum; even.
      num_demonstration_states: states of each strategy's demonstrations in a step.
      min_snippet_steps, max_snippet_steps: range of a snippet's length.
      hidden_sizes: units of the hidden layers of every head.
      learning_rate: Adam's step size.
      kernel_scale: standard deviation of initial kernels (SSRR: 0.001).
      l2: weight of R^0's squared kernels (SSRR: 0.1).
      strategy_l2: weight of those of every R~^i, which Eq. 4 keeps small already.
      ensemble_size: independent copies, whose mean is the reward.
      return_scale: learned return of a whole episode whose curve value is 1 (SSRR: 10).
      strategy_weight: alpha_i of Eq. 1, for all strategies.
      lambda_ssrr, lambda_reg, lambda_bcd: weights of Eq. 2's terms.
      discrimination: reading of Eq. 5.
      discrimination_ratio: w, target of exp u_i(m) / exp u_i(i).
      include_action: whether rewards see state and action as well as the next state.
      task_entries: entries of the next observation that R^0 sees, such as the objects that a task
        is about; everything that a R~^i sees if empty.
      input_quantile: rewards see no input beyond this quantile of the noisy rollouts, nor below
        its counterpart: what lies outside counts as being at the edge, so that nothing is paid for
        going on where nobody has been. Not bounded if none.
      within_demonstrations: whether rewards see nothing beyond what was demonstrated, R^0 by all,
        R~^i by strategy i, and R^0 falls there as steeply as it rises within. More of the task was
        better in all that was rolled out; only demonstrations tell where to stop. R^0 sees all of
        what was demonstrated, whatever `input_quantile` says.
      learn_units: whether each strategy's curve has a unit of its own, learned with the rewards.
        Scaled to [0, 1] by themselves, curves say that all strategies are equally good without
        noise; R^0, which sees them all, then has to call the better one's rollouts too bad.
    """

    num_updates: int = 3000
    num_snippets: int = 64
    states_per_snippet: int = 16
    num_demonstration_states: int = 256
    min_snippet_steps: int = 50
    max_snippet_steps: int = 500
    hidden_sizes: tuple[int, ...] = (128, 128)
    learning_rate: float = 1e-4
    kernel_scale: float = 1e-3
    l2: float = 0.1
    strategy_l2: float = 0.01
    ensemble_size: int = 3
    return_scale: float = 10.0
    strategy_weight: float = 1.0
    lambda_ssrr: float = 1.0
    lambda_reg: float = 0.1
    lambda_bcd: float = 0.01
    discrimination: str = "log_ratio"
    discrimination_ratio: float = 0.7
    include_action: bool = False
    task_entries: tuple[int, ...] = later(())
    input_quantile: float | None = later(None)
    within_demonstrations: bool = later(False)
    learn_units: bool = later(True, before=False)

    @property
    def revision(self) -> int:
        """Of what is made of these settings: 2 since R^0 sees all that was demonstrated."""
        return 2 if self.within_demonstrations and self.input_quantile is not None else 1

    def __post_init__(self) -> None:
        for field in (
            *("num_updates", "num_snippets", "num_demonstration_states"),
            *("min_snippet_steps", "ensemble_size"),
        ):
            require(getattr(self, field) >= 1, field, "at least 1", getattr(self, field))
        for field in ("learning_rate", "kernel_scale", "return_scale"):
            require(getattr(self, field) > 0.0, field, "positive", getattr(self, field))
        for field in (
            *("l2", "strategy_l2", "strategy_weight"),
            *("lambda_ssrr", "lambda_reg", "lambda_bcd"),
        ):
            require(getattr(self, field) >= 0.0, field, ">= 0", getattr(self, field))
        require_sizes(self.hidden_sizes)
        require(
            self.states_per_snippet >= 2 and self.states_per_snippet % 2 == 0,
            "states_per_snippet",
            "even and at least 2",
            self.states_per_snippet,
        )
        require(
            self.max_snippet_steps >= self.min_snippet_steps,
            "max_snippet_steps",
            f"at least min_snippet_steps ({self.min_snippet_steps})",
            self.max_snippet_steps,
        )
        readings = tuple(Discrimination)
        require(
            self.discrimination in readings,
            "discrimination",
            f"one of {', '.join(readings)}",
            self.discrimination,
        )
        require(
            0.0 < self.discrimination_ratio <= 1.0,
            "discrimination_ratio",
            "in (0, 1]",
            self.discrimination_ratio,
        )
        require_indices(self.task_entries, "task_entries")
        if self.input_quantile is not None:
            require(
                0.5 < self.input_quantile <= 1.0,
                "input_quantile",
                "in (0.5, 1], or none",
                self.input_quantile,
            )
