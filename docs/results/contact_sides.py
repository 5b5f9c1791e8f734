"""Where learners touch a register's base block, and where it ends, in Markdown.

Run from the root of the repository, with the folder of a sweep that has been
trained here, because the evaluation episodes are replayed from their traces:

    python docs/results/contact_sides.py results/decoupling coupled decoupled

A block goes where it is pushed, so an agent that reaches it from the side from
which pushing pays gains without any incentive to. The gain is therefore
compared within sides: *behind* the block, from where a push pays, *ahead* of
it, and *beside* it, where neither side is nearer than 45 degrees. Sides are
those of the avatar when the block first moves by 1 mm; gains are what its
displacement adds to a reading five control steps later, and at the end of the
episode, in units. Means are over the seeds that have such an episode. Below the
table are the numbers of episodes in which a hand holds the block, and two
comparisons of the first two runs: the gains of each seed above the mean of both
runs on the same side, with an exact permutation test of seeds. Only sides that
both touch count.
"""

import collections
from collections.abc import Callable, Mapping
import contextlib
import math
import pathlib
import sys
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from realab_suite.engine import environment
from realab_suite.evaluation import results
from realab_suite.lab.experiments import replays
from realab_suite.lab.experiments import studies
from realab_suite.lab.experiments import tracking
from realab_suite.lab.verdicts import intervals
from realab_suite.lab.verdicts import study

_SIDES = 'behind', 'ahead', 'beside'
_ROLES = 'feedback', 'memory'
_MOVED = 0.001  # Least displacement of a block that was touched, in m.
_SOON = 5  # Control steps after the first contact.


class Contact(NamedTuple):
  """The first contact with a block in an episode.

  Attributes:
    seed: Seed of the agent.
    side: Side of the block on which the avatar was.
    soon: Gain `_SOON` control steps later, in units.
    final: Gain at the end, in units.
    is_held: True if a hand held the block in the episode.
  """

  seed: int
  side: str
  soon: float
  final: float
  is_held: bool


# Gains of each seed, by side.
_Gains = Mapping[str, Mapping[int, list[float]]]


def contacts(run: study.Run) -> list[Contact]:
  """Returns the contact of each episode that has one.

  Args:
    run: A run whose episodes have traces.
  """
  return [
      contact
      for row in run.rows
      if max(one.own for one in row.registers.values()) > 0
      for contact in _of_episode(run, row)
  ]


def _of_episode(run: study.Run, row: results.EpisodeResult) -> list[Contact]:
  avatars: list[np.ndarray] = []
  axes: dict[str, np.ndarray] = {}
  held: set[str] = set()

  def on_step(
      env: environment.Environment, unused_stack: contextlib.ExitStack
  ) -> Callable[[Any, tracking.Track], None]:
    bases = {
        name: port.blocks[0]
        for name, port in env.mechanism.ports.items()
        if port.role in _ROLES
        and port.blocks
        and run.design.channel_of(name) != 'secure'
    }

    def see(physics: Any, unused_track: tracking.Track) -> None:
      if not avatars:
        for name, block in bases.items():
          turn = np.array(physics.bind(block.geom).xmat)
          axes[name] = turn.reshape(3, 3)[:2, 0]
      place = np.array(physics.bind(env.task.avatar.body).xpos)
      avatars.append(place[:2])
      held.update(
          name
          for name, block in bases.items()
          if any(grasp.is_anywhere_held(physics) for grasp in block.grasps)
      )

    return see

  track = replays.replay(run, row, on_step)
  first_contacts = []
  for name, axis in axes.items():
    base = np.array(track.registers[name].blocks)[:, 0]
    is_moved = np.linalg.norm(base - base[0], axis=1) > _MOVED
    if is_moved.any():
      first = max(int(is_moved.argmax()) - 1, 0)
      way = base[first] - avatars[first]
      # A reading grows while the base block moves against the axis.
      side = _side(float(-axis @ way / np.linalg.norm(way)))
      gains = -(base - base[0]) @ axis / run.design.registers[name].scale
      soon = gains[min(first + 1 + _SOON, len(gains) - 1)]
      first_contacts.append(
          Contact(row.seed, side, float(soon), float(gains[-1]), name in held)
      )
  return first_contacts


def _side(share: float) -> str:
  """Returns the side of a block on which an avatar is.

  Args:
    share: Cosine between the way to the block and the direction that pays.
  """
  if abs(share) <= math.cos(math.pi / 4):
    return 'beside'
  return 'behind' if share > 0 else 'ahead'


def _gains(found: list[Contact], name: str) -> _Gains:
  gains: dict[str, dict[int, list[float]]] = {side: {} for side in _SIDES}
  for contact in found:
    of_side = gains[contact.side]
    of_side.setdefault(contact.seed, []).append(getattr(contact, name))
  return gains


def main(folder: str, *names: str) -> None:
  """Prints the table.

  Args:
    folder: Folder of a sweep.
    *names: Runs, of which the first two are compared.
  """
  runs = studies.read_sweep(pathlib.Path(folder)).runs
  by_run = {name: contacts(runs[name]) for name in names}
  print('| side | ' + ' | '.join(f'`{name}`' for name in names) + ' |')
  print('|---|' + '---|' * len(names))
  for side in _SIDES:
    cells = [_cell(by_run[name], side) for name in names]
    print(f'| {side} | ' + ' | '.join(cells) + ' |')
  for name, of_run in by_run.items():
    held = sum(contact.is_held for contact in of_run)
    print(f'\n`{name}`: a hand holds the block in {held} episodes.')
  for kind, when in (('soon', f'{_SOON} steps later'), ('final', 'at the end')):
    gains, other_gains = (_gains(by_run[name], kind) for name in names[:2])
    print(f'\n{when}: {_compared(*names[:2], gains, other_gains)}')


def _cell(found: list[Contact], side: str) -> str:
  """Returns the number of episodes on a side, and both gains."""
  texts = []
  for kind in ('soon', 'final'):
    of_side = _gains(found, kind)[side]
    means = {seed: [float(np.mean(each))] for seed, each in of_side.items()}
    texts.append(str(intervals.mean_interval(means)) if means else '-')
  number = sum(contact.side == side for contact in found)
  return f'{number} episodes: {", ".join(texts)}'


def _compared(name: str, other_name: str, one: _Gains, other: _Gains) -> str:
  """Returns by how much the seeds of a run gain more than those of another."""
  centres = {
      side: float(
          np.mean(
              [
                  np.mean(each)
                  for run in (one, other)
                  for each in run[side].values()
              ]
          )
      )
      for side in _SIDES
      if one[side] and other[side]
  }
  first, second = (_excess(run, centres) for run in (one, other))
  if min(len(first), len(second)) < 2:
    return f'`{name}`, `{other_name}`: too few seeds touch the same sides.'
  test = stats.permutation_test((first, second), _difference)
  return (
      f'within sides, `{name}` gains {_difference(first, second):.2g} more than'
      f' `{other_name}` ({len(first)} and {len(second)} seeds; p'
      f' {test.pvalue:.3f}).'
  )


def _excess(gains: _Gains, centres: Mapping[str, float]) -> list[float]:
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
