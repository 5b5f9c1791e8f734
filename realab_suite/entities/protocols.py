"""Types of the physics that entities, tasks and feedback act on.

Contains no implementation: `mjcf.Physics` is one, `realab_suite.engine` has
others for one world, for many, and for one of many.
"""

from collections.abc import Sequence
from typing import Any, Protocol

from dm_control import mjcf
import numpy as np


class Binding(Protocol):
  """One MJCF element or several, bound to a physics.

  Attributes are read and written whole; shapes have a leading axis of worlds
  where the physics holds many. A write takes effect at once, and the next read
  of any attribute, derived ones included, reflects it.

  Arrays that are read belong to the physics: they may or may not follow later
  changes, so copy what has to last, and never write to their elements. The
  physics of `realab_suite.engine` return them read-only.

  Attributes:
    qpos: Positions of joints.
    qvel: Velocities of joints.
    ctrl: Control signals of actuators.
    mocap_pos: Positions of mocap bodies, in m.
    mocap_quat: Orientations of mocap bodies, as quaternions.
    active: 1 for each equality constraint that is active, otherwise 0.
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
  def element_id(self) -> Any:
    """Indices of the elements in the compiled model; the same in all worlds."""


class Data(Protocol):
  """The part of `mjData` that entities use."""

  @property
  def userdata(self) -> np.ndarray:
    """Slots of `entities.state`, `(slots,)` or `(worlds, slots)`, live."""


class Physics(Protocol):
  """A world, or a batch of worlds of the same model."""

  @property
  def model(self) -> Any:
    """The compiled model, as `mjcf.Physics.model`."""

  @property
  def data(self) -> Data:
    """The state that no element holds."""

  def bind(
      self, mjcf_elements: mjcf.Element | Sequence[mjcf.Element]
  ) -> Binding:
    """Returns the binding of an element, or of a sequence of elements."""

  def mark_as_dirty(self) -> None:
    """Marks derived quantities as out of date."""
