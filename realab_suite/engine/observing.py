"""Observations: the agent's senses and the readings of registers."""

from collections.abc import Mapping
from typing import final

from dm_env import specs
import numpy as np

from realab_suite import errors
from realab_suite.engine import hosts
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms

# Sense with the remaining share of the episode, from 1 to 0.
_TIME_LEFT = 'time_left'


@final
class Observer:
  """Makes the observations of one world or of a batch.

  Observations contain the keys `senses/<name>` of the senses that the host
  declares and `registers/<name>` of the registers that agents read. Other keys
  are never added.
  """

  def __init__(
      self,
      host: hosts.Host,
      mechanism: mechanisms.FeedbackMechanism,
      max_steps: int | None,
  ) -> None:
    """Initializes the observer.

    Args:
      host: Host of the task.
      mechanism: Registers, meters and providers.
      max_steps: Maximum length of an episode in control steps, or `None`.

    Raises:
      SpecError: If the task has a sense called `time_left` and `max_steps` is
        not `None`.
    """
    self._host = host
    self._mechanism = mechanism
    self._max_steps = max_steps
    self._keys = {name: f'senses/{name}' for name in host.sense_spec}
    if max_steps is not None and _TIME_LEFT in host.sense_spec:
      raise errors.SpecError(
          f'the task has its own observable {_TIME_LEFT!r}; rename it, or pass'
          ' max_steps=None'
      )

  def spec(self) -> dict[str, specs.Array]:
    """Returns a new dict with the observation spec of one world, by key."""
    senses = dict(self._host.sense_spec)
    if self._max_steps is not None:
      senses[_TIME_LEFT] = specs.BoundedArray((), np.float32, 0.0, 1.0)
    spec = {
        f'senses/{name}': part.replace(name=f'senses/{name}')
        for name, part in senses.items()
    }
    for name in self._mechanism.read_by_agent:
      key = f'registers/{name}'
      spec[key] = specs.Array((), np.float64, name=key)
    return spec

  def observe(
      self, physics: hosts.SteppedPhysics
  ) -> tuple[dict[str, np.ndarray], list[registers.Read]]:
    """Makes an observation.

    Args:
      physics: Physics of one world or of a batch.

    Returns:
      The observation, with arrays of shape `(..., *spec.shape)` by key, and the
      reads of registers for it.
    """
    keys = self._keys
    observation = {
        keys[name]: value for name, value in self._host.sense(physics).items()
    }
    if self._max_steps is not None:
      spent = self._mechanism.step_count(physics) / self._max_steps
      observation[f'senses/{_TIME_LEFT}'] = np.asarray(1.0 - spent, np.float32)
    reads = self._mechanism.read_for_agent(physics)
    for read in reads:
      observation[f'registers/{read.register}'] = np.array(read.reading)
    return observation, reads


def frozen(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
  """Makes the arrays read-only, as providers get them, and returns them."""
  for value in observation.values():
    value.setflags(write=False)
  return observation


def copied(observation: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
  """Returns a copy of an observation with copies of its arrays."""
  return {key: value.copy() for key, value in observation.items()}
