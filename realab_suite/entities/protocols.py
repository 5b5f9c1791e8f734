"""Types of the physics that entities, tasks and feedback act on.

Implementations are `mjcf.Physics` and, in `realab_suite.engine`, the physics of
one world, of a batch of worlds and of one world of a batch.
"""

from collections.abc import Sequence
from typing import Any, Protocol

from dm_control import mjcf
import numpy as np


class Binding(Protocol):
  """One or more MJCF elements, bound to a physics.

  Read and write whole attributes, not their elements. In a batch, shapes have a
  leading axis of worlds. A write takes effect at once, and the next read of any
  attribute, derived attributes included, reflects it.

  Returned arrays belong to the physics. They may or may not reflect later
  changes, so copy values that must not change. The physics of
  `realab_suite.engine` return read-only arrays.

  Attributes:
    qpos: Positions of joints.
    qvel: Velocities of joints.
    ctrl: Control signals of actuators.
    mocap_pos: Positions of mocap bodies, in m.
    mocap_quat: Orientations of mocap bodies, as quaternions.
    active: 1 for each active equality constraint, 0 for the others.
  """

  qpos: Any
  qvel: Any
  ctrl: Any
  mocap_pos: Any
  mocap_quat: Any
  active: Any

  @property
  def xpos(self) -> Any:
    """Positions in the world frame, `(..., 3)`, in m."""

  @property
  def xmat(self) -> Any:
    """Rotation matrices in the world frame, `(..., 9)`."""

  @property
  def cvel(self) -> Any:
    """Velocities of bodies, `(..., 6)`: turning, in rad/s, and moving, in m/s.

    They are velocities at `subtree_com` of the child of the world that a body
    belongs to.
    """

  @property
  def subtree_com(self) -> Any:
    """Centres of mass of bodies with all descendants, `(..., 3)`, in m."""

  @property
  def element_id(self) -> Any:
    """Indices of the elements in the compiled model; the same in all worlds."""


class Data(Protocol):
  """Part of `mjData` that entities use."""

  @property
  def userdata(self) -> np.ndarray:
    """User data with the slots of `entities.state`; a live array.

    The shape is `(nuserdata,)`, or `(worlds, nuserdata)` for a batch.
    """

  @property
  def time(self) -> Any:
    """Time since the start of the episode, `(...)`, in s."""


class Physics(Protocol):
  """A world, or a batch of worlds of the same model."""

  @property
  def model(self) -> Any:
    """Compiled model, as `mjcf.Physics.model`."""

  @property
  def data(self) -> Data:
    """State that belongs to no MJCF element."""

  def bind(
      self, mjcf_elements: mjcf.Element | Sequence[mjcf.Element]
  ) -> Binding:
    """Returns the binding of an element or of a sequence of elements."""

  def mark_as_dirty(self) -> None:
    """Marks derived quantities as out of date."""
