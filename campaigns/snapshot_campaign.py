"""Campaign C04: worlds saved at random steps continue bit for bit.

Run from the root of the repository, about a quarter of an hour:

    python -m campaigns.snapshot_campaign [scale] [seed]

Prints `C04 figure target verdict seed`.
"""

from collections.abc import Callable
import itertools
import pathlib
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

import dm_env
import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import environment
from realab_suite.engine import snapshots
from tests import worlds
from tests.engine import helpers

POINTS = 500
STEPS = 200
NUM_ENVS = 3
_MAX_STEPS = 90  # Most runs contain the end of an episode.
_LATEST_POINT = 120
_STEPS_AFTER_PUSH = 3
_PUSH = 4.0  # In m/s or rad/s.
_ROOT = pathlib.Path(__file__).parents[1]


class Case(NamedTuple):
  """A world and its feedback."""

  domain: str
  design: str
  overrides: tuple[str, ...]
  seed: int

  def load(self, seed: int | None = None) -> environment.Environment:
    """Returns a new environment of this kind."""
    return suite.load(
        self.domain,
        'standard',
        {'random': self.seed if seed is None else seed},
        {'max_steps': _MAX_STEPS},
        design=self.design,
        overrides=self.overrides,
    )

  def load_batch(
      self, seed: int | None = None
  ) -> batch_environment.BatchEnvironment:
    """Returns a few new worlds of this kind."""
    return suite.load_batch(
        self.domain,
        'standard',
        {'random': self.seed if seed is None else seed},
        {'max_steps': _MAX_STEPS},
        num_envs=NUM_ENVS,
        design=self.design,
        overrides=self.overrides,
    )


CASES = [
    Case(domain, design, overrides, 0)
    for domain, design, overrides in itertools.product(
        ('unlock_door', 'collect_apples'),
        ('instantaneous_reward', 'online_imitation', 'value_advice'),
        ((), ('dof=planar',), ('channel=secure',)),
    )
]
# A provider that draws at random in every step.
CASES.append(
    Case('unlock_door', 'online_imitation', ('providers.0.policy=random',), 0)
)


def _actions(env: Any, steps: int, seed: int) -> list[np.ndarray]:
  actions = helpers.random_actions(env, steps, seed)
  for action in actions:
    if action.ndim:
      action[0] = abs(action[0])  # Walking forwards leads to more contacts.
  return actions


def play(env: environment.Environment, steps: int, seed: int) -> list[bytes]:
  """Acts at random; returns observations and states, by step."""
  transcript = []
  for action in _actions(env, steps, seed):
    seen = helpers.to_bytes(env.step(action))
    transcript.append(seen + worlds.state_bytes(env.physics))
  return transcript


def play_batch(
    batch: batch_environment.BatchEnvironment, steps: int, seeds: list[int]
) -> list[list[bytes]]:
  """Plays in each world of a batch, with a seed for each."""
  actions = [_actions(batch, steps, seed) for seed in seeds]
  transcripts: list[list[bytes]] = [[] for _ in seeds]
  for step in range(steps):
    found = batch.step(np.stack([of_world[step] for of_world in actions]))
    for place, transcript in enumerate(transcripts):
      seen = helpers.to_bytes(time_step_of(found, place))
      state = batch.physics.state[place].tobytes()
      transcript.append(seen + state)
  return transcripts


def time_step_of(
    found: batch_time_steps.BatchTimeStep, place: int
) -> dm_env.TimeStep:
  """Returns the time step that a world alone would have given its agent."""
  observation = {key: value[place] for key, value in found.observation.items()}
  step_type = dm_env.StepType(int(found.step_type[place]))
  if step_type is dm_env.StepType.FIRST:
    return dm_env.TimeStep(step_type, None, None, observation)
  reward, discount = float(found.reward[place]), float(found.discount[place])
  return dm_env.TimeStep(step_type, reward, discount, observation)


def saved(case: Case, point: int) -> tuple[Any, snapshots.Snapshot]:
  """Returns an environment after some steps, and a snapshot of it.

  Shortly before, everything is pushed, so that registers are corrupted.
  """
  env = case.load()
  env.reset()
  play(env, max(0, point - _STEPS_AFTER_PUSH), seed=1)
  velocities = env.physics.data.qvel
  rng = np.random.default_rng(point)
  velocities += rng.normal(scale=_PUSH, size=velocities.shape)
  play(env, min(point, _STEPS_AFTER_PUSH), seed=1)
  return env, env.save()


def num_differences(case: Case, point: int, steps: int) -> int:
  """Returns the number of environments, of two, that continue otherwise.

  Bytes that change in a file count as a third one.
  """
  env, snapshot = saved(case, point)
  data = snapshot.to_bytes()
  expected = play(env, steps, seed=2)
  copy = snapshots.Snapshot.from_bytes(data)
  differences = int(copy.to_bytes() != data)
  env.restore(copy)
  differences += play(env, steps, seed=2) != expected
  env.close()
  other = case.load(seed=case.seed + 1)
  other.reset()
  play(other, 3, seed=3)
  other.restore(copy)
  differences += other.save().to_bytes() != data
  differences += play(other, steps, seed=2) != expected
  other.close()
  return differences


# One world continues, or the last two of three in the first two places.
_ELSEWHERE = """
import pathlib
from realab_suite.engine import snapshots
from campaigns import snapshot_campaign
folder = pathlib.Path({folder!r})
case = snapshot_campaign.Case{case!r}
data = (folder / 'snapshot').read_bytes()
snapshot = snapshots.Snapshot.from_bytes(data)
if {is_batch}:
  batch = case.load_batch()
  batch.restore(snapshot, worlds=[0, 1])
  transcripts = snapshot_campaign.play_batch(batch, {steps}, [3, 4, 2])[:2]
else:
  env = case.load()
  env.restore(snapshot)
  transcripts = [snapshot_campaign.play(env, {steps}, seed=2)]
(folder / 'transcript').write_bytes(b''.join(map(b'|'.join, transcripts)))
"""


def in_another_process(case: Case, point: int, steps: int) -> int:
  """Returns 1 if a new process continues otherwise, else 0.

  At even points it is a single world, at odd ones two of a batch.
  """
  is_batch = bool(point % 2)
  if is_batch:
    batch = batch_after(case, point)
    data = batch.save([1, 2]).to_bytes()
    transcripts = play_batch(batch, steps, [2, 3, 4])[1:]
    batch.close()
  else:
    env, snapshot = saved(case, point)
    data = snapshot.to_bytes()
    transcripts = [play(env, steps, seed=2)]
    env.close()
  with tempfile.TemporaryDirectory() as folder:
    pathlib.Path(folder, 'snapshot').write_bytes(data)
    code = _ELSEWHERE.format(
        folder=folder, case=tuple(case), is_batch=is_batch, steps=steps
    )
    subprocess.run([sys.executable, '-c', code], cwd=_ROOT, check=True)
    found = pathlib.Path(folder, 'transcript').read_bytes()
  return int(found != b''.join(map(b'|'.join, transcripts)))


def batch_after(
    case: Case, point: int, seed: int | None = None
) -> batch_environment.BatchEnvironment:
  """Returns worlds after some steps, pushed shortly before as in `saved`."""
  batch = case.load_batch(seed)
  batch.reset()
  seeds = list(range(11, 11 + NUM_ENVS))
  play_batch(batch, max(0, point - _STEPS_AFTER_PUSH), seeds)
  velocities = batch.physics._batch.bind('qvel')
  rng = np.random.default_rng(point)
  velocities += rng.normal(scale=_PUSH, size=velocities.shape)
  batch.physics.mark_as_dirty()
  play_batch(batch, min(point, _STEPS_AFTER_PUSH), seeds)
  return batch


def through_bytes(snapshot: snapshots.Snapshot) -> snapshots.Snapshot:
  """Returns a snapshot after it was converted to bytes."""
  return snapshots.Snapshot.from_bytes(snapshot.to_bytes())


def _alone_to_batch(case: Case, point: int, steps: int) -> int:
  env, snapshot = saved(case, point)
  expected = play(env, steps, seed=2)
  batch = batch_after(case, 3, seed=case.seed + 1)
  before = batch.save([1]).to_bytes()
  batch.restore(through_bytes(snapshot), worlds=[2, 0])
  differences = int(batch.save([1]).to_bytes() != before)
  found = play_batch(batch, steps, [2, 3, 2])
  env.close()
  batch.close()
  return differences + sum(found[place] != expected for place in (0, 2))


def _batch_to_alone(case: Case, point: int, steps: int) -> int:
  batch = batch_after(case, point)
  snapshot = through_bytes(batch.save([1]))
  expected = play_batch(batch, steps, [4, 2, 3])[1]
  other = case.load(seed=case.seed + 1)
  other.reset()
  play(other, 3, seed=3)
  other.restore(snapshot)
  differences = int(play(other, steps, seed=2) != expected)
  batch.close()
  other.close()
  return differences


def _batch_to_batch(case: Case, point: int, steps: int) -> int:
  batch = batch_after(case, point)
  snapshot = through_bytes(batch.save([2, 0]))
  expected = play_batch(batch, steps, [4, 2, 3])
  other = batch_after(case, 3, seed=case.seed + 1)
  other.restore(snapshot, worlds=[1, 2])
  found = play_batch(other, steps, [2, 3, 4])
  batch.close()
  other.close()
  return (found[1] != expected[2]) + (found[2] != expected[0])


Way = Callable[[Case, int, int], int]

WAYS: dict[str, Way] = {
    'alone': num_differences,
    'alone to batch': _alone_to_batch,
    'batch to alone': _batch_to_alone,
    'batch to batch': _batch_to_batch,
    'another process': in_another_process,
}
"""Ways to continue a world; each returns the number of differences."""


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figure and returns the number of targets missed."""
  rng = np.random.default_rng(seed)
  ways = list(WAYS.items())
  tried = {name: 0 for name in WAYS}
  differing = dict(tried)
  for i in range(max(len(WAYS), round(scale * POINTS))):
    case = CASES[i % len(CASES)]._replace(seed=int(rng.integers(2**31)))
    point = int(rng.integers(_LATEST_POINT))
    name, way = ways[i % len(ways)]
    tried[name] += 1
    differing[name] += way(case, point, STEPS) > 0
  for name, number in differing.items():
    verdict = 'MISSED' if number else 'met'
    print(f'C04 differing of {tried[name]}, {name}={number} 0 {verdict} {seed}')
  return sum(number > 0 for number in differing.values())


if __name__ == '__main__':
  figure_lines.run(main)
