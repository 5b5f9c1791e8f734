"""Movers: whether the agent or the world has moved a body last.

Bodies are the avatar, blocks and other objects that forces can move. Parts that
joints connect are one body. A batch has no list of contacts, so contacts are
computed from the states before and after a control step.
"""

from collections.abc import Iterable, Mapping, Sequence
import copy
import math
from typing import Any, NamedTuple, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.entities import grasps
from realab_suite.entities import protocols
from realab_suite.entities.registers import ports
from realab_suite.tasks import base

# Surfaces within this distance touch, in m.
_TOUCH = 0.005
# Largest gap of bodies that can meet within a control step, in m.
_APART = 0.6
# Bodies below this speed are at rest, in m/s.
_STILL = 0.005


@final
class _Moment(NamedTuple):
  """State of all worlds between two control steps.

  Attributes:
    qpos: Positions of all joints, `(worlds, nq)`.
    qvel: Velocities of all joints, `(worlds, nv)`.
    places: Positions of the bodies, `(worlds, bodies, 3)`, in m.
    speeds: Speeds of the bodies, `(worlds, bodies)`, in m/s. Those of turning
      bodies contain the energy of the turn.
    is_held: True for blocks in a hand, `(worlds, bodies)` bool.
  """

  qpos: np.ndarray
  qvel: np.ndarray
  places: np.ndarray
  speeds: np.ndarray
  is_held: np.ndarray


@final
class _Step(NamedTuple):
  """A control step. Masks have the shape `(worlds, bodies)`.

  Attributes:
    before: State before the step.
    after: State after the step.
    is_agents: True for bodies that the agent had moved last before the step,
      and for the avatar if it acts.
    is_source: True for bodies that were in motion before the step, and for the
      avatar if it acts.
    is_written: True for blocks of registers that were written.
  """

  before: _Moment
  after: _Moment
  is_agents: np.ndarray
  is_source: np.ndarray
  is_written: np.ndarray


@final
class _Scene(NamedTuple):
  """One world before and after a control step.

  Attributes:
    gaps: Smallest distance of each body to each other body near it, in m; -inf
      between a hand and what it holds.
    approach: Largest speed of each body towards each other one, in m/s.
  """

  gaps: Mapping[int, Mapping[int, float]]
  approach: Sequence[Sequence[float]]


@final
class Movers:
  """Tracks which bodies the agent moved last; all others are the world's.

  In a control step, a body is moved by

  1. the nearest source that it touches, directly or through bodies at rest. A
     source is the avatar, if it acts, or a body in motion, which passes on its
     own mover. If the body itself was in motion, the source needs more momentum
     towards it than it has towards the source;
  2. else, if it or a body that it touches was written, by the agent if the
     agent moved one of these last. A write pushes bodies apart because one of
     them was brought into the way;
  3. else by the world, if it was at rest and starts to move, because forces
     such as wind need no contact;
  4. else by its last mover, because its motion continues.

  A hand touches what it holds, at any distance.
  """

  def __init__(
      self,
      task: base.Task,
      movable: Sequence[ports.AnyPort],
      physics: protocols.Physics,
      num_worlds: int,
  ) -> None:
    """Finds the bodies.

    Args:
      task: Task of the worlds.
      movable: Ports of registers with blocks that forces can move.
      physics: Physics of one world or of a batch.
      num_worlds: Number of worlds; 1 for one world.
    """
    model, root = physics.model, task.root_entity.mjcf_model
    self._timestep = task.control_timestep
    trees = np.array(model.body_treeid)

    def number(body: mjcf.Element) -> int:
      return int(trees[physics.bind(body).element_id])

    self._of_geom = trees[model.geom_bodyid]
    self._roots = roots = np.array(model.tree_bodyadr)
    self._masses = np.array(model.body_subtreemass[roots])
    self._places = physics.bind(_numbered(physics, root, 'body', roots))
    joints = _numbered(physics, root, 'joint', range(model.njnt))
    self._joints = physics.bind(joints)
    # Other joints, such as that of the avatar's head, do not move the body.
    of_dof, eye = np.array(model.dof_treeid), np.eye(len(roots))
    inertia = model.dof_M0 * (model.dof_bodyid == roots[of_dof])
    self._inertia = eye[of_dof] * inertia[:, np.newaxis] / self._masses
    torso = task.avatar.body
    self._avatar = number(torso)
    motors = task.avatar.mjcf_model.find_all('actuator')
    self._motors = physics.bind(
        [one for one in motors if (one.joint or one.site).parent is torso]
    )
    # Several ports may depend on a block.
    blocks: list[Any] = [
        *dict.fromkeys(block for one in movable for block in one.blocks)
    ]
    held = [
        (constraint, number(block.body))
        for block in blocks
        for constraint in grasps.constraints_of(block.grasps)
    ]
    self._grasps = physics.bind([one for one, _ in held]) if held else None
    self._grasped = eye[[body for _, body in held]]
    bodies = [[number(block.body) for block in one.blocks] for one in movable]
    # Without blocks, a port has no corruption of its own, and any body will do.
    ends = [[(ones or [0])[i] for ones in bodies] for i in (0, -1)]
    self._ends = np.array(ends, int)
    self._is_of = np.zeros((len(movable), len(roots)))
    for i, ones in enumerate(bodies):
      self._is_of[i, ones] = 1.0
    self._make_scene(model)
    self._is_agents = np.zeros((num_worlds, len(roots)), bool)
    self._has_acted = np.zeros(num_worlds, bool)
    self._now = self._look()

  def _make_scene(self, model: Any) -> None:
    """Makes a model in which bodies that are near each other have contacts."""
    self._scene = scene = copy.copy(model)
    for flags in (scene.geom_contype, scene.geom_conaffinity):
      flags[self._of_geom < 0] = 0
    for margins in (scene.geom_margin, scene.body_margin, scene.pair_margin):
      margins[:] = _APART
    self._data = data = mujoco.MjData(scene.ptr)
    mujoco.mj_kinematics(scene.ptr, data)
    # Radii of spheres around the positions of bodies that contain their geoms.
    self._radii = np.zeros(len(self._roots))
    for geom in np.flatnonzero(scene.geom_contype | scene.geom_conaffinity):
      body = self._of_geom[geom]
      offset = data.geom_xpos[geom] - data.xpos[self._roots[body]]
      radius = np.linalg.norm(offset) + model.geom_rbound[geom]
      self._radii[body] = max(self._radii[body], radius)

  @property
  def is_agents(self) -> np.ndarray:
    """True for blocks that the agent moved last, `(2, ports, worlds)` bool.

    The first and the last block of each port; they may be the same block.
    """
    return self._is_agents.T[self._ends]

  def have_put(self, geoms: np.ndarray) -> np.ndarray:
    """Returns True for geoms whose body the agent moved last.

    Args:
      geoms: Geoms, `(..., geoms)`; -1 for none.

    Returns:
      `(..., geoms)` bool.
    """
    bodies = np.where(geoms < 0, -1, self._of_geom[geoms])
    rows = bodies.reshape(len(self._is_agents), -1)
    is_moved = np.take_along_axis(self._is_agents, rows, axis=-1)
    return (is_moved & (rows >= 0)).reshape(geoms.shape)

  def begin(self, where: np.ndarray) -> None:
    """Begins episodes in some worlds, `(worlds,)` bool."""
    self._now = self._look()
    self._is_agents[where] = self._has_acted[where] = False

  def update(
      self,
      where: np.ndarray,
      is_displaced: np.ndarray,
      is_written: np.ndarray,
  ) -> None:
    """Finds the movers in a control step.

    Args:
      where: Worlds that have run the step, `(worlds,)` bool.
      is_displaced: True for blocks that have moved other than by a write, in
        the shape of `is_agents`. Blocks in motion need not be named.
      is_written: True for ports that were written, `(ports, worlds)`.
    """
    before, after = self._now, self._look()
    # Other worlds have not changed, or begin their next episode.
    self._now = after
    acts = np.reshape(self._motors.ctrl, (len(where), -1)).any(axis=-1)
    acts |= (before.is_held != after.is_held).any(axis=-1)
    acts &= where
    # In the step after it has acted, it may bounce off what it stood against.
    moves_itself = acts | (self._has_acted & where)
    self._has_acted = np.where(where, acts, self._has_acted)
    self._is_agents[moves_itself, self._avatar] = True
    is_moved = after.speeds > _STILL
    ends, numbers, worlds = np.nonzero(is_displaced)
    is_moved[worlds, self._ends[ends, numbers]] = True
    is_moved &= where[:, np.newaxis]
    is_moved[moves_itself, self._avatar] = False
    if not is_moved.any():
      return  # The most frequent case.
    is_source = before.speeds > _STILL
    is_source[acts, self._avatar] = True
    step = _Step(
        before,
        after,
        self._is_agents.copy(),
        is_source,
        is_written.T @ self._is_of > 0,
    )
    is_unclear = self._may_change(is_moved, step)
    for world in np.flatnonzero(is_unclear.any(axis=-1)).tolist():
      scene = self._see(world, step)
      unclear = frozenset(np.flatnonzero(is_unclear[world]).tolist())
      for body in unclear:
        self._is_agents[world, body] = self._is_moved_by_agent(
            body, world, step, scene, unclear
        )

  def _look(self) -> _Moment:
    """Returns the present state of all worlds."""
    num, num_bodies = self._is_agents.shape
    qvel = np.array(self._joints.qvel).reshape(num, -1)
    is_held = np.zeros((num, num_bodies), bool)
    if self._grasps is not None:
      is_held = np.reshape(self._grasps.active, (num, -1)) @ self._grasped > 0
    return _Moment(
        np.array(self._joints.qpos).reshape(num, -1),
        qvel,
        np.array(self._places.xpos).reshape(num, num_bodies, 3),
        np.sqrt((qvel * qvel) @ self._inertia),
        is_held,
    )

  def _may_change(self, is_moved: np.ndarray, step: _Step) -> np.ndarray:
    """Returns True for moved bodies whose mover is to be searched.

    The others have no source of another mover near them. This takes little time
    for all worlds together, and a search takes long.
    """
    starts = (step.before.speeds <= _STILL) & (step.after.speeds > _STILL)
    may_change = is_moved & starts
    speeds = np.maximum(step.before.speeds, step.after.speeds)
    reach = self._radii + speeds * self._timestep + _TOUCH
    # Almost always, all sources of a world have the same mover.
    is_agents = step.is_agents
    is_other = is_agents[:, :, np.newaxis] != is_agents[:, np.newaxis]
    is_other &= is_moved[:, :, np.newaxis] & step.is_source[:, np.newaxis]
    worlds, ones, others = np.nonzero(is_other)
    limits = reach[worlds, ones] + reach[worlds, others]
    for moment in (step.before, step.after):
      offsets = moment.places[worlds, ones] - moment.places[worlds, others]
      is_near = (offsets * offsets).sum(axis=-1) <= limits * limits
      may_change[worlds[is_near], ones[is_near]] = True
    return may_change

  def _see(self, world: int, step: _Step) -> _Scene:
    """Returns the contacts and velocities in one world."""
    scene, data = self._scene.ptr, self._data
    gaps: dict[int, dict[int, float]] = {}
    speeds = []
    for moment in (step.before, step.after):
      data.qpos[:], data.qvel[:] = moment.qpos[world], moment.qvel[world]
      mujoco.mj_kinematics(scene, data)
      mujoco.mj_comPos(scene, data)
      mujoco.mj_comVel(scene, data)
      mujoco.mj_collision(scene, data)
      pairs = self._of_geom[data.contact.geom].tolist()
      contacts = [*zip(pairs, data.contact.dist.tolist(), strict=True)]
      for body in np.flatnonzero(moment.is_held[world]).tolist():
        contacts.append(([body, self._avatar], -math.inf))
      for pair, gap in contacts:
        for first, second in (pair, reversed(pair)):
          near = gaps.setdefault(first, {})
          near[second] = min(gap, near.get(second, gap))
      centres = data.subtree_com[self._roots]
      ways = centres - centres[:, np.newaxis]
      lengths = np.linalg.norm(ways, axis=-1) + np.eye(len(centres))
      velocities = data.cvel[self._roots, np.newaxis, 3:]
      speeds.append((velocities * ways).sum(axis=-1) / lengths)
    return _Scene(gaps, np.maximum(*speeds).tolist())

  def _is_moved_by_agent(
      self,
      body: int,
      world: int,
      step: _Step,
      scene: _Scene,
      unclear: frozenset[int],
  ) -> bool:
    """Returns True if the agent moves a body, by the rules of the class.

    Args:
      body: Number of the body.
      world: Index of the world.
      step: The step.
      scene: The world in this step.
      unclear: Numbers of the bodies whose mover may change in this step.
    """
    is_agents, is_source = step.is_agents[world], step.is_source[world]
    # Bodies may have met and parted within the step. A source that does not
    # come nearer may push out a body that overlaps with it.
    tries = (0.0, _STILL), (self._timestep, _STILL), (0.0, -math.inf)
    for time, least in tries:
      source, touching = self._find_source(
          body, is_source, is_agents, scene, time, least
      )
      if source in unclear and source is not None:
        # Something else may move the source itself.
        return self._is_moved_by_agent(
            source, world, step, scene, unclear - {body}
        )
      if source is not None:
        return bool(is_agents[source])
    if step.is_written[world, touching].any():
      return bool(is_agents[touching].any())
    is_moving = step.after.speeds[world, body] > _STILL
    return bool(is_agents[body] and (is_source[body] or not is_moving))

  def _find_source(
      self,
      body: int,
      is_source: np.ndarray,
      is_agents: np.ndarray,
      scene: _Scene,
      time: float,
      least: float,
  ) -> tuple[int | None, list[int]]:
    """Returns the nearest source that a body touches, if there is one.

    Args:
      body: Number of the body.
      is_source: True for sources, `(bodies,)` bool.
      is_agents: True for bodies that the agent moved last, `(bodies,)` bool.
      scene: The world.
      time: Time in which bodies may meet, in s.
      least: Least speed of a source towards the next body, in m/s.

    Returns:
      The source, or `None`; and the bodies that touch the body directly or
      through others, up to the source.
    """
    touching = ring = [body]
    while ring:
      sources, following = [], []
      for link in ring:
        for peer, gap in scene.gaps.get(link, {}).items():
          back, forth = scene.approach[link][peer], scene.approach[peer][link]
          path = time * (max(back, 0.0) + max(forth, 0.0))
          if peer in touching or gap > _TOUCH + path:
            continue
          # A hand always pulls.
          speed = forth if gap > -math.inf else math.inf
          force = self._masses[peer] * speed
          if is_source[link] and force <= self._masses[link] * back:
            continue  # It is not pushed, but pushes.
          if not is_source[peer]:
            following.append(peer)
          elif speed >= least:
            # If several push, most of the motion is due to the strongest.
            sources.append((force, bool(is_agents[peer]), peer))
      if sources:
        return max(sources)[-1], touching
      ring = list(dict.fromkeys(following))
      touching = touching + ring
    return None, touching


def _numbered(
    physics: protocols.Physics,
    root: mjcf.RootElement,
    kind: str,
    numbers: Iterable[int],
) -> list[mjcf.Element]:
  """Returns the elements of a kind with the given numbers in the model."""
  elements = root.find_all(kind)
  if kind == 'body':  # Bindings cannot mix them with mocap bodies.
    elements = [element for element in elements if not element.mocap]
  ids = physics.bind(elements).element_id
  by_number = dict(zip(ids, elements, strict=True))
  return [by_number[number] for number in numbers]
