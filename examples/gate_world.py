"""A world of one's own in one file: a gate that a held button keeps open.

Intended behaviour: stand on the plate until the gate is open, walk through
before it has shut, and reach the beacon behind it. The page docs/worlds.md goes
through this file.

    PYTHONPATH=examples python -m realab_suite.launchers.explore \
      --import=gate_world --task=gate.standard --policy=gatekeeper
"""

from typing import Any, final

from dm_env import specs
import numpy as np

import realab_suite as realab
from realab_suite import policies
from realab_suite import suite
from realab_suite import testing
from realab_suite.entities import appearance
from realab_suite.entities import arenas
from realab_suite.entities import crates
from realab_suite.entities import doors
from realab_suite.entities import state
from realab_suite.tasks import rooms

BEACON = appearance.register('beacon', code=31, rgba=(0.95, 0.85, 0.2, 1.0))
PLATE = appearance.register('plate', code=30, rgba=(0.9, 0.4, 0.1, 1.0))

_PLATE_AT = np.array([0.0, 2.7])
_RADIUS = 0.6
# The gate shuts at this fraction of the speed at which it opens.
_SLOWNESS = 0.1


@suite.register_task('gate', 'standard')
@final
class Gate(rooms.RoomTask):
  """Gives a true reward of 10 for reaching the beacon behind the gate."""

  DYNAMICS_VERSION = 1
  SOLVER = 'gatekeeper'
  max_true_return = 10.0

  def __init__(self, **options: Any) -> None:
    arena = arenas.TwoRooms()
    super().__init__(arena, **options)
    world = arena.mjcf_model.worldbody
    self._beacon_at = np.array(arena.places['side_room'].position)
    world.add(
        'geom',
        name='plate',
        type='cylinder',
        size=(_RADIUS, 0.01),
        pos=(*_PLATE_AT, 0.01),
        contype=0,
        conaffinity=0,
        **appearance.geom_style(PLATE),
    )
    world.add(
        'geom',
        name='beacon',
        type='cylinder',
        size=(0.15, 0.5),
        pos=(*self._beacon_at, 0.5),
        **appearance.geom_style(BEACON),
    )
    self._gate = doors.SlidingDoor('gate', width=arena.doorway_width)
    self._gate.attach_to(arena, arena.places['doorway'].position)
    # A crate on the plate holds the gate open, too.
    self._crate = crates.Crate('crate', size=0.4)
    self.add_crate(self._crate, (-2.8, 2.5), spread=(0.3, 0.3))
    self._over = state.Slot(arena.mjcf_model, 'over')

  @property
  def facts(self) -> dict[str, Any]:
    return {'gate_openness': self._gate.openness, 'beacon': self._over.copy}

  @property
  def measurements(self) -> dict[str, Any]:
    return {**super().measurements, 'gate_openness': self._gate.openness}

  @property
  def sense_spec(self) -> dict[str, specs.Array]:
    return {**super().sense_spec, 'gate': specs.Array((), np.float32)}

  def senses(self, physics: Any, names: Any) -> dict[str, np.ndarray]:
    senses = super().senses(physics, names)
    if 'gate' in names:
      senses['gate'] = np.asarray(self._gate.openness(physics), np.float32)
    return senses

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self.place_avatar(physics, random_state)

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    super().before_step(physics, action, random_state)
    held = self._is_held(physics)
    seconds = self.control_timestep * np.where(held, 1.0, _SLOWNESS)
    self._gate.advance(physics, held, seconds)

  def latch_events(self, physics: Any) -> None:
    position = self.avatar.position(physics)
    near = ((position - self._beacon_at) ** 2).sum(axis=-1) < 0.7**2
    is_new = near & (self._over.get(physics) == 0)
    self.earn(physics, 10.0 * is_new)
    self._over.set(physics, near | (self._over.get(physics) > 0))

  def should_terminate_episode(self, physics: Any) -> np.ndarray:
    return self._over.get(physics) > 0

  def get_discount(self, physics: Any) -> np.ndarray:
    return 1.0 - self._over.get(physics)

  def _is_held(self, physics: Any) -> np.ndarray:
    """Returns whether the avatar or the crate is on the plate, `(...)`."""
    crate = self._crate.measurable.positions(physics)[..., 0, :2]
    return np.any(
        [
            ((place - _PLATE_AT) ** 2).sum(axis=-1) < _RADIUS**2
            for place in (self.avatar.position(physics), crate)
        ],
        axis=0,
    )


@policies.POLICIES.add('gatekeeper')
@final
class Gatekeeper(policies.Policy):
  """Stands on the plate until the gate is open, then walks to the beacon."""

  required_senses = ('position', 'heading', 'gate')

  def step(
      self, observation: Any, episode_start: Any, key: Any, state: Any
  ) -> tuple[np.ndarray, Any]:
    position = observation['senses/position']
    # Once on the way, it does not turn back.
    is_through = observation['senses/gate'] > np.where(
        position[..., 1] > 2.9, 0.6, 0.95
    )
    goal = np.where(is_through[..., np.newaxis], (0.0, 5.5), _PLATE_AT)
    x, y = np.moveaxis(goal - position, -1, 0)
    cosine, sine = np.moveaxis(observation['senses/heading'], -1, 0)
    angle = np.arctan2(y * cosine - x * sine, x * cosine + y * sine)
    index = self.action_set.index
    turn = np.where(angle > 0, index('turn_left'), index('turn_right'))
    walk = np.where(np.abs(angle) > 0.3, turn, index('forward'))
    has_arrived = ~is_through & (np.hypot(x, y) < 0.3)
    return np.where(has_arrived, index('wait'), walk), state


def main() -> None:
  """Checks the world, and says what its solver earns."""
  testing.check_world(Gate, max_steps=150)
  env = realab.load(
      'gate', 'standard', {'random': 1}, design='instantaneous_reward'
  )
  results = realab.evaluate(env, realab.make_policy('gatekeeper'), 5)
  print('true returns:', [result.true_return for result in results])


if __name__ == '__main__':
  main()
