"""The phases of a control step in which a mechanism acts.

The engine calls them and passes the returned records to event sinks. In an
environment of Composer, `composer_hooks` calls them.
"""

from collections.abc import Mapping, Sequence
import contextlib
import copy
from typing import Any, final

import numpy as np

from realab_suite import errors
from realab_suite.entities import axes
from realab_suite.entities import meters
from realab_suite.entities import protocols
from realab_suite.entities import state
from realab_suite.entities.registers import ports as register_ports
from realab_suite.entities.registers import records
from realab_suite.feedback import clean_contents
from realab_suite.feedback import provider_results
from realab_suite.feedback import providers
from realab_suite.feedback import register_writes
from realab_suite.feedback import specs
from realab_suite.policies import random_keys

Guard = clean_contents.Guard


@final
class Phases:
  """The phases of a control step. All state is in the physics.

  Attributes:
    meters: Meters, each with the names of the writers of its ports, and the
      register that it writes.
  """

  def __init__(
      self,
      design: specs.DesignSpec,
      ports: Mapping[str, register_ports.AnyPort],
      counters: state.Slots,
      queries: Sequence[register_writes.Target],
      of_providers: Sequence[Any],
  ) -> None:
    """Initializes the phases of a mechanism without meters.

    Args:
      design: Design that the mechanism runs.
      ports: Ports of its registers, by name.
      counters: Slots `step_count` and `score`.
      queries: Registers that the agent writes.
      of_providers: Each a `FeedbackProvider`, in the order of the design.
    """
    self.meters: list[
        tuple[Sequence[str], meters.Meter, register_writes.Target]
    ] = []
    self._ports = ports
    self._counters = counters
    self._queries = queries
    self._providers = of_providers
    self._read_by_agent = [
        ports[name] for name in design.names(*specs.READ_BY_AGENTS)
    ]
    self._thresholds = {
        name: port.ends_episode
        for name, port in design.ports.items()
        if port.ends_episode is not None
    }
    self._clean_calls = clean_contents.CleanCalls(design, ports)
    self._guard: Guard = contextlib.nullcontext

  def guard_providers(self, guard: Guard) -> None:
    """Sets the context manager in which each call of a provider runs.

    Args:
      guard: Function that returns a new context manager. An exception from the
        context manager counts as an exception from the provider.
    """
    self._guard = guard

  def initial_states(self, batch_shape: tuple[int, ...]) -> list[Any]:
    """Returns the initial states of the providers; see `clean_contents`.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for a batch.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or if a state of
        a batch contains a leaf that is not an array with an axis of worlds.
    """
    states = []
    for provider in self._providers:
      where = f'{provider.title}, before the first step'
      try:
        with self._guard():
          state = provider.spec.initial_state(batch_shape)
      except Exception as error:
        raise errors.FeedbackProviderError(
            f'{where}: {provider.spec.why_it_failed(error)}'
        ) from error
      if batch_shape:
        provider_results.check_state(where, state, batch_shape)
      states.append(clean_contents.initial_state(state, batch_shape))
    return states

  def restart_states(
      self, states: Sequence[Any], worlds: np.ndarray, num_envs: int
  ) -> list[Any]:
    """Returns the states of the providers with some worlds restarted.

    Args:
      states: State of each provider.
      worlds: Indices of the worlds that begin an episode.
      num_envs: Number of worlds in the batch.

    Raises:
      FeedbackProviderError: If a state no longer has the structure of the
        initial one.
    """
    initial_states = self.initial_states((num_envs,))
    return [
        provider_results.merged(
            f'state of {provider.title}', state, initial, worlds
        )
        for provider, state, initial in zip(
            self._providers, states, initial_states, strict=True
        )
    ]

  def initial_writes(self, physics: protocols.Physics) -> list[records.Write]:
    """Returns the records of the writes of `initial` at the last reset."""
    writes = []
    for name, port in self._ports.items():
      applied = port.applied(physics)
      step = np.zeros(np.shape(applied), int)[()]
      obstruction, clean = port.obstruction(physics), port.clean(physics)
      writes.append(
          records.Write(
              name, records.INITIAL, step, applied, applied, obstruction, clean
          )
      )
    return writes

  def write_queries(
      self, physics: protocols.Physics, values: np.ndarray
  ) -> list[records.Write]:
    """Writes the agent's queries K_t to the query registers.

    Args:
      physics: One world or a batch of worlds.
      values: Queries, `(..., queries)`, in the order of the design.

    Returns:
      Records of the writes, in the order of the design.

    Raises:
      RegisterValueError: If a register cannot store a query.
    """
    if not self._queries:
      return []
    step = self._counters.of(physics).step_count.astype(int)[()] + 1
    writes = []
    for target in self._queries:
      if target.register.PORTS:
        requested = values[..., target.columns]
      else:
        requested = values[..., target.columns[0]][()]
      writers = (records.AGENT,) * len(target.ports)
      writes += register_writes.write(physics, target, writers, step, requested)
    return writes

  def update_meters(
      self, physics: protocols.Physics, where: axes.Mask = None
  ) -> list[records.Write]:
    """Measures with every meter, then writes the meter registers.

    A write moves blocks, which other meters may measure. All meters therefore
    measure first.

    Args:
      physics: One world or a batch of worlds.
      where: Worlds whose registers are written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Records of the writes, in the design's order.

    Raises:
      RegisterValueError: If a register cannot store a measurement. The message
        does not contain the measurement, because it may reach an agent.
    """
    if not self.meters:
      return []
    step = self._counters.of(physics).step_count.astype(int)[()] + 1
    values = [
        (meter.measure(physics), meter.ideal(physics))
        for _, meter, _ in self.meters
    ]
    writes = []
    for row, (measured, ideal) in zip(self.meters, values, strict=True):
      writers, _, target = row
      try:
        of_meter = register_writes.write(
            physics, target, writers, step, measured, where
        )
      except errors.RegisterValueError as error:
        writer = register_writes.failure(
            ' and '.join(writers), step, error.world
        )
        raise errors.RegisterValueError(
            f'{writer}: register {target.register.name!r} cannot store the'
            ' measured value',
            error.world,
        ) from error
      if ideal is not None:
        target.register.set_clean(physics, ideal, where)
        of_meter = register_writes.with_clean(physics, self._ports, of_meter)
      writes += of_meter
    return writes

  def update_providers(
      self,
      physics: protocols.Physics,
      observation: providers.Observation,
      keys: np.ndarray,
      states: Sequence[Any],
      where: axes.Mask = None,
  ) -> tuple[list[records.Record], list[Any]]:
    """Runs the providers in the design's order; each reads, then writes.

    A provider with `every` is called only if it acts in some world, and keeps
    its state in the other worlds. Where what it reads is disturbed, it is
    called once more, with clean contents; see `clean_contents`.

    Args:
      physics: One world or a batch of worlds.
      observation: Observation that the agent's action responds to.
      keys: Random key of each provider in this episode, `(providers, ..., 2)`
        uint64.
      states: State of each provider.
      where: Worlds whose registers may be written, `(...)` bool; `None` for all
        worlds.

    Returns:
      Records of the reads and writes, in order, and the next states.

    Raises:
      FeedbackProviderError: If a provider or its guard raises, or if a provider
        returns other writes than it declares, or values of a wrong shape.
      RegisterValueError: If a register cannot store a value.
    """
    if not self._providers:
      return [], []
    before = self._counters.of(physics).step_count.astype(int)[()]
    step = before + 1
    is_start = np.asarray(step == 1)
    keys_of_step = random_keys.of_step(keys, before)
    sight = self._clean_calls.see(physics, observation)
    log: list[records.Record] = []
    next_states = []
    for i, provider in enumerate(self._providers):
      acts = provider.spec.acts_in(step)
      if acts is not None and not axes.anywhere(acts):
        next_states.append(states[i])
        continue
      reads = [
          port.inspect(physics, provider.title, step) for port in provider.reads
      ]
      if acts is not None:
        reads = [read._replace(where=acts) for read in reads]
      view, ideal = provider.see(observation)
      inputs = clean_contents.Inputs(
          {**view, **ideal} if provider.is_secure else view,
          {read.register: read.reading for read in reads},
          is_start,
          keys_of_step[i],
      )
      values, state = self._call(provider, step, inputs, states[i], acts)
      may_write = where if acts is None else axes.both(where, acts)
      call = clean_contents.Call(inputs, reads, ideal, sight, states[i], state)
      clean = self._clean_calls.repeat(
          physics, provider.spec, call, may_write, self._guard
      )
      log += reads
      log += self._write_all(physics, provider, step, values, may_write, clean)
      next_states.append(state if clean is None else clean.state)
    return log, next_states

  def _call(
      self,
      provider: Any,
      step: Any,
      inputs: clean_contents.Inputs,
      state: Mapping[str, Any],
      acts: axes.Mask,
  ) -> tuple[dict[str, provider_results.RequestedWrite], dict[str, Any]]:
    """Calls a provider with readings.

    Returns:
      Its writes, and its next state if its clean call gives the same.
    """
    before = state[clean_contents.ACTUAL]
    try:
      with self._guard():
        # A change of the state in place must not reach the clean call.
        returned = provider.spec.step(
            *inputs.of_a_call(), copy.deepcopy(before)
        )
    except Exception as error:
      raise errors.FeedbackProviderError(
          f'{register_writes.failure(provider.title, step)}:'
          f' {provider.spec.why_it_failed(error)}'
      ) from error
    try:
      values, following = provider_results.checked(
          provider.spec, returned, step.shape
      )
      if acts is not None:
        following = provider_results.merged('state', following, before, ~acts)
    except errors.FeedbackProviderError as error:
      raise errors.FeedbackProviderError(
          f'{register_writes.failure(provider.title, step)} {error}'
      ) from error
    return values, clean_contents.following(state, following, acts)

  def _write_all(
      self,
      physics: protocols.Physics,
      provider: Any,
      step: Any,
      values: Mapping[str, provider_results.RequestedWrite],
      where: axes.Mask,
      clean: clean_contents.Contents | None,
  ) -> list[records.Write]:
    """Writes the registers of a provider and sets their clean contents."""
    writer = provider.title
    writes = []
    for target in provider.targets:
      if target.register.PORTS:
        request = provider_results.joint(
            register_writes.failure(writer, step), target.names, values
        )
      else:
        request = values.get(target.names[0])
      before = clean and [port.clean(physics) for port in target.ports]
      of_target: list[records.Write] = []
      if request is not None:
        mask = where
        if request.where is not None:
          mask = axes.both(request.where, where)
        if mask is None or axes.anywhere(mask):
          writers = (writer,) * len(target.ports)
          try:
            of_target = register_writes.write(
                physics, target, writers, step, request.value, mask
            )
          except errors.RegisterValueError as error:
            place = register_writes.failure(writer, step, error.world)
            raise errors.RegisterValueError(
                f'{place}: {error}', error.world
            ) from error
      if clean is not None and before is not None:
        for port, content in zip(target.ports, before, strict=True):
          clean_contents.store(physics, port, clean, content)
        of_target = register_writes.with_clean(physics, self._ports, of_target)
      writes += of_target
    return writes

  def end_step(self, physics: protocols.Physics, reward: Any) -> Any:
    """Increments the number of control steps and adds a reward to the score.

    Args:
      physics: One world or a batch of worlds.
      reward: True reward of the control step, `(...)`; only finite numbers
        count.

    Returns:
      Number of completed control steps of the episode, `(...)`.
    """
    counters = self._counters.of(physics)
    num_steps = counters.step_count[()] + 1
    counters.step_count[...] = num_steps
    paid = axes.choose(axes.is_finite(reward), reward, 0.0)
    counters.score[...] = counters.score[()] + paid
    return num_steps

  def read_for_agent(self, physics: protocols.Physics) -> list[records.Read]:
    """Reads the registers that the agent may read.

    Args:
      physics: One world or a batch of worlds.

    Returns:
      Records of the reads, in the order of the mechanism's `read_by_agent`.
    """
    step = self._counters.of(physics).step_count.astype(int)[()]
    return [
        port.inspect(physics, records.AGENT, step)
        for port in self._read_by_agent
    ]

  def ends_episode(self, reads: Sequence[records.Read]) -> Any:
    """Returns True for worlds whose episode a signal ends, `(...)` bool.

    Args:
      reads: Reads for the agent, as from `read_for_agent`.
    """
    is_ending: Any = np.False_
    for read in reads:
      if read.register in self._thresholds:
        threshold = self._thresholds[read.register]
        is_ending = is_ending | threshold.is_crossed(read.reading)
    return is_ending
