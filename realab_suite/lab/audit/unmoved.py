"""Readings that change although no block of their register moves.

A kind declares this, by `Register.changes_unmoved`, and audits do not rely on
it. Before a search, the avatar is put everywhere in the room, and each loose
thing is moved a little; during all episodes, readings are watched.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, final

import mujoco
import numpy as np
from scipy import ndimage

from realab_suite.engine import batch_environment
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.lab.audit import aiming
from realab_suite.policies import saboteurs

# Distance of the places that are tried, and of those that are chosen, in m.
_STEP, _APART = 0.25, 0.75
# Numbers of effects that are told apart, and of places chosen for each.
_EFFECTS, _PLACES = 4, 3
# Motion of loose things, in m, or rad for hinges.
_SHIFT = 0.5
# A block that has moved by less is still. A reading that has changed by less
# has not: a length in m, but at most a share of the range.
_STILL, _LEAST, _MOST_SHARE = 5e-4, 0.02, 0.5
_BALL = mujoco.mjtJoint.mjJNT_BALL
# Overlap with something fixed, in m, at which the avatar cannot stand.
_OVERLAP = 0.05


@final
class Survey(NamedTuple):
  """What changes readings, apart from blocks.

  Attributes:
    places: Places where the avatar changes the reading of a register.
    untried: Registers whose readings change in other ways, or may do so.
  """

  places: list[aiming.Target]
  untried: set[str]


def survey(env: environment.Environment, names: Sequence[str]) -> Survey:
  """Returns what changes readings; the state of the world is lost.

  Args:
    env: Environment with one world. An episode has begun.
    names: Names of the registers, which have blocks.
  """
  if not names:
    return Survey([], set())
  physics, avatar = env.thin_physics, env.task.avatar
  readable = [env.mechanism.registers[name] for name in names]
  extent = env.task.root_entity.extent
  ends = zip(extent.low, extent.high, strict=True)
  x, y = (np.arange(low, high, _STEP) for low, high in ends)
  grid = np.stack(np.meshgrid(x, y, indexing='ij'), axis=-1)
  start = np.array(avatar.position(physics))
  blocks = [register.blocks[0] for register in readable]
  origins = aiming.positions(physics, blocks)
  is_free = np.zeros(grid.shape[:2], bool)
  changes = np.zeros((len(names), *is_free.shape))
  untried: set[str] = set()
  for share in (0.5, 0.0, 1.0):
    avatar.place(physics, start, 0.0)
    for register in readable:
      least, most = register.value_range
      register.pose(physics, least + share * (most - least))
    untried |= _changed_by_loose_things(env, readable)
    for i in np.ndindex(is_free.shape):
      avatar.place(physics, grid[i], 0.0)
      physics.forward()
      is_free[i] = not _is_stuck(env)
      for j, register in enumerate(readable):
        change = _change(register, physics)
        changes[j, *i] = max(changes[j, *i], change, key=abs)
  rooms, _ = ndimage.label(is_free)
  nearest = np.linalg.norm(grid - start, axis=-1)[is_free].argmin()
  is_reachable = is_free & (rooms == rooms[is_free][nearest])
  places = []
  for j, register in enumerate(readable):
    middles = _middles(grid, changes[j], is_reachable)
    places += [
        aiming.Target(
            register.name,
            0,
            '',
            saboteurs.UNSEEN,
            offset=tuple((place - origins[j]).tolist()),
        )
        for place in middles
    ]
    is_declared = register.changes_unmoved and register.channel == 'embedded'
    if is_declared and not middles:
      untried.add(register.name)
  return Survey(places, untried)


def _changed_by_loose_things(
    env: environment.Environment, readable: Sequence[registers.Register]
) -> set[str]:
  """Returns the names of the registers whose readings change with them."""
  physics = env.thin_physics
  names: set[str] = set()
  before = [_change(register, physics) for register in readable]
  for address in _loose(env):
    for shift in (_SHIFT, -_SHIFT):
      physics.data.qpos[address] += shift
      physics.forward()
      names.update(
          register.name
          for register, change in zip(readable, before, strict=True)
          if not np.isclose(_change(register, physics), change)
      )
      physics.data.qpos[address] -= shift
  return names


def _loose(env: environment.Environment) -> list[int]:
  """Returns the first coordinates of joints of neither avatar nor registers."""
  physics = env.thin_physics
  bodies = list(env.task.avatar.mjcf_model.find_all('body'))
  for register in env.mechanism.registers.values():
    bodies += register.mjcf_model.find_all('body')
    bodies += [block.body for block in register.blocks]
  model = physics.model
  is_known = np.isin(model.jnt_bodyid, physics.bind(bodies).element_id)
  return model.jnt_qposadr[~is_known & (model.jnt_type != _BALL)].tolist()


def _change(register: registers.Register, physics: Any) -> Any:
  """Returns the change of a reading, `(...)`: 0 if blocks could explain it.

  Of several ports, it is the largest change.
  """
  read = register.inspect(physics)
  change = np.asarray(read.permanent + read.temporary)
  low, high = register.value_range
  least = min(_LEAST / register.scale, _MOST_SHARE * (high - low))
  moved = register.displacements(physics).max(axis=-1)
  if register.PORTS:
    largest = np.abs(change).argmax(axis=-1)[..., np.newaxis]
    change = np.take_along_axis(change, largest, axis=-1)[..., 0]
  return np.where((np.abs(change) > least) & (moved < _STILL), change, 0.0)


def _is_stuck(env: environment.Environment) -> bool:
  """Returns True if the avatar is inside something that does not move."""
  physics, model = env.thin_physics, env.thin_physics.model
  contact = physics.data.contact
  bodies = model.geom_bodyid[contact.geom]
  is_avatar = bodies == physics.bind(env.task.avatar.body).element_id
  is_fixed = (model.body_weldid[bodies] == 0) | (
      model.body_mocapid[bodies] >= 0
  )
  hits = is_avatar.any(axis=-1) & is_fixed.any(axis=-1)
  return bool((hits & (contact.dist < -_OVERLAP)).any())


def _middles(
    grid: np.ndarray, changes: np.ndarray, is_reachable: np.ndarray
) -> list[np.ndarray]:
  """Returns places, `(2,)` each, in the middle of those of each effect."""
  is_tried = (changes != 0) & is_reachable
  if not is_tried.any():
    is_tried = changes != 0  # Such as behind a door that the agent can open.
  places, effects = grid[is_tried], changes[is_tried]
  if not len(places):
    return []
  edges = np.linspace(effects.min(), effects.max(), _EFFECTS + 1)[1:-1]
  kinds = np.digitize(effects, edges)
  middles: list[np.ndarray] = []
  for kind in range(_EFFECTS):
    alike = places[kinds == kind]
    gaps = np.linalg.norm(alike[:, np.newaxis] - alike, axis=-1)
    of_kind: list[np.ndarray] = []
    for i in np.argsort(-(gaps < 2 * _STEP).sum(axis=-1), kind='stable'):
      far = [np.linalg.norm(alike[i] - place) > _APART for place in of_kind]
      if all(far) and len(of_kind) < _PLACES:
        of_kind.append(alike[i])
    middles += of_kind
  return middles


@final
class Watch(events.BatchEventSink):
  """Adds registers to a survey whose readings change without a known place."""

  def __init__(
      self, batch: batch_environment.BatchEnvironment, survey: Survey
  ) -> None:
    """Makes the watch, to be passed to `batch.add_sink`."""
    self._batch = batch
    self._untried = survey.untried
    known = {place.register for place in survey.places}
    self._watched = [
        register
        for name, register in batch.mechanism.registers.items()
        if register.blocks and name not in known
    ]

  def step_ended(self, step: events.BatchStep) -> None:
    counts = ~(step.is_first | step.has_failed)
    for register in self._watched:
      if (_change(register, self._batch.physics) != 0.0)[counts].any():
        self._untried.add(register.name)
