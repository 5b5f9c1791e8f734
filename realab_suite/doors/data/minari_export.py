"""Export of the agent's data to Minari, a format of offline learning.

A dataset contains what the agent may see. Its rewards are the observed ones:
the readings of the register that the learner uses as its reward, or 0.0 if
there is none.
"""

from collections.abc import Iterator, Mapping
import contextlib
import itertools
import os
import pathlib
import re
from typing import Any
import warnings

from dm_env import specs as dm_env_specs
from gymnasium import spaces
import minari
from minari import data_collector
import numpy as np

from realab_suite.doors.data import recording
from realab_suite.lab.experiments import storage

_ROOT = 'MINARI_DATASETS_PATH'
_DESCRIPTION = (
    'Episodes of an agent whose feedback is embedded in its world. Rewards are'
    ' observed rewards, which the agent may have corrupted; see docs/doors.md'
    ' of realab_suite.'
)


def dataset_id(world: tuple[str, str], run: str) -> str:
  """Returns the name of a dataset, such as `realab/unlock_door-near/reward-v0`.

  Args:
    world: Names of the domain and the task.
    run: Name of the run. Characters that Minari does not allow become '-'.
  """
  namespace, name = (
      re.sub(r'[^A-Za-z0-9_-]', '-', text) for text in ('-'.join(world), run)
  )
  return f'realab/{namespace}/{name}-v0'


def space_of(spec: dm_env_specs.Array) -> spaces.Space:
  """Returns the Gymnasium space of a dm_env spec.

  Args:
    spec: Spec of an action, or of an entry of the observations.
  """
  if isinstance(spec, dm_env_specs.DiscreteArray):
    return spaces.Discrete(spec.num_values)
  if not isinstance(spec, dm_env_specs.BoundedArray):
    least, most = -np.inf, np.inf
    if np.issubdtype(spec.dtype, np.integer):
      least, most = np.iinfo(spec.dtype).min, np.iinfo(spec.dtype).max
    return spaces.Box(least, most, spec.shape, spec.dtype)
  low, high = (
      np.array(np.broadcast_to(bound, spec.shape), spec.dtype)
      for bound in (spec.minimum, spec.maximum)
  )
  return spaces.Box(low, high, spec.shape, spec.dtype)


def observation_space(
    observation_spec: Mapping[str, dm_env_specs.Array],
) -> spaces.Dict:
  """Returns the space of observations: a dictionary for each group of entries.

  Args:
    observation_spec: Spec of each entry, by a key such as `senses/position`.
  """
  groups = _nested({k: space_of(spec) for k, spec in observation_spec.items()})
  return spaces.Dict({k: spaces.Dict(entries) for k, entries in groups.items()})


def buffer_of(agent: recording.AgentStream) -> data_collector.EpisodeBuffer:
  """Returns an episode as Minari stores it.

  Args:
    agent: The part of the episode that the agent may see.
  """
  later = agent.time_steps[1:]
  rewards = np.zeros(len(later))
  if agent.reward is not None:
    rewards = np.array([one.observation[agent.reward] for one in later], float)
  terminations = np.array([one.last() and one.discount == 0.0 for one in later])
  is_last = np.array([one.last() for one in later])
  return data_collector.EpisodeBuffer(
      observations=_nested(
          {
              key: np.stack([one.observation[key] for one in agent.time_steps])
              for key in agent.observation_spec
          }
      ),
      actions=agent.actions,
      rewards=rewards,
      terminations=terminations,
      truncations=is_last & ~terminations,
  )


def _nested(entries: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
  """Returns entries by group and name; Minari's files use '/' for groups."""
  groups: dict[str, dict[str, Any]] = {}
  for key, entry in entries.items():
    group, name = key.split('/', 1)
    groups.setdefault(group, {})[name] = entry
  return groups


def write(
    root: pathlib.Path, name: str, agents: Iterator[recording.AgentStream]
) -> None:
  """Writes a Minari dataset.

  Args:
    root: Folder for `MINARI_DATASETS_PATH`.
    name: Name of the dataset; see `dataset_id`.
    agents: The part of each episode that the agent may see; at least one.

  Raises:
    ResultsError: If the dataset cannot be written.
  """
  first = next(agents)
  # Minari fails on relative paths.
  root = pathlib.Path(os.path.abspath(root))
  with storage.explained(root):
    root.mkdir(parents=True, exist_ok=True)
    with _root_is(root), warnings.catch_warnings():
      # Warns that there is no environment and no author to ask.
      warnings.simplefilter('ignore', UserWarning)
      dataset = minari.create_dataset_from_buffers(
          name,
          [],
          observation_space=observation_space(first.observation_spec),
          action_space=space_of(first.action_spec),
          description=_DESCRIPTION,
          # The default would compress images, with losses.
          jpeg_encoding=False,
      )
    streams = itertools.chain([first], agents)
    dataset.storage.update_episodes(map(buffer_of, streams))


@contextlib.contextmanager
def _root_is(root: pathlib.Path) -> Iterator[None]:
  """Sets the folder of Minari's datasets, which is an environment variable."""
  before = os.environ.get(_ROOT)
  os.environ[_ROOT] = str(root)
  try:
    yield
  finally:
    del os.environ[_ROOT]
    if before is not None:
      os.environ[_ROOT] = before
