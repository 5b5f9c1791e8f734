"""Base class of learners, their registry, and the factory `make`."""

import abc
from collections.abc import Mapping
import copy
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
from realab_suite.config import integers
from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.feedback import objectives
from realab_suite.feedback import specs

Positive = Annotated[int, pydantic.Field(gt=0)]
Fraction = Annotated[float, pydantic.Field(ge=0, le=1)]
Rate = Annotated[float, pydantic.Field(gt=0, le=1)]
Weight = Annotated[float, pydantic.Field(ge=0, le=1000)]
Choice = dict[str, np.ndarray]
FIRST = int(dm_env.StepType.FIRST)
LAST = int(dm_env.StepType.LAST)

# Each stream has a key of its own, so that the draws of one reveal nothing
# about the others.
_STREAMS = ('initial', 'act', 'query', 'update')


class TimeStep(Protocol):
  """Time steps of a batch, of the engine or of another environment."""

  @property
  def step_type(self) -> np.ndarray:
    """Type of each world's step, `(worlds,)`; see `dm_env.StepType`."""

  @property
  def discount(self) -> np.ndarray:
    """Discount of each world, `(worlds,)`; 0 where an episode terminated."""

  @property
  def observation(self) -> Mapping[str, np.ndarray]:
    """Observations by name, each `(worlds, ...)`."""


class Options(validation.Model):
  """Options of every learner.

  Attributes:
    kind: Name of the learner.
    hidden: Widths of the hidden layers.
    learning_rate: Learning rate of Adam.
    max_gradient_norm: Maximum norm of gradients. Longer gradients are scaled
      down.
    frame_stack: Number of images to see at once: the last ones of the episode,
      stacked on channels. Other entries of an observation are not stacked.
  """

  kind: str
  hidden: Annotated[tuple[Positive, ...], pydantic.Field(strict=False)] = (
      128,
      128,
  )
  learning_rate: Rate = 5e-4
  max_gradient_norm: Weight = 0.5
  frame_stack: Annotated[int, pydantic.Field(ge=1, le=16)] = 1


class Learner(abc.ABC):
  """Learner that acts in a batch of worlds, and updates itself within `step`.

  Learners receive only specs and time steps. They learn from one reading in the
  observation: the time step after an action contains the feedback on it.
  """

  OPTIONS: ClassVar[type[Options]]
  # The option with the name of the register whose reading is learned from.
  READS: ClassVar[str]
  # True if it can learn from the actions of others; see `watch`.
  is_off_policy = False
  # Networks and the state of the optimiser, a pytree of arrays that a subclass
  # makes in `__init__`.
  _networks: Any

  def __init__(
      self,
      options: Any,
      reading: str,
      encoder: features.Encoder,
      controls: action_encoding.Controls,
      num_envs: int,
      seed: int,
  ) -> None:
    """Makes a learner; `make` derives the arguments from specs.

    Args:
      options: An instance of `OPTIONS`.
      reading: Key in the observation of the reading to learn from.
      encoder: Encoder of observations.
      controls: Encoder of actions.
      num_envs: Number of worlds.
      seed: Seed of all random draws.
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
    # The last observation and choice, until the next time step arrives.
    self._last: dict[str, Any] | None = None
    self._metrics: dict[str, float] = {}

  @property
  def num_envs(self) -> int:
    """Number of worlds."""
    return self._num_envs

  @property
  def num_steps(self) -> int:
    """Number of control steps so far, summed over worlds."""
    return self._num_acts * self._num_envs

  @property
  def largest_credit(self) -> float | None:
    """Largest sum of readings of an episode that it credits, or `None`."""
    return None

  @jax_settings.pinned()
  def step(self, time_step: TimeStep) -> np.ndarray:
    """Learns from the outcome of the last action, and chooses the next one.

    Args:
      time_step: Time step that `reset` or `step` of the environment returned.

    Returns:
      Actions, `(worlds, *action_spec.shape)`.

    Raises:
      SpecError: If the observation does not match its spec.
    """
    observation = self._learn_from(time_step)
    choice = self._choose(observation, self._act_keys(), greedy=False)
    choice = self._steered(choice, time_step, observation)
    self._last = {'observation': observation, 'choice': choice}
    self._num_acts += 1
    return self._encode(choice)

  @jax_settings.pinned()
  def watch(self, time_step: TimeStep, actions: np.ndarray) -> None:
    """Learns from the outcome of the last actions, and is shown the next ones.

    Like `step`, except that another has chosen the actions.

    Args:
      time_step: Same as in `step`.
      actions: Actions that followed it, `(worlds, *action_spec.shape)`; any
        where an episode has ended.

    Raises:
      SpecError: If it learns from its own actions alone, or the observation
        does not match its spec.
    """
    if not self.is_off_policy:
      raise errors.SpecError(
          f'learner {self._options.kind!r}: learns from its own actions alone,'
          ' as set here; allowed for recorded episodes are off-policy learners,'
          ' such as behavioural_cloning, and q_learning without a gate'
      )
    observation = self._learn_from(time_step)
    # Queries stand before the index of an action.
    indices = np.reshape(actions, (self._num_envs, -1))[:, -1]
    choice = {'action': indices.astype(np.int32)}
    self._last = {'observation': observation, 'choice': choice}
    self._num_acts += 1

  def _learn_from(self, time_step: TimeStep) -> features.Packed:
    """Learns from the outcome of the last choice; returns the observation."""
    # The last observation has the frames before this one, also in `state`.
    earlier = self._last and self._last['observation']
    stacked = self.stack(time_step, earlier)
    observation = self._encoder.pack(stacked, self._num_envs)
    if self._last is not None:
      step_type = np.asarray(time_step.step_type)
      transition = {
          **self._last,
          'reading': np.array(time_step.observation[self._reading], np.float32),
          'discount': self._discount(time_step).astype(np.float32),
          # The step that begins an episode ignores the action, so it is not an
          # outcome of the last choice.
          'is_valid': step_type != FIRST,
          **self._also_read(time_step),
      }
      self._observe(transition, observation)
    return observation

  def _discount(self, time_step: TimeStep) -> np.ndarray:
    """Returns the weight of what follows a step, `(worlds,)`."""
    return np.asarray(time_step.discount)

  def stack(
      self, time_step: TimeStep, earlier: Mapping[str, np.ndarray] | None
  ) -> Mapping[str, np.ndarray]:
    """Returns the observation for `act`, with images stacked if an option says.

    `act` has no memory, so its caller keeps the images: each result is the
    `earlier` of the next step.

    Args:
      time_step: Time step of any number of worlds.
      earlier: Result for the step before, or `None` for the first one.
    """
    is_first = np.asarray(time_step.step_type) == FIRST
    return self._encoder.stack(time_step.observation, is_first, earlier)

  @jax_settings.pinned()
  def act(
      self,
      observation: Mapping[str, np.ndarray],
      key: np.ndarray,
      greedy: bool = False,
  ) -> np.ndarray:
    """Chooses actions with the current networks, without changing any state.

    Args:
      observation: Observations by name, each `(worlds, ...)`, for any number of
        worlds; a result of `stack` if `frame_stack` is above 1.
      key: Random key, two numbers of dtype uint32.
      greedy: True to take the best action instead of drawing one.

    Returns:
      Actions, `(worlds, *action_spec.shape)`.

    Raises:
      SpecError: If the observation does not match its spec.
    """
    seeds = np.random.SeedSequence([int(word) for word in key]).spawn(2)
    act, query = (child.generate_state(2) for child in seeds)
    keys = {'act': act, 'query': query}
    packed = self._encoder.pack(observation, _num_envs(observation))
    return self._encode(self._choose(packed, keys, greedy=greedy))

  @jax_settings.pinned()
  def probabilities(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the probability of each action, `(worlds, actions)`.

    Args:
      observation: Observations by name, as for `act`.

    Raises:
      SpecError: If the actions are vectors.
    """
    self._controls.check_discrete(self._options.kind)
    packed = self._encoder.pack(observation, _num_envs(observation))
    return np.asarray(self._probabilities(packed))

  def settings(self) -> dict[str, Any]:
    """Returns the device and the JAX settings that can change results.

    Settings that `jax_settings` pins are not included.
    """
    return jax_settings.recorded()

  def metrics(self) -> dict[str, float]:
    """Returns metrics of the last update, from observed feedback only."""
    counts = {
        'num_steps': float(self.num_steps),
        'num_updates': float(self._num_updates),
    }
    # Names that a defence gives to its metrics do not replace these.
    return {**counts, **self._metrics, **counts}

  @jax_settings.pinned()
  def state(self) -> dict[str, Any]:
    """Returns the complete state of the learner as plain data.

    Returns:
      Dicts and lists of arrays, numbers, strings and `None`.
    """
    return {
        'kind': self._options.kind,
        'num_acts': self._num_acts,
        'num_updates': self._num_updates,
        'keys': {name: key.copy() for name, key in self._keys.items()},
        'last': copy.deepcopy(self._last),
        'metrics': dict(self._metrics),
        'trained': to_plain(self._networks),
        'memory': copy.deepcopy(self._memory()),
    }

  @jax_settings.pinned()
  def set_state(self, state: Mapping[str, Any]) -> None:
    """Continues from a state that `state` returned.

    Raises:
      StateLayoutError: If the state belongs to another kind of learner, or its
        arrays do not fit. The learner is then unchanged.
    """
    if state.get('kind') != self._options.kind:
      raise errors.StateLayoutError(
          f'state of a learner: kind {state.get("kind")!r}; this learner is'
          f' {self._options.kind!r}'
      )
    self._networks = from_plain(self._networks, state['trained'])
    self._set_memory(copy.deepcopy(state['memory']))
    self._num_acts = int(state['num_acts'])
    self._num_updates = int(state['num_updates'])
    self._keys = {n: np.array(key) for n, key in state['keys'].items()}
    self._last = copy.deepcopy(state['last'])
    self._metrics = dict(state['metrics'])

  def _act_keys(self) -> dict[str, np.ndarray]:
    """Returns the random keys of this step's choice, by stream."""
    return {
        name: folded(self._keys[name], self._num_acts)
        for name in ('act', 'query')
    }

  def _initial_generator(self) -> np.random.Generator:
    """Returns the random generator of the networks' initial weights."""
    key = self._keys['initial'].astype(np.uint64)
    return np.random.Generator(np.random.Philox(key=key))

  def _update_key(self) -> np.ndarray:
    """Returns the random key of the next update."""
    return folded(self._keys['update'], self._num_updates)

  def _encode(self, choice: Choice) -> np.ndarray:
    return self._controls.encode(choice['action'], self._queries(choice))

  def _steered(
      self, choice: Choice, time_step: TimeStep, observation: features.Packed
  ) -> Choice:
    """Returns the choice to act on, which may not be the learner's own."""
    del time_step, observation
    return choice

  def _also_read(self, time_step: TimeStep) -> dict[str, Any]:
    """Returns further entries of the transition that ends with a time step."""
    del time_step
    return {}

  def _queries(self, choice: Choice) -> dict[str, np.ndarray]:
    """Returns the values of query registers by name, each `(worlds,)`."""
    del choice
    return {}

  @abc.abstractmethod
  def _choose(
      self,
      observation: features.Packed,
      keys: Mapping[str, np.ndarray],
      greedy: bool,
  ) -> Choice:
    """Chooses actions.

    Args:
      observation: Packed observations.
      keys: Random keys of the streams 'act' and 'query'.
      greedy: True to take the best action instead of drawing one.

    Returns:
      The `action`, and further arrays that an update needs; each has a leading
      axis of worlds.
    """

  @abc.abstractmethod
  def _probabilities(self, observation: features.Packed) -> Any:
    """Returns the probability of each action, `(worlds, actions)`."""

  @abc.abstractmethod
  def _observe(
      self, transition: dict[str, Any], observation: features.Packed
  ) -> None:
    """Stores a transition, and updates the networks when one is due.

    Args:
      transition: The `observation`, the `choice` that was made on it, and
        `reading`, `discount` and `is_valid` of the step after it, each
        `(worlds,)`.
      observation: Observation of the step after it.
    """

  def _memory(self) -> dict[str, Any]:
    """Returns the state other than networks, as plain data."""
    return {}

  def _set_memory(self, memory: dict[str, Any]) -> None:
    """Replaces the state that `_memory` returns."""
    del memory  # There is none in this base class.


LEARNERS: registry.Registry[type[Learner]] = objectives.LEARNERS


def make(
    spec: specs.LearnerSpec | Mapping[str, Any] | None,
    observation_spec: Mapping[str, dm_env_specs.Array],
    action_spec: dm_env_specs.Array,
    num_envs: int,
    seed: int,
) -> Learner:
  """Makes the learner of a design.

  Args:
    spec: The `learner` of a design, or a mapping with `kind` and options.
    observation_spec: Observation spec of one world.
    action_spec: Action spec of one world.
    num_envs: Number of worlds.
    seed: Seed of all random draws, a non-negative integer.

  Raises:
    SpecError: If the learner is unknown, an option is invalid, or the specs
      lack a register that the learner needs.
  """
  num_envs = integers.check('num_envs', num_envs, 1)
  seed = integers.check('seed', seed, 0, high=None)
  options = options_of(spec)
  learner_class = LEARNERS.get(options.kind)
  return learner_class(
      options,
      _find_reading(options, learner_class.READS, observation_spec),
      features.Encoder.from_spec(observation_spec, options.frame_stack),
      action_encoding.Controls.from_spec(action_spec),
      num_envs,
      seed,
  )


def options_of(
    spec: specs.LearnerSpec | Mapping[str, Any] | None,
) -> Options:
  """Returns the options of a learner.

  Args:
    spec: As for `make`.

  Raises:
    SpecError: If the learner is unknown, or an option is invalid.
  """
  if spec is None:
    raise errors.SpecError(
        'learner: None; allowed are a design with a learner, and a mapping'
        f' whose kind is one of {sorted(LEARNERS)}'
    )
  if not isinstance(spec, specs.LearnerSpec):
    spec = validation.validate(specs.LearnerSpec, spec, 'learner')
  # The objective is for evaluators.
  given = {k: v for k, v in spec.model_dump().items() if k != 'objective'}
  options = LEARNERS.get(spec.kind).OPTIONS
  return validation.validate(options, given, 'learner')


def _find_reading(
    options: Options,
    field: str,
    observation_spec: Mapping[str, dm_env_specs.Array],
) -> str:
  """Returns the observation key of the reading that a learner learns from."""
  register = getattr(options, field)
  key = features.key_of(register, observation_spec)
  if key is not None:
    if observation_spec[key].shape:
      raise errors.SpecError(
          f'learner.{field}: {key!r} has shape {observation_spec[key].shape};'
          ' allowed are scalars'
      )
    return key
  raise errors.SpecError(
      f'learner.{field}: the agent does not read {register!r}; this environment'
      f' has {sorted(observation_spec)}'
  )


def _num_envs(observation: Mapping[str, np.ndarray]) -> int:
  return len(next(iter(observation.values())))


def folded(key: np.ndarray, number: int) -> np.ndarray:
  """Returns the random key for a numbered step of a stream, `(2,)`."""
  words = [*(int(word) for word in key), number]
  return np.random.SeedSequence(words).generate_state(2)


def to_plain(tree: Any) -> dict[str, np.ndarray]:
  """Returns the arrays of a pytree by their key path."""
  leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
  return {jax.tree_util.keystr(path): np.array(leaf) for path, leaf in leaves}


def from_plain(like: Any, arrays: Mapping[str, Any]) -> Any:
  """Returns a pytree with the structure of `like` and the given arrays.

  Args:
    like: Pytree of arrays.
    arrays: Arrays by their key path in the tree.

  Raises:
    StateLayoutError: If the key paths or shapes differ.
  """
  leaves, structure = jax.tree_util.tree_flatten_with_path(like)
  expected = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
  if differing := sorted(expected.keys() ^ arrays.keys()):
    raise errors.StateLayoutError(
        f'state of a learner: {differing[0]!r} is either missing or unexpected;'
        ' the state was made with other options or specs'
    )
  for name, leaf in expected.items():
    if np.shape(arrays[name]) != np.shape(leaf):
      raise errors.StateLayoutError(
          f'state of a learner: {name!r} has shape {np.shape(arrays[name])},'
          f' expected {np.shape(leaf)}'
      )
  # JAX would round the float64 of a learner that uses NumPy.
  new = [
      jax.numpy.asarray(arrays[name], leaf.dtype)
      if isinstance(leaf, jax.Array)
      else np.array(arrays[name], np.asarray(leaf).dtype)[()]
      for name, leaf in expected.items()
  ]
  return jax.tree_util.tree_unflatten(structure, new)
