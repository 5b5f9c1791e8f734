"""Chains of contacts from the avatar to the blocks of registers.

A batch has no list of contacts, so contacts are computed from the poses at the
start and at the end of a control step, as in `entities.proximity`.
"""

from collections.abc import Sequence
import itertools
from typing import Any, NamedTuple, final

import numpy as np

from realab_suite.engine import batch_environment
from realab_suite.entities import block_kinds
from realab_suite.entities import proximity

AVATAR = 'avatar'
"""Name of the avatar in a chain."""

# Surfaces within this distance touch, in m.
_TOUCH = 0.005

Chain = tuple[str, ...]
"""Names of the avatar and of the blocks that it moved, as `reward/base`."""


@final
class _Candidates(NamedTuple):
  """Pairs of bodies that may be in contact in a control step.

  Attributes:
    near: True if their bounding spheres touch at the start or at the end of the
      step, `(2, worlds, pairs)`.
    is_held: True if the hand holds the block, `(worlds, pairs)`.
    limits: Distance up to which they touch, `(worlds, pairs)`, in m.
  """

  near: np.ndarray
  is_held: np.ndarray
  limits: np.ndarray


@final
class ContactRecorder:
  """Records poses of the avatar and the blocks, and finds chains of contacts.

  Blocks that nothing can push are left out.
  """

  def __init__(
      self, batch: batch_environment.BatchEnvironment, num_worlds: int
  ) -> None:
    """Makes a recorder.

    Args:
      batch: The worlds.
      num_worlds: Number of worlds to record: the first ones.
    """
    self._batch = batch
    self._num_worlds = num_worlds
    blocks = [
        (name, block)
        for name, register in batch.mechanism.registers.items()
        for block in register.blocks
        if isinstance(block, block_kinds.JointedBlock)
    ]
    self._names = [AVATAR, *(f'{n}/{block.body.name}' for n, block in blocks)]
    self._registers = np.array(['', *(name for name, _ in blocks)])
    torso = batch.task.avatar.mjcf_model.find('geom', 'torso')
    bound = batch.physics.bind((torso, *(block.geom for _, block in blocks)))
    self._geoms = bound
    self._ids = np.asarray(bound.element_id)
    self._radii = batch.physics.model.geom_rbound[self._ids]
    self._grasps = [
        [c for grasp in block.grasps for c in grasp.constraints]
        for _, block in blocks
    ]
    # The blocks of one register never collide with each other.
    self._pairs = np.array(
        [
            (one, other)
            for one, other in itertools.combinations(range(len(self._names)), 2)
            if self._registers[one] != self._registers[other]
        ],
        int,
    ).reshape(-1, 2)
    self._centres: list[np.ndarray] = []
    self._matrices: list[np.ndarray] = []
    self._held: list[np.ndarray] = []
    self._found: dict[tuple[int, bool], _Candidates] = {}

  def record(self) -> None:
    """Records the present poses: first those of the start, then each step's."""
    worlds = slice(self._num_worlds)
    self._centres.append(np.array(self._geoms.xpos[worlds]))
    self._matrices.append(np.array(self._geoms.xmat[worlds]))
    held = np.zeros((self._num_worlds, len(self._names)), bool)
    for i, constraints in enumerate(self._grasps, start=1):
      if constraints:
        active = self._batch.physics.bind(tuple(constraints)).active[worlds]
        held[:, i] = np.any(active, axis=-1)
    self._held.append(held)

  def chain(self, world: int, step: int, register: str) -> Chain:
    """Returns the shortest chain from the avatar to a register in a step.

    Args:
      world: Index of the world.
      step: Index of the control step, from 0.
      register: Name of the register.

    Returns:
      Names of the avatar and the blocks, in the order of the chain; `()` if no
      contact was found.
    """
    # Two bodies can touch and part again within a step. Their path counts only
    # if nothing touches at its ends, because a write makes a block jump.
    for is_swept in (False, True):
      contacts = self._contacts(world, step, is_swept)
      if path := self._path(contacts, register):
        return tuple(self._names[i] for i in path)
    return ()

  def _path(
      self, contacts: Sequence[tuple[int, int]], register: str
  ) -> tuple[int, ...]:
    """Returns the shortest path from the avatar to a block of a register."""
    paths: list[tuple[int, ...]] = [(0,)]
    seen = {0}
    for path in paths:  # Grows in the loop: a breadth-first search.
      if self._registers[path[-1]] == register:
        return path
      for pair in contacts:
        if path[-1] in pair:
          other = pair[0] + pair[1] - path[-1]
          if other not in seen:
            seen.add(other)
            paths.append((*path, other))
    return ()

  def _contacts(
      self, world: int, step: int, is_swept: bool
  ) -> list[tuple[int, int]]:
    """Returns the pairs in contact at the start or at the end of a step.

    Args:
      world: Index of the world.
      step: Index of the control step.
      is_swept: True to count pairs that may have met in between as well.
    """
    near, is_held, limits = self._candidates(step, is_swept)
    touching = is_held[world].copy()
    for i in np.flatnonzero(near[:, world].any(axis=0) & ~touching):
      limit = limits[world, i]
      touching[i] = any(
          self._distance(world, step + int(end), self._pairs[i], limit) <= limit
          for end in np.flatnonzero(near[:, world, i])
      )
    return [(int(a), int(b)) for a, b in self._pairs[touching]]

  def _candidates(self, step: int, is_swept: bool) -> _Candidates:
    """Returns the pairs that may be in contact, computed once for all worlds.

    Args:
      step: Index of the control step.
      is_swept: As in `_contacts`.
    """
    if (step, is_swept) not in self._found:
      centres = np.stack(self._centres[step : step + 2])
      held = self._held[step] | self._held[step + 1]
      one, other = self._pairs.T
      offsets = centres[:, :, one] - centres[:, :, other]
      limits = np.full(offsets.shape[1:3], _TOUCH)
      if is_swept:
        limits += np.linalg.norm(offsets[1] - offsets[0], axis=-1)
      reach = self._radii[one] + self._radii[other] + limits
      self._found[step, is_swept] = _Candidates(
          np.linalg.norm(offsets, axis=-1) <= reach,
          (one == 0) & held[:, other],
          limits,
      )
    return self._found[step, is_swept]

  def _distance(self, world: int, at: int, pair: Any, limit: float) -> float:
    return proximity.distance(
        self._batch.physics.model,
        self._ids[pair],
        self._centres[at][world][pair],
        self._matrices[at][world][pair],
        limit,
    )
