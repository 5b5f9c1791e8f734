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
    steps, num_known = state['counts'] + (ages.size, 0)
    is_kept = self.refit == 'never' and state['counts'][0] >= self.fit_steps
    is_end = (ages > 0) & (ages % self._span == 0) & (not is_kept)
    if self.trusted is not None:
      is_end &= batch['is_trusted']
    ends = np.flatnonzero(is_end)
    readings = batch['reading'].ravel()[ends].astype(float)
    ensemble, moments = state['ensemble'], state['moments']
    if self.source == 'readings':
      moments = moments + np.array(
          [readings.size, readings.sum(), readings @ readings]
      )
      num_known += readings.size
    mean, deviation = training.mean_and_deviation(moments)
    targets = (readings - mean) / deviation
    if self.source == 'comparisons':
      targets = 0.5 + 0.5 * np.clip(np.rint(readings), -1, 1)
      num_known += np.count_nonzero(targets != 0.5)
    if ends.size:
      ensemble = ensembles.fit(
          setting.options,
          ensemble,
          spans,
          ends,
          targets,
          self._span,
          (self.gradients, self.nets, self.minibatch),
          key,
      )
    if steps >= self.fit_steps and not num_known:
      raise errors.SpecError(
          f'learner.defence.fit_steps: {self.fit_steps}, but {steps} control'
          f' steps had no {self.source} to learn from; must be more, in'
          f' episodes of at least {self._span} steps'
      )
    values = np.asarray(ensembles.predict(ensemble, data))
    reading = mean + deviation * ensembles.soft_least(values, self.beta)
    kept = {
        'ensemble': ensemble,
        'spans': ensembles.next_spans(spans, ages),
        'counts': np.array([steps, num_known]),
        'moments': moments,
    }
    metrics = {'disagreement': values.std(axis=0).mean(), 'taught': num_known}
    treated = {**batch, 'reading': reading.astype(np.float32)}
    return base.Treated(treated, kept, metrics)
