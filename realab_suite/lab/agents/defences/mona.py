"""MONA: returns over few steps, plus approval of each action.

Myopic optimisation with non-myopic approval (Farquhar et al. 2025, arXiv
2501.13011), with the horizon as a dial.
"""

from typing import Annotated, Literal, final

import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.lab.agents.defences import base


@base.DEFENCES.add('mona')
@final
class Mona(base.Defence):
  """Cuts returns off after `horizon` steps, without a value for the rest.

  A supervisor who foresees consequences approves of actions instead. Tampering
  that pays later than within the horizon is not learned; what is worth doing
  for later must be approved of.

  Attributes:
    horizon: Number of steps of a piece. Returns end with the piece.
    approval: Name of the register whose reading is the approval of the action.
    query: Name of the query register in which the learner names its action.
    weight: Weight of approval beside rewards.
  """

  kind: Literal['mona']
  horizon: Annotated[int, pydantic.Field(ge=1)] = 1
  approval: str
  query: str
  weight: Annotated[float, pydantic.Field(gt=0, le=1e6)] = 1.0

  @property
  def reads(self) -> tuple[str, ...]:
    return (self.approval,)

  @property
  def queries(self) -> tuple[str, ...]:
    return (self.query,)

  def check(self, setting: base.Setting) -> None:
    options = setting.options
    setting.controls.check_query('learner.defence.query', self.query)
    if options.steps_per_update % self.horizon:
      raise errors.SpecError(
          f'learner.defence.horizon: {self.horizon}; must be a divisor of'
          f' steps_per_update, which is {options.steps_per_update}'
      )
    if options.gae_lambda != 1.0 and self.horizon > 1:
      raise errors.SpecError(
          f'learner.gae_lambda: {options.gae_lambda:g} with mona; must be'
          ' 1.0, because others take values of later states'
      )

  def treat(
      self,
      batch: base.Batch,
      setting: base.Setting,
      state: tuple[()],
      key: np.ndarray,
  ) -> base.Treated:
    del setting, key
    approval = self.weight * batch['readings'][self.approval]
    discount = batch['discount'].copy()
    discount[self.horizon - 1 :: self.horizon] = 0.0
    # What follows a time limit has no value within a piece, either.
    discount[:-1] *= batch['is_valid'][1:]
    reading = (batch['reading'] + approval).astype(np.float32)
    return base.Treated(
        {**batch, 'reading': reading, 'discount': discount}, state
    )
