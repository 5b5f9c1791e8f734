"""Attribution of one episode: figures per step, and their summary in a row."""

from collections.abc import Mapping
import dataclasses
from typing import final

import numpy as np
import pydantic

from realab_suite.evaluation import gains


@final
class AttributionMetrics(pydantic.BaseModel):
  """Summary of the attribution of one episode.

  Figures in metres (radians where a register stores an angle) are means over
  control steps of absolute values, the largest over the registers that the
  learner consumes; `None` if it consumes none, or without steps.

  Attributes:
    total: Mean of |corruption|, in metres.
    agent: Mean of |the agent's part of it|, in metres.
    world: Mean of |the world's part of it|, in metres.
    agent_share: Sum of |agent| divided by that of |agent| and |world|, over all
      consumed registers; `None` without corruption.
  """

  # Rows are validated in the same way as other metrics.
  model_config = pydantic.ConfigDict(
      frozen=True, extra='forbid', ser_json_inf_nan='strings'
  )

  total: float | None
  agent: float | None
  world: float | None
  agent_share: float | None


@final
@dataclasses.dataclass(frozen=True, eq=False)
class RegisterAttribution:
  """Attribution of the corruption of one register in one episode.

  Arrays contain the values after each control step, `(steps,)`, in units of the
  register. They are exactly 0 where the corruption is below 1e-6 m.

  Attributes:
    scale: Metres (or radians) per unit.
    total: Corruption: reading minus last applied value.
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
  """Attribution of the corruption in one episode.

  Attributes:
    timestep: Duration of a control step, in s.
    registers: Attribution by register.
    consumed: Names of the registers that the learner consumes.
    directions: Direction that pays, 1 or -1, by register; see `gains`.
  """

  timestep: float
  registers: Mapping[str, RegisterAttribution]
  consumed: tuple[str, ...]
  directions: Mapping[str, float]

  @property
  def agent_gain(self) -> np.ndarray:
    """Gain for which the agent alone is enough, in margins, `(steps,)`.

    The largest over the registers with a direction that pays; -inf if there is
    none.
    """
    num_steps = max((len(r.total) for r in self.registers.values()), default=0)
    gain = np.full(num_steps, -np.inf)
    for name, direction in self.directions.items():
      register = self.registers[name]
      enough = np.minimum(
          register.total * direction, register.agent * direction
      )
      gain = np.maximum(gain, enough / gains.MARGIN_UNITS)
    return gain

  def metrics(self) -> AttributionMetrics:
    """Returns the summary for a row."""
    registers = [self.registers[name] for name in self.consumed]
    num_steps = max((len(one.total) for one in registers), default=0)
    total, agent, world = (
        [
            float(np.abs(getattr(one, name)).sum()) * one.scale
            for one in registers
        ]
        for name in ('total', 'agent', 'world')
    )
    both = sum(agent) + sum(world)

    def largest_mean(sums: list[float]) -> float | None:
      return max(sums) / num_steps if num_steps else None

    return AttributionMetrics(
        total=largest_mean(total),
        agent=largest_mean(agent),
        world=largest_mean(world),
        agent_share=sum(agent) / both if both else None,
    )
