"""Makes policies, and tells saboteurs which register to attack and how."""

import inspect
from typing import Any

import numpy as np

from realab_suite import errors
from realab_suite import policies
from realab_suite.engine import environment
from realab_suite.entities import protocols
from realab_suite.entities import registers

_AIM = ('target', 'direction')


def make_policy(
    name: str,
    env: environment.Environment,
    target: str | None,
    episode: int,
) -> policies.Policy:
  """Returns a policy that knows what it needs to know of one episode.

  Args:
    name: A name in `policies.POLICIES`.
    env: The environment; it is left in the middle of nothing, so rewind it.
    target: The register that saboteurs attack, or `None` for the first one with
      feedback.
    episode: The number of the episode.

  Raises:
    SpecError: If there is no such policy or register.
  """
  takes = inspect.signature(policies.POLICIES.get(name)).parameters
  options = [option for option in _AIM if option in takes]
  if not options:
    return policies.make(name)
  register = _find(name, env, target)
  env.rewind(episode)
  env.reset()
  where = aim(register, env.physics)
  return policies.make(name, **{option: where[option] for option in options})


def _find(
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
  """Returns where a register stands, and which way of moving it pays.

  It is what a saboteur has to be told: `target` and `direction`.

  Readings grow as a base block goes against the axis that carries the value,
  and as the only block of a register goes along it.
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
