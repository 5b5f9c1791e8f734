"""Campaign C03: a rollout is the same in every process, and over a socket.

Run from the root of the repository, about five minutes:

    python -m campaigns.digests_campaign [scale] [seed]

Processes that differ in the seed of hashes, in threads, folder, locale and time
zone act at random in the same worlds, and so does a stock client of each world
when it is served. All digests of a world and a seed have to be one. Another
seed has to give another digest.
"""

from collections.abc import Iterator, Sequence
import hashlib
import itertools
import json
import os
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import environment
from tests.engine import helpers
from tests.interop import served

STEPS = 300
SEEDS = 3
NUM_CASES = 20
_MAX_STEPS = 120

_PROCESSES: dict[str, dict[str, str]] = {
    'hash seed 0': {'PYTHONHASHSEED': '0', 'OMP_NUM_THREADS': '1'},
    'hash seed 1': {'PYTHONHASHSEED': '1', 'OMP_NUM_THREADS': '2'},
    'random hash seed': {'PYTHONHASHSEED': 'random'},
    'elsewhere': {'TZ': 'Pacific/Chatham', 'LC_ALL': 'C'},
    'another locale': {'LC_ALL': '', 'LANG': 'tr_TR.UTF-8'},
}


class Case(NamedTuple):
  """A world, its feedback and a seed."""

  domain: str
  task: str
  design: str
  seed: int

  def load(self) -> environment.Environment:
    return suite.load(
        self.domain,
        self.task,
        {'random': self.seed},
        {'max_steps': _MAX_STEPS},
        design=self.design,
    )


def cases(number: int, seeds: int, seed: int) -> list[Case]:
  """Returns some worlds with some feedback, each with several seeds."""
  pairs = list(itertools.product(suite.ALL_TASKS, suite.DESIGNS))
  # With this stride few of them have most worlds and most designs.
  worlds = [pairs[11 * i % len(pairs)] for i in range(number)]
  return [
      Case(*task, design, seed + i)
      for task, design in worlds
      for i in range(seeds)
  ]


def _digest(time_steps: Iterator[Any]) -> str:
  digest = hashlib.sha256()
  for time_step in time_steps:
    digest.update(served.to_bytes(time_step))
  return digest.hexdigest()


def in_process(case: Case, steps: int) -> str:
  """Returns the digest of what an agent gets in this process."""
  env = case.load()
  actions = helpers.random_actions(env, steps, case.seed)
  found = _digest(
      env.step(action) if i else env.reset() for i, action in enumerate(actions)
  )
  env.close()
  return found


def over_a_socket(case: Case, steps: int) -> str:
  """Returns the digest of what a stock client gets."""
  actions: list[Any] = []

  def make_env() -> environment.Environment:
    env = case.load()
    actions.extend(helpers.random_actions(env, steps, case.seed))
    return env

  with (
      served.in_thread(make_env) as serving,
      served.Client(serving.address) as client,
  ):
    env = client.env()
    [name] = env.action_spec()
    return _digest(
        env.step({name: action}) if i else env.reset()
        for i, action in enumerate(actions)
    )


def in_another(
    chosen: Sequence[Case], steps: int, variables: dict[str, str], folder: str
) -> list[str]:
  """Returns the digests that a new process comes to."""
  ran = subprocess.run(
      [sys.executable, '-m', 'campaigns.digests_campaign', '--digests'],
      input=json.dumps([steps, chosen]),
      env={**os.environ, 'PYTHONPATH': str(served.ROOT), **variables},
      cwd=folder,
      capture_output=True,
      text=True,
      check=True,
  )
  return json.loads(ran.stdout.splitlines()[-1])


def num_distinct(
    chosen: Sequence[Case], steps: int, processes: Sequence[str]
) -> list[int]:
  """Returns how many digests there are of each world and seed."""
  digests = [
      [in_process(case, steps) for case in chosen],
      [over_a_socket(case, steps) for case in chosen],
  ]
  with tempfile.TemporaryDirectory() as folder:
    for name in processes:
      digests.append(in_another(chosen, steps, _PROCESSES[name], folder))
  return [len(set(of_case)) for of_case in zip(*digests, strict=True)]


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C03', seed)
  chosen = cases(max(1, int(NUM_CASES * scale)), SEEDS, seed)
  steps = max(30, int(STEPS * scale))
  found = num_distinct(chosen, steps, list(_PROCESSES))
  lines.at_least('worlds and seeds', len(found), 3)
  lines.at_most(
      f'most digests of one, in {len(_PROCESSES)} processes, here and served',
      max(found),
      1,
  )
  seeds = {in_process(case, steps) for case in chosen[:SEEDS]}
  lines.at_least('digests of other seeds (control)', len(seeds), SEEDS)
  return lines.num_missed


if __name__ == '__main__':
  if sys.argv[1:] == ['--digests']:
    _steps, _chosen = json.load(sys.stdin)
    print(json.dumps([in_process(Case(*c), _steps) for c in _chosen]))
    sys.exit(0)
  figure_lines.run(main)
