"""Arguments of registers, as designs and other programs give them."""

import typing
from typing import Annotated, Literal

import pydantic

from realab_suite.config import validation
from realab_suite.entities import block_kinds

Role = Literal['feedback', 'meter', 'query', 'signal', 'memory']
# embedded: the poses of the blocks store the value; blocks can be pushed.
# secure: a slot of the state stores the value; the blocks are scenery.
Channel = Literal['embedded', 'secure']
Dof = Literal['free', 'planar']

CHANNELS: tuple[Channel, ...] = typing.get_args(Channel)
DOFS: tuple[Dof, ...] = typing.get_args(Dof)

Name = Annotated[str, pydantic.StringConstraints(pattern=validation.NAME)]
# A text is a name, even one that no name looks like.
TextOrOther = pydantic.Discriminator(
    lambda value: 'name' if isinstance(value, str) else 'other'
)
# Larger numbers make the arithmetic of a step overflow.
Value = Annotated[float, pydantic.Field(ge=-1e9, le=1e9)]
Initial = Annotated[
    Annotated[Name, pydantic.Tag('name')]
    | Annotated[Value, pydantic.Tag('other')],
    TextOrOther,
]
Size = Annotated[float, pydantic.Field(ge=block_kinds.LEAST_SIZE, le=1.0)]


class Arguments(validation.Spec):
  """Arguments of every register.

  Attributes:
    range: Lowest and highest value that can be stored, in each port. Values
      out of it are saturated.
    scale: Length in m (angle in rad for an orientation) per unit of value.
    initial: Value at the start of an episode, in each port; or the name of a
      function that the task offers to meters, which returns it. A `feedback`
      or `signal` register that no provider writes keeps it, and has to state
      it.
    role: Role of the register. Agents read `feedback` and `signal` registers
      and write `query` registers. Only providers read `meter` registers. Only
      providers read and write `memory` registers.
    channel: Channel of the register; `None` for `embedded`.
    dof: Degrees of freedom of blocks that can be pushed; `None` for `free`.
    block_size: Edge length of each block, in m.
    mass: Mass of each block, in kg.
  """

  range: Annotated[tuple[Value, Value], pydantic.Field(strict=False)]
  # With a smaller scale, readings are mostly numerical noise of positions.
  scale: Annotated[float, pydantic.Field(ge=1e-6, le=10)] = 0.1
  initial: Initial = 0.0
  role: Role = 'feedback'
  channel: Channel | None = None
  dof: Dof | None = None
  block_size: Size = 0.2
  mass: Annotated[float, pydantic.Field(ge=0.01, le=100)] = 1.0

  @property
  def constant_initial(self) -> float:
    """Value of `initial`, or a value in the range in place of a function."""
    if isinstance(self.initial, str):
      return min(max(0.0, self.range[0]), self.range[1])
    return self.initial

  @pydantic.model_validator(mode='after')
  def _in_order(self) -> 'Arguments':
    low, high = self.range
    if not low < high:
      raise ValueError(f'range {list(self.range)} must have low < high')
    if not low <= self.constant_initial <= high:
      raise ValueError(
          f'initial {self.initial} must be in range {list(self.range)}'
      )
    return self
