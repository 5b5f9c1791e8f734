"""A defence at work: its state, and the worlds of its trusted policy."""

from collections.abc import Mapping
from typing import Any, final

import jax
import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.lab.agents import base
from realab_suite.lab.agents import defences
from realab_suite.lab.agents import features
from realab_suite.lab.agents import trusted_policies


@final
class Guard(base.Wrapper):
  """Applies a defence to a learner, and keeps its state."""

  NAME = 'defence'

  def __init__(self, defence: defences.Defence, learner: base.Learner) -> None:
    """Makes a guard, or raises a `SpecError` if the defence does not fit."""
    self._defence, self._learner = defence, learner
    self._setting = setting = learner.setting
    learner.largest_credit = defence.largest_credit
    defence.check(setting)
    generator = base.generator_of(learner.key('initial', 1))
    self._state = defence.initial_state(setting, generator)
    self._reads = {name: self._key_of(name) for name in defence.reads}
    self._hidden = self._undeclared()
    self._metrics: dict[str, float] = {}
    self._trusted = None
    if (trusts := defence.trusts) is not None:
      if not isinstance(trusts, trusted_policies.TrustedPolicy):
        raise errors.SpecError(
            f'learner.defence {defence.kind!r}: trusts {messages.quote(trusts)}'
            '; must be a `TrustedPolicy`'
        )
      self._trusted = trusts.make(
          setting.controls, setting.num_envs, setting.encoder.names
      )

  def steer(
      self,
      choice: base.Choice,
      time_step: base.TimeStep,
      observation: features.Packed,
      key: np.ndarray,
  ) -> base.Choice:
    """Returns a choice with the trusted policy's actions in its worlds."""
    del observation
    if self._trusted is None:
      return choice
    return self._trusted.steer(choice, time_step, key)

  def _key_of(self, register: str) -> str:
    """Returns the key in observations of the reading of a register."""
    names = self._setting.encoder.names
    return features.find_key('learner.defence', register, names)

  def _undeclared(self) -> frozenset[str]:
    """Returns the keys of readings, in a batch, that the defence does not get.

    What it pays is judged by what it declares, so it can pay nothing else.
    """
    defence, reward = self._defence, self._setting.options.reward
    if (paid := defence.pays(reward)) is None or defence.SEES_READINGS:
      return frozenset()
    names = self._setting.encoder.names
    readings = {name for name in names if name.startswith('registers/')}
    payers = [name for name, weight in paid.items() if weight]
    declared = {self._key_of(name) for name in (*payers, *defence.reads)}
    hidden = readings - declared
    if self._key_of(reward) in hidden:
      hidden.add('reading')
    return frozenset(hidden)

  def queries(self, choice: base.Choice) -> dict[str, np.ndarray]:
    return {name: choice['action'] for name in self._defence.queries}

  def read(self, time_step: base.TimeStep) -> dict[str, Any]:
    is_trusted = np.zeros(self._setting.num_envs, bool)
    if self._trusted is not None:
      is_trusted = self._trusted.acts
    readings = {
        name: np.array(time_step.observation[key], np.float32)
        for name, key in self._reads.items()
    }
    return {'is_trusted': is_trusted, 'readings': readings}

  def treat(self, batch: dict[str, Any]) -> dict[str, Any]:
    """Returns the batch to learn from, without the trusted policy's steps.

    It has `is_cloned`: the steps whose actions are to be cloned. If there are
    any, no step is valid.
    """
    key = base.folded(self._learner.update_key(), 1)
    observation, hidden = batch['observation'], self._hidden
    visible = {name: x for name, x in observation.items() if name not in hidden}
    entries = {name: x for name, x in batch.items() if name not in hidden}
    shown = jax.tree.map(_read_only, {**entries, 'observation': visible})
    try:
      result = self._defence.treat(shown, self._setting, self._state, key)
    except KeyError as error:
      if not hidden.intersection(error.args):
        raise
      raise errors.SpecError(
          f'learner.defence {self._defence.kind!r}: takes {error} from a'
          f' batch; must be one of {sorted(visible)}, or the reading of a'
          ' register that `reads` or `pays` names'
      ) from error
    if not isinstance(result, defences.Treated):
      raise self._error(messages.quote(result), 'a `defences.Treated`')
    treated, state, metrics = result
    self._check(treated, batch)
    shapes, now = _shapes(self._state), _shapes(state)
    if now != shapes:
      raise self._error(
          f'a state with the shapes {now}',
          f'those of the state before, {shapes}',
      )
    self._state = state
    is_own = batch['is_valid'] & ~batch['is_trusted']
    is_same = np.isclose(treated['reading'], batch['reading'], atol=1e-6)
    is_same &= treated['discount'] == batch['discount']
    is_changed = ~(is_same & treated['is_valid'])[is_own]
    try:
      reported = {name: float(value) for name, value in metrics.items()}
    except (AttributeError, TypeError, ValueError) as error:
      raise self._error(
          f'the metrics {messages.quote(metrics)}', 'numbers by name'
      ) from error
    share = float(is_changed.mean()) if is_own.any() else 0.0
    self._metrics = {**reported, 'changed': share}
    trusts = self._defence.trusts
    num_steps = self._learner.num_steps
    clones = trusts is not None and num_steps <= trusts.clone_steps
    is_trusted, is_valid = batch['is_trusted'], treated['is_valid']
    return {
        **batch,
        'reading': treated['reading'],
        'discount': treated['discount'],
        'is_cloned': batch['is_valid'] & is_trusted & clones,
        'is_valid': is_valid & batch['is_valid'] & ~is_trusted & (not clones),
    }

  def _check(self, treated: dict[str, Any], batch: dict[str, Any]) -> None:
    """Refuses an entry that is missing, or has another shape, type or range."""
    largest = float(np.finfo(np.float32).max)
    for name, kinds, low, high, rule in (
        ('reading', 'iuf', -largest, largest, 'finite numbers'),
        ('discount', 'iuf', 0.0, 1.0, 'numbers from 0 to 1'),
        ('is_valid', 'b', 0.0, 1.0, 'booleans'),
    ):
      value = np.asarray(treated.get(name))
      shape = batch[name].shape
      if value.shape != shape or value.dtype.kind not in kinds:
        what = f'of the shape {value.shape} and dtype {value.dtype}'
      # A comparison with NaN is False.
      elif (wrong := value[~((low <= value) & (value <= high))]).size:
        what = f'with {wrong[:1]}'
      else:
        continue
      raise self._error(f'{name!r} {what}', f'{rule} of the shape {shape}')

  def _error(self, what: str, rule: str) -> errors.SpecError:
    """Returns the error about something that `treat` returned."""
    return errors.SpecError(
        f'learner.defence {self._defence.kind!r}: treat returned {what}; must'
        f' be {rule}'
    )

  @property
  def metrics(self) -> Mapping[str, float]:
    """Metrics of the latest batch; `changed` is a share of the own steps."""
    return self._metrics

  def state(self) -> dict[str, Any]:
    return {
        'defence': base.to_plain(self._state),
        'trusted': self._trusted and self._trusted.state(),
    }

  def set_state(self, state: Mapping[str, Any]) -> None:
    self._state = base.from_plain(self._state, state['defence'])
    if self._trusted is not None:
      self._trusted.set_state(state['trusted'])


def _shapes(state: Any) -> dict[str, tuple[int, ...]]:
  """Returns the shape of each entry of a state, by its path."""
  return {name: x.shape for name, x in base.to_plain(state).items()}


def _read_only(array: Any) -> np.ndarray:
  """Returns a view that a defence cannot change."""
  view = np.asarray(array).view()
  view.flags.writeable = False
  return view
