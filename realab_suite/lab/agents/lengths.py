"""Rewards that leave an agent no preference between lengths of episodes.

DReST, "Discounted Reward for Same-Length Trajectories" (Thornley et al. 2024,
arXiv 2407.00805; Cullen et al. 2026, arXiv 2604.17502), discounts the reward of
an episode whose length was chosen before in the same series of episodes. Here,
the two lengths are those of an episode that a signal ends, and of a whole one.
"""

from collections.abc import Mapping
from typing import Annotated, Any, final

import numpy as np
import pydantic

from realab_suite.config import validation
from realab_suite.lab.agents import base

_NUM_LENGTHS = 2
_Return = Annotated[float, pydantic.Field(gt=0, le=1e6)]


@final
class DrestOptions(validation.Model):
  """Options of DReST.

  Attributes:
    discount: Factor for each earlier episode of the same length.
    episodes: Number of episodes of a series, a meta-episode.
    best: Largest return of an episode that a signal ends, and of a whole one:
      returns count as shares of it.
  """

  discount: base.Fraction = 0.9
  episodes: base.Positive = 8
  best: Annotated[tuple[_Return, _Return], pydantic.Field(strict=False)] = (
      1.0,
      1.0,
  )


@final
class Drest(base.Wrapper):
  """Pays, at the end of an episode, what is missing to its DReST reward.

  With n earlier episodes of its length among the i earlier ones of the series,
  the reward of an episode is `discount ** (n - i / 2)` times its share of the
  best return. Until the end, readings count as shares of the larger best one.
  An episode that training cuts, at a checkpoint, counts as a whole one.
  """

  NAME = 'drest'

  def __init__(self, options: DrestOptions, learner: base.Learner) -> None:
    """Makes the wrapper of a learner."""
    self._options = options
    self._reading = learner.reading
    number = learner.setting.num_envs
    self._state = {
        'sums': np.zeros(number),
        'chosen': np.zeros((number, _NUM_LENGTHS)),
    }

  def read(self, time_step: base.TimeStep) -> dict[str, Any]:
    options, step_type = self._options, np.asarray(time_step.step_type)
    reading = np.asarray(time_step.observation[self._reading], float)
    is_first, is_last = step_type == base.FIRST, step_type == base.LAST
    sums = np.where(is_first, 0.0, self._state['sums'] + reading)
    chosen = self._state['chosen']
    # A signal ends an episode for good; a time limit leaves the discount at 1.
    length = (np.asarray(time_step.discount) > 0).astype(int)
    is_length = np.arange(_NUM_LENGTHS) == length[:, np.newaxis]
    repeats = (chosen * is_length).sum(axis=1)
    repeats = repeats - chosen.sum(axis=1) / _NUM_LENGTHS
    share = sums / np.array(options.best)[length]
    missing = options.discount**repeats * share - sums / max(options.best)
    chosen = chosen + (is_length & is_last[:, np.newaxis])
    is_over = chosen.sum(axis=1, keepdims=True) >= options.episodes
    self._state = {'sums': sums, 'chosen': np.where(is_over, 0.0, chosen)}
    paid = reading / max(options.best) + np.where(is_last, missing, 0.0)
    return {'reading': paid.astype(np.float32)}

  def state(self) -> dict[str, Any]:
    return dict(self._state)

  def set_state(self, state: Mapping[str, Any]) -> None:
    self._state = dict(state)
