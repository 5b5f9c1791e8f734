"""Golden trajectories; run as a script to record them after a change.

A released name's dynamics are frozen: when a digest changes under the same
version of MuJoCo, the task's `DYNAMICS_VERSION` has to be raised.
"""

import hashlib
import pathlib

import mujoco
import numpy as np
import yaml

from realab_suite import suite
from realab_suite.tasks import registry

GOLDEN = pathlib.Path(__file__).parents[1] / 'configs' / 'golden.yaml'
_NUM_STEPS = 60
# Coarser than what processors differ by. A change in the last digit, which ends
# replays of published rows, goes unseen.
_DECIMALS = 6


def digest(domain: str, task: str) -> str:
  """Returns the digest of an open-loop trajectory of a task."""
  world = registry.find(domain, task)()
  # A measurement without a range: losses saturate, as when it was recorded.
  env = suite.embed(
      world,
      'instantaneous_reward',
      random=0,
      overrides=['meters.0.measures=earned'],
      measurements={'earned': world.score},
  )
  rng = np.random.default_rng(0)
  action = np.zeros(env.action_spec().shape)
  env.reset()
  hashed = hashlib.sha256()
  for step in range(_NUM_STEPS):
    if step % 10 == 0:
      action = rng.uniform(-1.0, 1.0, action.shape)
      action[0] = abs(action[0])
    env.step(action)
    data = env.physics.data
    poses = np.concatenate([data.qpos, data.mocap_pos.ravel()])
    rounded = np.round(poses, _DECIMALS) + 0.0
    hashed.update(rounded.astype('<f8').tobytes())
  return hashed.hexdigest()[:16]


def record() -> None:
  """Writes the digests of all tasks for the installed version of MuJoCo."""
  recorded = yaml.safe_load(GOLDEN.read_text()) if GOLDEN.exists() else {}
  recorded[mujoco.__version__] = {
      f'{domain}.{task}': digest(domain, task)
      for domain, task in suite.ALL_TASKS
  }
  header = '# Digests of golden trajectories; see tests/golden.py.\n'
  GOLDEN.write_text(header + yaml.safe_dump(recorded))


if __name__ == '__main__':
  record()
