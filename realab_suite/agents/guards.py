"""A defence at work: its state, and the worlds of its trusted policy."""

from collections.abc import Mapping
from typing import Any, final

import jax
import numpy as np

from realab_suite import errors
from realab_suite.agents import base
from realab_suite.agents import defences
from realab_suite.agents import features
from realab_suite.agents import trusted_policies
from realab_suite.config import messages


@final
class Guard:
  """Applies a defence to a learner, and keeps its state."""

  def __init__(
      self,
      defence: defences.Defence,
      setting: defences.Setting,
      generator: np.random.Generator,
  ) -> None:
    """Makes a guard.

    Args:
      defence: The defence.
      setting: What it knows of its learner.
      generator: Random generator of its networks.

    Raises:
      SpecError: If the defence does not fit the learner.
    """
    defence.check(setting)
    self._defence, self._setting = defence, setting
    self._state = defence.initial_state(setting, generator)
    self._reads = {name: self._key_of(name) for name in defence.reads}
    self._hidden = self._undeclared()
    self._metrics: dict[str, float] = {}
    self._trusted = None
    if (trusts := defence.trusts) is not None:
      if not isinstance(trusts, trusted_policies.TrustedPolicy):
        raise errors.SpecError(
            f'learner.defence {defence.kind!r}: trusts {messages.quote(trusts)}'
            '; allowed is a `TrustedPolicy`'
        )
      self._trusted = trusts.make(
          setting.controls, setting.num_envs, setting.encoder.names
      )

  def steer(
      self, choice: base.Choice, time_step: base.TimeStep, key: np.ndarray
  ) -> base.Choice:
    """Returns a choice with the trusted policy's actions in its worlds.

    Args:
      choice: Choice of the learner, which stays as it is.
      time_step: Time step that it responds to.
      key: Random key of this step, two numbers.
    """
    if self._trusted is None:
      return choice
    return self._trusted.steer(choice, time_step, key)

  def _key_of(self, register: str) -> str:
    """Returns the key in observations of the reading of a register."""
    names = self._setting.encoder.names
    if (key := features.key_of(register, names)) is None:
      raise errors.SpecError(
          f'learner.defence: the agent does not read {register!r}; this'
          f' environment has {sorted(names)}'
      )
    return key

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
    declared = {self._key_of(one) for one in (*payers, *defence.reads)}
    # A memory is made of readings.
    hidden = {*readings, features.MEMORY} - declared
    if self._key_of(reward) in hidden:
      hidden.add('reading')
    return frozenset(hidden)

  def queries(self, choice: base.Choice) -> dict[str, np.ndarray]:
    """Returns the values of query registers by name, each `(worlds,)`."""
    return {name: choice['action'] for name in self._defence.queries}

  def read(self, time_step: base.TimeStep) -> dict[str, Any]:
    """Returns what it adds to the transition that ends with a time step."""
    is_trusted = np.zeros(self._setting.num_envs, bool)
    if self._trusted is not None:
      is_trusted = self._trusted.acts
    readings = {
        name: np.array(time_step.observation[key], np.float32)
        for name, key in self._reads.items()
    }
    return {'is_trusted': is_trusted, 'readings': readings}

  def treat(
      self, batch: dict[str, Any], num_steps: int, key: np.ndarray
  ) -> dict[str, Any]:
    """Returns the batch to learn from, without the trusted policy's steps.

    Args:
      batch: Transitions, each array `(time, worlds, ...)`.
      num_steps: Number of control steps so far, summed over worlds.
      key: Random key of this batch, two numbers.

    Returns:
      The batch, with `is_cloned`: the steps whose actions are to be cloned. If
      there are any, no step is valid.
    """
    given, hidden = batch['observation'], self._hidden
    seen = {name: x for name, x in given.items() if name not in hidden}
    entries = {name: x for name, x in batch.items() if name not in hidden}
    shown = jax.tree.map(_read_only, {**entries, 'observation': seen})
    try:
      result = self._defence.treat(shown, self._setting, self._state, key)
    except KeyError as error:
      if not hidden.intersection(error.args):
        raise
      raise errors.SpecError(
          f'learner.defence {self._defence.kind!r}: takes {error} from a'
          f' batch; allowed are {sorted(seen)}, and readings of'
          ' registers that `reads` or `pays` names'
      ) from error
    if not isinstance(result, defences.Treated):
      raise errors.SpecError(
          f'learner.defence {self._defence.kind!r}: treat returned'
          f' {messages.quote(result)}; allowed is a `defences.Treated`'
      )
    treated, state, metrics = result
    self._check(treated, batch)
    _check_state(self._defence.kind, self._state, state)
    self._state = state
    is_own = batch['is_valid'] & ~batch['is_trusted']
    is_same = np.isclose(treated['reading'], batch['reading'], atol=1e-6)
    is_same &= treated['discount'] == batch['discount']
    is_changed = ~(is_same & treated['is_valid'])[is_own]
    try:
      told = {name: float(value) for name, value in metrics.items()}
    except (AttributeError, TypeError, ValueError) as error:
      raise errors.SpecError(
          f'learner.defence {self._defence.kind!r}: treat returned the metrics'
          f' {messages.quote(metrics)}; allowed are numbers by name'
      ) from error
    share = float(is_changed.mean()) if is_own.any() else 0.0
    self._metrics = {**told, 'changed': share}
    trusts = self._defence.trusts
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
    """Checks what a defence has returned.

    Raises:
      SpecError: If an entry is missing, or has another shape, type or range.
    """
    largest = float(np.finfo(np.float32).max)
    for name, kinds, low, high, allowed in (
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
      raise errors.SpecError(
          f'learner.defence {self._defence.kind!r}: treat returned {name!r}'
          f' {what}; allowed are {allowed} of the shape {shape}'
      )

  @property
  def largest_credit(self) -> float | None:
    """Largest sum of rewards that an episode can earn, or `None`."""
    return self._defence.largest_credit

  @property
  def metrics(self) -> Mapping[str, float]:
    """Metrics of the last batch, by name.

    `changed` is the share of the learner's own steps that are left out, or have
    another reward than the reading.
    """
    return self._metrics

  def state(self) -> dict[str, Any]:
    """Returns the complete state, as plain data."""
    return {
        'defence': base.to_plain(self._state),
        'trusted': self._trusted and self._trusted.state(),
    }

  def set_state(self, state: Mapping[str, Any]) -> None:
    """Continues from a state that `state` returned.

    Raises:
      StateLayoutError: If it does not fit; nothing changes then.
    """
    self._state = base.from_plain(self._state, state['defence'])
    if self._trusted is not None:
      self._trusted.set_state(state['trusted'])


def _check_state(kind: str, old: Any, new: Any) -> None:
  """Checks that training can be continued from a state.

  Raises:
    SpecError: If it has other entries or shapes than the one before.
  """
  was, is_now = (
      {name: np.shape(value) for name, value in base.to_plain(one).items()}
      for one in (old, new)
  )
  if was != is_now:
    raise errors.SpecError(
        f'learner.defence {kind!r}: treat returned a state with the shapes'
        f' {is_now}; allowed are those of the state before, {was}'
    )


def _read_only(array: Any) -> np.ndarray:
  """Returns a view that a defence cannot change."""
  view = np.asarray(array).view()
  view.flags.writeable = False
  return view
