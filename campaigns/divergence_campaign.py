"""Campaign C33: a failure of the physics ends only its own episode.

Run from the root of the repository, about five minutes on one processor:

    python -m campaigns.divergence_campaign

Each of five failures is provoked at 200 random substeps, in a single world and
in one world of a batch: nan in positions, velocities, forces and controls, and
too many contacts. The episode has to end as invalid in the same control step,
with the last valid observation, and the next one has to equal that of an
environment without a failure. Arguments: a scale for the number of failures,
and a seed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import dm_env
import mujoco
import numpy as np

from campaigns import figure_lines
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from tests import worlds
from tests.engine import helpers

DRILLS = 200
KINDS = ('BADQPOS', 'BADQVEL', 'BADQACC', 'BADCTRL', 'CONTACTFULL')
NUM_ENVS = 3
_STEPS_BEFORE = 12
_STEPS_AFTER = 5
_DOMAIN, _TASK, _DESIGN = 'unlock_door', 'near', 'value_advice'
_AWFUL = (float('nan'), float('inf'), -float('inf'), 1e15)


class Result(NamedTuple):
  """Counts of failures.

  Attributes:
    num_drills: All failures.
    num_flagged: Failures that ended their episode as diverged, in that step.
    num_censored: Failures whose episode is invalid in the ledger.
    num_stale: Failures after which the agent received its last observation and
      discount 1.
    num_mid_after: Failures that were not followed by FIRST.
    num_clean: Failures that were followed by the episode of a clean
      environment, bit for bit.
    num_harmed: Failures that changed another world of the batch.
  """

  num_drills: int = 0
  num_flagged: int = 0
  num_censored: int = 0
  num_stale: int = 0
  num_mid_after: int = 0
  num_clean: int = 0
  num_harmed: int = 0

  def plus(self, other: 'Result') -> 'Result':
    """Returns both together."""
    return Result(*(a + b for a, b in zip(self, other, strict=True)))


class Drill(NamedTuple):
  """One failure.

  Attributes:
    kind: One of `KINDS`.
    step: Control step.
    substep: Substep before which it happens; after the last one if that is
      larger than their number.
    value: Value to write.
    index: Index to write to, modulo the number of values.
    world: World of a batch.
  """

  kind: str
  step: int
  substep: int
  value: float
  index: int
  world: int


def draw(kind: str, num_substeps: int, rng: np.random.Generator) -> Drill:
  """Draws a failure."""
  # Forces and controls have no effect after the last substep.
  latest = num_substeps + (kind in ('BADQPOS', 'BADQVEL', 'CONTACTFULL'))
  return Drill(
      kind,
      int(rng.integers(0, _STEPS_BEFORE)),
      int(rng.integers(0, latest)),
      float(rng.choice(_AWFUL)),
      int(rng.integers(0, 1_000)),
      int(rng.integers(0, NUM_ENVS)),
  )


def inject(
    advance: Callable[[int], None],
    substep: int,
    num_substeps: int,
    strike: Callable[[], None],
) -> Callable[[int], None]:
  """Returns an `advance` that breaks the physics once, before a substep.

  Args:
    advance: Original method of the physics.
    substep: Substep of the next control step.
    num_substeps: Number of substeps in a control step.
    strike: Breaks the physics.
  """
  done, has_struck = 0, False

  def advance_and_strike(number: int) -> None:
    nonlocal done, has_struck
    before = substep - done
    if has_struck or not 0 <= before < number:
      advance(number)
    else:
      if before:
        advance(before)
      strike()
      has_struck = True
      advance(number - before)
    done += number
    if not has_struck and done == num_substeps == substep:
      strike()
      has_struck = True

  return advance_and_strike


def _strike(drill: Drill, fields: Callable[[str], Any], warn: Any) -> None:
  """Breaks one world; `fields` finds its arrays."""
  if drill.kind == 'CONTACTFULL':
    # Too many contacts: MuJoCo drops some, and counts a warning.
    warn(int(mujoco.mjtWarning.mjWARN_CONTACTFULL))
    return
  name, value = {
      'BADQPOS': ('qpos', drill.value),
      'BADQVEL': ('qvel', drill.value),
      'BADQACC': ('qvel', 9e9),
      # MuJoCo clamps all other values.
      'BADCTRL': ('ctrl', float('nan')),
  }[drill.kind]
  array = fields(name)
  if drill.kind == 'BADQACC':
    # Finite, and too large for any solver.
    fields('qfrc_applied')[drill.index % array.size] = 1e30
    return
  array[drill.index % array.size] = value


def _load_single(seed: int, world: int = 0) -> Any:
  return suite.load(
      _DOMAIN, _TASK, {'random': seed}, {'world': world}, design=_DESIGN
  )


def _load_batch(seed: int) -> Any:
  return suite.load_batch(
      _DOMAIN, _TASK, {'random': seed}, num_envs=NUM_ENVS, design=_DESIGN
  )


def drill_single(drill: Drill, seed: int, env: Any, clean: Any) -> Result:
  """Breaks a single world, which continues like a clean one."""
  env.rewind(0)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  actions = helpers.random_actions(env, 40, seed)
  last = env.reset()
  for action in actions[: drill.step]:
    last = env.step(action)
  physics = env.thin_physics
  data = physics.data.ptr

  def warn(kind: int) -> None:
    data.warning[kind].number = 1

  physics.advance = inject(
      physics.advance,
      drill.substep,
      env.num_substeps,
      lambda: _strike(drill, lambda name: getattr(data, name), warn),
  )
  found = env.step(actions[drill.step])
  del physics.advance
  flagged = found.last() and ledger.last.end is events.End.DIVERGENCE
  stale = found.discount == 1.0 and all(
      value.tobytes() == last.observation[name].tobytes()
      for name, value in found.observation.items()
  )
  censored = flagged and not ledger.last.is_valid
  clean.rewind(1)
  afterwards, is_clean = [], True
  for action in actions[-_STEPS_AFTER:]:
    afterwards.append(env.step(action))
    expected = clean.step(action)
    is_clean &= helpers.to_bytes(afterwards[-1]) == helpers.to_bytes(expected)
    is_clean &= worlds.state_bytes(env.physics) == worlds.state_bytes(
        clean.physics
    )
  env.remove_sink(ledger)
  return Result(
      1, flagged, censored, stale, not afterwards[0].first(), is_clean
  )


def drill_batch(
    drill: Drill, seed: int, batch: Any, twin: Any, clean: Any
) -> Result:
  """Breaks one world of a batch; the others continue like its twin."""
  for each in (batch, twin):
    each._episodes[:] = -1  # A batch has no `rewind`.
  ledger = ledgers.BatchLedger()
  batch.add_sink(ledger)
  actions = [
      np.stack([action] * NUM_ENVS)
      for action in helpers.random_actions(clean, 40, seed)
  ]
  last, _ = batch.reset(), twin.reset()
  for action in actions[: drill.step]:
    last = batch.step(action)
    twin.step(action)
  physics, world = batch.physics, drill.world

  def warn(kind: int) -> None:
    physics._batch.warning[world, kind, 1] = 1

  physics.advance = inject(
      physics.advance,
      drill.substep,
      clean.num_substeps,
      lambda: _strike(drill, lambda n: physics._batch.bind(n)[world], warn),
  )
  found = batch.step(actions[drill.step])
  del physics.advance
  episode = ledger.episodes(world)[-1]
  flagged = (
      found.step_type[world] == dm_env.StepType.LAST
      and episode.end is events.End.DIVERGENCE
  )
  stale = found.discount[world] == 1.0 and all(
      value[world].tobytes() == last.observation[name][world].tobytes()
      for name, value in found.observation.items()
  )
  censored = flagged and not episode.is_valid
  others = [i for i in range(NUM_ENVS) if i != world]
  harmed = _differs(found, twin.step(actions[drill.step]), others)
  clean.rewind(1)
  is_mid, is_clean = False, True
  for i, action in enumerate(actions[-_STEPS_AFTER:]):
    found, expected = batch.step(action), clean.step(action[0])
    is_mid |= i == 0 and found.step_type[world] != dm_env.StepType.FIRST
    is_clean &= found.step_type[world] == expected.step_type and all(
        value.tobytes() == found.observation[name][world].tobytes()
        for name, value in expected.observation.items()
    )
    is_clean &= physics.state[world].tobytes() == worlds.state_bytes(
        clean.physics
    )
    harmed |= _differs(found, twin.step(action), others)
    harmed |= bool((physics.state[others] != twin.physics.state[others]).any())
  batch.remove_sink(ledger)
  return Result(1, flagged, censored, stale, is_mid, is_clean, harmed)


def _differs(found: Any, expected: Any, places: list[int]) -> bool:
  return any(
      value[places].tobytes() != found.observation[name][places].tobytes()
      for name, value in expected.observation.items()
  ) or bool((found.step_type[places] != expected.step_type[places]).any())


def run(kind: str, number: int, seed: int, *, in_batch: bool) -> Result:
  """Returns the counts of failures of one kind."""
  rng = np.random.default_rng((seed, KINDS.index(kind)))
  clean = [_load_single(seed, world) for world in range(NUM_ENVS)]
  env, *batches = _load_single(seed), _load_batch(seed), _load_batch(seed)
  total = Result()
  for i in range(number):
    drill = draw(kind, env.num_substeps, rng)
    if in_batch:
      found = drill_batch(drill, seed + i, *batches, clean[drill.world])
    else:
      found = drill_single(drill, seed + i, env, clean[0])
    total = total.plus(Result(*map(int, found)))
  for each in (env, *batches, *clean):
    each.close()
  return total


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  number = max(1, int(DRILLS * scale))
  report = figure_lines.Lines('C33', seed)
  for in_batch in (False, True):
    where = 'batch' if in_batch else 'single'
    for kind in KINDS:
      found = run(kind, number, seed, in_batch=in_batch)
      name = f'{where} {kind}:'
      report.at_least(f'{name} failures', found.num_drills, number)
      report.at_least(f'{name} flagged invalid', found.num_flagged, number)
      report.at_least(f'{name} ledger censored', found.num_censored, number)
      report.at_least(f'{name} last valid observation', found.num_stale, number)
      report.at_most(f'{name} MID after error', found.num_mid_after, 0)
      report.at_least(f'{name} next reset clean', found.num_clean, number)
      report.at_most(f'{name} other worlds harmed', found.num_harmed, 0)
  return report.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
