"""Converts demonstrations between formats; several inputs are several demonstrators, in order.

python -m experiments.convert --from=minari --inputs=me/a-v0,me/b-v0 --out=mine.npz --env=hopper
python -m experiments.convert --from=d4rl --inputs=one.hdf5,two.hdf5 --out=mine.npz --env=hopper
python -m experiments.convert --inputs=half_cheetah --to=minari --out=half_cheetah/shipped-v0

Without --out the inputs are read and described, and nothing is written.
"""

from collections.abc import Iterator

import numpy as np
from absl import flags

from experiments import launch
from represent_jax.data import formats
from represent_jax.data.trajectories import Demonstrations

_KNOWN = "; ".join(f"{name}: {one.what}" for name, one in formats.FORMATS.items())

_FROM = flags.DEFINE_string("from", "npz", f"Format of the inputs. {_KNOWN}.")
_INPUTS = flags.DEFINE_list(
    "inputs", None, "Files, folders or datasets, one for each demonstrator.", required=True
)
_TO = flags.DEFINE_string("to", "npz", "Format of the output, one of those of --from.")
_OUT = flags.DEFINE_string("out", None, "File, folder or dataset to write.")
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace a file that --out names.")
_ENV = flags.DEFINE_string("env", "", "Environment they are of; our own exports say so themselves.")
_LEAVE_OUT = flags.DEFINE_list("leave_out", [], "Of actions and rewards: what not to take over.")


def main(argv: list[str]) -> None:
    launch.refuse_arguments(argv)
    target = formats.find_format(_TO.value)
    if _OUT.value and not _OVERWRITE.value:
        launch.refuse_to_replace(_OUT.value)
    data = formats.read(_FROM.value, _INPUTS.value, _ENV.value, _LEAVE_OUT.value)
    print("\n".join(_describe(data)))
    if _OUT.value:
        target.write(_OUT.value, data)
        print(f"written: {_OUT.value}")


def _describe(data: Demonstrations) -> Iterator[str]:
    """Yields what was read, in lines."""
    actions = f"actions of {data.action_dim}" if data.has_actions else "no actions"
    yield (
        f"{data.env_name}: {len(data.trajectories)} trajectories of {data.num_strategies} "
        f"demonstrators, {sum(t.length for t in data.trajectories):,} steps; "
        f"observations of {data.obs_dim} numbers, {actions}"
    )
    for i in range(data.num_strategies):
        own = data.of_strategy(i)
        lengths = [t.length for t in own]
        known = f"mean return {data.mean_return(i):,.1f}" if data.has_rewards else "no true rewards"
        yield (
            f"  strategy {i + 1}: {len(own)} trajectories of {min(lengths)} to {max(lengths)} "
            f"steps (mean {np.mean(lengths):.0f}), {sum(t.terminated for t in own)} terminated; "
            f"{known}"
        )
    for source in [data.metadata, *data.metadata.get("inputs", ())]:
        for note in source.get("notes", ()):
            yield f"  {source.get('input', source.get('source', 'note'))}: {note}"


if __name__ == "__main__":
    launch.run(main)
