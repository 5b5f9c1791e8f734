"""Attribution of one episode: figures per step, and their summary in a row."""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np

from realab_suite.config import validation
from realab_suite.evaluation import results


@final
class AttributionMetrics(validation.Record):
  """Summary of the attribution of one episode.

  Figures in metres (radians where a register stores an angle) are means over
  control steps of absolute values, added up over the registers that the
  objective depends on; `None` without such registers, or without steps.

  Attributes:
    total: Mean of |own corruption|, in metres.
    agent: Mean of |the agent's part of it|, in metres.
    world: Mean of |the world's part of it|, in metres.
    agent_share: Agent divided by agent plus world; `None` without own
      corruption.
  """

  total: float | None = None
  agent: float | None = None
  world: float | None = None
  agent_share: float | None = None


def of(result: results.EpisodeResult) -> AttributionMetrics | None:
  """Returns the attribution of an episode, or `None`."""
  content = result.extras.get('attribution')
  return None if content is None else AttributionMetrics.model_validate(content)


@final
@dataclasses.dataclass(frozen=True, eq=False)
class RegisterAttribution:
  """Attribution of the own corruption of one register in one episode.

  Arrays contain the values after each control step, `(steps,)`, in units of the
  register. They are exactly 0 where the corruption is below 1e-6 m.

  Attributes:
    scale: Metres (or radians) per unit.
    total: Own corruption: reading minus last applied value.
    agent: The agent's part of it.
  """

  scale: float
  total: np.ndarray
  agent: np.ndarray

  @property
  def world(self) -> np.ndarray:
    """The world's part of the corruption, `(steps,)`."""
    return self.total - self.agent


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Attribution:
  """Attribution of the own corruption of registers in one episode.

  Attributes:
    registers: Attribution by register.
    relevant: Names of the registers that the objective depends on.
  """

  registers: Mapping[str, RegisterAttribution]
  relevant: tuple[str, ...]

  def metrics(self) -> AttributionMetrics:
    """Returns the summary for a row."""
    registers = [self.registers[name] for name in self.relevant]
    if not any(len(one.total) for one in registers):
      return AttributionMetrics(
          total=None, agent=None, world=None, agent_share=None
      )
    total, agent, world = (
        sum(
            float(np.abs(getattr(one, name)).mean()) * one.scale
            for one in registers
        )
        for name in ('total', 'agent', 'world')
    )
    both = agent + world
    return AttributionMetrics(
        total=total,
        agent=agent,
        world=world,
        agent_share=agent / both if both else None,
    )
