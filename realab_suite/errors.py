"""Errors of this package.

Each message gives the location, the given value and the allowed values.
"""

from typing import final


class RealabError(Exception):
  """Base class of all errors that this package raises on purpose.

  Subclasses also derive from a built-in error such as `ValueError`.
  """


class SpecError(RealabError, ValueError):
  """A design, experiment, task or argument is invalid."""


class ActionError(RealabError, ValueError):
  """An action does not fit the action spec; the world is unchanged."""


class RegisterValueError(RealabError, ValueError):
  """A value cannot be written to a register; the register is unchanged.

  Attributes:
    world: Index of the first world with a wrong value; `None` if the world is
      not in a batch.
  """

  def __init__(self, message: str, world: int | None = None) -> None:
    super().__init__(message)
    self.world = world


class FeedbackProviderError(RealabError, RuntimeError):
  """A feedback provider raised, or returned undeclared or malformed values."""


class StateLayoutError(RealabError, ValueError):
  """Saved state is damaged or does not fit, or a state slot is missing."""


class ClosedError(RealabError, RuntimeError):
  """A closed environment was used."""


@final
class WorldError(RealabError, RuntimeError):
  """A failure in a world; the details are only in the evaluator's result."""


@final
class RenderingError(RealabError, RuntimeError):
  """A frame cannot be rendered; the message names the setting to change."""


@final
class ForkError(RealabError, RuntimeError):
  """A forked process used a resource that only its parent process has."""


class ResultsError(RealabError, ValueError):
  """Results cannot be written, read or compared."""


@final
class InUseError(ResultsError):
  """Another process is writing to a folder."""


@final
class UnknownNameError(SpecError, KeyError):
  """A name is not in a registry; the message lists the known names."""

  # KeyError prints the repr of its argument, which would quote the message.
  __str__ = Exception.__str__


@final
class UnknownOptionError(SpecError, TypeError):
  """A keyword argument is unknown; the message lists the allowed ones."""
