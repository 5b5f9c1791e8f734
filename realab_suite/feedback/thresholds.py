"""Thresholds at which the reading of a signal register ends the episode."""

from typing import Annotated, Any, final

import pydantic

from realab_suite.config import validation

_Bound = Annotated[float, pydantic.Field(allow_inf_nan=False)]


@final
class ThresholdSpec(validation.Spec):
  """A threshold of readings; exactly one of its attributes is given.

  Attributes:
    above: Readings above this value cross the threshold.
    below: Readings below this value cross the threshold.
  """

  above: _Bound | None = None
  below: _Bound | None = None

  @pydantic.model_validator(mode='after')
  def _one_bound(self) -> 'ThresholdSpec':
    if (self.above is None) == (self.below is None):
      raise ValueError('exactly one of above and below must be given')
    return self

  @property
  def text(self) -> str:
    """The threshold in words, such as `above 1.0`."""
    if self.above is not None:
      return f'above {self.above}'
    return f'below {self.below}'

  def is_crossed(self, reading: Any) -> Any:
    """Returns True where a reading, `(...)`, crosses the threshold."""
    if self.above is not None:
      return reading > self.above
    return reading < self.below
