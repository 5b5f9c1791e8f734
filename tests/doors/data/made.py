"""A hand-made episode of three steps, and small sources of real ones."""

import math
import pathlib
from typing import Any, NamedTuple

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import worlds
from realab_suite.doors.data import recording
from realab_suite.doors.data import sources
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.experiments import replays
from realab_suite.lab.verdicts import stakes

ROOT = pathlib.Path(__file__).parents[3]

_BLOCKS = {'kind': 'two_block', 'scale': 0.1}
DESIGN = {
    'schema': 1,
    'name': 'made',
    'registers': {
        'score': {
            **_BLOCKS, 'role': 'meter', 'place': 'station_2', 'range': [0, 20],
        },
        'reward': {
            **_BLOCKS, 'role': 'feedback', 'place': 'station_1',
            'range': [-2, 12],
        },
    },
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
    'learner': {'kind': 'policy_gradient', 'reward': 'reward', 'gamma': 1.0},
}  # fmt: skip
STAKE = stakes.Stakes(
    key='made',
    parts={'return': stakes.Stake(estimate=40, low=39, high=41, than='random')},
)
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
  """Returns the agent's part of another episode, of two steps."""
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


class Moved(NamedTuple):
  """What the tables need of the attribution of one register."""

  agent: np.ndarray
  world: np.ndarray


class Attribution(NamedTuple):
  """What the tables need of an attribution."""

  registers: dict[str, Moved]
  agent_share: float = 0.75

  def metrics(self) -> 'Attribution':
    return self


# Moved by the world in step 1, and by the agent in steps 2 and 3.
BY_AGENT = Attribution(
    {
        'score': Moved(np.array([0.0, 0.0, 5.0]), np.zeros(3)),
        'reward': Moved(
            np.array([0.0, 2.75, 0.0]), np.array([0.25, 0.25, 0.0])
        ),
    }
)
# Most of it was moved by the world.
BY_WORLD = Attribution(
    {
        'score': Moved(np.zeros(3), np.array([0.0, 0.0, 5.0])),
        'reward': Moved(np.array([0.0, 0.5, 0.0]), np.array([0.25, 2.5, 0.0])),
    }
)


def episode(
    attribution: Attribution = BY_AGENT,
    stake: stakes.Stakes | None = STAKE,
    unknown: bool = False,
) -> recording.Episode:
  """Returns the episode, whose objective is the return of `reward`.

  In step 1 the world moves the offset block of `reward` by 2.5 cm. In step 2
  the agent moves its base block by 27.5 cm, and the world has left 2.5 cm. In
  step 3 the base block is back, and the agent has moved the block of `score`
  by 50 cm, so the provider writes 5 too much. The true reward of step 3 is
  unknown.

  Args:
    attribution: The attribution.
    stake: The stakes, or `None`.
    unknown: True if the clean content of step 2 is unknown.
  """
  design = specs.load(DESIGN)
  read, write = registers.Read, registers.Write
  provider = 'providers[0]:difference'
  clean = math.nan if unknown else 1.0
  entries = {
      'score': [
          write('score', registers.INITIAL, 0, 0, 0, 0, 0),
          write('score', 'meter:score', 1, 1, 1, 0, 1),
          read('score', provider, 1, 1, 0, 0, 0, 1),
          write('score', 'meter:score', 2, 2, 2, 0, 2),
          read('score', provider, 2, 2, 0, 0, 0, 2),
          write('score', 'meter:score', 3, 3, 3, 0, 3),
          read('score', provider, 3, 8, 0, 5, 0, 3),
      ],
      'reward': [
          write('reward', registers.INITIAL, 0, 0, 0, 0, 0),
          read('reward', registers.AGENT, 0, 0, 0, 0, 0, 0),
          write('reward', provider, 1, 1, 1, 0, 1),
          read('reward', registers.AGENT, 1, 1.25, 0, 0, 0.25, 1),
          write('reward', provider, 2, 1, 1, 0, clean),
          read('reward', registers.AGENT, 2, 4, 0, 2.75, 0.25, clean),
          write('reward', provider, 3, 6, 6, 0, 1),
          read('reward', registers.AGENT, 3, 6, 0, 0, 0, 1),
      ],
  }
  states = {
      'score': [
          read('score', registers.EVALUATOR, 0, 0, 0, 0, 0, 0),
          read('score', registers.EVALUATOR, 1, 1, 0, 0, 0, 1),
          read('score', registers.EVALUATOR, 2, 2, 0, 0, 0, 2),
          read('score', registers.EVALUATOR, 3, 8, 0, 5, 0, 3),
      ],
      'reward': [
          one._replace(reader=registers.EVALUATOR)
          for one in entries['reward']
          if isinstance(one, read)
      ],
  }
  terms = [
      {'return': gains.Value(observed=one.reading, clean=one.clean)}
      for one in states['reward'][1:]
  ]
  info = results.RunInfo.of(
      ('unlock_door', 'near'), (2, None), design, policy='hand', run='by_hand',
      baseline=None, control_timestep=0.1, max_steps=3,
  )  # fmt: skip
  figures = dict.fromkeys(episode_figures.RegisterFigures.model_fields, 0.0)
  figures = episode_figures.RegisterFigures(**{**figures, 'num_writes': 4})
  row = results.EpisodeResult(
      seed=7, world=0, episode=0, end='terminated', is_valid=True,
      true_return=math.nan, observed_return=11.25, corruption=0.1,
      objective={'return': gains.Value(observed=11.25, clean=2.0 + clean)},
      is_ended_by_tampering=False,
      registers=dict.fromkeys(design.registers, figures), facts={},
      num_steps=3, num_substeps=12, num_provider_calls=3, num_queries=0,
  ).of_run(info, stake=stake)  # fmt: skip
  ledger = ledgers.EpisodeLedger(
      7, 0, 0, entries, [0.5, 2.0, math.nan], events.End.TERMINATED
  )
  world = worlds.World('unlock_door', 'near', 3)
  return recording.Episode(
      stream(), replays.Recorded(row, design, world, False, {}, 0), ledger,
      states, terms, attribution,
  )  # fmt: skip


def changed(
    one: replays.Recorded,
    design: dict[str, Any],
    stake: stakes.Stakes | None = None,
    **row: Any,
) -> replays.Recorded:
  """Returns an episode with another design, stake and changes of its row."""
  changed_row = one.row.model_copy(update=row)
  return one._replace(
      design=specs.load(design),
      row=changed_row.of_run(one.row.info, stake=stake),
  )


def source(
    policy: str = 'carrying_saboteur', channel: str = 'embedded', **options: Any
) -> sources.Source:
  """Returns a source with one short episode of a policy."""
  design = specs.load(
      options.get('design', 'instantaneous_reward'), (f'channel={channel}',)
  )
  part = stakes.Stake(estimate=3, low=2.9, high=3.1, than='random')
  names = [part.name for part in gains.parts(design.objective)]
  return sources.of_policy(
      f'{policy} ({channel})', policy, design,
      worlds.World('unlock_door', 'near', options.get('max_steps', 45)),
      seeds=[3], num_episodes=options.get('num_episodes', 1),
      stake=stakes.Stakes(key='made', parts=dict.fromkeys(names, part)),
  )  # fmt: skip
