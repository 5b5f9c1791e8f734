"""Recording of episodes: the agent's stream and the evaluator's records.

An episode is replayed through the view that agents get, so the agent's stream
contains nothing else.
"""

from collections.abc import Mapping, Sequence
import contextlib
import dataclasses
from typing import Any, final

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.entities import protocols
from realab_suite.entities import registers
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.feedback import specs
from realab_suite.lab.attribution import attribution
from realab_suite.lab.attribution import attribution_metrics
from realab_suite.lab.experiments import replays


@final
@dataclasses.dataclass(frozen=True, eq=False)
class AgentStream:
  """The part of an episode that the agent may see.

  Attributes:
    observation_spec: Spec of each entry of the observations.
    action_spec: Spec of the actions.
    time_steps: Time steps, as `agent_view.AgentView` returns them.
    actions: Action after each time step except the last one,
      `(steps, *action_spec.shape)`.
    reward: Observation that the learner maximises as its reward, or `None`.
  """

  observation_spec: Mapping[str, dm_env_specs.Array]
  action_spec: dm_env_specs.Array
  time_steps: Sequence[dm_env.TimeStep]
  actions: np.ndarray
  reward: str | None


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
  """A recorded episode.

  Attributes:
    agent: The part that the agent may see. The rest is the evaluator's.
    recorded: Its result, its design and its world.
    ledger: Writes, reads and true rewards.
    states: State of each register at the reset and after each control step, as
      a read would show it, by name.
    terms: Terms of each control step in the objective, by part.
    attribution: Own corruption by mover.
  """

  agent: AgentStream
  recorded: replays.Recorded
  ledger: ledgers.EpisodeLedger
  states: Mapping[str, Sequence[registers.Read]]
  terms: Sequence[dict[str, gains.Value]]
  attribution: attribution_metrics.Attribution


def record(recorded: replays.Recorded) -> Episode:
  """Replays and records an episode.

  Args:
    recorded: The episode.

  Raises:
    ResultsError: If the replay differs from the results, for example because
      the version of the physics does.
  """
  ledger = ledgers.Ledger()
  with contextlib.closing(recorded.load()) as env:
    inspector = _Inspector(env)
    attributor = attribution.WorldAttributor(env)
    time_steps = replays.play(env, recorded, [ledger, inspector, attributor])
    view = agent_view.AgentView(env)
    agent = AgentStream(
        view.observation_spec(),
        view.action_spec(),
        time_steps,
        np.array(recorded.actions),
        _reward(recorded.design),
    )
  return Episode(
      agent,
      recorded,
      ledger.last,
      inspector.states,
      inspector.terms,
      attributor.attribution(),
  )


def kind_of(one: replays.Recorded) -> str:
  """Returns a text that is equal for episodes with equal agent's columns."""
  with contextlib.closing(one.load()) as env:
    view = agent_view.AgentView(env)
    parts = view.observation_spec(), view.action_spec(), _reward(one.design)
  return repr(parts)


def _reward(design: specs.DesignSpec) -> str | None:
  """Returns the observation that the learner uses as its reward, or `None`."""
  extras = (design.learner.model_extra or {}) if design.learner else {}
  name = extras.get('reward')
  return f'registers/{name}' if name in design.names('feedback') else None


@final
class _Inspector(events.EventSink):
  """Collects states of registers and terms of the objective, by step."""

  def __init__(self, env: environment.Environment) -> None:
    self._registers: dict[str, Any] = dict(env.mechanism.ports)
    self._gains = gains.Accumulator(env.mechanism.design)
    self.states: dict[str, list[registers.Read]] = {}
    self.terms: list[dict[str, gains.Value]] = []

  def episode_started(
      self, start: events.Start, physics: protocols.Physics
  ) -> None:
    self.states = {name: [] for name in self._registers}
    self.terms = []
    self._gains.begin(np.asarray(True))
    self._add(physics)

  def step_ended(self, step: events.Step, physics: protocols.Physics) -> None:
    reads = [one for one in step.records if isinstance(one, registers.Read)]
    by_agent = [one for one in reads if one.reader == registers.AGENT]
    self._gains.add(by_agent, step.action)
    self.terms.append(self._gains.terms())
    self._add(physics)

  def episode_ended(self, end: events.End) -> None:
    pass

  def _add(self, physics: protocols.Physics) -> None:
    for name, states in self.states.items():
      read = self._registers[name].inspect(physics, step=len(states))
      plain = registers.of_world(read)
      if isinstance(plain, registers.Read):
        states.append(plain)
