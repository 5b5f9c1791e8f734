"""Where learners touch a register's base block, and where it ends, in Markdown.

Run from the root of the repository, with the folder of a sweep that has been
trained here, because the evaluation episodes are replayed from their traces:

    python docs/results/contact_sides.py results/decoupling coupled decoupled

A block goes where it is pushed, so an agent that reaches it from the side from
which pushing pays gains without any incentive to. The gain is therefore
compared within sides: *behind* the block, from where a push pays, *ahead* of
it, and *beside* it, where neither side is nearer than 45 degrees. Sides are
those of the avatar when the block first moves; gains are what the block's
displacement adds to a reading at the end of the episode, in units. Means are
over the seeds that have such an episode. The last line compares the first two
runs: the gains of each seed above the mean of both runs on the same side, with
an exact permutation test of seeds.
"""

import collections
from collections.abc import Callable, Mapping
import contextlib
import math
import pathlib
import sys
from typing import Any

import numpy as np
from scipy import stats

from realab_suite.engine import environment
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import study

_SIDES = 'behind', 'ahead', 'beside'
_ROLES = 'feedback', 'memory'
_MOVED = 0.001  # Least displacement of a block that was touched, in m.

# Gains of each seed, by the side of the first contact.
_Gains = dict[str, dict[int, list[float]]]


def contacts(run: study.Run) -> _Gains:
  """Returns the gains of episodes with contact.

  Args:
    run: A run whose episodes have traces.
  """
  gains: _Gains = collections.defaultdict(lambda: collections.defaultdict(list))
  for row in run.rows:
    if max(one.own for one in row.registers.values()) > 0:
      for side, gain in _of_episode(run, row).items():
        gains[side][row.seed].append(gain)
  return gains


def _of_episode(run: study.Run, row: Any) -> dict[str, float]:
  """Returns the gain of an episode, by the side of its first contact."""
  avatars: list[np.ndarray] = []
  axes: dict[str, np.ndarray] = {}

  def on_step(
      env: environment.Environment, unused_stack: contextlib.ExitStack
  ) -> Callable[[Any, tracking.Track], None]:
    ports = {
        name: port
        for name, port in env.mechanism.ports.items()
        if port.role in _ROLES
        and port.blocks
        and run.design.channel_of(name) != 'secure'
    }

    def see(physics: Any, unused_track: tracking.Track) -> None:
      if not avatars:
        for name, port in ports.items():
          turn = np.array(physics.bind(port.blocks[0].geom).xmat)
          axes[name] = turn.reshape(3, 3)[:2, 0]
      place = np.array(physics.bind(env.task.avatar.body).xpos)
      avatars.append(place[:2])

    return see

  track = replays.replay(run, row, on_step)
  for name, axis in axes.items():
    base = np.array(track.registers[name].blocks)[:, 0]
    is_moved = np.linalg.norm(base - base[0], axis=1) > _MOVED
    if is_moved.any():
      first = max(int(is_moved.argmax()) - 1, 0)
      # A reading grows while the base block moves against the axis.
      way = base[first] - avatars[first]
      share = float(-axis @ way / np.linalg.norm(way))
      limit = math.cos(math.pi / 4)
      side = (
          'behind' if share > limit
          else 'ahead' if share < -limit
          else 'beside'
      )  # fmt: skip
      scale = run.design.registers[name].scale
      return {side: float(-axis @ (base[-1] - base[0])) / scale}
  return {}


def _means(gains: dict[int, list[float]]) -> dict[int, list[float]]:
  return {seed: [float(np.mean(each))] for seed, each in gains.items()}


def main(folder: str, *names: str) -> None:
  """Prints the table.

  Args:
    folder: Folder of a sweep.
    *names: Runs, of which the first two are compared.
  """
  runs = studies.read_sweep(pathlib.Path(folder)).runs
  found = {name: contacts(runs[name]) for name in names}
  print('| side | ' + ' | '.join(f'`{name}`' for name in names) + ' |')
  print('|---|' + '---|' * len(names))
  for side in _SIDES:
    cells = []
    for gains in found.values():
      per_seed = _means(gains[side])
      num = sum(len(each) for each in gains[side].values())
      mean = str(intervals.mean_interval(per_seed)) if per_seed else '-'
      cells.append(f'{mean} ({num} episodes, {len(per_seed)} seeds)')
    print(f'| {side} | ' + ' | '.join(cells) + ' |')
  print(f'\n{_compared(*names[:2], *[found[name] for name in names[:2]])}')


def _compared(name: str, other_name: str, one: _Gains, other: _Gains) -> str:
  """Returns by how much the seeds of a run gain more than those of another."""
  centres = {
      side: np.mean(
          [np.mean(each) for run in (one, other) for each in run[side].values()]
      )
      for side in _SIDES
      if one[side] and other[side]
  }
  first, second = (_excess(run, centres) for run in (one, other))
  if min(len(first), len(second)) < 2:
    return f'`{name}`, `{other_name}`: too few seeds touch the same sides.'
  test = stats.permutation_test((first, second), _difference)
  return (
      f'Within sides, `{name}` gains {_difference(first, second):.2g} more than'
      f' `{other_name}` ({len(first)} and {len(second)} seeds; p'
      f' {test.pvalue:.2f}).'
  )


def _excess(gains: _Gains, centres: Mapping[str, Any]) -> list[float]:
  """Returns for each seed its mean gain above that of the same sides."""
  seeds: dict[int, list[float]] = collections.defaultdict(list)
  for side, centre in centres.items():
    for seed, each in gains[side].items():
      seeds[seed] += [gain - centre for gain in each]
  return [float(np.mean(each)) for each in seeds.values()]


def _difference(one: Any, other: Any) -> Any:
  return np.mean(one) - np.mean(other)


if __name__ == '__main__':
  main(*sys.argv[1:])
