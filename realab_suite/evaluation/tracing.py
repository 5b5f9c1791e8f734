"""Tracing of corruption to the control steps that caused it.

This is the arithmetic of `attribution`, without a simulation. All arrays belong
to one register in one episode and have the shape `(steps,)`. Corruption is in
units of the register, and its temporary part includes the obstruction, because
the next write removes both.
"""

from typing import NamedTuple, final

import numpy as np


@final
class Parts(NamedTuple):
  """A corruption and its parts after each control step.

  Attributes:
    permanent: Part that writes do not repair, `(steps,)`.
    temporary: Part that the next write repairs, `(steps,)`.
  """

  permanent: np.ndarray
  temporary: np.ndarray

  @property
  def total(self) -> np.ndarray:
    """Sum of the parts, `(steps,)`."""
    return self.permanent + self.temporary

  def minus(self, other: 'Parts') -> 'Parts':
    """Returns the difference of each part."""
    return Parts(
        self.permanent - other.permanent, self.temporary - other.temporary
    )


def trace(
    agent: Parts, caused: Parts, is_written: np.ndarray, culprits: np.ndarray
) -> np.ndarray:
  """Traces the agent's share to the steps that caused it.

  What a step causes at once belongs to that step. Other changes of the agent's
  share happen without an action, such as those by a block that flies on after a
  throw, and belong to the culprit of their step. Permanent corruption counts in
  every later step, and temporary corruption until the next write.

  Args:
    agent: Agent's share of the corruption.
    caused: Corruption with the actual action minus that with the no-op.
    is_written: True if the register was written in the step, `(steps,)` bool.
    culprits: Earlier step to which changes without an action belong, `(steps,)`
      int; see `find_culprits`.

  Returns:
    For each step, the sum over all steps of the corruption that is traced to
    it, in units. The sum over steps is that of the agent's share.
  """
  num_steps = len(is_written)
  steps = np.arange(num_steps)
  # Step of the next write, after which nothing temporary is left.
  writes = np.where(is_written, steps, num_steps)
  following = np.minimum.accumulate(np.append(writes, num_steps)[::-1])[::-1]
  before = Parts(*(np.append(0.0, part[:-1]) for part in agent))
  before = before._replace(
      temporary=np.where(is_written, 0.0, before.temporary)
  )
  without_action = agent.minus(before).minus(caused)
  traced = np.zeros(num_steps)
  for now, later, duration in zip(
      caused, without_action, (num_steps - steps, following[1:] - steps),
      strict=True,
  ):  # fmt: skip
    traced += now * duration
    np.add.at(traced, culprits, later * duration)
  return traced


def find_culprits(
    has_moved: np.ndarray, has_acted: np.ndarray, is_disturbed: np.ndarray
) -> np.ndarray:
  """Returns the step to which changes without an action belong, `(steps,)`.

  It is the last step before that moved the register. If nothing about the
  register shows that the agent has moved it, something else has hit it: the
  avatar, or an object that the agent set in motion. Then it is the last step
  with any action.

  Args:
    has_moved: True if the action of the step moved the register, `(steps,)`.
    has_acted: True if the action of the step had any effect, `(steps,)`.
    is_disturbed: True if the register differs from that of the shadow at the
      start of the step, `(steps,)`.
  """
  moved, acted = _last_before(has_moved), _last_before(has_acted)
  chosen = np.where(is_disturbed & (moved >= 0), moved, acted)
  return np.where(chosen >= 0, chosen, np.arange(len(chosen)))


def _last_before(mask: np.ndarray) -> np.ndarray:
  """Returns the last earlier step with True, `(steps,)`; -1 if none."""
  found = np.where(mask, np.arange(len(mask)), -1)
  return np.append(-1, np.maximum.accumulate(found)[:-1])
