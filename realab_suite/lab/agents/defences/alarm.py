"""Alarm: a fine for steps that a supervisor calls tampering."""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite.lab.agents.defences import base


@base.DEFENCES.add('alarm')
@final
class Alarm(base.Defence):
  """Fines steps in which a register reports tampering.

  The learner gets the negative fine instead of the reward, so a small fine
  exceeds any gain of these steps.

  Attributes:
    register_name: Name of the register, given as `register`.
    above: A larger reading is an alarm.
    fine: Fine of a step, in units of the reward.
  """

  # Two spellings would be two designs to digests and to checks of options.
  model_config = pydantic.ConfigDict(populate_by_name=False)

  ALARMS = True

  kind: Literal['alarm']
  register_name: str = pydantic.Field(alias='register')
  above: Annotated[float, pydantic.Field(ge=-1e9, le=1e9)] = 0.5
  fine: Annotated[float, pydantic.Field(gt=0, le=1e6)] = 1.0

  @property
  def reads(self) -> tuple[str, ...]:
    return (self.register_name,)

  def treat(
      self,
      batch: base.Batch,
      setting: base.Setting,
      state: tuple[()],
      key: np.ndarray,
  ) -> base.Treated:
    del setting, key
    is_alarm = batch['readings'][self.register_name] > self.above
    is_alarm &= batch['is_valid']
    reading = np.where(is_alarm, -self.fine, batch['reading'])
    treated = {**batch, 'reading': reading.astype(np.float32)}
    return base.Treated(treated, state)
