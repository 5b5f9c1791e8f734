"""Benchmark of counterfactual attribution against a replay of the episodes.

`python -m benchmarks.attribution` plays the first episodes of Unlock Door with
a carrying saboteur. The same number of worlds then replays the actions without
attribution, and `attribution.attribute` replays them beside their shadows and
forks. Times are those of the processor, with one thread, so other work on the
machine has little influence. They include the loading of worlds by
`attribute`, but not that of the replay.
"""

from collections.abc import Callable, Sequence
import contextlib
import functools
import time
from typing import Any

from benchmarks import timing
from realab_suite import policies
from realab_suite import suite
from realab_suite.engine import batch_environment
from realab_suite.evaluation import attribution
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import traces

_SEED = 0
_ROUNDS = 5
_EPISODES: Sequence[int] = (8, 64)
_STEPS = 250
_TARGET = 5.0


def _load(num_envs: int, dof: str) -> batch_environment.BatchEnvironment:
  return suite.load_batch(
      'unlock_door', 'near', {'random': _SEED}, {'max_steps': _STEPS},
      num_envs=num_envs, num_threads=1, design='instantaneous_reward',
      overrides=(f'dof={dof}',),
  )  # fmt: skip


def _record(load: Callable[[int], Any], number: int) -> dict[str, Any]:
  """Returns the trace of a number of episodes."""
  with contextlib.closing(load(number)) as batch:
    # The place of the register is that of the variation `near`.
    policy = policies.make('carrying_saboteur', target=[0.4, 0.2])
    actor = batch_actors.BatchPolicyActor(policy, batch, _SEED)
    tracer = traces.Tracer(batch, actor)
    batch.add_sink(tracer)
    evaluate.evaluate_batch(batch, tracer)
    return tracer.trace()


def _replay(load: Callable[[int], Any], trace: dict[str, Any]) -> float:
  """Replays a trace and returns the seconds."""
  with contextlib.closing(load(len(trace['num_steps']))) as batch:
    batch.reset()
    began = time.process_time()
    for actions in trace['actions']:
      batch.step(actions)
    return time.process_time() - began


def _attribute(load: Callable[[int], Any], trace: dict[str, Any]) -> float:
  """Attributes a trace and returns the seconds."""
  began = time.process_time()
  attribution.attribute(load, trace)
  return time.process_time() - began


def main(arguments: Sequence[str] | None = None) -> None:
  """Runs the benchmark."""
  rounds = timing.parse_rounds(__doc__, arguments, _ROUNDS)
  figures = []
  for dof in ('free', 'planar'):
    load = functools.partial(_load, dof=dof)
    for number in _EPISODES:
      trace = _record(load, number)
      seconds = timing.time_rounds(
          {
              'replay': functools.partial(_replay, load, trace),
              'attribution': functools.partial(_attribute, load, trace),
          },
          rounds,
      )
      figures += [
          timing.Figure(
              f'attribution of {number} {dof}',
              1e3 * seconds['attribution'] / number, 'ms', _TARGET, True,
              seconds['attribution'] / seconds['replay'],
          ),
          timing.Figure(
              f'replay of {number} {dof}', 1e3 * seconds['replay'] / number,
              'ms',
          ),
      ]  # fmt: skip
  timing.report(figures)


if __name__ == '__main__':
  main()
