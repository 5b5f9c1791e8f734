"""What a feedback provider is: a pure function from what it sees to writes."""

import abc
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import pydantic

from realab_suite.config import registry

Observation = Mapping[str, np.ndarray]
Readings = Mapping[str, np.ndarray]
# A file has lists; strict validation would take only tuples.
Names = Annotated[tuple[str, ...], pydantic.Field(strict=False)]
OneName = Annotated[
    tuple[str, ...], pydantic.Field(strict=False, min_length=1, max_length=1)
]


class Provider(pydantic.BaseModel, abc.ABC):
  """A feedback provider: its choices as fields, its behaviour as methods.

  A provider has the same interface as an agent: observations in, actions out.
  Its actions are writes to registers (paper, section 3.1). It is pure, so one
  provider serves many worlds at once: leading axes of every array are worlds.
  It gets neither the physics nor the true reward.

  Attributes:
    kind: The name under which the class is registered.
    reads: The registers whose readings it gets.
    writes: The registers that it writes.
  """

  model_config = pydantic.ConfigDict(frozen=True, extra='forbid', strict=True)

  kind: str
  reads: Names = ()
  writes: Names

  @property
  def action_queries(self) -> tuple[str, ...]:
    """Names in `reads` whose readings are rounded to the index of an action.

    A subclass that reads an index off a query register overrides it.
    """
    return ()

  @property
  def action_writes(self) -> tuple[str, ...]:
    """Names in `writes` that are given the index of an action.

    A subclass that writes such an index overrides it.
    """
    return ()

  def initial_state(self, batch_shape: tuple[int, ...]) -> Any:
    """Returns the state before the first step: arrays, tuples or dicts of them.

    Args:
      batch_shape: `()` for one world, `(worlds,)` for many.
    """
    del batch_shape
    return ()

  @abc.abstractmethod
  def step(
      self,
      observation: Observation,
      readings: Readings,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    """Gives feedback for one control step.

    Args:
      observation: What the agent saw when it chose its action; keys
        `senses/<name>` and `registers/<name>`.
      readings: What each register in `reads` holds now, shape `(...)`.
      episode_start: Whether this is an episode's first step, `(...)`, bool.
        Worlds start their episodes at different times.
      key: A random key per world, `(..., 2)`, uint64; see `random_keys`.
      state: What `initial_state` or the last `step` returned.

    Returns:
      The value to write to each register in `writes`, shape `(...)`, and the
      next state.
    """

  def check(self, design: Any) -> None:
    """Checks what only the whole design can tell.

    Args:
      design: The `specs.DesignSpec` that the provider is part of.

    Raises:
      ValueError: If the provider cannot work in this design.
    """


PROVIDERS: registry.Registry[type[Provider]] = registry.Registry(
    'provider kind'
)
