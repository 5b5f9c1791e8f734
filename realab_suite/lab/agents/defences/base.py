"""Base class for defences of a learner against corrupted rewards.

A defence stands between the readings and the learner. It gets what the learner
gets, and changes what the learner learns from: rewards, where returns are cut
off, and which steps count. A design declares it as an option of its learner:

    learner:
      kind: policy_gradient
      reward: reward
      defence: {kind: cap, high: 10, total: 18}
"""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, final

import jax
import numpy as np

from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.feedback import objectives
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import trusted_policies

Batch = dict[str, Any]
Setting = base.Setting


@final
class Treated(NamedTuple):
  """Result of `Defence.treat`.

  Attributes:
    batch: The batch to learn from.
    state: State for the next call.
    metrics: Numbers to report, by name.
  """

  batch: Batch
  state: Any
  metrics: Mapping[str, float] = {}


class Defence(validation.Model):
  """Base class for defences.

  Fields of a subclass are its options, methods are its behaviour. It keeps no
  state: what it remembers is handed in and out, so that a learner can be saved.

  Attributes:
    kind: Name under which the class is registered.
  """

  # True if it changes suspicious steps alone, so that each change is an alarm.
  ALARMS: ClassVar[bool] = False
  # True if it gets the readings of all registers in `observation`. Otherwise it
  # gets those that it reads or pays from, so that no others can be paid.
  SEES_READINGS: ClassVar[bool] = False

  kind: str

  @property
  def reads(self) -> tuple[str, ...]:
    """Names of further registers whose readings it uses."""
    return ()

  def pays(self, reward: str) -> Mapping[str, float] | None:
    """Returns the weight of each register in the sum that the learner is paid.

    It is part of the learner's objective: evaluators add up these readings as
    they are, so that tampering with any of them is seen.

    Args:
      reward: Name of the register that the learner reads as its reward.

    Returns:
      Weights by name; `None` if no sum of readings is paid, and nothing can be
      said about tampering. The default is the reward alone, or `None` for a
      defence that gets further readings, because it may pay from them.
    """
    if self.kind in objectives.PAYMENTS:
      paid = objectives.PAYMENTS.get(self.kind)(self.model_dump(), reward)
      return None if isinstance(paid, str) else paid.registers
    return None if self.reads or self.SEES_READINGS else {reward: 1.0}

  @property
  def queries(self) -> tuple[str, ...]:
    """Names of query registers in which the learner names its action."""
    return ()

  @property
  def trusts(self) -> trusted_policies.TrustedPolicy | None:
    """A policy that acts in some of the worlds, or `None`.

    These worlds come first. The learner does not learn from their steps.
    """
    return None

  @property
  def largest_credit(self) -> float | None:
    """Largest sum of rewards that an episode can earn; `None` for any sum."""
    return None

  def check(self, setting: Setting) -> None:
    """Checks that the defence fits a learner.

    Raises:
      SpecError: If it does not.
    """
    del setting  # Any learner fits by default.

  def initial_state(
      self, setting: Setting, generator: np.random.Generator
  ) -> Any:
    """Returns the state before the first batch.

    Args:
      setting: What the defence knows of its learner.
      generator: Random generator, for initial weights of networks.

    Returns:
      A pytree of arrays.
    """
    del setting, generator
    return ()

  @abc.abstractmethod
  def treat(
      self, batch: Batch, setting: Setting, state: Any, key: np.ndarray
  ) -> Treated:
    """Returns what the learner learns from instead of a batch.

    Args:
      batch: Transitions, each array `(time, worlds, ...)`: `observation`
        (packed, see `features.Encoder.pack`, without undeclared readings) and
        `choice` with the `action`; `reading`, `discount` and `is_valid` of the
        step after it, and `readings` of the registers in `reads`, by name.
        `is_valid` is False in the step between two episodes. `is_trusted`,
        `(time, worlds)` bool, is True where the trusted policy has acted.
      setting: What the defence knows of its learner.
      state: State that `initial_state` or the last call returned.
      key: Random key of this batch, two numbers.
    """


DEFENCES: registry.Registry[type[Defence]] = objectives.DEFENCES


def blinded(
    observation: Mapping[str, np.ndarray], setting: Setting
) -> dict[str, np.ndarray]:
  """Returns a packed observation with 0 for each reading of a register."""
  reward = features.key_of(setting.options.reward, observation)
  return {
      name: np.zeros_like(value)
      if name == reward or name.startswith('registers/')
      else value
      for name, value in observation.items()
  }


def data_of(
    batch: Batch, setting: Setting, with_readings: bool = True
) -> dict[str, jax.Array]:
  """Returns features of the observations and actions, `(time, worlds, ...)`.

  Args:
    batch: See `Defence.treat`.
    setting: What the defence knows of its learner.
    with_readings: False to put 0 for each reading of a register.

  Returns:
    `vector` and images; actions are the last elements of `vector`, one-hot or
    as they are. Readings that a defence does not get are 0.
  """
  observation = batch['observation']
  lead = np.shape(batch['choice']['action'])
  missing = [e for e in setting.encoder.entries if e.name not in observation]
  zeros = {e.name: np.zeros((*lead[:2], *e.shape), np.float32) for e in missing}
  observation = {**zeros, **observation}
  if not with_readings:
    observation = blinded(observation, setting)
  encoded = dict(setting.encoder.encode(observation))
  action = jax.numpy.asarray(batch['choice']['action'])
  if setting.controls.num_actions is not None:
    action = jax.nn.one_hot(action, setting.controls.num_actions)
  encoded['vector'] = jax.numpy.concatenate([encoded['vector'], action], -1)
  return encoded
