"""Factory of learners: options, encoders and wrappers, from specs."""

from collections.abc import Mapping
from typing import Any

from dm_env import specs as dm_env_specs

from realab_suite import errors
from realab_suite.config import integers
from realab_suite.config import validation
from realab_suite.feedback import specs
from realab_suite.lab.agents import action_encoding
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import gates
from realab_suite.lab.agents import guards
from realab_suite.lab.agents import histories
from realab_suite.lab.agents import jax_settings
from realab_suite.lab.agents import lengths

# Class of the wrapper of an option, and the value of the option without one.
_WRAPPERS: Mapping[str, tuple[Any, Any]] = {
    'frame_stack': (histories.FrameStack, 1),
    'recollection': (histories.Recollection, False),
    'drest': (lengths.Drest, None),
    'defence': (guards.Guard, None),
    'gate': (gates.Gatekeeper, None),
}


@jax_settings.pinned()
def make(
    spec: specs.LearnerSpec | Mapping[str, Any] | None,
    observation_spec: Mapping[str, dm_env_specs.Array],
    action_spec: dm_env_specs.Array,
    num_envs: int,
    seed: int,
) -> base.Learner:
  """Makes the learner of a design.

  Args:
    spec: The `learner` of a design, or a mapping with `kind` and options.
    observation_spec: Observation spec of one world.
    action_spec: Action spec of one world.
    num_envs: Number of worlds.
    seed: Seed of all random draws, a non-negative integer.

  Raises:
    SpecError: If the learner is unknown, an option is invalid, the specs lack a
      register that the learner needs, or JAX has no device.
  """
  jax_settings.check_device()
  num_envs = integers.check('num_envs', num_envs, 1)
  seed = integers.check('seed', seed, 0, high=None)
  options = options_of(spec)
  learner_class = base.LEARNERS.get(options.kind)
  reading = _find_reading(options, learner_class.READS, observation_spec)
  if options.recollection:
    observation_spec = histories.recollected(observation_spec, reading)
  learner = learner_class(
      # Compiled functions depend on the other options alone.
      options.model_copy(
          update=dict.fromkeys(
              {'defence', 'drest', 'gate'} & {*learner_class.WRAPPED}
          )
      ),
      reading,
      features.Encoder.from_spec(observation_spec, options.frame_stack),
      action_encoding.Controls.from_spec(action_spec),
      num_envs,
      seed,
  )
  for name in learner_class.WRAPPED:
    wrapper_class, none = _WRAPPERS[name]
    if (option := getattr(options, name)) != none:
      learner.wrap(wrapper_class(option, learner))
  return learner


def check(design: specs.DesignSpec) -> None:
  """Refuses the learner of a design, as far as no world is needed for it.

  Raises:
    SpecError: If the learner is unknown, an option is invalid, the design lacks
      the action set that the learner needs, or its defence listens to anything
      but a register that a provider writes.
  """
  options = options_of(design.learner)
  learner_class = base.LEARNERS.get(options.kind)
  if learner_class.NEEDS_ACTION_SET and design.action_set is None:
    raise errors.SpecError(
        f'action_set: missing, and learner {options.kind!r} chooses among the'
        ' actions of a set; must be one, such as {name: dmlab_like, version: 1}'
    )
  written = {name for spec in design.providers for name in spec.writes}
  defence = getattr(options, 'defence', None)
  for name in defence.reads if defence else ():
    if name not in written:
      raise errors.SpecError(
          f'learner.defence: listens to {name!r}, which is no register that a'
          f' provider writes; must be one of {sorted(written)}'
      )


def is_of_package(spec: specs.LearnerSpec) -> bool:
  """Returns False if the learner or its defence is of another package.

  Args:
    spec: The `learner` of a design.

  Raises:
    SpecError: If the learner is unknown, or an option is invalid.
  """
  options = options_of(spec)
  members: list[type[Any]] = [base.LEARNERS.get(options.kind)]
  if (defence := getattr(options, 'defence', None)) is not None:
    members.append(type(defence))
  own = __name__.partition('.')[0]
  return {one.__module__.partition('.')[0] for one in members} == {own}


def options_of(
    spec: specs.LearnerSpec | Mapping[str, Any] | None,
) -> base.Options:
  """Returns the options of a learner.

  Args:
    spec: As for `make`.

  Raises:
    SpecError: If the learner is unknown, or an option is invalid.
  """
  if spec is None:
    raise errors.SpecError(
        'learner: None; must be that of a design, or a mapping'
        f' whose kind is one of {sorted(base.LEARNERS)}'
    )
  if not isinstance(spec, specs.LearnerSpec):
    spec = validation.validate(specs.LearnerSpec, spec, 'learner')
  # The objective is for evaluators.
  values = {k: v for k, v in spec.model_dump().items() if k != 'objective'}
  options_class = base.LEARNERS.get(spec.kind).OPTIONS
  return validation.validate(options_class, values, 'learner')


def _find_reading(
    options: base.Options,
    field: str,
    observation_spec: Mapping[str, dm_env_specs.Array],
) -> str:
  """Returns the observation key of the reading that a learner learns from."""
  where, register = f'learner.{field}', getattr(options, field)
  key = features.find_key(where, register, observation_spec)
  if shape := observation_spec[key].shape:
    raise errors.SpecError(
        f'{where}: {key!r} has shape {shape}; must be a scalar'
    )
  return key
