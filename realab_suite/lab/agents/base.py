"""Base classes of learners, and of the wrappers around them."""

import abc
from collections.abc import Mapping
import copy
import dataclasses
from typing import Annotated, Any, ClassVar, Protocol, final

import dm_env
import jax
import numpy as np
import pydantic

from realab_suite import errors
from realab_suite.config import registry
from realab_suite.config import validation
from realab_suite.feedback import objectives
from realab_suite.lab.agents import action_encoding
from realab_suite.lab.agents import features
from realab_suite.lab.agents import jax_settings

Positive = Annotated[int, pydantic.Field(gt=0)]
Fraction = Annotated[float, pydantic.Field(ge=0, le=1)]
Rate = Annotated[float, pydantic.Field(gt=0, le=1)]
Weight = Annotated[float, pydantic.Field(ge=0, le=1000)]
Choice = dict[str, np.ndarray]
FIRST = int(dm_env.StepType.FIRST)
LAST = int(dm_env.StepType.LAST)

LEARNERS: registry.Registry[type['Learner']] = objectives.LEARNERS

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
    recollection: True to see what `recollections` remembers of the reading that
      is learned from: where it last paid, and how much it has paid.
  """

  kind: str
  hidden: Annotated[tuple[Positive, ...], pydantic.Field(strict=False)] = (
      128,
      128,
  )
  learning_rate: Rate = 5e-4
  max_gradient_norm: Weight = 0.5
  frame_stack: Annotated[int, pydantic.Field(ge=1, le=16)] = 1
  recollection: bool = False


@final
@dataclasses.dataclass(frozen=True)
class Setting:
  """The part of a learner that its wrappers and defences know.

  Attributes:
    options: Options of the learner.
    encoder: Encoder of observations.
    controls: Encoder of actions.
    num_envs: Number of worlds.
  """

  options: Any
  encoder: features.Encoder
  controls: action_encoding.Controls
  num_envs: int


class Wrapper(abc.ABC):
  """Changes what a learner sees, learns from or does; by default nothing.

  The learner calls the methods in every step, in the order in which they stand
  here, and keeps the states of its wrappers in its own.
  """

  # Name of its state in that of the learner.
  NAME: ClassVar[str]

  def see(
      self,
      observation: dict[str, Any],
      is_first: np.ndarray,
      earlier: Mapping[str, np.ndarray] | None,
  ) -> dict[str, Any]:
    """Returns the observation that the learner gets, each `(worlds, ...)`.

    `is_first` is True where an episode begins, `(worlds,)`, and `earlier` what
    the learner got in the step before, or `None`.
    """
    del is_first, earlier
    return observation

  def read(self, time_step: TimeStep) -> dict[str, Any]:
    """Returns further entries of the transition that ends with a time step."""
    del time_step
    return {}

  def treat(self, batch: dict[str, Any]) -> dict[str, Any]:
    """Returns the transitions to learn from; each array is `(..., worlds)`."""
    return batch

  def holds(self, observation: features.Packed) -> bool:
    """Returns True if no update may follow the transition to an observation."""
    del observation
    return False

  def follow(self) -> None:  # noqa: B027 - Most have nothing to do.
    """Responds to an update of the networks."""

  def steer(
      self,
      choice: Choice,
      time_step: TimeStep,
      observation: features.Packed,
      key: np.ndarray,
  ) -> Choice:
    """Returns the choice to act on, and leaves the given one as it is."""
    del time_step, observation, key
    return choice

  def queries(self, choice: Choice) -> dict[str, np.ndarray]:
    """Returns the values of query registers by name, each `(worlds,)`."""
    del choice
    return {}

  @property
  def metrics(self) -> Mapping[str, float]:
    """Metrics of the latest update, by name."""
    return {}

  def state(self) -> dict[str, Any]:
    """Returns the complete state, as plain data."""
    return {}

  def set_state(self, state: Mapping[str, Any]) -> None:
    """Continues from a state, or raises a `StateLayoutError` and does not."""
    del state  # There is none by default.


class Learner(abc.ABC):
  """Learner that acts in a batch of worlds, and updates itself within `step`.

  Learners receive only specs and time steps. They learn from one reading in the
  observation: the time step after an action contains the feedback on it.
  """

  OPTIONS: ClassVar[type[Options]]
  # The option with the name of the register whose reading is learned from.
  READS: ClassVar[str]
  # Options that ask for wrappers, from the innermost on.
  WRAPPED: ClassVar[tuple[str, ...]] = ('frame_stack', 'recollection')
  # True if it chooses among the actions of a set.
  NEEDS_ACTION_SET: ClassVar[bool] = False
  # True if it can learn from the actions of others; see `watch`. A wrapper that
  # acts sets it to False.
  is_off_policy = False
  # Largest sum of readings of an episode that it credits, which a wrapper sets.
  largest_credit: float | None = None
  # Networks and the state of the optimiser, a pytree of arrays that a subclass
  # makes in `__init__`.
  networks: Any

  def __init__(
      self,
      options: Any,
      reading: str,
      encoder: features.Encoder,
      controls: action_encoding.Controls,
      num_envs: int,
      seed: int,
  ) -> None:
    """Makes a learner; `factory.make` derives the arguments from specs.

    They are those of `Setting`, with `reading`, the key in the observation of
    the reading to learn from, and `seed`, that of all random draws.
    """
    if self.NEEDS_ACTION_SET:
      controls.check_discrete(options.kind)
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
    self._wrappers: list[Wrapper] = []

  def wrap(self, wrapper: Wrapper) -> None:
    """Adds a wrapper, around those that there are."""
    self._wrappers.append(wrapper)

  @property
  def setting(self) -> Setting:
    """The part of the learner that wrappers know."""
    return Setting(self._options, self._encoder, self._controls, self._num_envs)

  @property
  def reading(self) -> str:
    """Key in the observation of the reading that it learns from."""
    return self._reading

  @property
  def num_steps(self) -> int:
    """Number of control steps so far, summed over worlds."""
    return self._num_acts * self._num_envs

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
    keys = {name: self.key(name, self._num_acts) for name in ('act', 'query')}
    choice = self._choose(observation, keys, greedy=False)
    for wrapper in self._wrappers:
      choice = wrapper.steer(choice, time_step, observation, keys['query'])
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
          ' as set here; a learner from recorded episodes must be off-policy,'
          ' such as behavioural_cloning, or q_learning without a gate'
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
      }
      for wrapper in self._wrappers:
        transition |= wrapper.read(time_step)
      self._observe(transition, observation)
    return observation

  def _discount(self, time_step: TimeStep) -> np.ndarray:
    """Returns the weight of what follows a step, `(worlds,)`."""
    return np.asarray(time_step.discount)

  def stack(
      self, time_step: TimeStep, earlier: Mapping[str, np.ndarray] | None
  ) -> Mapping[str, np.ndarray]:
    """Returns the observation for `act`, with what wrappers add to it.

    `act` remembers nothing, so its caller keeps earlier images: each result is
    the `earlier` of the next step.

    Args:
      time_step: Time step of any number of worlds.
      earlier: Result for the step before, or `None` for the first one.
    """
    observation = dict(time_step.observation)
    is_first = np.asarray(time_step.step_type) == FIRST
    for wrapper in self._wrappers:
      observation = wrapper.see(observation, is_first, earlier)
    return observation

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
        worlds; a result of `stack` if the learner sees what was earlier.
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
    num_envs = len(next(iter(observation.values())))
    packed = self._encoder.pack(observation, num_envs)
    return self._encode(self._choose(packed, keys, greedy))

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
        'trained': to_plain(self.networks),
        'memory': copy.deepcopy(self._memory()),
        'wrappers': copy.deepcopy(
            {wrapper.NAME: wrapper.state() for wrapper in self._wrappers}
        ),
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
    networks = from_plain(self.networks, state['trained'])
    names = sorted(wrapper.NAME for wrapper in self._wrappers)
    wrappers = state['wrappers']
    if sorted(wrappers) != names:
      raise errors.StateLayoutError(
          f'state of a learner: wrappers {sorted(wrappers)}; must be {names}'
      )
    for wrapper in self._wrappers:
      wrapper.set_state(copy.deepcopy(wrappers[wrapper.NAME]))
    self.networks = networks
    self._set_memory(copy.deepcopy(state['memory']))
    self._num_acts = int(state['num_acts'])
    self._num_updates = int(state['num_updates'])
    self._keys = {n: np.array(key) for n, key in state['keys'].items()}
    self._last = copy.deepcopy(state['last'])
    self._metrics = dict(state['metrics'])

  def key(self, stream: str, number: int) -> np.ndarray:
    """Returns the random key of a numbered draw of a stream, two numbers."""
    return folded(self._keys[stream], number)

  def update_key(self) -> np.ndarray:
    """Returns the random key of the next update, two numbers."""
    return self.key('update', self._num_updates)

  def _encode(self, choice: Choice) -> np.ndarray:
    queries = dict(self._queries(choice))
    for wrapper in self._wrappers:
      queries |= wrapper.queries(choice)
    return self._controls.encode(choice['action'], queries)

  def _treated(self, batch: dict[str, Any]) -> dict[str, Any]:
    """Returns transitions as the wrappers change them."""
    for wrapper in self._wrappers:
      batch = wrapper.treat(batch)
    return batch

  def _report(self, metrics: Mapping[str, Any]) -> None:
    """Sets the metrics of an update, to which those of wrappers are added."""
    self._metrics = {
        name: float(value)
        for part in (*(wrapper.metrics for wrapper in self._wrappers), metrics)
        for name, value in part.items()
    }

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


def folded(key: np.ndarray, number: int) -> np.ndarray:
  """Returns the random key for a numbered step of a stream, `(2,)`."""
  words = [*(int(word) for word in key), number]
  return np.random.SeedSequence(words).generate_state(2)


def generator_of(key: np.ndarray) -> np.random.Generator:
  """Returns the random generator of NumPy for a key of two numbers."""
  return np.random.Generator(np.random.Philox(key=key.astype(np.uint64)))


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
