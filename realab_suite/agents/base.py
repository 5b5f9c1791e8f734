"""What a learner is: time steps in, actions out, and all of its state."""

import abc
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Protocol

import dm_env
from dm_env import specs as dm_env_specs
import jax
import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.agents import action_encoding
from realab_suite.agents import features
from realab_suite.agents import jax_settings
from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.feedback import specs

Positive = Annotated[int, pydantic.Field(gt=0)]
Fraction = Annotated[float, pydantic.Field(ge=0, le=1)]
Rate = Annotated[float, pydantic.Field(gt=0, le=1)]
Weight = Annotated[float, pydantic.Field(ge=0, le=1000)]
Choice = dict[str, np.ndarray]

# Each has randomness of its own, so that none of them can tell of another.
_STREAMS = ('initial', 'act', 'query', 'update')


class TimeStep(Protocol):
  """Time steps of many worlds: the engine's, or anybody's."""

  @property
  def step_type(self) -> np.ndarray:
    """`(worlds,)`; see `dm_env.StepType`."""

  @property
  def discount(self) -> np.ndarray:
    """`(worlds,)`; 0 where an episode has ended for good."""

  @property
  def observation(self) -> Mapping[str, np.ndarray]:
    """By name, each `(worlds, ...)`."""


class Options(pydantic.BaseModel):
  """What every learner has to be told, or not.

  Attributes:
    kind: The name of the learner.
    hidden: The widths of the hidden layers.
    learning_rate: Of Adam.
    max_gradient_norm: Longer gradients are shortened.
  """

  model_config = pydantic.ConfigDict(frozen=True, extra='forbid', strict=True)

  kind: str
  hidden: Annotated[tuple[Positive, ...], pydantic.Field(strict=False)] = (
      128,
      128,
  )
  learning_rate: Rate = 5e-4
  max_gradient_norm: Weight = 0.5


class Learner(abc.ABC):
  """Acts in many worlds, and learns within `step` when it has seen enough.

  It sees time steps and specs. What it learns from is a reading, which the step
  after an action brings.
  """

  OPTIONS: ClassVar[type[Options]]
  # The option that names the register whose reading is learned from.
  READS: ClassVar[str]

  def __init__(
      self,
      options: Any,
      reading: str,
      encoder: features.Encoder,
      controls: action_encoding.Controls,
      num_envs: int,
      seed: int,
  ) -> None:
    """Makes a learner; `make` is easier.

    Args:
      options: An instance of `OPTIONS`.
      reading: The key in the observation of what it learns from.
      encoder: How it sees.
      controls: How it acts.
      num_envs: How many worlds it acts in.
      seed: Two learners that differ in nothing else learn the same.
    """
    self._options = options
    self._reading = reading
    self._encoder = encoder
    self._controls = controls
    self._num_envs = num_envs
    children = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    self._keys = {
        name: child.generate_state(2)
        for name, child in zip(_STREAMS, children, strict=True)
    }
    self._num_acts = 0
    self._num_updates = 0
    # What was seen and chosen last, until it is known what came of it.
    self._last: dict[str, Any] | None = None
    self._metrics: dict[str, float] = {}

  @property
  def num_envs(self) -> int:
    return self._num_envs

  @property
  def num_steps(self) -> int:
    """How many control steps it has acted in, all worlds together."""
    return self._num_acts * self._num_envs

  @jax_settings.pinned()
  def step(self, time_step: TimeStep) -> np.ndarray:
    """Learns from what its last action came to, and chooses the next one.

    Args:
      time_step: What `reset` or `step` of the environment returned.

    Returns:
      Actions, `(worlds, *action_spec.shape)`.
    """
    observation = self._encoder.pack(time_step.observation, self._num_envs)
    if self._last is not None:
      step_type = np.asarray(time_step.step_type)
      transition = {
          **self._last,
          'reading': np.array(time_step.observation[self._reading], np.float32),
          'discount': np.array(time_step.discount, np.float32),
          # Where an episode began, the action was ignored: what was before it
          # has nothing to do with what comes now.
          'is_valid': step_type != int(dm_env.StepType.FIRST),
      }
      self._observe(transition, observation)
    choice = self._choose(observation, self._act_keys(), greedy=False)
    self._last = {'observation': observation, 'choice': choice}
    self._num_acts += 1
    return self._encode(choice)

  @jax_settings.pinned()
  def act(
      self,
      observation: Mapping[str, np.ndarray],
      key: np.ndarray,
      greedy: bool = False,
  ) -> np.ndarray:
    """Chooses actions as it would now, and neither learns nor remembers.

    Args:
      observation: By name, each `(worlds, ...)`; any number of worlds.
      key: Two numbers of dtype uint32, which the choice depends on.
      greedy: Whether to take the best action instead of drawing one.
    """
    seeds = np.random.SeedSequence([int(word) for word in key]).spawn(2)
    act, query = (child.generate_state(2) for child in seeds)
    keys = {'act': act, 'query': query}
    packed = self._encoder.pack(observation, _num_envs(observation))
    return self._encode(self._choose(packed, keys, greedy=greedy))

  @jax_settings.pinned()
  def probabilities(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the probability of each action, `(worlds, actions)`.

    Raises:
      SpecError: If the actions are vectors.
    """
    self._controls.check_discrete(self._options.kind)
    packed = self._encoder.pack(observation, _num_envs(observation))
    return np.asarray(self._probabilities(packed))

  def settings(self) -> dict[str, Any]:
    """Returns the device and the settings of JAX that can change results.

    Those that `jax_settings` pins are not among them.
    """
    return jax_settings.recorded()

  def metrics(self) -> dict[str, float]:
    """Returns what is known of the last update; nothing true is."""
    return {
        'num_steps': float(self.num_steps),
        'num_updates': float(self._num_updates),
        **self._metrics,
    }

  @jax_settings.pinned()
  def state(self) -> dict[str, Any]:
    """Returns all that the future depends on, as plain data.

    Returns:
      Dicts and lists of arrays, numbers, texts and `None`.
    """
    return {
        'kind': self._options.kind,
        'num_acts': self._num_acts,
        'num_updates': self._num_updates,
        'keys': {name: key.copy() for name, key in self._keys.items()},
        'last': _copy(self._last),
        'metrics': dict(self._metrics),
        'trained': _to_plain(self._trained()),
        'memory': _copy(self._memory()),
    }

  @jax_settings.pinned()
  def set_state(self, state: Mapping[str, Any]) -> None:
    """Goes on from what `state` returned.

    Raises:
      StateLayoutError: If it was another learner's; nothing has changed.
    """
    if state.get('kind') != self._options.kind:
      raise errors.StateLayoutError(
          f'state of a learner: kind {state.get("kind")!r}; this learner is'
          f' {self._options.kind!r}'
      )
    trained = _from_plain(self._trained(), state['trained'])
    self._set_trained(trained)
    self._set_memory(_copy(state['memory']))
    self._num_acts = int(state['num_acts'])
    self._num_updates = int(state['num_updates'])
    self._keys = {n: np.array(key) for n, key in state['keys'].items()}
    self._last = _copy(state['last'])
    self._metrics = dict(state['metrics'])

  def _act_keys(self) -> dict[str, np.ndarray]:
    """Returns the randomness of this step's choice, by stream."""
    return {
        name: _folded(self._keys[name], self._num_acts)
        for name in ('act', 'query')
    }

  def _initial_generator(self) -> np.random.Generator:
    """Returns what draws the weights of networks."""
    key = self._keys['initial'].astype(np.uint64)
    return np.random.Generator(np.random.Philox(key=key))

  def _update_key(self) -> np.ndarray:
    """Returns the randomness of the next update."""
    return _folded(self._keys['update'], self._num_updates)

  def _encode(self, choice: Choice) -> np.ndarray:
    return self._controls.encode(choice['action'], self._asked(choice))

  def _asked(self, choice: Choice) -> dict[str, np.ndarray]:
    """Returns what goes into query registers, by name."""
    del choice
    return {}

  @abc.abstractmethod
  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> Choice:
    """Returns `action`, and what else has to be known to learn from it."""

  @abc.abstractmethod
  def _probabilities(self, observation: features.Packed) -> Any:
    """Returns the probability of each action, `(worlds, actions)`."""

  @abc.abstractmethod
  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    """Takes in what came of a choice.

    Args:
      transition: What was seen (`observation`), what was chosen (`choice`), and
        `reading`, `discount` and `is_valid` of the step after it, each
        `(worlds,)`.
      observation: What is seen now.
    """

  @abc.abstractmethod
  def _trained(self) -> Any:
    """Returns networks and the optimiser's state: a pytree of arrays."""

  @abc.abstractmethod
  def _set_trained(self, trained: Any) -> None:
    """Takes what `_trained` returned."""

  @abc.abstractmethod
  def _memory(self) -> dict[str, Any]:
    """Returns what else is remembered: plain data."""

  @abc.abstractmethod
  def _set_memory(self, memory: dict[str, Any]) -> None:
    """Takes what `_memory` returned."""


LEARNERS: registry.Registry[type[Learner]] = registry.Registry('learner')


def make(
    spec: specs.LearnerSpec | Mapping[str, Any] | None,
    observation_spec: Mapping[str, dm_env_specs.Array],
    action_spec: dm_env_specs.Array,
    num_envs: int,
    seed: int,
) -> Learner:
  """Makes the learner that a design asks for.

  Args:
    spec: A design's `learner`, or a mapping with `kind` and options.
    observation_spec: Of one world.
    action_spec: Of one world.
    num_envs: How many worlds there are.
    seed: Any integer from 0 on.

  Raises:
    SpecError: If the learner is unknown, an option is wrong, or the environment
      lacks what the learner needs.
  """
  if spec is None:
    raise errors.SpecError(
        'learner: None; allowed is a design with a learner, or a mapping with a'
        f' kind from {sorted(LEARNERS)}'
    )
  for name, value, least in (('num_envs', num_envs, 1), ('seed', seed, 0)):
    if type(value) is not int or value < least:
      raise errors.SpecError(
          f'{name}: {value!r:.80}; allowed are integers from {least} on'
      )
  if not isinstance(spec, specs.LearnerSpec):
    spec = validation.validate(specs.LearnerSpec, spec, 'learner')
  learner_class = LEARNERS.get(spec.kind)
  options = validation.validate(
      learner_class.OPTIONS, spec.model_dump(), 'learner'
  )
  return learner_class(
      options,
      _find_reading(options, learner_class.READS, observation_spec),
      features.Encoder.from_spec(observation_spec),
      action_encoding.Controls.from_spec(action_spec),
      num_envs,
      seed,
  )


def _find_reading(
    options: Options,
    field: str,
    observation_spec: Mapping[str, dm_env_specs.Array],
) -> str:
  """Returns the key of the reading that a learner learns from."""
  register = getattr(options, field)
  for key in (f'registers/{register}', register):
    if key in observation_spec:
      if observation_spec[key].shape:
        raise errors.SpecError(
            f'learner.{field}: {key!r} has shape {observation_spec[key].shape};'
            ' allowed are single numbers'
        )
      return key
  raise errors.SpecError(
      f'learner.{field}: {register!r} is not read by the agent; this'
      f' environment has {sorted(observation_spec)}'
  )


def _num_envs(observation: Mapping[str, np.ndarray]) -> int:
  return len(next(iter(observation.values())))


def _folded(key: np.ndarray, number: int) -> np.ndarray:
  """Returns the key of a stream's step."""
  words = [*(int(word) for word in key), number]
  return np.random.SeedSequence(words).generate_state(2)


def _copy(data: Any) -> Any:
  """Copies plain data, arrays included."""
  if isinstance(data, Mapping):
    return {key: _copy(value) for key, value in data.items()}
  if isinstance(data, list | tuple):
    return [_copy(value) for value in data]
  return np.array(data) if isinstance(data, np.ndarray) else data


def _to_plain(tree: Any) -> dict[str, np.ndarray]:
  """Returns the arrays of a pytree by their place in it."""
  leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
  return {jax.tree_util.keystr(path): np.array(leaf) for path, leaf in leaves}


def _from_plain(like: Any, arrays: Mapping[str, Any]) -> Any:
  """Returns a pytree like another one, with these arrays.

  Raises:
    StateLayoutError: If they do not fit.
  """
  leaves, structure = jax.tree_util.tree_flatten_with_path(like)
  expected = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
  if differing := sorted(expected.keys() ^ arrays.keys()):
    raise errors.StateLayoutError(
        f'state of a learner: {differing[0]!r} is on one side only; both sides'
        ' need the same options and specs'
    )
  for name, leaf in expected.items():
    if np.shape(arrays[name]) != leaf.shape:
      raise errors.StateLayoutError(
          f'state of a learner: {name!r} has shape {np.shape(arrays[name])},'
          f' expected {leaf.shape}'
      )
  new = [
      jax.numpy.asarray(arrays[name], leaf.dtype)
      for name, leaf in expected.items()
  ]
  return jax.tree_util.tree_unflatten(structure, new)
