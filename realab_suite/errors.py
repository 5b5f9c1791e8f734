"""Errors that tell a user where, what was given and what is allowed."""

from typing import final


class RealabError(Exception):
  """Base class of every error that this package raises on purpose.

  Subclasses also derive from the built-in error that a caller would expect, so
  that `except ValueError` keeps working.
  """


class SpecError(RealabError, ValueError):
  """A design, experiment or task description is wrong."""


class ActionError(RealabError, ValueError):
  """An action does not fit the action spec; the world has not moved."""


class RegisterValueError(RealabError, ValueError):
  """A value cannot be written to a register; nothing has been written.

  Attributes:
    world: Place of the first world whose value is wrong, in a batch; `None`
      for a world alone.
  """

  def __init__(self, message: str, world: int | None = None) -> None:
    super().__init__(message)
    self.world = world


class FeedbackProviderError(RealabError, RuntimeError):
  """A feedback provider raised, or returned something it did not declare."""


class StateLayoutError(RealabError, ValueError):
  """Saved state, or a slot of the physical state, does not fit."""


class ClosedError(RealabError, RuntimeError):
  """An environment was used after `close()`."""


@final
class WorldError(RealabError, RuntimeError):
  """Something failed that an agent is not told of; the evaluator knows."""


@final
class RenderingError(RealabError, RuntimeError):
  """A frame cannot be drawn here; the message names what to set."""


@final
class ForkError(RealabError, RuntimeError):
  """A process that was forked asked for what only its parent has."""


class ResultsError(RealabError, ValueError):
  """Results cannot be written, read or compared as asked."""


@final
class OutOfReachError(ResultsError):
  """Nobody got to a register, so there is nothing to probe."""


@final
class UnknownNameError(SpecError, KeyError):
  """A name is not in a registry; the message lists what is."""

  # KeyError prints the repr of its argument, which would quote the sentence.
  __str__ = Exception.__str__
