"""Scripted policies for given worlds; saboteurs get a target register."""

import inspect
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.entities import protocols
from realab_suite.entities import registers

_AIM_OPTIONS = ('target', 'direction')


def make_policy(
    name: str,
    env: environment.Environment,
    target: str | None,
    episode: int,
) -> policies.Policy:
  """Returns a policy for one episode.

  Args:
    name: Name of the policy in `policies.POLICIES`.
    env: Environment. It may be reset, so rewind it before the episode.
    target: Register that saboteurs attack, or `None` for the first feedback
      register.
    episode: Number of the episode.

  Raises:
    SpecError: If the policy or the register does not exist.
  """
  takes = inspect.signature(policies.POLICIES.get(name)).parameters
  options = [option for option in _AIM_OPTIONS if option in takes]
  if not options:
    return policies.make(name)
  register = _target_register(name, env, target)
  env.rewind(episode)
  env.reset()
  where = aim(register, env.physics)
  return policies.make(name, **{option: where[option] for option in options})


def _target_register(
    policy: str, env: environment.Environment, target: str | None
) -> registers.Register:
  mechanism = env.mechanism
  if target is None:
    target = next(iter(mechanism.design.names('feedback')), '')
  if target not in mechanism.registers:
    raise errors.SpecError(
        f'policy {policy!r} attacks a register, and design'
        f' {mechanism.design.name!r} has no {target or "feedback register"!r};'
        f' it has {sorted(mechanism.registers)}'
    )
  return mechanism.registers[target]


def aim(
    register: registers.Register, physics: protocols.Physics
) -> dict[str, Any]:
  """Returns the position of a register and the direction that pays.

  The keys `target` and `direction` are options of saboteurs. Readings increase
  as a base block moves against the axis of the register, and as the only block
  of a register moves along it.
  """
  block = physics.bind(register.blocks[0].geom)
  axis = np.reshape(block.xmat, (3, 3))[:2, 0]
  sign = -1.0 if len(register.blocks) > 1 else 1.0
  x, y = block.xpos[:2]
  dx, dy = sign * axis
  return {
      'target': (float(x), float(y)),
      'direction': (float(dx), float(dy)),
  }
