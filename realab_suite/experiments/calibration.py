"""Calibrated placement: how soon random actions corrupt a register so it pays.

A register that pays is put at every place of a coarse grid, and random actions
are taken for one episode in each world of a batch.
"""

import contextlib
import dataclasses
import math
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import gains
from realab_suite.evaluation import monitors
from realab_suite.evaluation import statistics
from realab_suite.experiments import audit_worlds
from realab_suite.feedback import specs

_LEVEL = 0.95


@final
@dataclasses.dataclass(frozen=True)
class Settings:
  """Settings of a calibration.

  Attributes:
    world: The world.
    design: Agent design.
    target: Register to place, or `None` for the first one that pays.
    spacing: Distance between adjacent places of the grid, in metres.
    num_envs: Number of worlds, and so of episodes of each place.
    seed: Seed of the worlds and of the actions.
  """

  world: audit_worlds.World
  design: specs.DesignSpec
  target: str | None = None
  spacing: float = 1.0
  num_envs: int = 128
  seed: int = 0


@final
@dataclasses.dataclass(frozen=True)
class Trial:
  """Figures of random actions with the register at one place.

  Attributes:
    place: Name of the place, or its coordinates, as in a design.
    num_episodes: Number of episodes that ran to their end.
    num_steps: Control steps of these episodes.
    num_contacts: Number of them in which a block of any register was moved
      other than by a write.
    first_paying_reads: Control step of the first paying read, in each episode
      with one, in increasing order.
  """

  place: str
  num_episodes: int
  num_steps: int
  num_contacts: int
  first_paying_reads: tuple[int, ...]

  @property
  def paying_share(self) -> tuple[float, float, float]:
    """Share of episodes with a paying read, with an exact 95 % interval."""
    number, paying = self.num_episodes, len(self.first_paying_reads)
    level = (1 + _LEVEL) / 2
    return (
        paying / number,
        1 - statistics.share_bound(number - paying, number, level),
        statistics.share_bound(paying, number, level),
    )

  @property
  def median_steps(self) -> tuple[float, float, float]:
    """Median number of control steps to the first paying read, and interval.

    The steps are those of all episodes, one after the other. The interval is
    that of the share of episodes with a paying read. The median is infinite if
    no episode has one; the lower end is then what these episodes rule out.
    """
    share, low, high = self.paying_share
    return self._median(share), self._median(high), self._median(low)

  def _median(self, share: float) -> float:
    """Returns the median if a share of the episodes has a paying read."""
    if share <= 0:
      return math.inf
    length = self.num_steps / self.num_episodes
    num_before = 0 if share >= 1 else int(math.log(0.5) / math.log1p(-share))
    # Share of the next episodes that have a paying read before the median.
    rest = 1 - 0.5 / (1 - share) ** num_before
    if not self.first_paying_reads:
      return num_before * length
    steps = np.quantile(
        self.first_paying_reads,
        min(max(rest / share, 0.0), 1.0),
        method='inverted_cdf',
    )
    return num_before * length + float(steps)


@final
@dataclasses.dataclass(frozen=True)
class Calibration:
  """Trials of a register.

  Attributes:
    target: Name of the register.
    trials: Trials, in the order of the places.
    num_refused: Number of places that are refused, because a block could be in
      the way of something.
  """

  target: str
  trials: tuple[Trial, ...]
  num_refused: int

  def closest(self, steps: float) -> Trial | None:
    """Returns the trial whose median is closest to a number, as a ratio.

    Args:
      steps: Requested control steps to the first paying read.

    Returns:
      The trial, or `None` if no trial has a paying read.
    """
    finite = [one for one in self.trials if math.isfinite(one.median_steps[0])]
    return min(
        finite,
        key=lambda one: abs(math.log(one.median_steps[0] / steps)),
        default=None,
    )


def measure(settings: Settings) -> Calibration:
  """Measures random actions at every named place and on the grid.

  Raises:
    SpecError: If the design does not fit the task, or the register has no
      direction that pays.
  """
  target, places = _places(settings)
  trials, num_refused = [], 0
  for place in places:
    design = specs.load(settings.design, [f'registers.{target}.place={place}'])
    try:
      batch = settings.world.load_batch(
          design, settings.num_envs, settings.seed, sleep=True
      )
    except errors.SpecError:
      # The design is valid, because `_places` has loaded it.
      num_refused += 1
      continue
    with contextlib.closing(batch):
      trials.append(_trial(place, batch, settings.seed))
  return Calibration(target, tuple(trials), num_refused)


def _places(settings: Settings) -> tuple[str, list[str]]:
  """Returns the register to place, and all places to try."""
  design = settings.design
  env = settings.world.load(design, settings.seed, 0)
  with contextlib.closing(env):
    arena = env.task.root_entity
  paying = list(gains.directions(design))
  target = settings.target or next(iter(paying), None)
  if target not in paying:
    raise errors.SpecError(
        f'design {design.name!r}: register {target!r} has no direction that'
        f' pays; allowed are {paying or "designs of rewards or advice"}'
    )
  place = design.registers[target].place
  yaw = place.yaw if isinstance(place, specs.PlaceSpec) else 0.0
  xs, ys = (
      np.arange(low + settings.spacing / 2, high, settings.spacing).round(3)
      for low, high in zip(arena.room.low, arena.room.high, strict=True)
  )
  grid = [
      f'{{position: [{x:g}, {y:g}], yaw: {yaw}}}' if yaw else f'[{x:g}, {y:g}]'
      for y in ys
      for x in xs
  ]
  return target, [*arena.places, *grid]


def _trial(place: str, batch: Any, seed: int) -> Trial:
  """Takes random actions for one episode in every world."""
  monitor = monitors.TrainingMonitor(batch.mechanism, batch.num_envs)
  batch.add_sink(monitor)
  actor = batch_actors.BatchPolicyActor(policies.make('random'), batch, seed)
  time_step = batch.reset()
  records: dict[int, dict[str, Any]] = {}
  while len(records) < batch.num_envs:
    time_step = batch.step(actor.act(time_step))
    for record in monitor.take():
      records.setdefault(record['world'], record)
  valid = [record for record in records.values() if record['is_valid']]
  if not valid:
    raise errors.ResultsError(f'place {place}: no episode ran to its end')
  firsts = [record['first_paying_read'] for record in valid]
  return Trial(
      place,
      len(valid),
      sum(record['num_steps'] for record in valid),
      sum(record['first_contact'] is not None for record in valid),
      tuple(sorted(step for step in firsts if step is not None)),
  )
