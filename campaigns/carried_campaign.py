"""Campaign: did trained agents carry the blocks of registers, or push them?

Run from the root of the repository, about a second per episode:

    python -m realab_suite.launchers.unpack --input=docs/results/advice.zip \
      --output=results/advice
    python -m campaigns.carried_campaign results/advice

Episodes with a mean gain above 1 margin are replayed. In each control step, the
register that pays gains permanent corruption, which stays, and temporary
corruption, which lasts until the next write. What is gained in the direction
that pays counts as carried if the hand held a block of this register at the
start or at the end of the step, and otherwise as pushed (or thrown). The figure
is the carried share, with its 95 % interval over seeds. Episodes whose replay
differs, for example on another machine, are counted and left out.
"""

from collections.abc import Callable
import contextlib
import pathlib
from typing import Any

import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite.engine import environment
from realab_suite.entities import block_kinds
from realab_suite.evaluation import gains
from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.experiments import result_tables
from realab_suite.reports import replays
from realab_suite.reports import sweep_results


def carried_share(run: sweep_results.Run, row: results.EpisodeRow) -> float:
  """Returns the carried share of what an episode gains.

  Args:
    run: A learned run with one register that pays.
    row: An evaluation episode of the run, with a gain.
  """
  [(name, direction)] = gains.directions(run.design).items()
  permanent: list[float] = []
  temporary: list[float] = []
  held: list[bool] = []

  def watch(
      env: environment.Environment, stack: contextlib.ExitStack
  ) -> Callable[[Any, Any], None]:
    del stack
    register = env.mechanism.registers[name]
    grips = tuple(
        constraint
        for block in register.blocks
        if isinstance(block, block_kinds.JointedBlock)
        for grasp in block.grasps
        for constraint in grasp.constraints
    )

    def look(physics: Any, track: Any) -> None:
      del track
      read: Any = register.inspect(physics)
      permanent.append(float(read.permanent))
      temporary.append(float(read.temporary))
      held.append(bool(np.any(physics.bind(grips).active)))

    return look

  replays.replay(run, row, watch)
  return share(
      direction * np.array(permanent),
      direction * np.array(temporary),
      np.array(held),
  )


def share(
    permanent: np.ndarray, temporary: np.ndarray, held: np.ndarray
) -> float:
  """Returns the carried share of what an episode gains.

  Arguments have a value for the start and for the end of each control step.

  Args:
    permanent: Permanent corruption in the direction that pays, `(steps + 1,)`.
    temporary: Temporary corruption in this direction, `(steps + 1,)`.
    held: True if the hand holds a block, `(steps + 1,)` bool.
  """
  gained = np.maximum(np.diff(permanent), 0) + np.maximum(temporary[1:], 0)
  is_carried = held[1:] | held[:-1]
  return float(gained[is_carried].sum() / gained.sum())


def main(folder: str) -> int:
  """Prints the figures of each learned run of a sweep."""
  for run in sweep_results.load(pathlib.Path(folder)).learned():
    if len(gains.directions(run.design)) != 1:
      continue
    shares: dict[int, list[float]] = {}
    num_different = 0
    for row in run.rows:
      if row.gain is None or row.gain <= 1:
        continue
      try:
        shares.setdefault(row.seed, []).append(carried_share(run, row))
      except errors.ResultsError:
        num_different += 1
    number = sum(map(len, shares.values()))
    text = '-'
    if shares:
      text = result_tables.interval_text(
          intervals.mean_interval(shares, bounds=intervals.SHARE)
      )
    print(
        f'{run.name}: carried share {text} in {number} episodes of'
        f' {len(shares)} seeds; {num_different} replays differ',
        flush=True,
    )
  return 0


if __name__ == '__main__':
  figure_lines.run(main)
