"""Campaigns C01, C05, C06, C08, C11, C12, C17: an agent learns no secret.

Run from the root of the repository, about twelve minutes on one processor:

    python -m campaigns.leaks_campaign

C01: the contract of `AgentView` and `BatchAgentView`, for every task and
design. C08: pairs of runs that differ in a secret; in C05 the secret is the set
of event sinks. C06: worlds stepped in turns. C11: all observables are enabled.
C12: paths from a view to secrets. C17: failures are provoked, and scanned.

Prints `Cxx figure target verdict seed`. Arguments are the scale and the seed.
"""

from collections.abc import Iterator
import functools
import itertools
import os
from typing import Any, NamedTuple
import warnings

# Before anything imports dm_control: walks reach its renderers.
os.environ.setdefault('MUJOCO_GL', 'disable')

import numpy as np

from campaigns import figure_lines
from tests.leaks import contract
from tests.leaks import failures
from tests.leaks import pairs
from tests.leaks import secrets
from tests.leaks import walk

PAIRS = 500
OBSERVER_PAIRS = 100
SCHEDULES = 200
FAILURES = 500
_INTERLEAVED = 4
_MOST_KEPT = 12
_REACH = 0.6  # Distance between the middles of an avatar and a block, in m.
_STEPS_INTERLEAVED = 24


class PairCounts(NamedTuple):
  """Comparison of pairs of runs.

  Attributes:
    num_pairs: Number of pairs.
    num_differing: Number of pairs that the agent could tell apart.
    num_silent: Number of pairs that the evaluator wrongly could not tell apart.
  """

  num_pairs: int
  num_differing: int
  num_silent: int


def play_pairs(number: int, seed: int, kinds: tuple[str, ...]) -> PairCounts:
  """Plays pairs that differ in a secret, of one world and of two together.

  Args:
    number: Number of pairs.
    seed: First seed.
    kinds: Beginnings of the names of the secrets.
  """
  num_pairs = num_differing = num_silent = 0
  plain: dict[Any, pairs.Transcript] = {}
  for name, case, leave_out in _pairs(seed, kinds):
    if num_pairs == number:
      break
    secret = secrets.SECRETS[name]
    if name.startswith('meter') and meets_meter(case):
      continue
    key = case, leave_out
    if key not in plain:
      plain = {key: pairs.play(case, leave_out=leave_out), **plain}
      plain = dict(itertools.islice(plain.items(), _MOST_KEPT))
    if secret.is_heard and not pairs.has_earned(plain[key]):
      continue  # Most rewards are alike in a world without any.
    found = pairs.play(case, secret, leave_out=leave_out)
    num_pairs += 1
    num_differing += bool(pairs.compare(secret, plain[key], found))
    is_unheard = found.true_rewards == plain[key].true_rewards
    num_silent += secret.is_heard and is_unheard
  return PairCounts(num_pairs, num_differing, num_silent)


@functools.cache
def meets_meter(case: pairs.Case) -> bool:
  """Returns True if the avatar comes near enough to a meter to touch it.

  A meter is a thing in the world: an agent that pushes its blocks feels their
  positions, which is not a leak of the data channel.
  """
  env = case.load()
  meters = env.mechanism.design.names('meter')
  blocks = [b for n in meters for b in env.mechanism.registers[n].blocks]
  env.reset()
  nearest = np.inf
  for action in pairs.walk(pairs.view_of(env).action_spec(), case):
    env.step(action)
    avatar = env.task.avatar.position(env.physics)
    for block in blocks:
      way = np.array(block.position(env.physics))[..., :2] - avatar
      nearest = min(nearest, float(np.linalg.norm(way, axis=-1).min()))
  env.close()
  return nearest < _REACH


def _pairs(
    seed: int, kinds: tuple[str, ...]
) -> Iterator[tuple[str, pairs.Case, tuple[str, ...]]]:
  """Yields secrets and cases without end, seed by seed."""
  for shift in itertools.count():
    for is_batch in (False, True):
      for name, secret in secrets.SECRETS.items():
        if name.startswith(kinds):
          for case, leave_out in pairs.cases_for(
              secret, seed + shift, is_batch
          ):
            yield name, case, leave_out


def contract_complaints(cases: list[pairs.Case]) -> tuple[int, list[str]]:
  """Returns the number of cases that keep the contract, and the violations."""
  found = [
      f'{case.domain}.{case.variation} {case.design}: {complaint}'
      for case in cases
      for complaint in contract.complaints(case)[:3]
  ]
  return len(cases) - len({text.partition(':')[0] for text in found}), found


class Interleaving(NamedTuple):
  """Comparison of worlds that are stepped in turns with each one alone."""

  num_differing: int
  num_global_changes: int


def interleave(schedules: int, seed: int) -> Interleaving:
  """Steps four worlds in a shuffled order, again and again."""
  cases = [
      pairs.Case(domain, variation, design, seed + i, 0, _STEPS_INTERLEAVED, 9)
      for i, (domain, variation, design) in enumerate(
          (
              ('collect_apples', 'standard', 'instantaneous_reward'),
              ('collect_apples', 'standard', 'instantaneous_reward'),
              ('unlock_door', 'near', 'online_imitation'),
              ('unlock_door', 'far', 'value_advice'),
          )
      )
  ]
  envs = [case.load() for case in cases]
  views = [pairs.view_of(env) for env in envs]
  actions = [
      pairs.walk(view.action_spec(), case)
      for view, case in zip(views, cases, strict=True)
  ]

  def run(order: list[int]) -> list[list[bytes]]:
    for env in envs:
      env.rewind()
    told: list[list[bytes]] = [[] for _ in envs]
    for which in order:
      action = actions[which][len(told[which])]
      told[which].append(pairs.encode(views[which].step(action)))
    return told

  turns = [i for i in range(_INTERLEAVED) for _ in range(_STEPS_INTERLEAVED)]
  before = pairs._global_generators()
  alone = run(turns)
  generator = np.random.default_rng(seed)
  num_differing = num_changes = 0
  for _ in range(schedules):
    told = run(list(generator.permutation(turns)))
    num_differing += sum(
        one != other for one, other in zip(alone, told, strict=True)
    )
    after = pairs._global_generators()
    num_changes += before != after
    before = after
  for env in envs:
    env.close()
  return Interleaving(num_differing, num_changes)


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  printed = []

  def lines(campaign: str) -> figure_lines.Lines:
    printed.append(figure_lines.Lines(campaign, seed))
    return printed[-1]

  def some(number: int) -> int:
    return max(4, int(scale * number))

  cases = [*contract.all_cases(), *contract.all_cases(num_envs=2)]
  cases = cases[:: max(1, round(1 / scale))]
  good, found = contract_complaints(cases)
  _explain(found)
  lines('C01').at_least(f'cases of {len(cases)}', good, len(cases))

  counts = play_pairs(some(OBSERVER_PAIRS), seed, ('observer',))
  lines('C05').at_most(
      f'differing of {counts.num_pairs} pairs', counts.num_differing, 0
  )

  schedules = some(SCHEDULES)
  interleaving = interleave(schedules, seed)
  c06 = lines('C06')
  c06.at_most(
      f'differing worlds in {schedules} schedules',
      interleaving.num_differing,
      0,
  )
  c06.at_most(
      'changes of global generators', interleaving.num_global_changes, 0
  )

  counts = play_pairs(some(PAIRS), seed, ('reward', 'meter', 'random'))
  c08 = lines('C08')
  c08.at_most(f'differing of {counts.num_pairs} pairs', counts.num_differing, 0)
  c08.at_most('of which the evaluator heard nothing', counts.num_silent, 0)

  found = [
      complaint
      for case in contract.all_cases()[:: max(1, round(1 / scale))]
      for complaint in contract.enabling_everything(case)
  ]
  _explain(found)
  lines('C11').at_most('keys outside the allowlist', len(found), 0)

  c12 = lines('C12')
  for num_envs in (0, 2):
    case = pairs.Case(num_envs=num_envs, steps=3)
    public = walk.find(case)
    _explain(public)
    c12.at_most(f'secrets by public names, view {num_envs}', len(public), 0)

  scanned = failures.scan(max(1, round(scale * 2)), seed)
  _explain(scanned.found)
  c17 = lines('C17')
  c17.at_most(
      f'hits in {scanned.num_failures} failures of {scanned.num_kinds} kinds',
      len(scanned.found),
      0,
  )
  c17.at_least('failures', scanned.num_failures, min(1.0, scale) * FAILURES)
  return sum(line.num_missed for line in printed)


def _explain(texts: list[str]) -> None:
  for text in texts[:10]:
    print(f'# {text:.200}')


if __name__ == '__main__':
  # The walk touches deprecated attributes of other packages.
  warnings.simplefilter('ignore', DeprecationWarning)
  figure_lines.run(main)
