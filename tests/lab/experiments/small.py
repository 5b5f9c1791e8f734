"""Experiments that take a second."""

from collections.abc import Iterator
import contextlib
import dataclasses
import functools
import json
import pathlib
from typing import Any

import pytest

from realab_suite import suite
from realab_suite import worlds
from realab_suite.evaluation import results
from realab_suite.lab.experiments import scripted
from realab_suite.lab.verdicts import stakes

# Planning a job asks for it twice, and builds a world each time.
dynamics = functools.cache(suite.dynamics)

# The contents of the file of a small experiment with learners.
EXPERIMENT = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'max_steps': 9,
    'runs': {
        'reward': {
            'design': 'instantaneous_reward',
            'overrides': ['dof=planar'],
        },
    },
    'baselines': ['random'],
    'seeds': [3],
    'training': {
        'num_envs': 2,
        'steps': 80,
        'checkpoint_every': 20,
        'curve_every': 20,
    },
    'evaluation': {'episodes': 2},
}

_measured: dict[str, stakes.Stakes] = {}


@contextlib.contextmanager
def quick_stakes(num_episodes: int = 20) -> Iterator[None]:
  """Measures the stakes of a key once, and in fewer episodes."""
  measure = stakes.measure

  def measured(*arguments: Any) -> stakes.Stakes:
    key = arguments[4]
    if key not in _measured:
      _measured[key] = measure(*arguments)
    return _measured[key]

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(stakes, 'NUM_EPISODES', num_episodes)
    patch.setattr(stakes, 'measure', measured)
    yield


_SETTINGS = scripted.Settings(
    world=worlds.World('unlock_door', 'near', 12),
    design='instantaneous_reward',
    overrides=(),
    policies=('random', 'no_op'),
    channels=('embedded', 'secure'),
    target=None,
    seeds=(3, 5),
    num_episodes=2,
    output='',
)


def settings(output: pathlib.Path, **changes: Any) -> scripted.Settings:
  """Returns the settings of a small experiment.

  Args:
    output: The folder of its results.
    **changes: Settings that differ from the usual ones, or those of its world.
  """
  names = {field.name for field in dataclasses.fields(worlds.World)}
  of_world = {name: changes.pop(name) for name in names & changes.keys()}
  world = dataclasses.replace(_SETTINGS.world, **of_world)
  return dataclasses.replace(
      _SETTINGS, world=world, output=str(output), **changes
  )


def rows(folder: pathlib.Path) -> list[results.EpisodeResult]:
  """Returns the rows that an experiment left."""
  return list(results.read_rows(folder / 'episodes.jsonl'))


def description(folder: pathlib.Path) -> dict[str, Any]:
  """Returns the description of an experiment."""
  return json.loads((folder / 'run.json').read_text(encoding='utf-8'))
