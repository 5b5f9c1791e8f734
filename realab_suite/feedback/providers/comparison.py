"""Comparison: which of two clips of an episode was better."""

from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.feedback.providers import base
from realab_suite.feedback.providers import growth
from realab_suite.feedback.providers import queries


@base.PROVIDERS.add('comparison')
@final
class Comparison(growth.WeightedSum):
  """Provider that compares two consecutive clips by the growth of a sum.

  At the end of each pair of clips, it writes 1 if the later one is better, -1
  if the earlier one is, and 0 if neither is. Otherwise it is silent. Pairs are
  those about which a `person` is asked.

  Attributes:
    clip: Length of each clip, in steps.
    tolerance: Largest difference of the growth of equally good clips.
    every: Only 1.
  """

  kind: Literal['comparison'] = 'comparison'
  clip: Annotated[int, pydantic.Field(ge=1, le=10_000)] = 10
  tolerance: Annotated[float, pydantic.Field(ge=0, le=1e9)] = 1e-3
  every: Annotated[int, pydantic.Field(ge=1, le=1)] = 1

  def check(self, design: Any) -> None:
    queries.check_clip(design, self.writes[0], self.clip)

  def initial_state(self, batch_shape: tuple[int, ...]) -> dict[str, Any]:
    return {
        'steps': np.zeros(batch_shape, int),
        'total': np.zeros(batch_shape),
        # What each clip of the pair has grown by so far.
        'sums': np.zeros((*batch_shape, 2)),
    }

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[base.Writes, dict[str, Any]]:
    del observation, key
    steps = np.where(episode_start, 0, state['steps']) + 1
    before = np.where(episode_start, 0.0, state['total'])
    total = self._total(readings)
    place, is_end = queries.place_of(steps, self.clip)
    is_new = (place == 0)[..., np.newaxis]
    is_clip = np.arange(2) == (place >= self.clip)[..., np.newaxis]
    sums = np.where(is_new, 0.0, state['sums'])
    sums = sums + is_clip * (total - before)[..., np.newaxis]
    better = queries.sign(sums[..., 1] - sums[..., 0], self.tolerance)
    state = {'steps': steps, 'total': total, 'sums': sums}
    return {self.writes[0]: (better, is_end)}, state
