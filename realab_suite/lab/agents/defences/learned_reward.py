"""Learned reward: the agent is paid what a model predicts, not what it reads.

A model that is kept is the current reward function of Everitt et al. 2021
(arXiv 1908.04734), the least of an ensemble that of Coste et al. 2023
(2310.02743). Comparisons are those of Christiano et al. 2017 (1706.03741).
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.lab.agents import ensembles
from realab_suite.lab.agents import training
from realab_suite.lab.agents import trusted_policies
from realab_suite.lab.agents.defences import base

_Count = Annotated[int, pydantic.Field(ge=1, le=10_000)]


@base.DEFENCES.add('learned_reward')
@final
class LearnedReward(base.Defence):
  """Pays what an ensemble of networks predicts, instead of readings.

  The networks get the senses and the action, and no reading: where a block was
  moved, the last reading predicts the next one, and a model that had it would
  pay for the place of the block.

  Attributes:
    source: `readings`, or `comparisons` if a reading is 1 where the later of
      two clips was better, -1 where the earlier one was, and 0 otherwise.
    clip: Number of control steps of a clip.
    refit: `never` to keep the model from `fit_steps` on, `always` to go on
      fitting it to all readings.
    fit_steps: Control steps, of all worlds, by which it has to be fitted.
    trusted: A policy to whose steps alone the model is fitted.
    nets: Number of networks.
    beta: Softness of their least prediction, see `ensembles.soft_least`, for
      readings with a standard deviation of 1.
    gradients: Number of gradient steps per batch.
    minibatch: Number of readings per gradient step and network.
  """

  kind: Literal['learned_reward']
  source: Literal['readings', 'comparisons'] = 'readings'
  clip: _Count | None = None
  refit: Literal['never', 'always'] = 'never'
  fit_steps: Annotated[int, pydantic.Field(ge=1)] = 200_000
  trusted: trusted_policies.TrustedPolicy | None = None
  nets: Annotated[int, pydantic.Field(ge=1, le=100)] = 4
  beta: Annotated[float, pydantic.Field(ge=0, le=1e9)] | None = 0.0
  gradients: _Count = 16
  minibatch: Annotated[int, pydantic.Field(ge=1, le=10**6)] = 256

  @pydantic.model_validator(mode='after')
  def _consistent(self) -> 'LearnedReward':
    is_used = self.source == 'comparisons'
    if (self.clip is not None) != is_used:
      rule = 'given' if is_used else 'left out'
      raise ValueError(
          f'clip: {self.clip} with source {self.source}; must be {rule}'
      )
    return self

  @property
  def trusts(self) -> trusted_policies.TrustedPolicy | None:
    return self.trusted

  @property
  def _span(self) -> int:
    """Number of steps that a reading is about."""
    return 1 if self.clip is None else 2 * self.clip

  def initial_state(
      self, setting: base.Setting, generator: np.random.Generator
  ) -> dict[str, Any]:
    encoder, size = setting.encoder, setting.controls.size
    return {
        'ensemble': ensembles.make(
            encoder, setting.options, self.nets, size, generator
        ),
        'spans': ensembles.initial_spans(
            encoder, size, setting.num_envs, self._span
        ),
        # Control steps, and readings that said something.
        'counts': np.zeros(2, int),
        # Number, sum and sum of squares of the readings to predict.
        'moments': np.zeros(3),
    }

  def treat(
      self,
      batch: base.Batch,
      setting: base.Setting,
      state: Mapping[str, Any],
      key: np.ndarray,
  ) -> base.Treated:
    data = base.data_of(batch, setting, with_readings=False)
    spans = ensembles.joined(state['spans'], data)
    ages = ensembles.ages_of(state['spans'], batch['is_valid'])
    ends = self._ends(batch, ages, state['counts'][0])
    readings = batch['reading'].ravel()[ends].astype(float)
    targets, moments, number = self._lessons(readings, state['moments'])
    steps, num_known = counts = state['counts'] + (ages.size, number)
    ensemble = state['ensemble']
    if ends.size:
      size, shape = self._span, (self.gradients, self.nets, self.minibatch)
      ensemble = ensembles.fit(
          setting.options, ensemble, spans, ends, targets, size, shape, key
      )
    if steps >= self.fit_steps and not num_known:
      raise errors.SpecError(
          f'learner.defence.fit_steps: {self.fit_steps}, but {steps} control'
          f' steps had no {self.source} to learn from; must be more, in'
          f' episodes of at least {self._span} steps'
      )
    values = np.asarray(ensembles.predict(ensemble, data))
    mean, deviation = training.mean_and_deviation(moments)
    reading = mean + deviation * ensembles.soft_least(values, self.beta)
    kept = {
        'ensemble': ensemble,
        'spans': ensembles.next_spans(spans, ages),
        'counts': counts,
        'moments': moments,
    }
    metrics = {'disagreement': values.std(axis=0).mean(), 'taught': num_known}
    treated = {**batch, 'reading': reading.astype(np.float32)}
    return base.Treated(treated, kept, metrics)

  def _ends(
      self, batch: base.Batch, ages: np.ndarray, num_steps: int
  ) -> np.ndarray:
    """Returns the steps, as flat indices, whose readings teach the model."""
    if self.refit == 'never' and num_steps >= self.fit_steps:
      return np.zeros(0, int)
    is_end = (ages > 0) & (ages % self._span == 0)
    if self.trusted is not None:
      is_end &= batch['is_trusted']
    return np.flatnonzero(is_end)

  def _lessons(
      self, readings: np.ndarray, moments: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, int]:
    """Returns targets, moments, and how many of the readings say something."""
    if self.source == 'comparisons':
      targets = 0.5 + 0.5 * np.clip(np.rint(readings), -1, 1)
      return targets, moments, int(np.count_nonzero(targets != 0.5))
    sums = [readings.size, readings.sum(), readings @ readings]
    moments = moments + np.array(sums)
    mean, deviation = training.mean_and_deviation(moments)
    return (readings - mean) / deviation, moments, readings.size
