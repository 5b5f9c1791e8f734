"""Inspection: supervision with a price (paper, section 4.5)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, final

import numpy as np
import pydantic

from realab_suite.config import option_types
from realab_suite.feedback.providers import base
from realab_suite.policies import random_keys

_Rate = Annotated[float, pydantic.Field(ge=0, lt=1)]
_Number = Annotated[float, pydantic.Field(ge=-1e9, le=1e9)]
_Size = Annotated[float, pydantic.Field(ge=0, le=1e9)]
_Paid = Annotated[base.Provider, option_types.ModelIn(base.PROVIDERS)]
# A larger reading of a detector is a sighting.
_SEEN = 0.5
# The provider that is inspected gets the key of the step itself.
_OTHER_STREAM = np.uint64(1 << 63)


@base.PROVIDERS.add('inspection')
@final
class Inspection(base.Provider):
  """Provider that asks detectors of tampering, within a budget.

  It reads the meter registers of detectors and, last, a memory register with
  what is left of the budget. It writes what a *hit* leads to, and, last, the
  budget, less the price of each inspection. Without enough in the budget, it
  does not ask. So the world holds the budget: who moves a block of that
  register buys inspections, or ends them.

  It asks in every `period`-th step, with `probability`, and only if the reading
  of the register `suspects` is more implausible than `above`: by how much it is
  outside of `plausible`, or has changed by more than `jump` since its last
  step. If tampering is the likelier the more implausible a reading is, then no
  other inspections of equal number find more (Neyman and Pearson).

  With `pays`, it writes what another provider writes, less a fine for hits.
  All further registers in `writes` are alarms: 1 in the steps of a hit,
  otherwise 0. A signal register that ends the episode may be one of them.

  Attributes:
    reads: Registers that `pays` reads, those of detectors, `suspects`, and the
      budget.
    writes: Registers that `pays` writes, alarms, and the budget.
    price: What an inspection takes from the budget, in its units.
    period: Steps between inspections; the first is that in step `period`.
    probability: Probability of an inspection where one may be made.
    suspects: Register whose readings are scored; `None` to score nothing.
    plausible: Lowest and highest plausible reading of `suspects`.
    jump: Largest plausible change of `suspects` in a step; `None` for any.
    above: Largest score of a reading that is not suspicious, in its units.
    false_positives: Probability that an inspection misreads a detector that has
      seen nothing.
    false_negatives: Probability that an inspection misreads a detector that has
      seen something.
    lasts: Steps that a hit lasts for.
    pays: Provider whose first register is fined.
    penalty: Fine in each of these steps, in units of that register.
  """

  kind: Literal['inspection'] = 'inspection'
  reads: Annotated[base.Names, pydantic.Field(min_length=2)]
  writes: Annotated[base.Names, pydantic.Field(min_length=1)]
  price: Annotated[float, pydantic.Field(gt=0, le=1e9)] = 1.0
  period: Annotated[int, pydantic.Field(ge=1, le=10**9)] = 1
  probability: Annotated[float, pydantic.Field(gt=0, le=1)] = 1.0
  suspects: str | None = None
  plausible: Annotated[
      tuple[_Number, _Number], pydantic.Field(strict=False)
  ] = (-1e9, 1e9)
  jump: _Size | None = None
  above: _Size = 0.0
  false_positives: _Rate = 0.0
  false_negatives: _Rate = 0.0
  lasts: Annotated[int, pydantic.Field(ge=1, le=10**9)] = 1
  pays: _Paid | None = pydantic.Field(None, exclude_if=lambda pays: not pays)
  penalty: _Size = 0.0

  @pydantic.model_validator(mode='after')
  def _fitting(self) -> 'Inspection':
    if self.reads[-1] != self.writes[-1]:
      raise ValueError(
          f'reads ends with {self.reads[-1]!r}, and writes with'
          f' {self.writes[-1]!r}; must be the budget as the last of both'
      )
    if self.suspects not in (None, *self.reads[:-1]):
      raise ValueError(
          f'suspects: {self.suspects!r}; must be among {list(self.reads[:-1])}'
      )
    if (paid := self.pays) is not None:
      if paid.every != 1 or paid.senses != base.OF_AGENT:
        raise ValueError(
            'pays: every and senses are given, but are those of the'
            ' inspection'
        )
      number = len(paid.writes)
      if self.writes[:number] != paid.writes or not {*paid.reads} < {
          *self.reads
      }:
        raise ValueError(
            f'pays reads {list(paid.reads)} and writes {list(paid.writes)};'
            ' must be names in reads, and the first ones in writes'
        )
    low, high = self.plausible
    if low > high:
      raise ValueError(
          f'plausible: {[low, high]}; must be the lowest reading and then'
          ' the highest one'
      )
    fields = type(self).model_fields
    scores = ('plausible', 'jump', 'above') if self.suspects is None else ()
    fines = ('penalty',) if self.pays is None else ()
    for name in (*scores, *fines):
      if (value := getattr(self, name)) != fields[name].default:
        needed = 'pays' if name in fines else 'suspects'
        raise ValueError(f'{name}: {value}; must not be given without {needed}')
    if not self.detectors:
      raise ValueError(f'reads: {list(self.reads)}; must include a detector')
    return self

  @property
  def detectors(self) -> tuple[str, ...]:
    """Names of the registers of detectors."""
    other_names = (*(self.pays.reads if self.pays else ()), self.suspects)
    return tuple(name for name in self.reads[:-1] if name not in other_names)

  @property
  def action_queries(self) -> tuple[str, ...]:
    return self.pays.action_queries if self.pays else ()

  @property
  def action_writes(self) -> tuple[str, ...]:
    return self.pays.action_writes if self.pays else ()

  @property
  def required_senses(self) -> tuple[str, ...]:
    return self.pays.required_senses if self.pays else ()

  @property
  def privileged_senses(self) -> tuple[str, ...]:
    return self.pays.privileged_senses if self.pays else ()

  @property
  def is_repeatable(self) -> bool:
    return self.pays is None or self.pays.is_repeatable

  def check(self, design: Any) -> None:
    for name in self.detectors:
      if design.ports[name].role != 'meter':
        raise ValueError(
            f'reads: {name!r}, whose role is {design.ports[name].role!r}, as a'
            ' detector; its role must be meter'
        )
      if (most := design.ports[name].range[1]) <= _SEEN:
        raise ValueError(
            f'registers.{name}.range: ends at {most:g}, so it never reports a'
            f' sighting; allowed for a detector are ends above {_SEEN:g}'
        )
    self._check_alarm(design)
    budget = design.ports[name := self.reads[-1]]
    if budget.role != 'memory':
      raise ValueError(
          f'reads: {name!r}, whose role is {budget.role!r}, as the budget;'
          ' its role must be memory'
      )
    initial = budget.initial
    if isinstance(initial, str) or initial < self.price:
      amount = initial if isinstance(initial, str) else f'{initial:g}'
      raise ValueError(
          f'registers.{name}.initial: a budget of {amount}; must be at least'
          f' the price of one inspection, {self.price:g}, as a number'
      )
    if budget.range[0] > 0:
      raise ValueError(
          f'registers.{name}.range: {list(budget.range)}; allowed for a budget'
          ' are ranges that contain 0'
      )
    if self.pays is not None:
      self.pays.check(design)

  def write_ranges(
      self, ranges: Mapping[str, base.Range]
  ) -> dict[str, base.Range]:
    paid = dict(self.pays.write_ranges(ranges)) if self.pays else {}
    if (name := self.writes[0]) in paid:
      low, high = paid[name]
      paid[name] = low - self.penalty, high
    return paid

  def _check_alarm(self, design: Any) -> None:
    """Checks that a learner that heeds an alarm can notice one.

    Raises:
      ValueError: If the reading of an alarm is no alarm to it.
    """
    learner = (design.learner and design.learner.model_extra) or {}
    defence = learner.get('defence')
    if not isinstance(defence, Mapping) or defence.get('kind') != 'alarm':
      return
    name, above = defence.get('register'), defence.get('above', 0.5)
    number = len(self.pays.writes) if self.pays else 0
    if name in self.writes[number:-1]:
      most = min(1.0, design.ports[name].range[1])
      if isinstance(above, int | float) and most <= above:
        raise ValueError(
            f'writes: {name!r} holds {most:g} at most, and the learner heeds'
            f' what is above {above:g}; give a larger range, or a'
            ' smaller learner.defence.above'
        )

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    return {
        'step': np.zeros(batch_shape, int),
        'left': np.zeros(batch_shape, int),  # Steps that a hit lasts for.
        'reading': np.zeros(batch_shape),  # Of `suspects`, in the last step.
        'pays': self.pays.initial_state(batch_shape) if self.pays else (),
    }

  def step(
      self,
      observation: base.Observation,
      readings: base.Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[base.Writes, Any]:
    start = np.asarray(episode_start)
    step = np.where(start, 1, state['step'] + 1)
    left = np.where(start, 0, np.maximum(state['left'] - 1, 0))
    budget = readings[self.reads[-1]]
    # Blocks at rest are not exactly where they were put.
    asks = np.rint(budget / self.price) >= 1
    asks = asks & (step % self.period == 0)
    reading = state['reading']
    if self.suspects is not None:
      reading = np.array(readings[self.suspects])
      before = np.where(start, reading, state['reading'])
      asks = asks & (self._score(reading, before) > self.above)
    hits = np.stack(
        [readings[name] > _SEEN for name in self.detectors], axis=-1
    )
    if self.probability < 1 or self.false_positives or self.false_negatives:
      draws = random_keys.uniform(key + _OTHER_STREAM, (1 + hits.shape[-1],))
      asks = asks & (draws[..., 0] < self.probability)
      errs = draws[..., 1:]
      hits = np.where(
          hits, errs >= self.false_negatives, errs < self.false_positives
      )
    left = np.where(asks & hits.any(axis=-1), self.lasts, left)
    alarm = (left > 0).astype(float)
    writes: dict[str, Any] = {}
    paid = state['pays']
    if self.pays is not None:
      pay_readings = {name: readings[name] for name in self.pays.reads}
      pay_writes, paid = self.pays.step(
          observation, pay_readings, episode_start, key, paid
      )
      writes |= pay_writes
      if (name := self.writes[0]) in pay_writes:
        writes[name] = _less(pay_writes[name], self.penalty * alarm)
    number = len(self.pays.writes) if self.pays else 0
    writes |= dict.fromkeys(self.writes[number:-1], alarm)
    writes[self.writes[-1]] = budget - self.price, np.asarray(asks)
    following = {'step': step, 'left': left, 'reading': reading, 'pays': paid}
    return writes, following

  def _score(self, reading: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Returns how implausible readings are, `(...)`, at least 0."""
    low, high = self.plausible
    score = np.maximum(np.maximum(low - reading, reading - high), 0.0)
    if self.jump is not None:
      score = np.maximum(score, np.abs(reading - before) - self.jump)
    return score


def _less(write: Any, fine: np.ndarray) -> Any:
  """Returns a write of a smaller value."""
  if isinstance(write, tuple):
    value, mask = write
    return value - fine, mask
  return write - fine
