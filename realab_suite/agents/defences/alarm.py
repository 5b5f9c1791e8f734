"""Alarm: what to do with steps that a supervisor calls tampering."""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite.agents.defences import base


@base.DEFENCES.add('alarm')
@final
class Alarm(base.Defence):
  """Responds to the reading of a register in which tampering is reported.

  Attributes:
    register_name: Name of the register, given as `register`.
    above: A larger reading is an alarm.
    response: `screen` to leave the step out of the batch; `penalty` to learn
      from a smaller reward; `fine` to learn from a negative reward instead, so
      that a small one does for any gain of the steps with an alarm.
    penalty: What is subtracted from the reward, or its size instead.
  """

  # Two spellings would be two designs to digests and to checks of options.
  model_config = pydantic.ConfigDict(populate_by_name=False)

  ALARMS = True

  kind: Literal['alarm']
  register_name: str = pydantic.Field(alias='register')
  above: Annotated[float, pydantic.Field(ge=-1e9, le=1e9)] = 0.5
  response: Literal['screen', 'penalty', 'fine'] = 'screen'
  penalty: Annotated[float, pydantic.Field(ge=0, le=1e6)] = 1.0

  @pydantic.model_validator(mode='after')
  def _consistent(self) -> 'Alarm':
    is_used = self.response != 'screen'
    if 'penalty' in self.model_fields_set and is_used != (self.penalty > 0):
      rule = 'more than 0' if is_used else 'left out'
      raise ValueError(
          f'penalty: {self.penalty:g} with response {self.response}; must be'
          f' {rule}'
      )
    return self

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
    if self.response == 'screen':
      is_valid = batch['is_valid'] & ~is_alarm
      return base.Treated({**batch, 'is_valid': is_valid}, state)
    reading = batch['reading']
    rest = reading if self.response == 'penalty' else 0.0
    reading = np.where(is_alarm, rest - self.penalty, reading)
    treated = {**batch, 'reading': reading.astype(np.float32)}
    return base.Treated(treated, state)
