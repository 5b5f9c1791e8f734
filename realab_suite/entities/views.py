"""Views: a physics of Composer as registers access it between substeps.

Composer begins a step with the derived quantities of the previous step, which
are wrong after a write to a register. It also recomputes accelerations, and the
sensors that measure them, when a bound attribute is read after a write. A write
to a register must not cause this, because the task would then observe other
values.
"""

from typing import Any, final

from dm_control import mjcf
import mujoco


def refresh(physics: mjcf.Physics) -> None:
  """Updates the quantities derived from positions and velocities.

  Unlike `physics.forward`, this function does not change accelerations and the
  solver's warm start.

  Args:
    physics: Physics of one world.

  Raises:
    PhysicsError: If MuJoCo issued a warning.
  """
  with physics.check_invalid_state():
    mujoco.mj_step1(physics.model.ptr, physics.data.ptr)


@final
class View(mjcf.Physics):
  """A second physics with the state of another one.

  Reads through it update poses and velocities only. Call `open` before reads
  and writes, and `refresh` after them, before Composer continues.
  """

  def __init__(self, physics: mjcf.Physics) -> None:
    """Makes a view of a physics.

    Args:
      physics: Physics of one world, which may be Composer's proxy of it. The
        view must not be used after the model is compiled again.
    """
    super().__init__(physics.data)

  def after_reset(self) -> None:
    """Does nothing, because the state belongs to the other physics."""

  def open(self, physics: Any) -> None:
    """Begins a part of a control step.

    Args:
      physics: Physics that the view was made of.
    """
    # Without legacy steps, poses are those before the last substep.
    if physics.is_dirty or not physics.legacy_step:
      self.mark_as_dirty()

  def forward(self) -> None:
    """Updates poses and velocities."""
    refresh(self)
    self._dirty = False

  def refresh(self) -> None:
    """Updates poses and velocities, with which the next substep begins."""
    self.forward()
