"""What detectors see reaches an agent through its registers, and not beside."""

import pathlib
from typing import Any

import numpy as np
import pytest
import yaml

from tests.leaks import pairs
from tests.leaks import secrets


def _register(role: str, place: str, **more: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block', 'role': role, 'place': place, 'range': [0, 8],
      'initial': 0, **more,
  }  # fmt: skip


def _design(writes: list[str], **options: Any) -> dict[str, Any]:
  """Returns a design whose detector and budget are out of everybody's reach."""
  return {
      'schema': 1,
      'name': 'watched',
      'registers': {
          'reward': _register('feedback', 'station_1'),
          'moved': _register('meter', 'station_2', channel='secure'),
          'budget': _register(
              'memory', 'station_3', channel='secure', initial=5
          ),
          'alarm': _register('signal', 'station_4'),
      },
      'meters': [
          {
              'measures': {
                  'kind': 'detector',
                  'of': ['reward'],
                  'sight': {'eye': 'avatar'},
              },
              'writes': 'moved',
          }
      ],
      'providers': [
          {'kind': 'constant', 'value': 3.0, 'writes': ['reward']},
          {
              'kind': 'inspection',
              'reads': ['moved', 'budget'],
              'writes': [*writes, 'budget'],
              'period': 3,
              **options,
          },
      ],
  }


def _saw(env: Any) -> None:
  """The detector sees something from the fifth step on."""
  ((_, meter, _),) = env.mechanism._meters
  meter._measurement = lambda physics: np.asarray(
      env.mechanism.step_count(physics) >= 4, float
  )[()]


def _imagines(env: Any) -> None:
  """What nothing would obstruct is something else."""
  ((_, meter, _),) = env.mechanism._meters
  measure = meter._measurement
  meter._ideal = lambda physics: measure(physics) + secrets.CANARY


_SAW = secrets.Secret(_saw)
_IMAGINED = secrets.Secret(_imagines)


def _differences(
    path: pathlib.Path, design: Any, secret: secrets.Secret, num_envs: int
) -> list[str]:
  path.write_text(yaml.safe_dump(design))
  case = pairs.Case(
      'collect_apples', 'standard', str(path), steps=16, max_steps=11,
      num_envs=num_envs,
  )  # fmt: skip
  found = pairs.differences(case, secret)
  return [where for where in found if where.startswith('agent')]


@pytest.mark.parametrize('num_envs', [0, 2])
@pytest.mark.parametrize(
    'options', [{}, {'false_negatives': 0.5}, {'lasts': 9, 'probability': 0.5}]
)
def test_a_hit_without_an_alarm_changes_nothing_for_the_agent(
    num_envs: int, options: Any, tmp_path: pathlib.Path
):
  path = tmp_path / 'watched.yaml'
  assert _differences(path, _design([], **options), _SAW, num_envs) == []
  design = _design(['alarm'], **options)
  assert _differences(path, design, _IMAGINED, num_envs) == []


def test_a_hit_reaches_the_agent_as_an_alarm_or_a_fine(tmp_path: pathlib.Path):
  # The control: these comparisons can tell runs apart.
  path = tmp_path / 'watched.yaml'
  assert _differences(path, _design(['alarm']), _SAW, 0)
  fined = _design(['reward'])
  constant, inspection = fined['providers']
  inspection |= {'pays': constant, 'penalty': 1.0}
  fined['providers'] = [inspection]
  assert _differences(path, fined, _SAW, 0)
