"""Settings of the gate of `gates`, an option of Q-learning."""

from typing import Annotated, final

import pydantic

from realab_suite.config import validation
from realab_suite.lab.agents import trusted_policies

_Positive = Annotated[int, pydantic.Field(ge=1, le=10**9)]


@final
class Gate(validation.Model):
  """Holds back unexpected readings, and decides about them in trials.

  Attributes:
    threshold: Largest difference between a reading and its prediction that is
      expected, in units of the register.
    fit_steps: Control steps of all worlds until the model is kept and the gate
      opens. What is read until then is believed.
    trusted: A policy from whose steps alone is learned until then; `None` for
      the learner's own.
    alarms: Number of unexpected readings that start a trial.
    gradients: Number of gradient steps of each copy, about.
    trial_steps: Number of control steps of each world in a trial.
  """

  threshold: Annotated[float, pydantic.Field(gt=0, le=1e9)]
  fit_steps: _Positive
  trusted: trusted_policies.TrustedPolicy | None = None
  alarms: _Positive = 64
  gradients: _Positive = 512
  trial_steps: _Positive = 250

  @pydantic.model_validator(mode='after')
  def _without_cloning(self) -> 'Gate':
    if self.trusted is not None and self.trusted.clone_steps:
      raise ValueError(
          f'trusted.clone_steps: {self.trusted.clone_steps}; must be 0,'
          ' because a learner of values clones no policy'
      )
    return self
