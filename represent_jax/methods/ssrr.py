"""SSRR (Chen, Paleja, Gombolay; CoRL 2020, https://arxiv.org/abs/2010.11723) on the same stages.

Noisy-AIRL, noise-performance curve and snippet regression of one demonstrator. It is what
REPRESENT is with a single reward: no R~^i, so neither Eq. 4 nor Eq. 5. For a task reward the
demonstrations of all strategies are merged, as in the paper's Tables I and II.
"""

import dataclasses

from represent_jax.methods.config import RepresentConfig


def configure(config: RepresentConfig) -> RepresentConfig:
    """Turns a preset's settings into SSRR's on merged demonstrations."""
    regression = dataclasses.replace(
        config.regression, strategy_weight=0.0, lambda_reg=0.0, lambda_bcd=0.0
    )
    return dataclasses.replace(config, method="ssrr", grouping="merged", regression=regression)
