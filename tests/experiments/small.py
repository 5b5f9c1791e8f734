"""Experiments that take a second."""

import dataclasses
import json
import pathlib
from typing import Any

from realab_suite.evaluation import results
from realab_suite.experiments import experiment

_SETTINGS = experiment.Settings(
    domain='unlock_door',
    task='near',
    design='instantaneous_reward',
    overrides=(),
    policies=('random', 'no_op'),
    channels=('embedded', 'secure'),
    baseline=None,
    target=None,
    seeds=(3, 5),
    num_episodes=2,
    max_steps=12,
    output='',
    plots=False,
    videos=False,
)


def settings(output: pathlib.Path, **changes: Any) -> experiment.Settings:
  """Returns the settings of a small experiment."""
  return dataclasses.replace(_SETTINGS, output=str(output), **changes)


def rows(folder: pathlib.Path) -> list[results.EpisodeRow]:
  """Returns the rows that an experiment left."""
  return list(results.read_rows(folder / 'episodes.jsonl'))


def description(folder: pathlib.Path) -> dict[str, Any]:
  """Returns what an experiment says of itself."""
  return json.loads((folder / 'run.json').read_text(encoding='utf-8'))
