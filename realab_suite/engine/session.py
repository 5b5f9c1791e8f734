"""The session of one world: everything about its episodes beside the physics.

The engine's environment and the wrapper for plain environments of Composer have
one each. They decide when episodes begin and steps end; the session keeps the
random streams, the states of the providers, the last observation and the event
sinks, and it never steps the physics.
"""

from collections.abc import Callable, Iterator
import contextlib
from typing import Any, final

from dm_control.rl import control
import numpy as np

from realab_suite.engine import control_step
from realab_suite.engine import episodes
from realab_suite.engine import events
from realab_suite.engine import hosts
from realab_suite.engine import observing
from realab_suite.entities import registers
from realab_suite.feedback import mechanisms


@final
class Session:
  """The episodes of one world.

  Attributes:
    seed: Seed of every random stream, together with `world` and `episode`.
    world: Number of the world in a batch; 0 for a single world.
    episode: Number of the current episode; -1 before the first.
    is_open: True if the sinks have been notified of the start of an episode and
      not of its end.
    keys: Random key of each provider in this episode, `(providers, 2)` uint64.
    states: State of each provider.
    observation: Last observation, by key; its arrays are read-only.
    sinks: Event sinks.
  """

  def __init__(
      self,
      mechanism: mechanisms.FeedbackMechanism,
      host: hosts.Host,
      observer: observing.Observer,
      max_steps: int | None,
      seed: int,
      world: int,
  ) -> None:
    """Initializes the session, before the first episode.

    Args:
      mechanism: Registers, meters and providers.
      host: Host of the task.
      observer: Makes the observations.
      max_steps: Maximum length of an episode in control steps, or `None`.
      seed: See `Session`.
      world: See `Session`.
    """
    self._mechanism = mechanism
    self._host = host
    self._observer = observer
    self._max_steps = max_steps
    self.seed, self.world, self.episode = seed, world, -1
    self.is_open = False
    self.keys = self._new_keys(0)
    self.states: list[Any] = []
    self.observation: dict[str, np.ndarray] = {}
    self.sinks: list[events.EventSink] = []

  def add_sink(self, sink: events.EventSink) -> None:
    """Abandons the current episode and notifies a sink of all later ones."""
    self.end(events.End.ABANDONED)
    self.sinks.append(sink)

  def remove_sink(self, sink: events.EventSink) -> None:
    """Undoes `add_sink`."""
    self.sinks.remove(sink)

  def restart_providers(self) -> None:
    """Sets keys and states of the providers to those of the episode's start."""
    self.keys = self._new_keys(self.episode)
    self.states = self._mechanism.initial_states(())

  def start(self, physics: Any) -> None:
    """Makes the first observation of an episode and notifies the sinks."""
    records: list[Any] = [*self._mechanism.initial_writes(physics)]
    records += self.observe(physics)
    start = events.Start(self.seed, self.world, self.episode, records)
    self._notify(physics, lambda sink: sink.episode_started(start, physics))
    # The episode is open only after every sink was notified without an error.
    self.is_open = True

  def observe(self, physics: Any) -> list[registers.Read]:
    """Updates the observation and returns the reads of registers for it."""
    observation, reads = self._observer.observe(physics)
    self.observation = observing.frozen(observation)
    return reads

  def inputs(self, physics: Any) -> dict[str, np.ndarray]:
    """Returns the observation with what providers alone sense, by key."""
    return {**self.observation, **self._observer.added(physics)}

  def finish_step(
      self,
      physics: Any,
      outcome: control_step.Outcome,
      reads: list[registers.Read],
      action: Any,
  ) -> events.End | None:
    """Ends a control step, after its observation, and notifies the sinks.

    Args:
      physics: Physics of the world.
      outcome: Result of the control step.
      reads: Reads of registers for the observation.
      action: Action of the agent.

    Returns:
      Reason why the episode ends with this step, or `None`.
    """
    self.states = outcome.provider_states
    ending = outcome.ending
    if self.sinks:
      step = events.Step(
          [*outcome.records, *reads],
          np.array(action),
          np.array(ending.true_reward),
          ending.failure,
      )
      self._notify(physics, lambda sink: sink.step_ended(step, physics))
    end = episodes.end_of_step(
        False,
        ending.is_ending,
        self._mechanism.ends_episode(reads),
        self._mechanism.step_count(physics) == self._max_steps,
    )
    if end is not None:
      self.end(end)
    return end

  @contextlib.contextmanager
  def ending_on_failure(self) -> Iterator[None]:
    """Returns a context in which an exception ends the episode."""
    try:
      yield
    except control.PhysicsError:
      self.end(events.End.DIVERGENCE)
      raise
    except Exception:
      self.end(events.End.ERROR)
      raise

  def end(self, end: events.End) -> None:
    """Notifies the sinks of the end of the episode, if there is one."""
    if self.is_open:
      self.is_open = False
      for sink in self.sinks:
        sink.episode_ended(end)

  def _new_keys(self, episode: int) -> np.ndarray:
    return episodes.provider_keys(
        self.seed,
        self.world,
        episode,
        len(self._mechanism.design.providers),
    )

  def _notify(
      self, physics: Any, notify: Callable[[events.EventSink], None]
  ) -> None:
    """Notifies the sinks, which may read the physics."""
    if self.sinks:
      with self._host.unchanged(physics):
        for sink in self.sinks:
          notify(sink)
