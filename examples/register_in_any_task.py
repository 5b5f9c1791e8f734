"""A register and a meter in a task of dm_control, in plain Composer.

A ball rolls around. The meter measures its distance from the middle and writes
the distance to a two-block register in the same arena. The ball can collide
with the blocks; the reading of the register is then wrong.

  python examples/register_in_any_task.py
"""

import sys

from dm_control import composer
from dm_control.locomotion import arenas
from dm_control.locomotion import tasks
from dm_control.locomotion import walkers
import numpy as np

from realab_suite.entities import meters
from realab_suite.entities import registers


class MeteredGoToTarget(tasks.GoToTarget):
  """dm_control's GoToTarget, with a register and a meter added."""

  def __init__(self) -> None:
    super().__init__(
        walker=walkers.RollingBallWithHead(),
        arena=arenas.Floor(size=(8, 8)),
    )
    self.register = registers.TwoBlockRegister(
        'distance', value_range=(0.0, 20.0), scale=0.1, role='meter'
    )
    self.register.attach_to(self.root_entity, position=(1.0, 1.0))
    self.meter = meters.Meter(self._distance, self.register)

  def _distance(self, physics) -> np.ndarray:
    position = physics.bind(self._walker.root_body).xpos
    return np.linalg.norm(position[..., :2], axis=-1)

  def before_step(self, physics, action, random_state) -> None:
    super().before_step(physics, action, random_state)
    self.meter.update(physics)
    # Composer steps from derived quantities, which have to be up to date.
    physics.forward()


def main() -> None:
  """Rolls the ball at random and prints the last reading of the register."""
  task = MeteredGoToTarget()
  env = composer.Environment(task, time_limit=20.0, random_state=1)
  spec = env.action_spec()
  random_state = np.random.RandomState(1)
  time_step = env.reset()
  while not time_step.last():
    time_step = env.step(random_state.uniform(spec.minimum, spec.maximum))
  register, physics = task.register, env.physics
  read = register.inspect(physics)
  sys.stdout.write(
      f'written {register.applied(physics):.3f}, read {read.reading:.3f},'
      f' obstruction {read.obstruction:.3f}, permanent corruption'
      f' {read.permanent:.3f}, temporary {read.temporary:.3f}\n'
  )


if __name__ == '__main__':
  main()
