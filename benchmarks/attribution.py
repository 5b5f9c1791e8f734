"""Benchmark of attribution against the same episodes without it.

`python -m benchmarks.attribution` records the actions of an honest policy and
of saboteurs in the first episodes of Unlock Door. Two batches then step with
them in turns, one of them with an attributor. Times are those of the processor,
with one thread, so other work on the machine has little influence.
"""

from collections.abc import Sequence
import contextlib
import time

import numpy as np

from benchmarks import timing
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import traces
from realab_suite.lab.attribution import attribution

_SEED = 0
_ROUNDS = 5
_EPISODES: Sequence[int] = (8, 64)
_STEPS = 100
_POLICIES: Sequence[str] = (
    'apple_seeker', 'carrying_saboteur', 'throwing_saboteur', 'pushing_saboteur'
)  # fmt: skip
_TARGET = 1.2


def _load(num_envs: int, dof: str) -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'unlock_door', 'near', {'random': _SEED}, {'max_steps': _STEPS},
      num_envs=num_envs, num_threads=1, design='instantaneous_reward',
      overrides=(f'dof={dof}',),
  )  # fmt: skip


def _record(policy: str, number: int, dof: str) -> np.ndarray:
  """Returns the actions of a policy in a number of episodes."""
  # The place of the register is that of the variation `near`.
  options = {'target': [0.4, 0.2]} if policy.endswith('saboteur') else {}
  with contextlib.closing(_load(number, dof)) as batch:
    actor = batch_actors.BatchPolicyActor(
        policies.make(policy, **options), batch, _SEED
    )
    tracer = traces.Tracer(batch, actor)
    batch.add_sink(tracer)
    evaluate.evaluate_batch(batch, tracer)
    actions: np.ndarray = tracer.trace()['actions']
    return actions


def _seconds(actions: np.ndarray, dof: str) -> tuple[float, float]:
  """Returns the seconds without and with an attributor."""
  seconds = [0.0, 0.0]
  with contextlib.ExitStack() as stack:
    batches = [
        stack.enter_context(contextlib.closing(_load(actions.shape[1], dof)))
        for _ in seconds
    ]
    batches[1].add_sink(attribution.Attributor(batches[1]))
    for batch in batches:
      batch.reset()
    for action in actions:
      for i, batch in enumerate(batches):
        began = time.process_time()
        batch.step(action)
        seconds[i] += time.process_time() - began
  return seconds[0], seconds[1]


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  figures = []
  for dof in ('free', 'planar'):
    for number in _EPISODES:
      for policy in _POLICIES:
        actions = _record(policy, number, dof)
        samples = np.array([_seconds(actions, dof) for _ in range(rounds + 1)])
        without, with_it = samples[1:].T
        figures.append(
            timing.Figure(
                f'{policy}, {number} {dof}', 1e3 * with_it / number, 'ms',
                _TARGET, True, with_it / without,
            )
        )  # fmt: skip
  timing.report(figures)


if __name__ == '__main__':
  main()
