"""Tasks of `dm_control.suite`, as Composer tasks to which registers attach.

Two worlds are stepped. The *own world* is the physics of the task, unchanged;
everything that the task computes, it computes from there. The *joint world*
contains the bodies of the task and the registers. As long as nothing touches a
register, the own world moves as it would without registers, bit for bit, and
the joint world follows it. While something touches a register, the own world
follows the joint world.
"""

from collections.abc import Mapping
import functools
from typing import Any, final

from dm_control import composer
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_control.rl import control
from dm_env import specs
import mujoco
import numpy as np

from realab_suite import errors
from realab_suite.engine import control_sources

# State of a world. In the joint world, the elements of the task come first.
_STATE = (
    'qpos', 'qvel', 'act', 'ctrl', 'mocap_pos', 'mocap_quat', 'qfrc_applied',
    'xfrc_applied', 'qacc_warmstart', 'eq_active',
)  # fmt: skip
# Derived quantities that `mj_step1` does not compute, or that differ while
# something touches a register.
_DERIVED = (
    'qacc', 'qacc_smooth', 'qfrc_actuator', 'qfrc_bias', 'qfrc_constraint',
    'qfrc_passive', 'qfrc_smooth', 'act_dot', 'actuator_force', 'sensordata',
    'cacc', 'cfrc_int', 'cfrc_ext',
)  # fmt: skip
# Prefixes of the arrays of a model that a task may change, and of those that
# differ between compiled sources.
_MODEL = (
    'qpos0', 'qpos_spring', 'body_', 'jnt_', 'dof_', 'geom_', 'site_', 'cam_',
    'light_', 'mat_', 'hfield_', 'eq_', 'tendon_', 'wrap_', 'actuator_',
    'sensor_',
)  # fmt: skip
_NO_CONTACTS = mujoco.mjtDisableBit.mjDSBL_CONTACT
_NO_CONSTRAINTS = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
_NO_GRAVITY = mujoco.mjtDisableBit.mjDSBL_GRAVITY
# Largest component of the quaternion of a plane that is a floor.
_UPRIGHT = 1e-6
_ALL_BITS = 0x7FFFFFFF
# Differences of rangefinders between both worlds that are not numerical, in m.
_SEEN = 1e-6


@final
class ControlTask(composer.Task):
  """A task of `dm_control.suite` as a Composer task.

  The task's functions get the physics that it was loaded with, in which there
  are no registers. Its `random` becomes the environment's stream of random
  numbers. The time limit of the `control.Environment` does not count.
  """

  def __init__(self, env: control.Environment) -> None:
    """Initializes the task.

    Args:
      env: Loaded task of a domain like those of `dm_control.suite`.

    Raises:
      SpecError: If its MJCF source is unknown, if it shows its reward, or if it
        has no generator of random numbers.
    """
    self._task, self._own = env.task, env.physics
    if getattr(self._task, 'visualize_reward', False):
      raise errors.SpecError(
          'task: visualize_reward=True would show the true reward to the agent;'
          ' allowed is False'
      )
    if not isinstance(
        getattr(self._task, 'random', None), np.random.RandomState
    ):
      raise errors.SpecError(
          f'task: {type(self._task).__name__} has no RandomState called random,'
          ' so its episodes cannot be seeded'
      )
    model = control_sources.find(env)
    _prepare(model, self._own.model.ptr)
    # Root entity of the joint world: the MJCF source of the task.
    self._root = composer.ModelWrapperEntity(model)
    self.set_timesteps(env.control_timestep(), self._own.timestep())
    self._kinds = np.zeros(0, int)
    self._is_touched = False
    self._has_old_senses = True
    self._seen: Mapping[str, Any] = {}
    with self._own.reset_context():
      pass
    self._observables = {
        name: observable.Generic(functools.partial(self._sense, name))
        for name in self._task.get_observation(self._own)
    }
    for one in self._observables.values():
      one.enabled = True

  @property
  def root_entity(self) -> composer.Entity:
    return self._root

  @property
  def own_physics(self) -> Any:
    """Physics of the task, without registers."""
    return self._own

  @property
  def task_observables(self) -> dict[str, observable.Observable]:
    return self._observables

  def action_spec(self, physics: Any) -> specs.BoundedArray:
    """Returns the action spec of the task, with the names of actuators."""
    del physics  # Registers have no actuators.
    spec = self._task.action_spec(self._own)
    model = self._own.model
    names = [
        model.id2name(i, 'actuator') or f'element_{i}' for i in range(model.nu)
    ]
    is_named = spec.shape == (model.nu,)
    return spec.replace(name='\t'.join(names)) if is_named else spec

  def after_compile(self, physics: Any, random_state: Any) -> None:
    """Gives the joint world the values of the own world.

    Raises:
      SpecError: If the models do not match.
    """
    del random_state
    own, joint = self._own.model.ptr, physics.model.ptr
    _refuse_mismatch(own, joint)
    joint.stat.meaninertia = own.stat.meaninertia
    is_joint = np.arange(joint.ngeom) >= own.ngeom
    is_block = is_joint & (joint.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    is_moving = joint.body_weldid[joint.geom_bodyid] != 0
    self._kinds = np.where(is_block, 2, np.where(is_moving, 1, 0))
    is_solid = (joint.geom_contype | joint.geom_conaffinity) != 0
    # Registers collide with everything that is solid.
    joint.geom_contype[is_block & is_solid] = _ALL_BITS
    joint.geom_conaffinity[is_block & is_solid] = _ALL_BITS
    if own.opt.disableflags & (_NO_CONTACTS | _NO_CONSTRAINTS):
      # Registers still need contacts; bodies of the task touch only registers.
      # Everything else is for decoration here: targets, and walls, which are
      # endless planes.
      is_solid &= is_moving | _are_floors(joint)
      joint.geom_contype[~is_joint] = 0
      joint.geom_conaffinity[~is_joint] = is_solid[~is_joint]
    joint.opt.disableflags &= ~(_NO_CONTACTS | _NO_CONSTRAINTS | _NO_GRAVITY)
    self._push_model(joint)

  def initialize_episode(self, physics: Any, random_state: Any) -> None:
    self._task.random.set_state(random_state.get_state())
    with self._own.reset_context():
      self._task.initialize_episode(self._own)
    self._push_model(physics.model.ptr)
    self._push_state(physics)
    self._has_old_senses = True

  def before_step(self, physics: Any, action: Any, random_state: Any) -> None:
    del random_state
    self._task.before_step(action, self._own)
    self._push_state(physics)

  def before_substep(
      self, physics: Any, action: Any, random_state: Any
  ) -> None:
    del action, random_state
    kinds = self._kinds[physics.data.ptr.contact.geom]
    self._is_touched = bool(((kinds == 1).any(1) & (kinds == 2).any(1)).any())

  def after_substep(self, physics: Any, random_state: Any) -> None:
    del random_state
    if self._is_touched:
      self._pull(physics)
    else:
      self._own.step()
      self._push_state(physics)

  def after_step(self, physics: Any, random_state: Any) -> None:
    del random_state
    self._see_registers(physics)
    self._task.after_step(self._own)
    self._has_old_senses = True

  def get_reward(self, physics: Any) -> float:
    del physics
    return self._task.get_reward(self._own)

  def get_discount(self, physics: Any) -> float:
    del physics
    discount = self._task.get_termination(self._own)
    return 1.0 if discount is None else discount

  def should_terminate_episode(self, physics: Any) -> bool:
    del physics
    return self._task.get_termination(self._own) is not None

  def _sense(self, name: str, physics: Any) -> Any:
    """Returns an entry of the observation, which is computed once per step."""
    del physics
    if self._has_old_senses:
      self._seen = self._task.get_observation(self._own)
      self._has_old_senses = False
    return self._seen[name]

  def _push_model(self, joint: mujoco.MjModel) -> None:
    """Copies the values of the own model to the joint model."""
    own = self._own.model.ptr
    world_mass = joint.body_subtreemass[0]
    for name in _value_names():
      values = getattr(own, name)
      getattr(joint, name)[: len(values)] = values
    joint.body_subtreemass[0] = world_mass
    if own.opt.disableflags & _NO_GRAVITY:
      joint.body_gravcomp[: own.nbody] = 1.0
    if own.opt.disableflags & _NO_CONSTRAINTS:
      # Constraints are enabled for registers only.
      joint.jnt_limited[: own.njnt] = 0
      joint.dof_frictionloss[: own.nv] = 0.0
      joint.tendon_limited[: own.ntendon] = 0
      joint.tendon_frictionloss[: own.ntendon] = 0.0

  def _push_state(self, physics: Any) -> None:
    """Copies the state of the own world to the joint world."""
    own, joint = self._own.data.ptr, physics.data.ptr
    for name in _STATE:
      values = getattr(own, name)
      getattr(joint, name)[: len(values)] = values

  def _pull(self, physics: Any) -> None:
    """Copies the state of the joint world to the own world."""
    own, joint = self._own.data.ptr, physics.data.ptr
    own.time = joint.time
    for name in _STATE:
      values = getattr(own, name)
      values[:] = getattr(joint, name)[: len(values)]
    mujoco.mj_step1(self._own.model.ptr, own)
    for name in _DERIVED:
      values = getattr(own, name)
      values[:] = getattr(joint, name)[: len(values)]

  def _see_registers(self, physics: Any) -> None:
    """Copies the distances of registers that rangefinders measure."""
    model = self._own.model.ptr
    is_ray = model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER
    for i in np.flatnonzero(is_ray).tolist():
      own, joint = self._own.data.sensordata, physics.data.sensordata
      at = model.sensor_adr[i]
      if abs(joint[at] - own[at]) > _SEEN:
        own[at] = joint[at]


def _prepare(model: mjcf.RootElement, own: mujoco.MjModel) -> None:
  """Changes the source of a task so that registers can be added.

  Args:
    model: Source of the task.
    own: Compiled model of the task.
  """
  # With the noslip pass, meters would affect bodies that they do not touch.
  model.option.noslip_iterations = 0
  if own.opt.disableflags & _NO_GRAVITY:
    # Registers have weight, and bodies of the task still have none.
    for body in model.find_all('body'):
      body.gravcomp = 1.0
  if not (_are_floors(own) & (own.geom_pos[:, 2] == 0.0)).any():
    # Registers stand at the height 0. As a part of the last body, this floor is
    # after the geoms of the task.
    body = model.worldbody.add('body', name='floor_of_registers')
    body.add(
        'geom', type='plane', size=(1, 1, 1), group=4, contype=0, conaffinity=1
    )


def _are_floors(model: mujoco.MjModel) -> np.ndarray:
  """Returns True for each geom that is a plane facing up, `(geoms,)` bool."""
  is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  return is_plane & (np.abs(model.geom_quat[:, 1:3]).max(axis=1) <= _UPRIGHT)


@functools.cache
def _value_names() -> tuple[str, ...]:
  """Returns the names of the arrays of a model that contain numbers."""
  empty = mujoco.MjModel.from_xml_string('<mujoco/>')
  arrays = {
      name: getattr(empty, name)
      for name in dir(empty)
      if name.startswith(_MODEL) and not name.endswith('_user')
  }
  return tuple(
      name
      for name, values in arrays.items()
      if isinstance(values, np.ndarray) and values.dtype.kind == 'f'
  )


def _refuse_mismatch(own: mujoco.MjModel, joint: mujoco.MjModel) -> None:
  """Raises a SpecError if a model does not begin with another one."""
  for name in ('body_parentid', 'jnt_qposadr', 'geom_bodyid', 'site_bodyid',
               'actuator_trnid', 'sensor_adr', 'wrap_type'):  # fmt: skip
    values = getattr(own, name)
    if not np.array_equal(values, getattr(joint, name)[: len(values)]):
      raise errors.SpecError(
          f'task: {name} of its model differs from that of its source, so'
          ' registers cannot be attached'
      )
