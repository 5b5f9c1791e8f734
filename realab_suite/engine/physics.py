"""One world, stepped without losing time between the physics and Python."""

from typing import Any, final

from dm_control import mjcf
from dm_control.rl import control
import mujoco


@final
class Physics(mjcf.Physics):
  """`mjcf.Physics` whose steps begin afresh from the state.

  Composer's own step keeps derived quantities current by starting every step in
  the middle of the engine's, which goes wrong for one substep after each write
  to a register unless everything is computed anew. Here a step computes what it
  needs from the state, and derived quantities are brought up to date when they
  are read.
  """

  def forward(self) -> None:
    """Brings positions and velocities, and what derives from them, up to date.

    Accelerations and contact forces stay those of the last substep, as in
    Composer. Solving for them here would change the solver's warm start, and
    with it the trajectory: looking would disturb.
    """
    mujoco.mj_step1(self.model.ptr, self.data.ptr)
    self._dirty = False

  def reset(self, keyframe_id: int | None = None) -> None:
    """Resets the state; accelerations are computed once, without actuation."""
    super().reset(keyframe_id)
    with self.model.disable('actuation'):
      mujoco.mj_forward(self.model.ptr, self.data.ptr)

  def advance(self, num_substeps: int) -> None:
    """Steps the physics, from the state as it is.

    Raises:
      PhysicsError: If MuJoCo warned. It has reset the state by then, so nothing
        may be read off it.
    """
    data = self.data.ptr
    mujoco.mj_step(self.model.ptr, data, num_substeps)
    self._dirty = True
    if data.warning.number.any():
      raise control.PhysicsError(_warnings(data))


def _warnings(data: Any) -> str:
  raised = [
      mujoco.mjtWarning(i).name
      for i, number in enumerate(data.warning.number)
      if number
  ]
  return f'MuJoCo warned of {", ".join(raised)}'
