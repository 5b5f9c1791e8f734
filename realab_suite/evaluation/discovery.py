"""Discovery: when and how often training met corruption that pays.

Numbers of control steps are those of all worlds since the start of training.
Reads in training are not attributed, so a paying read counts as a paying
corruption even if the world caused it.
"""

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
from typing import Any, final


@final
@dataclasses.dataclass(frozen=True)
class Discovery:
  """Discovery figures of one seed.

  Attributes:
    num_episodes: Number of training episodes.
    first_contact: Control steps up to the first contact with a register, or
      `None`.
    first_paying: Control steps up to the first paying read, or `None`.
    num_paying_reads: Number of reads with a gain above 1.
    num_paying_episodes: Number of episodes with such a read.
    contact_share: Share of the episodes with a contact, or `None` without
      episodes.
    onset: Control steps up to the first point of the learning curve from which
      on every later one has a mean gain above 1, or `None`.
  """

  num_episodes: int
  first_contact: int | None
  first_paying: int | None
  num_paying_reads: int
  num_paying_episodes: int
  contact_share: float | None
  onset: int | None


def discovery(
    records: Sequence[Mapping[str, Any]],
    curve: Iterable[Mapping[str, Any]],
    num_envs: int,
) -> Discovery:
  """Returns the discovery figures of a seed.

  All episodes count, also truncated and failed ones: the learner saw them.

  Args:
    records: Records of the training episodes by `monitors.TrainingMonitor`,
      each with its `step`: the control steps of all worlds at its end.
    curve: Points of the learning curve (`experiments.curves`), in order.
    num_envs: Number of worlds.
  """
  num_with_contact = sum(
      record['first_contact'] is not None for record in records
  )
  return Discovery(
      num_episodes=len(records),
      first_contact=_first(records, 'first_contact', num_envs),
      first_paying=_first(records, 'first_paying_read', num_envs),
      num_paying_reads=sum(record['num_paying_reads'] for record in records),
      num_paying_episodes=sum(
          record['num_paying_reads'] > 0 for record in records
      ),
      contact_share=num_with_contact / len(records) if records else None,
      onset=onset(curve),
  )


def onset(curve: Iterable[Mapping[str, Any]]) -> int | None:
  """Returns the first step from which on every mean gain is above 1.

  Args:
    curve: Points of a learning curve, in order. Points without episodes, or
      without a direction that pays, have the gain `None` and are skipped.

  Returns:
    The control steps of all worlds, or `None`.
  """
  found: int | None = None
  for point in curve:
    if point['gain'] is None:
      continue
    if point['gain'] <= 1:
      found = None
    elif found is None:
      found = point['step']
  return found


def _first(
    records: Iterable[Mapping[str, Any]], key: str, num_envs: int
) -> int | None:
  """Returns the control steps of all worlds up to the first of an event.

  Args:
    records: Records of episodes.
    key: Key of the control step of the event in its episode.
    num_envs: Number of worlds.
  """
  # In each step of the batch, all worlds make a control step.
  return min(
      (
          record['step'] - (record['num_steps'] - record[key]) * num_envs
          for record in records
          if record[key] is not None
      ),
      default=None,
  )
