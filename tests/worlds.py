"""Small worlds for tests, and what tests do to them."""

from collections.abc import Iterable
from typing import Any

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite.engine import single_physics
from realab_suite.entities import block_kinds
from realab_suite.entities import state


def compile_world(
    root: composer.Entity, kind: type[mjcf.Physics] = mjcf.Physics
) -> mjcf.Physics:
  """Returns the physics of a world: anybody's, or this package's own."""
  state.make_room(root.mjcf_model)
  return kind.from_mjcf_model(root.mjcf_model)


def fit_substeps(root: composer.Entity, blocks: Iterable[Any]) -> None:
  """Gives a world the longest substeps that its blocks are reliable with."""
  long = block_kinds.LONG_SUBSTEP
  is_long = all(block_kinds.find_misfit(b, long) is None for b in blocks)
  root.mjcf_model.option.timestep = (
      long if is_long else block_kinds.SHORT_SUBSTEP
  )


def step(physics: mjcf.Physics, steps: int = 1) -> None:
  """Steps a world from the state as it is, for `steps` times 10 ms."""
  steps = max(1, round(0.01 * steps / physics.timestep()))
  if isinstance(physics, single_physics.ThinPhysics):
    physics.advance(steps)
    return
  # Composer's steps begin in the middle of the engine's, with what was derived
  # before anything was written.
  physics.forward()
  physics.step(steps)


def start_episode(physics: Any, *entities: Any, seed: int = 0) -> None:
  """Resets the physics and tells the entities, as Composer would."""
  with physics.reset_context():
    random_state = np.random.RandomState(seed)
    for entity in entities:
      entity.initialize_episode(physics, random_state)


def shadow_reads(mechanism: Any, physics: Any, reader: str) -> list[Any]:
  """Reads every register on behalf of an evaluator; moves nothing."""
  return [r.inspect(physics, reader) for r in mechanism.registers.values()]


def state_bytes(physics: mjcf.Physics) -> bytes:
  """Returns all that the future depends on."""
  kind = mujoco.mjtState.mjSTATE_INTEGRATION
  model, data = physics.model.ptr, physics.data.ptr
  state = np.empty(mujoco.mj_stateSize(model, kind))
  mujoco.mj_getState(model, data, state, kind)
  return state.tobytes()


def guards(arena: composer.Arena) -> list[mjcf.Element]:
  """Returns the invisible walls that keep blocks in a room."""
  return [
      geom
      for geom in arena.mjcf_model.find_all('geom')
      if geom.name == 'lid' or geom.name.endswith('_guard')
  ]


def body_of(physics: mjcf.Physics, block: Any) -> int:
  """Returns the id of the body that a block's cube belongs to."""
  return physics.model.geom_bodyid[physics.bind(block.geom).element_id]


def world_position(physics: mjcf.Physics, block: Any) -> np.ndarray:
  """Returns the centre of a block in the frame of the world, `(3,)`."""
  return np.array(physics.bind(block.geom).xpos)


def shove(
    physics: mjcf.Physics,
    block: Any,
    force: Any,
    torque: Any = (0.0, 0.0, 0.0),
    steps: int = 20,
) -> None:
  """Applies a force to a block for some steps, then leaves it to itself."""
  body = body_of(physics, block)
  physics.data.xfrc_applied[body] = (*force, *torque)
  step(physics, steps)
  physics.data.xfrc_applied[body] = 0.0


def act(avatar: Any, physics: Any, steps: int, **commands: float) -> None:
  """Lets an avatar act for `steps` times 10 ms; `forward=1.0` and so on."""
  names = avatar.action_spec.name.split('\t')
  action = np.zeros(len(names))
  for name, value in commands.items():
    action[names.index(name)] = value
  avatar.apply_action(physics, action)
  step(physics, steps)
