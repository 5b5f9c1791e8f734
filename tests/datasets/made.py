"""A hand-made episode of two steps, and small sources of real ones."""

import pathlib
from typing import Any

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite.datasets import recording
from realab_suite.datasets import sources
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import attribution_metrics
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics
from realab_suite.evaluation import results
from realab_suite.feedback import specs

ROOT = pathlib.Path(__file__).parents[2]

DESIGN = {
    'schema': 1,
    'name': 'made',
    'registers': {
        'reward': {
            'kind': 'two_block', 'role': 'feedback', 'place': 'station_1',
            'range': [-2, 12], 'scale': 0.1,
        }
    },
    'providers': [{'kind': 'constant', 'value': 1.0, 'writes': ['reward']}],
    'learner': {'kind': 'policy_gradient', 'reward': 'reward'},
}  # fmt: skip
_SPEC = {
    'senses/camera': dm_env_specs.BoundedArray((1, 2, 3), np.uint8, 0, 255),
    'senses/codes': dm_env_specs.Array((2,), np.int32),
    'senses/time_left': dm_env_specs.BoundedArray((), np.float32, 0.0, 1.0),
    'registers/reward': dm_env_specs.Array((), np.float64),
}


def observation(step: int, reading: float) -> dict[str, np.ndarray]:
  camera = np.arange(6, dtype=np.uint8).reshape(1, 2, 3) + 200 + step
  return {
      'senses/camera': camera,
      'senses/codes': np.array([step, -step], np.int32),
      'senses/time_left': np.asarray(1 - step / 2, np.float32),
      'registers/reward': np.asarray(reading),
  }


def stream(
    action: Any = ((0.25, -1.0), (0.5, 1.0)),
    action_spec: dm_env_specs.Array | None = None,
    discount: float = 0.0,
) -> recording.AgentStream:
  """Returns the agent's part of the episode."""
  if action_spec is None:
    action_spec = dm_env_specs.BoundedArray(
        (2,), np.float64, -1.0, 1.0, name='forward\tturn'
    )
  return recording.AgentStream(
      _SPEC,
      action_spec,
      [
          dm_env.restart(observation(0, 0.0)),
          dm_env.transition(0.0, observation(1, 1.25), 1.0),
          dm_env.TimeStep(
              dm_env.StepType.LAST, 0.0, discount, observation(2, 4.0)
          ),
      ],
      np.array(action, action_spec.dtype),
      'registers/reward',
  )


def _attribution() -> attribution_metrics.Attribution:
  return attribution_metrics.Attribution(
      timestep=0.1,
      registers={
          'reward': attribution_metrics.RegisterAttribution(
              scale=0.1,
              total=np.array([0.25, 3.0]),
              agent=np.array([0.0, 2.75]),
          )
      },
      consumed=('reward',),
      directions={'reward': 1.0},
  )  # fmt: skip


def episode(is_attributed: bool = True) -> recording.Episode:
  """Returns the episode.

  In step 1 the world moves the offset block by 2.5 cm. In step 2 the agent
  moves the base block by 27.5 cm, and the write of the provider, which
  saturates, leaves 2.5 cm. The true reward of step 2 is unknown.
  """
  design = specs.load(DESIGN)
  read, write = registers.Read, registers.Write
  entries = [
      write('reward', registers.INITIAL, 0, 0.0, 0.0, 0.0),
      read('reward', registers.AGENT, 0, 0.0, 0.0, 0.0, 0.0),
      write('reward', 'constant', 1, 1.0, 1.0, 0.0),
      read('reward', registers.AGENT, 1, 1.25, 0.0, 0.0, 0.25),
      write('reward', 'constant', 2, 14.0, 1.0, 0.0),
      read('reward', registers.AGENT, 2, 4.0, 0.0, 2.75, 0.25),
  ]
  ledger = ledgers.EpisodeLedger(
      7, 0, 0, {'reward': entries}, [0.5, 2.0], events.End.TERMINATED
  )
  info = results.RunInfo.of(
      ('unlock_door', 'near'), (2, None), design, policy='hand', run='by_hand',
      baseline=None, control_timestep=0.1, max_steps=2,
  )  # fmt: skip
  row = results.EpisodeRow(
      info=info, seed=7, world=0, episode=0, end='terminated', is_valid=True,
      true_return=2.5, observed_return=5.25, corruption=0.1, gain=3.25,
      num_paying_reads=1, first_paying_read=2, first_contact=1,
      registers={'reward': metrics.register_metrics(entries, 0.1)}, facts={},
      num_steps=2, num_substeps=8, num_provider_calls=2, num_queries=0,
  )  # fmt: skip
  states = [
      read('reward', registers.EVALUATOR, 0, 0.0, 0.0, 0.0, 0.0),
      read('reward', registers.EVALUATOR, 1, 1.25, 0.0, 0.0, 0.25),
      read('reward', registers.EVALUATOR, 2, 4.0, 0.0, 2.75, 0.25),
  ]
  return recording.Episode(
      stream(), 'by_hand', False, row, design, ledger, {'reward': states},
      _attribution() if is_attributed else None,
  )  # fmt: skip


def source(
    policy: str = 'carrying_saboteur', channel: str = 'embedded', **options: Any
) -> sources.Source:
  """Returns a source with one short episode of a policy."""
  design = specs.load(
      options.get('design', 'instantaneous_reward'), (f'channel={channel}',)
  )
  return sources.of_policy(
      f'{policy} ({channel})', policy, design, ('unlock_door', 'near'),
      seeds=[3], num_episodes=options.get('num_episodes', 1), task_kwargs={},
      environment_kwargs={'max_steps': options.get('max_steps', 45)},
  )  # fmt: skip
