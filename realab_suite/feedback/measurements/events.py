"""Measurements of an episode: score, number of collected objects, and time."""

from typing import Literal, final

import numpy as np

from realab_suite.feedback.measurements import base


@base.MEASUREMENTS.add('score')
@final
class Score(base.Measurement):
  """The true return of the episode so far."""

  kind: Literal['score'] = 'score'

  def connect(self, world: base.World) -> base.Measure:
    return world.functions['score']

  def range_in(self, world: base.World) -> base.Range | None:
    return world.ranges.get('score')


@base.MEASUREMENTS.add('collected')
@final
class Collected(base.Measurement):
  """The number of objects of one kind that were collected in the episode.

  Attributes:
    of: Name of the objects, such as `apples`.
  """

  kind: Literal['collected'] = 'collected'
  of: base.PartName

  def connect(self, world: base.World) -> base.Measure:
    counted = {
        name: part.num_collected
        for name, part in world.parts.items()
        if part.num_collected is not None
    }
    if self.of not in counted:
      raise world.unknown('of', self.of, counted)
    return counted[self.of]


@base.MEASUREMENTS.add('time')
@final
class Time(base.Measurement):
  """The time since the start of the episode, in s."""

  kind: Literal['time'] = 'time'

  def connect(self, world: base.World) -> base.Measure:
    del world
    return lambda physics: np.asarray(physics.data.time, np.float64)[()]
