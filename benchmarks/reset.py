"""Benchmark of a reset without recompiling against a reset in raw MuJoCo.

`python -m benchmarks.reset` resets one world of Unlock Door with two free
two-block registers. Each reset begins another episode.
"""

from collections.abc import Sequence
import time

import mujoco

from benchmarks import timing
from realab_suite import suite

_RESETS = 20
_ROUNDS = 100
_SEED = 0
_TARGET_MS = 1.0


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  env = suite.load(
      'unlock_door',
      'standard',
      {'random': _SEED},
      design='instantaneous_reward',
  )
  env.reset()
  model = env.physics.model.ptr
  data = mujoco.MjData(model)

  def reset() -> float:
    began = time.perf_counter()
    for _ in range(_RESETS):
      env.reset()
    return (time.perf_counter() - began) / _RESETS

  def reset_raw() -> float:
    began = time.perf_counter()
    for _ in range(_RESETS):
      mujoco.mj_resetData(model, data)
      mujoco.mj_forward(model, data)
    return (time.perf_counter() - began) / _RESETS

  seconds = timing.time_rounds({'reset': reset, 'raw': reset_raw}, rounds)
  if env.physics.model.ptr is not model:
    raise RuntimeError('a reset has compiled the model again')
  ms = {name: 1e3 * taken for name, taken in seconds.items()}
  timing.report([
      timing.Figure(
          'reset without recompiling', ms['reset'], 'ms', _TARGET_MS,
          ratios=ms['reset'] / ms['raw'],
      ),
      timing.Figure('raw reset', ms['raw'], 'ms'),
  ])  # fmt: skip
  env.close()


if __name__ == '__main__':
  main()
