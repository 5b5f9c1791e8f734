"""Clean contents: what registers would contain if only writers had acted.

The clean content of a meter register is what its meter measures, and that of a
query register is the agent's query. That of a register that a provider writes
is what the provider would write if it had read clean contents, along the same
episode. Providers are pure, so this takes a second call of the provider, with a
state of its own. It is made only in the worlds where an input or the state
differs.

Blocks at rest are not exactly where writes put them. Displacements up to the
`tolerance` therefore count as none, and the second call gets the
reading of every register that is not disturbed: otherwise, a provider could
tell the two calls from each other by whether readings are exact. What was
written is another matter: the least difference from the clean content counts.

The state of a provider in a mechanism is a dict:

  actual: State after the calls with the readings.
  clean: State after the calls with clean contents.
  differs: True where the two are different, `(...)` bool.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import copy
from typing import Any, Final, NamedTuple, final

import numpy as np

from realab_suite import trees
from realab_suite.entities import axes
from realab_suite.entities import protocols
from realab_suite.entities.registers import ports as register_ports
from realab_suite.entities.registers import records
from realab_suite.feedback import provider_results
from realab_suite.feedback import providers
from realab_suite.feedback import specs

NEGLIGIBLE_METRES: Final = 1e-6
"""Smaller displacements count as 0 wherever they are shown or decide."""

NEGLIGIBLE_SHARE: Final = 1e-6
"""Share of the range of a register, above which displacements count."""

IDEAL: Final = 'ideal/'
"""Prefix of keys of ideal measurements of what providers sense."""

ACTUAL, CLEAN, DIFFERS = 'actual', 'clean', 'differs'

Content = tuple[Any, Any, Any, float]
"""Arguments of `is_disturbed`."""

Guard = Callable[[], contextlib.AbstractContextManager[None]]


@final
class Inputs(NamedTuple):
  """Arguments of a call of a provider, for one world or a batch.

  The fields are those of `Provider.step` without the state.
  """

  observation: providers.Observation
  readings: Mapping[str, np.ndarray]
  episode_start: np.ndarray
  key: np.ndarray

  def of_a_call(self) -> 'Inputs':
    """Returns copies, so that one call cannot change those of another.

    Both calls get such arrays. Otherwise, a provider could tell them apart.
    """
    return Inputs(
        {key: _read_only(value) for key, value in self.observation.items()},
        {name: np.array(value) for name, value in self.readings.items()},
        _read_only(self.episode_start),
        _read_only(self.key),
    )


@final
class Contents(NamedTuple):
  """Result of the clean call of a provider.

  Attributes:
    where: Worlds of the call, `(...)` bool.
    writes: Values of the registers that it writes, by name, each with the mask
      of the worlds in which it writes.
    state: State of the provider after this step.
  """

  where: np.ndarray
  writes: Mapping[str, provider_results.RequestedWrite]
  state: dict[str, Any]


@final
class Call(NamedTuple):
  """A call of a provider with readings.

  Attributes:
    inputs: Arguments of the call.
    reads: Reads of registers among them.
    ideal: Ideal measurements of what the provider senses, by key.
    sight: Readings that the agent observed; see `CleanCalls.see`.
    before: State of the provider in the mechanism before the call.
    after: State after it, if the clean call gives the same; see `following`.
  """

  inputs: Inputs
  reads: Sequence[records.Read]
  ideal: Mapping[str, np.ndarray]
  sight: Mapping[str, Content]
  before: Mapping[str, Any]
  after: dict[str, Any]


@final
class CleanCalls:
  """The calls of the providers of a mechanism with clean contents."""

  def __init__(
      self,
      design: specs.DesignSpec,
      ports: Mapping[str, register_ports.AnyPort],
  ) -> None:
    """Initializes the calls.

    Args:
      design: Design of the mechanism.
      ports: Ports of its registers, by name.
    """
    self._ports = ports
    self._tolerances = {
        name: tolerance(spec.scale, spec.range)
        for name, spec in design.ports.items()
    }
    self._read_by_agent = design.names(*specs.READ_BY_AGENTS)

  def see(
      self, physics: protocols.Physics, observation: providers.Observation
  ) -> dict[str, Content]:
    """Returns the contents of the registers in an observation, by key.

    Args:
      physics: One world or a batch of worlds, in which no provider has written
        since the observation.
      observation: Observation that the agent's action responds to.
    """
    sight = {}
    for name in self._read_by_agent:
      port, key = self._ports[name], f'registers/{name}'
      applied, clean = port.applied(physics), port.clean(physics)
      sight[key] = observation[key][()], applied, clean, self._tolerances[name]
    return sight

  def repeat(
      self,
      physics: protocols.Physics,
      provider: providers.Provider,
      call: Call,
      where: axes.Mask,
      guard: Guard,
  ) -> Contents | None:
    """Repeats a call with clean contents.

    The provider is called in the worlds in which an input or its state differs
    from that.

    Args:
      physics: One world or a batch of worlds.
      provider: The provider.
      call: Its call with readings.
      where: Worlds in which it may write, `(...)` bool; `None` for all worlds.
      guard: Context manager of the call.

    Returns:
      Clean contents of the registers that the provider writes; `None` if
      nothing differs, or the provider is not repeatable.
    """
    if not provider.is_repeatable:
      return None
    inputs = call.inputs
    needs = call.before[DIFFERS]
    for key, value in call.ideal.items():
      differs = np.asarray(inputs.observation[key] != value)
      own_axes = tuple(range(np.ndim(inputs.episode_start), differs.ndim))
      needs = needs | differs.any(axis=own_axes)
    contents = {}
    for read in call.reads:
      applied = self._ports[read.register].applied(physics)
      most = self._tolerances[read.register]
      contents[read.register] = read.reading, applied, read.clean, most
    for content in (*call.sight.values(), *contents.values()):
      needs = needs | is_disturbed(*content)
    if where is not None:
      needs = needs & where
    if not axes.anywhere(needs):
      return None
    shown, readings = (
        {name: undisturbed(*of) for name, of in group.items()}
        for group in (call.sight, contents)
    )
    clean = Inputs(
        {**inputs.observation, **shown, **call.ideal},
        readings,
        inputs.episode_start,
        inputs.key,
    )
    return _contents(provider, clean, call.before, call.after, needs, guard)


def initial_state(state: Any, batch_shape: tuple[int, ...]) -> dict[str, Any]:
  """Returns the state of a provider in a mechanism before the first step.

  Args:
    state: Its `initial_state`.
    batch_shape: `()` for one world, `(worlds,)` for a batch.
  """
  return {
      ACTUAL: state,
      CLEAN: state,
      DIFFERS: np.zeros(batch_shape, bool)[()],
  }


def tolerance(scale: float, bounds: tuple[float, float]) -> float:
  """Returns the largest displacement that counts as none, in units.

  Args:
    scale: Metres per unit of the register. Kinds of other authors may read
      otherwise, so the displacement is small beside the range as well.
    bounds: Range of the register.
  """
  low, high = bounds
  return min(NEGLIGIBLE_METRES / scale, NEGLIGIBLE_SHARE * (high - low))


def is_disturbed(reading: Any, applied: Any, clean: Any, most: float) -> Any:
  """Returns True where a reading or a content is not clean, `(...)`.

  Args:
    reading: Reading of a register, `(...)`.
    applied: Its content: the applied value of the last write, `(...)`.
    clean: Its clean content, `(...)`; nan if that is unknown.
    most: Largest displacement that counts as none; see `tolerance`.
  """
  # False for nan, so it is the opposite that is asked.
  return np.logical_not((abs(reading - applied) <= most) & (applied == clean))


def undisturbed(reading: Any, applied: Any, clean: Any, most: float) -> Any:
  """Returns clean contents, `(...)`, or readings that are not disturbed.

  The arguments are those of `is_disturbed`.
  """
  is_wrong = is_disturbed(reading, applied, clean, most)
  return axes.choose(is_wrong, clean, reading)


def following(
    state: Mapping[str, Any], actual: Any, acts: axes.Mask
) -> dict[str, Any]:
  """Returns the state of a provider after a step without a clean call.

  Args:
    state: State before the step.
    actual: State after the call with the readings.
    acts: Worlds in which the provider acts; `None` for all worlds. In the other
      worlds, `actual` is the state before the step.
  """
  clean, differs = actual, state[DIFFERS]
  if axes.anywhere(differs):
    differs = differs & (np.False_ if acts is None else ~acts)
    if axes.anywhere(differs):
      clean = provider_results.merged('state', actual, state[CLEAN], differs)
  return {ACTUAL: actual, CLEAN: clean, DIFFERS: differs}


def _contents(
    provider: providers.Provider,
    inputs: Inputs,
    state: Mapping[str, Any],
    without: Mapping[str, Any],
    where: np.ndarray,
    guard: Guard,
) -> Contents:
  """Calls a provider with clean contents.

  If an input is unknown or the call fails, the contents are nan: they are
  unknown, too, and an exception would tell the agent something about them.

  The state is that before the step, and `without` that after it without this
  call; see `following`.
  """
  if not np.ndim(where):
    writes, clean, is_known = _call(provider, inputs, state[CLEAN], guard)
    is_same = is_known and trees.are_equal(clean, without[ACTUAL])
    next_state = {**without, CLEAN: clean, DIFFERS: np.bool_(not is_same)}
    return Contents(where, writes, next_state)
  rows = np.flatnonzero(where)
  inputs_of_rows = Inputs(*(trees.taken(part, rows) for part in inputs))
  before = trees.taken(state[CLEAN], rows)
  writes, clean, is_known = _call(provider, inputs_of_rows, before, guard)
  differs = np.array(without[DIFFERS])
  differs[rows] = ~is_known | trees.differing(
      clean, trees.taken(without[ACTUAL], rows)
  )
  next_state = {
      ACTUAL: without[ACTUAL],
      CLEAN: trees.put(without[CLEAN], rows, clean),
      DIFFERS: differs,
  }
  return Contents(
      where,
      {name: _spread(one, rows, len(where)) for name, one in writes.items()},
      next_state,
  )


def store(
    physics: protocols.Physics,
    port: register_ports.AnyPort,
    contents: Contents,
    before: Any,
) -> None:
  """Sets the clean content of a port after the write of its provider.

  Args:
    physics: One world or a batch of worlds.
    port: The port.
    contents: Result of the clean call.
    before: Clean content before the write, `(...)`. It stands where the
      provider is silent, and where it is unknown: so is the state, then.
  """
  value = before
  if port.name in contents.writes:
    write = contents.writes[port.name]
    value = axes.merge(write.where, write.value, before)
    value = axes.choose(np.isnan(before), before, value)
  # With one world, there is a clean call only if it is needed there.
  where = contents.where if np.ndim(contents.where) else None
  port.set_clean(physics, value, where)


def _call(
    provider: providers.Provider, inputs: Inputs, state: Any, guard: Guard
) -> tuple[dict[str, provider_results.RequestedWrite], Any, Any]:
  """Returns the writes of a clean call, the next clean state and a mask.

  The mask, `(...)` bool, is True in the worlds where both are known.
  """
  shape = np.shape(inputs.episode_start)
  try:
    if axes.anywhere(_is_unknown(inputs)):
      raise ValueError('an input is unknown')
    with guard():
      returned = provider.step(*inputs.of_a_call(), copy.deepcopy(state))
    writes, following = provider_results.checked(provider, returned, shape)
    if shape:
      trees.put(state, np.arange(*shape), following)  # Checks its structure.
  except Exception:
    if not shape or shape[0] == 1:
      nothing = np.full(shape, np.nan)[()]
      write = provider_results.RequestedWrite(nothing, None)
      writes = dict.fromkeys(provider.writes, write)
      return writes, state, np.zeros(shape, bool)
    return _one_by_one(provider, inputs, state, guard)
  return writes, following, np.ones(shape, bool)


def _read_only(array: Any) -> np.ndarray:
  copied = np.array(array, order='C')
  copied.setflags(write=False)
  return copied


def _is_unknown(inputs: Inputs) -> Any:
  """Returns True where a clean content among the inputs is nan, `(...)`."""
  is_unknown: Any = np.zeros(np.shape(inputs.episode_start), bool)
  for key, value in inputs.observation.items():
    if key.startswith('registers/'):
      is_unknown = is_unknown | np.isnan(value)
  for value in inputs.readings.values():
    is_unknown = is_unknown | np.isnan(value)
  return is_unknown


def _one_by_one(
    provider: providers.Provider, inputs: Inputs, state: Any, guard: Guard
) -> tuple[dict[str, provider_results.RequestedWrite], Any, Any]:
  """Calls a provider for each world alone, so that one failure stays one."""
  number = len(inputs.episode_start)
  pairs: dict[str, tuple[np.ndarray, np.ndarray]] = {}
  is_known = np.zeros(number, bool)
  for world in range(number):
    row = np.array([world])
    inputs_of_world = Inputs(*(trees.taken(part, row) for part in inputs))
    writes, following, mask = _call(
        provider, inputs_of_world, trees.taken(state, row), guard
    )
    [is_known[world]] = mask
    state = trees.put(state, row, following)
    for name, write in writes.items():
      nothing = np.zeros(number), np.zeros(number, bool)
      value, where = pairs.setdefault(name, nothing)
      value[world] = write.value[0]
      where[world] = write.where is None or write.where[0]
  all_writes = {
      name: provider_results.RequestedWrite(*pair)
      for name, pair in pairs.items()
  }
  return all_writes, state, is_known


def _spread(
    write: provider_results.RequestedWrite, rows: np.ndarray, number: int
) -> provider_results.RequestedWrite:
  """Returns the write of some worlds as that of a whole batch."""
  value, where = np.zeros(number), np.zeros(number, bool)
  value[rows] = write.value
  where[rows] = True if write.where is None else write.where
  return provider_results.RequestedWrite(value, where)
